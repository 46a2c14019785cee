"""A run on data from the command line: its arguments, its progress, its summary, and the proof of its alarm."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager, nullcontext
from pathlib import Path
from time import monotonic
from typing import TYPE_CHECKING, Any, TextIO

from obsynth.errors import SpecError
from obsynth.files.inputs import protect, protect_stream
from obsynth.files.tables import text_table
from obsynth.monitoring.thresholds.options import LINEAR_OPTIONS, PARAMETER_OPTIONS, WINDOW, refuse_idle
from obsynth.monitoring.verbs.arguments import MONITOR_NAMES, stated_settings
from obsynth.plants.signal_names import listed
from obsynth.report.terminal.arguments import STREAM, columns_of, flag_of, numbers_of, ranges_of, refuse_given
from obsynth.report.terminal.output import output_file
from obsynth.report.terminal.specs import require_same_signals, required_scenario

if TYPE_CHECKING:
    from obsynth.monitoring.alarms.proof_file import AlarmProof
    from obsynth.monitoring.logs.run import DataRun
    from obsynth.monitoring.thresholds.monitor import Monitor
    from obsynth.plants.uncertainty import Uncertainty
    from obsynth.results.design import ObserverDesign

#: Seconds between the lines in which a run on a log that grows says that it is alive.
HEALTH_SECONDS = 60.0

#: Rows from the alarm on at whose windows a proof is tried, in windows.
_LATER = (0.0, 0.1, 0.25, 0.5, 0.95)


def protect_inputs(options: argparse.Namespace) -> None:
    """Refuse to write over what is read."""
    log = None if options.data in (None, STREAM) else Path(options.data)
    for file in (options.gains, getattr(options, "system", None), log):
        if file is not None:
            protect(file)
    if options.data == STREAM:
        protect_stream(sys.stdin)


def run_of(
    design: ObserverDesign,
    options: argparse.Namespace,
    watched: Monitor | None,
    out: Path | TextIO | None = None,
    **more: Any,
) -> DataRun:
    """Return a run of a design on the data of the command line, with its table where it is not written to ``out``."""
    from obsynth.monitoring.logs.followed import FollowedLog
    from obsynth.monitoring.logs.run import run_on_data

    design = with_input_delay(design, options)
    is_quiet, is_followed = getattr(options, "quiet", True), getattr(options, "follow", None) is not None
    log: Any = sys.stdin if options.data == STREAM else Path(options.data)
    if is_followed:
        log = FollowedLog(options.follow)
    with (
        closing(log) if is_followed else nullcontext(),
        nullcontext(None if is_quiet else health())
        if is_followed
        else rows_done(options.data, quiet=is_quiet or out is sys.stdout) as progress,
    ):
        run = run_on_data(
            design,
            log,
            out,
            columns=columns_of(options),
            time_zone=options.time_zone,
            time_unit=options.time_unit,
            scales=numbers_of(options.scale),
            thresholds=numbers_of(options.threshold),
            monitor=watched,
            gap=options.gap,
            warm_up=options.warm_up,
            progress=progress,
            units_as_is=getattr(options, "units_as_is", False),
            **more,
        )
    for text in run.warnings:
        print(f"Warning: {text}", file=sys.stderr)
    return run


def health() -> Callable[[int], None]:
    """Return what says on stderr every `HEALTH_SECONDS` how many rows are done, as long as rows come."""
    begun = monotonic()
    next_time = begun

    def report_rows(rows: int) -> None:
        nonlocal next_time
        if monotonic() >= next_time:
            next_time = monotonic() + HEALTH_SECONDS
            print(f"{rows} rows in {monotonic() - begun:.0f} s.", file=sys.stderr, flush=True)

    return report_rows


def stated_delay(options: argparse.Namespace) -> int | None:
    """Return by how many rows the inputs of a log act later, as the command line says it."""
    if options.input_delay == "auto":
        raise SpecError("--input-delay auto is for calibrate: give a number of rows.", path="--input-delay")
    rows: int | None = options.input_delay
    return rows


def with_input_delay(design: ObserverDesign, options: argparse.Namespace) -> ObserverDesign:
    """Return a design for a log whose inputs act as many rows later as the command line says."""
    rows = stated_delay(options)
    return design if rows is None else design.replace(input_delay=rows)


def own_tolerances(design: ObserverDesign, kind: str | None) -> Uncertainty | None:
    """Return the tolerances of a design's plant, which its pointwise threshold holds for."""
    from obsynth.observers.linear.observer import LinearObserver
    from obsynth.plants.descriptor import DescriptorSystem

    # Continuous designs with known inputs must be asked for it: the inputs have to be held between rows.

    plant = design.plant
    if design.method == "guaranteed-test" and not design.observer.state_names:
        # Nothing beside the test follows the state: its threshold is that of an exact model, and says so.
        return None
    if kind != "pointwise" or not isinstance(plant, DescriptorSystem) or (plant.nu and not plant.is_discrete):
        return None
    own = plant.uncertainty if isinstance(design.observer, LinearObserver) else None
    # Constants without a tolerance leave nothing to adapt to: the model is exact.
    return own if own is not None and own.box.names else None


