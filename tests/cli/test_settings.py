"""Rare arguments: ``--set NAME=VALUE``, or as an option of their own, and listed at the end of the help."""

from __future__ import annotations

import argparse

import pytest

from obsynth.cli.main import VERBS, main, obsynth_parser
from obsynth.report.terminal.arguments import read_settings, settings_of


def read(*line: str) -> argparse.Namespace:
    options, rest = obsynth_parser().parse_known_args(line)
    assert read_settings("obsynth", VERBS[options.verb].arguments, options, rest) == []
    return options


RUN = ("run", "--gains", "g.json", "--data", "log.csv")


def test_a_setting_is_the_option_of_its_name() -> None:
    by_set = read(*RUN, "--set", "noise_bound=4", "--set", "disturbance=d1=0.5", "--set", "disturbance=d[a=b]=2")
    by_name = read(*RUN, "--noise-bound", "4", "--disturbance", "d1=0.5", "--disturbance", "d[a=b]=2")
    assert by_set.noise_bound == by_name.noise_bound == 4.0
    assert by_set.disturbance == by_name.disturbance == [("d1", "0.5"), ("d[a=b]", "2")]
    assert (by_set.window, by_set.gap) == (None, None)


def test_a_flag_is_true_or_false() -> None:
    assert read("linearise", "--system", "s.yaml", "--set", "drift=true").drift
    assert not read("linearise", "--system", "s.yaml", "--set", "drift=false").drift


@pytest.mark.parametrize("wrong", ["polarity=1", "window=x", "window"])
def test_what_is_no_setting_is_refused(wrong: str, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as ended:
        main([*RUN, "--set", wrong])
    assert ended.value.code == 2
    assert wrong.partition("=")[0] in capsys.readouterr().err


@pytest.mark.parametrize("verb", VERBS)
def test_the_help_lists_every_setting(verb: str, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit):
        main([verb, "--help"])
    told = capsys.readouterr().out
    for argument in settings_of(VERBS[verb].arguments):
        assert f"  {argument.names[0].removeprefix('--')}=" in told


def test_the_options_are_few() -> None:
    """What is rare is a setting: the options of all verbs together stay readable."""
    parsers = next(action for action in obsynth_parser()._actions if isinstance(action, argparse._SubParsersAction))
    counts = {name: len(parser._actions) - 1 for name, parser in parsers.choices.items()}
    assert sum(counts.values()) <= 132
    assert max(counts.values()) <= 16


@pytest.mark.parametrize("verb", ["run", "sweep", "evaluate"])
def test_help_is_folded_to_the_terminal(
    verb: str, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("COLUMNS", "72")
    with pytest.raises(SystemExit):
        main([verb, "--help"])
    lines = capsys.readouterr().out.splitlines()
    assert max(map(len, lines)) <= 72
    if verb == "run":
        # What follows the first line of an item hangs below its text.
        place = lines.index("  gap         a sample is missing: fault estimates are held, the plant")
        assert lines[place + 1] == "              model replaces the sensors, no alarms"
