"""Runs on data from the command line: the run and its monitor from the arguments, and its summary."""

from __future__ import annotations

import argparse
import sys
from contextlib import closing, nullcontext
from pathlib import Path
from typing import TYPE_CHECKING, Any, TextIO

from obsynth.errors import SpecError
from obsynth.files.inputs import protect, protect_stream
from obsynth.monitoring.thresholds.options import LINEAR_OPTIONS, PARAMETER_OPTIONS, refuse_idle
from obsynth.monitoring.verbs.arguments import MONITOR_NAMES, stated_settings
from obsynth.monitoring.verbs.run_progress import health, rows_done
from obsynth.report.terminal.arguments import STREAM, columns_of, flag_of, numbers_of, refuse_given
from obsynth.report.terminal.specs import require_same_signals, required_scenario

if TYPE_CHECKING:
    from obsynth.monitoring.logs.run import DataRun
    from obsynth.monitoring.thresholds.monitor import Monitor
    from obsynth.plants.uncertainty import Uncertainty
    from obsynth.results.design import ObserverDesign


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