def monitor_settings(design: ObserverDesign, options: argparse.Namespace) -> dict[str, Any]:
    """Return what the monitor of a design that is asked for is made of, by the names of the arguments of
    `obsynth.monitor`."""
    from obsynth.observers.linear.observer import LinearObserver

    table = LINEAR_OPTIONS if isinstance(design.observer, LinearObserver) else PARAMETER_OPTIONS
    stated = stated_settings(options)
    if getattr(options, "prove", None) is not None:
        del stated["window"]  # it is that of the proof
    refuse_idle(table, options.monitor, stated, called=flag_of)
    stated["constants"] = own_tolerances(design, options.monitor)
    acting = table.get(options.monitor, ())
    settings = {name: value for name, value in stated.items() if name in acting and value is not None}
    return {**settings, "unverified": options.unverified}


def monitor_of(design: ObserverDesign, options: argparse.Namespace, *, has_scenario: bool = False) -> Monitor | None:
    """Return the monitor that is asked for."""
    from obsynth.monitoring.thresholds.online_monitor import online_monitor
    from obsynth.observers.linear.observer import LinearObserver
    from obsynth.specs.loader import load_spec

    if options.monitor is None:
        of_monitors = (*(() if has_scenario else ("system",)), "sample_time", *MONITOR_NAMES)
        refuse_given(options, of_monitors, "a monitor: name it with --monitor")
        return None

    linear, scenario = isinstance(design.observer, LinearObserver), None
    if not linear:
        refuse_given(options, ("sample_time", *(() if has_scenario else ("system",))), "monitors of linear designs")
    # Of other designs, and beside thresholds that were learned, a scenario is there for the pictures alone.
    if options.system is not None and not (has_scenario and (not linear or options.monitor == "learned")):
        spec = load_spec(options.system)
        require_same_signals(design, options.gains, spec)
        scenario = required_scenario(spec)
    return online_monitor(
        design,
        options.monitor,
        scenario=scenario,
        sample_time=options.sample_time,
        **monitor_settings(design, options),
    )


def summary_of_run(run: DataRun, watched: Monitor | None) -> str:
    """Return what a run was, in a few lines."""
    from obsynth.monitoring.alarms.events import alarm_notes, alarm_rows, silence, time_in_alarm

    counts = ", ".join(f"{count} {status}" for status, count in run.statuses.items())
    lines = [f"{run.rows} rows: {counts}."]
    if run.recovered:
        states = [f"{name} ({kind.replace('needs', 'with')})" for name, kind in run.recovered.items()]
        lines.append(f"Also estimated, of the plant as written: {listed(states)}.")
    if run.outliers:
        listed_outliers = ", ".join(f"{count} of {name}" for name, count in run.outliers.items())
        count = sum(run.outliers.values())
        lines.append(f"{count} outlier{'s' if count != 1 else ''}: {listed_outliers}.")
    for name, time in run.alarms.items():
        first = next((event for event in run.events if event.by == name), None)
        clear = watched is not None and name == watched.kind and first is not None and first.clear
        fault = f" Probable fault: {first.fault}." if clear and first is not None else ""
        by = f"threshold of {name}" if name in run.thresholds else f"monitor: {name}"
        lines.append(f"First alarm {run.stamps.shown(time)} ({by}).{fault}")
    rows, more = alarm_rows(run.events, run.stamps.shown)
    table = [*(text_table(rows) if rows else []), *([f"and {more} more"] if more else [])]
    lines += [*(f"  {line}" for line in table), *alarm_notes(run.events), *time_in_alarm(run.events, run.rows)]
    if watched is not None or run.thresholds:
        lines += silence(run, watched.kind if watched else "any threshold")
    if watched is not None:
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
        task = bar.add_task("rows", total=None if data == STREAM else _rows_in(Path(data)))
        yield lambda rows: bar.update(task, completed=rows)


