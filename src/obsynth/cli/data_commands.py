"""The verbs that take a gain set further: run it on data, hand it on, show it."""

from __future__ import annotations

import argparse
import sys
from collections import Counter
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, TextIO

from obsynth.cli.arguments import output_file
from obsynth.cli.output import print_json
from obsynth.errors import SpecError, VerificationError
from obsynth.files.inputs import protect, protect_stream
from obsynth.files.outputs import require_distinct

if TYPE_CHECKING:
    from obsynth.data.run import DataRun
    from obsynth.experiments.monitors.online import OnlineMonitor
    from obsynth.plants.uncertainty import Uncertainty
    from obsynth.results.design import ObserverDesign

STREAM = "-"


def run_run(options: argparse.Namespace) -> int:
    """Run ``run``: gain set and data in, estimates out."""
    from obsynth.results.gain_sets import load

    if options.json and options.out == STREAM:
        raise SpecError("--json and the estimates cannot both go to stdout: give --out a file.", path="--json")
    out = _target(options)
    design = load(options.gains)
    watched = monitor_of(design, options)
    from obsynth.data.run import run_on_data

    with rows_done(options.data, quiet=options.quiet or out is sys.stdout) as progress:
        found = run_on_data(
            design, sys.stdin if options.data == STREAM else Path(options.data), out,
            columns=dict(options.map), time_column=options.time_column, scales=numbers_of(options.scale),
            thresholds=numbers_of(options.threshold), monitor=watched, gap=options.gap, warm_up=options.warm_up,
            recovered=_recovered(options.recovered),
            outliers=options.outliers,
            state=options.state, progress=progress,
        )  # fmt: skip
    for text in found.warnings:
        print(f"Warning: {text}", file=sys.stderr)
    if options.json:
        print_json(
            {
                "command": "run",
                "gains": str(options.gains),
                "file": str(out),
                **found.as_dict(),
                "monitor": None if watched is None else {"kind": watched.kind, "statement": watched.statement},
            }
        )
    elif not options.quiet:
        # The estimates themselves may be on stdout.
        print(summary_of_run(found, watched), file=sys.stderr if out is sys.stdout else sys.stdout)
    return 0


def _recovered(names: list[str] | None) -> str | list[str] | None:
    return names[0] if names in (["all"], ["none"]) else names


def run_export(options: argparse.Namespace) -> int:
    """Run ``export``: gain set in, file for another program out."""
    from obsynth.exporting.files import export, exported_files
    from obsynth.results.gain_sets import load

    design = load(options.gains)
    for file, kind in exported_files(options.to).items():
        output_file(file, kind, options, option="--to")
    files = export(
        design, options.to, sample_time=options.sample_time, fmi=options.fmi,
        thresholds=numbers_of(options.threshold) or None, warm_up=options.warm_up,
    )  # fmt: skip
    if options.json:
        print_json({"command": "export", "gains": str(options.gains), "files": [str(file) for file in files]})
    else:
        print(f"Written: {', '.join(map(str, files))}")
    return 0


def run_report(options: argparse.Namespace) -> int:
    """Run ``report``: gain set in, verified again, one HTML page out."""
    from obsynth.methods.verifying import verify
    from obsynth.results.gain_sets import load

    require_distinct({"--gains": options.gains, "--system": options.system, "--out": options.out})
    design = load(options.gains)
    from obsynth.cli.simulate import required_scenario
    from obsynth.report.page import PAGE, html_report
    from obsynth.spec import load_spec

    scenario = None if options.system is None else required_scenario(load_spec(options.system))
    system = None if options.system is None else str(options.system)
    output_file(options.out, PAGE, options)
    report = verify(design)
    run, watched = None, None
    if options.data is not None:
        from obsynth.cli.plot import protect_inputs, run_in_memory

        protect_inputs(options)
        output_file(options.out, PAGE, options)
        run, watched = run_in_memory(design, options)
    file = html_report(
        design, options.out, report=report, gains_file=options.gains.name, scenario=scenario, system_file=system,
        run=run, data_file=options.data, statement="" if watched is None else watched.statement,
    )  # fmt: skip
    if options.json:
        print_json({"command": "report", "gains": str(options.gains), "file": str(file), "passed": report.passed})
    else:
        print(f"Written: {file}")
    return 0 if report.passed else VerificationError.exit_code


def _target(options: argparse.Namespace) -> Path | TextIO:
    """Return where estimates go; refuse a hopeless place before any work is done."""
    from obsynth.data.saved_state import STATE
    from obsynth.data.sinks import ESTIMATES
    from obsynth.data.sources import check_suffix

    named = {"--gains": options.gains, "--system": options.system, "--state": options.state}
    streams = {"--data": options.data, "--out": options.out}
    require_distinct({**named, **{name: file for name, file in streams.items() if file != STREAM}})
    for file in (options.gains, options.system, None if options.data == STREAM else Path(options.data)):
        if file is not None:
            protect(file)
    if options.data == STREAM:
        protect_stream(sys.stdin)
    if options.state is not None:
        output_file(options.state, STATE, options, option="--state")
    if options.out == STREAM:
        return sys.stdout
    target = Path(options.out)
    check_suffix(target)
    return output_file(target, ESTIMATES, options)


