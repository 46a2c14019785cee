"""The verbs that take a gain set further: run it on data, hand it on, show it."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, TextIO

from obsynth.cli.output import print_json
from obsynth.errors import SpecError, VerificationError

if TYPE_CHECKING:
    from obsynth.data.run import DataRun

STREAM = "-"


def run_run(options: argparse.Namespace) -> int:
    """Run ``run``: gain set and data in, estimates out.

    Parameters
    ----------
    options : argparse.Namespace
        ``gains``, ``data``, ``out``, ``map``, ``scale``, ``threshold``, ``gap``, ``warm_up``, ``state``, ``json``,
        ``quiet``.

    Returns
    -------
    int
        0; every failure is an error.

    Raises
    ------
    SpecError
        The gain set, the data or an option is malformed; no file is written then.
    """
    from obsynth.results.serialise import load

    out = _target(options)
    if options.json and out is sys.stdout:
        raise SpecError("--json and the estimates cannot both go to stdout: give --out a file.", path="--json")
    design = load(options.gains)
    from obsynth.data.run import run_on_data

    with _rows_done(quiet=options.quiet or out is sys.stdout) as progress:
        found = run_on_data(
            design, sys.stdin if options.data == STREAM else Path(options.data), out,
            columns=dict(options.map), scales=_numbers(options.scale), thresholds=_numbers(options.threshold),
            gap=options.gap, warm_up=options.warm_up, state=options.state, progress=progress,
        )  # fmt: skip
    for text in found.warnings:
        print(f"Warning: {text}", file=sys.stderr)
    if options.json:
        print_json({"command": "run", "gains": str(options.gains), "file": str(out), **found.as_dict()})
    elif not options.quiet:
        # The estimates themselves may be on stdout.
        print(_summary(found), file=sys.stderr if out is sys.stdout else sys.stdout)
    return 0


def run_export(options: argparse.Namespace) -> int:
    """Run ``export``: gain set in, file for another program out.

    Parameters
    ----------
    options : argparse.Namespace
        ``gains``, ``to``, ``sample_time``, ``json``.

    Returns
    -------
    int
        0; every failure is an error.

    Raises
    ------
    SpecError
        The gain set is malformed or recursive, or the file cannot be written.
    """
    from obsynth.exporting.files import export
    from obsynth.results.serialise import load

    design = load(options.gains)
    files = export(design, options.to, sample_time=options.sample_time)
    if options.json:
        print_json({"command": "export", "gains": str(options.gains), "files": [str(file) for file in files]})
    else:
        print(f"Written: {', '.join(map(str, files))}")
    return 0


def run_report(options: argparse.Namespace) -> int:
    """Run ``report``: gain set in, verified again, one HTML page out.

    Parameters
    ----------
    options : argparse.Namespace
        ``gains``, ``out``, ``system``, ``json``.

    Returns
    -------
    int
        0 if every check holds, else 6; the page is written in either case, and says so.

    Raises
    ------
    SpecError
        The gain set or the spec is malformed, the scenario does not fit the plant, or the page cannot be written.
    """
    from obsynth.results.serialise import load
    from obsynth.verification import verify

    if options.out.resolve() == options.gains.resolve():
        raise SpecError(f"--out and --gains are the same file {options.out}: give another one.", path=str(options.out))
    design = load(options.gains)
    report = verify(design)
    from obsynth.cli.simulating import required_scenario
    from obsynth.report.page import html_report
    from obsynth.spec import load_spec

    scenario = None if options.system is None else required_scenario(load_spec(options.system))
    system = None if options.system is None else str(options.system)
    file = html_report(
        design, options.out, report=report, gains_file=options.gains.name, scenario=scenario, system_file=system
    )
    if options.json:
        print_json({"command": "report", "gains": str(options.gains), "file": str(file), "passed": report.passed})
    else:
        print(f"Written: {file}")
    return 0 if report.passed else VerificationError.exit_code


def _target(options: argparse.Namespace) -> Path | TextIO:
    wanted: str = options.out
    if wanted == STREAM:
        return sys.stdout
    target = Path(wanted)
    for name in ("data", "gains", "state"):
        other = getattr(options, name)
        if other is None or other == STREAM:
            continue
        if target.resolve() == Path(other).resolve():
            raise SpecError(f"--out and --{name} are the same file {target}: give another one.", path=str(target))
    return target


def _numbers(pairs: list[tuple[str, str]]) -> Mapping[str, float]:
    found = {}
    for name, text in pairs:
        try:
            found[name] = float(text)
        except ValueError:
            raise SpecError(f"{name}={text}: {text!r} is no number.", path=name) from None
    return found


def _summary(found: DataRun) -> str:
    counts = ", ".join(f"{count} {status}" for status, count in found.statuses.items())
    lines = [f"{found.rows} rows: {counts}."]
    lines += [f"Alarm: {name} first above its threshold at {time:g} s." for name, time in found.alarms.items()]
    return "\n".join(lines)


@contextmanager
def _rows_done(*, quiet: bool) -> Iterator[Callable[[int], None] | None]:
    """Show on a terminal how many rows are done."""
    if quiet or not sys.stderr.isatty():
        yield None
        return
    from rich.console import Console
    from rich.text import Text

    with Console(stderr=True).status(Text("reading")) as status:
        yield lambda rows: status.update(Text(f"{rows} rows done"))