def _rows_in(path: Path) -> int | None:
    """Return how many rows a file of data has, about; `None` where that cannot be told without reading it whole."""
    from obsynth.monitoring.logs.sources import TEXT_SUFFIXES
    from obsynth.monitoring.logs.unpacked_logs import log_suffix

    try:
        if path.suffix.lower() == ".parquet":
            import pyarrow.parquet

            return int(pyarrow.parquet.ParquetFile(path).metadata.num_rows)
        if log_suffix(path) not in TEXT_SUFFIXES:
            return None
        with path.open("rb") as stream:
            sample = stream.read(1 << 20)
        # The rows of the beginning stand for all.
        lines = sample.count(b"\n")
        return round(path.stat().st_size / len(sample) * lines) - 1 if lines > 1 else None
    except (OSError, ImportError, ValueError):
        return None


def certificate_target(options: argparse.Namespace) -> Path | None:
    """Return where ``run --prove`` writes its certificate; refuse what cannot be proved before any work is done."""
    if options.prove is None:
        return None
    from obsynth.monitoring.alarms.proof_file import CERTIFICATE

    if options.monitor != "pointwise":
        raise SpecError("--prove is for alarms of --monitor pointwise.", path="--prove")
    if options.time_zone is not None:
        raise SpecError("--prove counts rows by stamps with a zone, or in UTC: leave --time-zone out.", path="--prove")
    if options.time_unit is not None:
        raise SpecError(
            "--prove reads the unit of the time in the log alone: call the column 'time [d]', and leave --time-unit "
            "out.",
            path="--prove",
        )
    if options.data == STREAM or options.state is not None:
        raise SpecError(
            "--prove reads the data again from their first row on: give --data a file, and no --state.", path="--prove"
        )
    return output_file(options.prove, CERTIFICATE, options, option="--prove")


def alarm_of_run(design: ObserverDesign, options: argparse.Namespace, run: DataRun, target: Path) -> dict[str, Any]:
    """Return whether the first alarm of a run is proved, in words, and the certificate's file."""
    row = run.alarm_rows.get("pointwise")
    if row is None:
        return {"proved": False, "row": None, "statement": "No alarm: there is nothing to prove.", "file": None}
    window = options.window or WINDOW
    tried = [min(row + int(share * window), run.rows) for share in _LATER]
    for last in dict.fromkeys(max(number, 2) for number in tried):
        proof = proof_of(design, options, last)
        if proof.proved:
            return {"proved": True, "row": last, "statement": proof.statement, "file": str(proof.save(target))}
    return {"proved": False, "row": row, "statement": proof.statement, "file": None}


def proof_of(design: ObserverDesign, options: argparse.Namespace, row: int, **more: Any) -> AlarmProof:
    """Return the proof, or why there is none, that the window up to a row of the data is not free of faults."""
    from obsynth.monitoring.alarms.proving import prove_alarm

    return prove_alarm(
        with_input_delay(design, options),
        Path(options.data),
        row,
        window=options.window or WINDOW,
        columns=columns_of(options),
        scales=numbers_of(options.scale),
        disturbance_bounds=numbers_of(options.disturbance),
        noise_bound=options.noise_bound,
        disturbance=options.disturbance_course or "any",
        initial_set=ranges_of(options.initial) or None,
        unverified=options.unverified,
        **more,
    )