def numbers_of(pairs: list[tuple[str, str]]) -> Mapping[str, float]:
    """Return values by name, from arguments of the form NAME=VALUE."""
    found = {}
    for name, text in pairs:
        try:
            found[name] = float(text)
        except ValueError:
            raise SpecError(f"{name}={text}: {text!r} is no number.", path=name) from None
    return found


def own_tolerances(design: ObserverDesign, kind: str | None) -> Uncertainty | None:
    """Return the tolerances of a sampled design's plant, which its pointwise threshold holds for."""
    from obsynth.observers.linear.observer import LinearObserver
    from obsynth.plants.descriptor import DescriptorSystem

    plant = design.plant
    if kind != "pointwise" or not isinstance(plant, DescriptorSystem) or not plant.is_discrete:
        return None
    return plant.uncertainty if isinstance(design.observer, LinearObserver) else None


def ranges_of(pairs: list[tuple[str, str]]) -> dict[str, float | tuple[float, float]]:
    """Return bounds by name, from arguments of the form NAME=BOUND or NAME=LOW:HIGH."""
    found: dict[str, float | tuple[float, float]] = {}
    for name, text in pairs:
        low, colon, high = text.partition(":")
        ends = numbers_of([(name, low), (name, high)] if colon else [])
        found[name] = (numbers_of([(name, low)])[name], ends[name]) if colon else numbers_of([(name, text)])[name]
    return found


def monitor_of(
    design: ObserverDesign, options: argparse.Namespace, *, has_scenario: bool = False
) -> OnlineMonitor | None:
    """Return the monitor that is asked for."""
    if options.monitor is None:
        asked = [
            name
            for name in (*(() if has_scenario else ("system",)), "noise_bound", "initial_error", "sample_time")
            if getattr(options, name)
        ]
        asked += [name for name in ("disturbance", "nominal", "initial") if getattr(options, name)]
        if asked:
            flag = f"--{asked[0].replace('_', '-')}"
            raise SpecError(f"{flag} is for a monitor: say which one by --monitor.", path=flag)
        return None
    from obsynth.experiments.monitors.online_monitor import online_monitor

    scenario = None
    if options.system is not None:
        from obsynth.cli.commands import require_same_signals
        from obsynth.cli.simulate import required_scenario
        from obsynth.spec import load_spec

        spec = load_spec(options.system)
        require_same_signals(design, options.gains, spec)
        scenario = required_scenario(spec)
    return online_monitor(
        design, options.monitor, scenario=scenario, disturbance_bounds=numbers_of(options.disturbance),
        noise_bound=options.noise_bound, initial_error=options.initial_error, window=options.window,
        false_alarms=options.false_alarms, change=options.change, nominal=numbers_of(options.nominal),
        sample_time=options.sample_time, initial_set=ranges_of(options.initial) or None,
        constants=own_tolerances(design, options.monitor),
    )  # fmt: skip


def summary_of_run(found: DataRun, watched: OnlineMonitor | None) -> str:
    """Return what a run was, in a few lines."""
    counts = ", ".join(f"{count} {status}" for status, count in found.statuses.items())
    lines = [f"{found.rows} rows: {counts}."]
    if found.recovered:
        kinds = Counter(found.recovered.values())
        told = ", ".join(f"{count} {kind.replace('needs', 'with')}" for kind, count in kinds.items())
        lines.append(f"{len(found.recovered)} states as written recovered: {told}.")
    if found.outliers:
        told = ", ".join(f"{count} of {name}" for name, count in found.outliers.items())
        lines.append(f"{sum(found.outliers.values())} outliers: {told}.")
    for name, time in found.alarms.items():
        fault = f"; {found.isolated} stands out" if watched and name == watched.kind and found.isolated else ""
        lines.append(f"Alarm: {name} first above its threshold at {found.stamps.shown(time)}{fault}.")
    if watched is not None:
        if watched.kind not in found.alarms:
            lines.append(f"No alarm by {watched.kind}.")
            if 2 * sum(found.statuses.get(status, 0) for status in ("warm-up", "recovering")) > found.rows:
                lines.append("More than half of the rows raise none, as they are warm-up: it lasts until the slowest "
                             "mode of the observer is forgotten, or as long as --warm-up says.")  # fmt: skip
        lines.append(f"The {watched.kind} threshold: {watched.statement}.")
    return "\n".join(lines)


@contextmanager
def rows_done(data: str, *, quiet: bool) -> Iterator[Callable[[int], None] | None]:
    """Show a bar on a terminal: how many rows are done, of how many where that can be known."""
    if quiet or not sys.stderr.isatty():
        yield None
        return
    from rich.console import Console
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

    columns = (TextColumn("rows"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn())
    with Progress(*columns, console=Console(stderr=True), transient=True) as bar:
        task = bar.add_task("rows", total=None if data == STREAM else rows_in(Path(data)))
        yield lambda rows: bar.update(task, completed=rows)


def rows_in(path: Path) -> int | None:
    """Return how many rows a file of data has, about; `None` where that cannot be told without reading it whole."""
    try:
        if path.suffix.lower() == ".parquet":
            import pyarrow.parquet

            return int(pyarrow.parquet.ParquetFile(path).metadata.num_rows)
        with path.open("rb") as stream:
            sample = stream.read(1 << 20)
        # The rows of the beginning stand for all.
        lines = sample.count(b"\n")
        return round(path.stat().st_size / len(sample) * lines) - 1 if lines > 1 else None
    except (OSError, ImportError, ValueError):
        return None
