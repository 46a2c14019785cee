"""The site's own example: from a spec and a log with dates to an alarm, as the first page says."""

from __future__ import annotations

import re
import runpy
import shlex
from pathlib import Path
from types import SimpleNamespace

import pytest

import obsynth
from obsynth.cli.main import main

DOCS = Path(__file__).parents[2] / "docs"


@pytest.mark.long
def test_the_first_steps_lead_to_a_plotted_alarm(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "spec.yaml").write_text((DOCS / "examples/thermal/spec.yaml").read_text(encoding="utf-8"))
    runpy.run_path(str(DOCS / "examples/thermal/make_log.py"), run_name="__main__")
    commands = re.findall(r"^obsynth .*$", (DOCS / "start.md").read_text(encoding="utf-8"), re.MULTILINE)
    assert [command.split()[1] for command in commands] == ["check", "design", "plot"]
    for command in commands:
        assert main(shlex.split(command)[1:]) == 0
    printed = capsys.readouterr().out
    assert "0.107 W" in printed
    # The heater loses 30 W at 09:30.
    assert re.search(r"First alarm 2026-05-01T09:3.* \(threshold of fhat\[heater fault\]\)", printed)
    assert (tmp_path / "oven.png").stat().st_size > 10_000
    (tmp_path / "oven.csv").rename(tmp_path / "log.csv")
    run = obsynth.run_on_data(obsynth.load("oven.gains.json"), "log.csv", time_column="Timestamp")
    assert run.table["fhat[heater fault]"].iloc[-1] == pytest.approx(30.0, abs=0.5)


@pytest.mark.one_in(4)
@pytest.mark.parametrize(
    "page", ["motor", "tank", "circuit", "mechanism", "time_varying", "smoothing", "conditions", "region"]
)
def test_the_code_of_the_how_tos_runs(page, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    names: dict[str, object] = {}
    text = (DOCS / "howto" / f"{page}.md").read_text(encoding="utf-8")
    blocks = re.findall(r"```(?:\{shown-python\}|python)\n(.*?)```", text, re.DOTALL)
    assert blocks
    for code in blocks:
        exec(code, names)


def test_every_page_is_in_a_list():
    pages = [path for path in DOCS.rglob("*.md") if "_build" not in path.parts and "made" not in path.parts]
    trees = re.findall(
        r"```\{toctree\}(.*?)```", "".join(page.read_text(encoding="utf-8") for page in pages), re.DOTALL
    )
    listed = "".join(trees)
    assert [page.name for page in pages if page.stem != "index" and page.stem not in listed] == []


@pytest.fixture
def battery(tmp_path, monkeypatch):
    """The how-to page's files, alone in a folder."""
    monkeypatch.chdir(tmp_path)
    for name in ("spec.yaml", "log.csv"):
        (tmp_path / name).write_bytes((DOCS / "examples/battery" / name).read_bytes())
    return tmp_path


@pytest.mark.long
def test_a_stranger_with_a_thermal_plant_gets_to_an_alarm(battery, capsys):
    """Semicolons, decimal commas, dates and a column of another name; only commands that the page shows."""
    commands = re.findall(r"^obsynth .*$", (DOCS / "howto/thermal.md").read_text(encoding="utf-8"), re.MULTILINE)
    assert [command.split()[1] for command in commands] == ["check", "compare", "design", "plot"]
    for command in (command for command in commands if "compare" not in command):
        assert main(shlex.split(command)[1:]) == 0
    printed = capsys.readouterr().out
    assert "the estimate reaches 90 % after 730 s (heater fault)" in printed
    assert "First alarm 2026-01-12T07:16:00 (threshold of fhat[heater fault])." in printed
    assert (battery / "battery.png").stat().st_size > 10_000


def test_what_a_stranger_gets_wrong_is_told_with_what_was_meant(battery, capsys):
    def told(old: str, new: str, verb: str = "check") -> str:
        text = (DOCS / "examples/battery/spec.yaml").read_text(encoding="utf-8")
        assert old in text
        (battery / "spec.yaml").write_text(text.replace(old, new), encoding="utf-8")
        code = main([verb, "--system", "spec.yaml"])
        printed = capsys.readouterr()
        return f"{code} {printed.err}"

    names = told("{outputs: [cell, plate, housing]}", "{outputs: [T cell, T plate, housing]}")
    assert names.startswith("2 ")
    assert "'T cell'. Did you mean 'cell'?" in names
    assert "'T plate'. Did you mean 'plate'?" in names
    both = told("heater: 60, cell: 80,", "heating: 60, cel: 80,")
    assert "'heating', which is no signal of the plant. Did you mean 'heater'" in both
    assert "'cel', which is no signal of the plant. Did you mean 'cell'" in both
    point = told("heater: 60, cell: 80, plate: 80, housing: 20, pad: 80, ambient: -10", "heater: 60, ambient: -10")
    assert "but not cell, plate, housing" in point
    assert "rests there at cell 80, plate 80, housing 20" in point
    nothing = told("name: battery-heater", "name: battery heater\nmehtod: {}")
    assert "unknown method" not in nothing
    assert "use letters" in nothing
    assert main(["design", "--system", str(DOCS / "examples/battery/spec.yaml"), "--quiet"]) == 0
    assert main(["plot", "--gains", "battery-heater.gains.json", "--data", "log.csv", "--out", "a.png"]) == 2
    assert "If 'Zeit' is the time: --time-column Zeit" in capsys.readouterr().err


def test_no_page_names_an_audit_that_no_reader_has():
    root = DOCS.parent
    pages = [*DOCS.rglob("*.md"), root / "README.md", *root.glob("designs/*/NOTES.md"), *root.glob("notebooks/*.py")]
    found = [
        str(page) for page in pages if re.search(r"\bthe audit\b", page.read_text(encoding="utf-8"), re.IGNORECASE)
    ]
    assert found == []


@pytest.mark.long
@pytest.mark.parametrize("example", ["buck", "reactor"])
def test_a_spec_of_a_how_to_is_designed_and_simulated(example, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    spec = str(DOCS / "examples" / example / "spec.yaml")
    assert main(["design", "--system", spec, "--quiet"]) == 0
    assert "Verified" in capsys.readouterr().out
    simulate = ["simulate", "--system", spec, "--gains", f"{example}.gains.json", "--out", "log.csv", "--quiet"]
    assert main(simulate) == 0
    design = obsynth.load(f"{example}.gains.json")
    fault, size = {"buck": ("sag", 0.5), "reactor": ("UA", 3.5)}[example]
    run = obsynth.run_on_data(design, "log.csv")
    assert not [text for text in run.warnings if "begins" in text]
    assert run.table[f"fhat[{fault}]"].iloc[-1] == pytest.approx(size, rel=0.05)
    assert "examples/" + example in "".join(path.read_text(encoding="utf-8") for path in DOCS.glob("howto/*.md"))


def test_a_block_says_which_files_it_needs(monkeypatch):
    """Commands on a page ran in a folder with files of which the page said nothing."""
    pytest.importorskip("sphinx")
    monkeypatch.syspath_prepend(str(DOCS / "_ext"))
    import shown

    env = SimpleNamespace(srcdir=str(DOCS), docname="howto/tuning")
    options = {"files": "examples/thermal/* designs/drive/plant.yaml"}
    (line,) = shown._files_needed(SimpleNamespace(env=env, options=options, lineno=1))
    assert line.astext() == (
        "With make_log.py, spec.yaml from docs/examples/thermal, plant.yaml from designs/drive of the repository, "
        "copied into a folder of your own:"
    )
    assert not shown._files_needed(SimpleNamespace(env=env, options={}, lineno=1))
