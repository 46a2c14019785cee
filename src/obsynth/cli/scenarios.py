"""The verbs that run a scenario: ``simulate``, ``evaluate``, and ``compare``, which does so for every method."""

from __future__ import annotations

import argparse
from collections.abc import Callable
from pathlib import Path
from typing import Any

import obsynth
from obsynth.cli.arguments import MONITOR_NAMES, columns_of, flag_of, numbers_of, refuse_given, stated_settings
from obsynth.cli.commands import designed_or_loaded, spec_output
from obsynth.cli.data_commands import (
    monitor_settings,
    picture_kind,
    required_scenario,
    written_picture,
)
from obsynth.cli.output import answer, output_file, progress, stdout_console
from obsynth.cli.sweep import chosen_executor
from obsynth.errors import PreconditionError, SpecError
from obsynth.experiments.monitors.options import CHANGE, FALSE_ALARMS, PARAMETER_OPTIONS, refuse_idle
from obsynth.files.inputs import protect
from obsynth.files.outputs import FileKind, write_atomically
from obsynth.results.certificate_files import RESULT_FILE


def _prepared(
    options: argparse.Namespace, report_stage: Callable[[str], None], kind: FileKind | None = None
) -> tuple[obsynth.Spec, obsynth.Scenario, Path | None, obsynth.ObserverDesign]:
    """Return spec, scenario, where to write a file of some kind, and the design, made or loaded."""
    report_stage(f"reading {options.system}")
    spec = obsynth.load_spec(options.system)
    scenario = required_scenario(spec)
    if options.gains is not None:
        protect(options.gains)
    else:
        refuse_given(options, ("unverified",), "a gain set: give --gains, as what is designed here is verified")
    target = None if options.out is None else spec_output(options.out, kind, spec, options, option="--out")
    return spec, scenario, target, designed_or_loaded(spec, options.gains, report_stage, unverified=options.unverified)


def run_simulate(options: argparse.Namespace) -> int:
    """Run ``simulate``: spec in, table of errors out, and every signal in a file if asked."""
    with progress(quiet=options.quiet) as report_stage:
        from obsynth.experiments.simulation import SIMULATED_SIGNALS, simulate

        spec, scenario, target, design = _prepared(options, report_stage, SIMULATED_SIGNALS)
        report_stage("simulating")
        found = simulate(design, scenario)
        # A log as run reads it; a bias of a sensor is a deviation of its own.
        point = {**getattr(design.plant, "operating_point", {})}
        point = {name: value for name, value in point.items() if name not in getattr(design.plant, "sensor_faults", ())}
        written = None if target is None else str(found.write_csv(target, operating_point=point))
    from obsynth.report.scenarios import simulation_report

    answer(
        options,
        {"spec": spec.path, "file": written, **found.summary()},
        lambda: simulation_report(design.name, found, console=stdout_console(), units=design.plant.units, file=written),
    )
    return 0


def _run_tolerances(options: argparse.Namespace) -> int:
    """Run ``evaluate --tolerances``: spec in, a table and a picture out."""
    if options.monitor not in (None, "pointwise"):
        raise SpecError("--tolerances compares two pointwise monitors: leave out --monitor.", path="--tolerances")
    unused = ("plants", "confidence", "jobs", "initial_error", "initial", "false_alarms", "window", "change")
    refuse_given(options, unused, "one monitor on many runs, and --tolerances compares two on plants that it draws")
    with progress(quiet=options.quiet) as report_stage:
        kind = None if options.out is None else RESULT_FILE if _is_json(options.out) else picture_kind(options.out)
        spec, scenario, target, design = _prepared(options, report_stage, kind)

        found = obsynth.tolerance_study(
            design,
            scenario,
            tolerances=[_tolerance(item) for item in options.tolerances.split(",")],
            runs=options.runs,
            disturbance_bounds=numbers_of(options.disturbance) or None,
            noise_bound=options.noise_bound,
            progress=report_stage,
        )
    if target is not None and _is_json(target):
        found.save(target)
    elif target is not None:
        from obsynth.plotting.trade_off import plot_tolerances

        written_picture(target, 2, lambda axes: plot_tolerances(found, axes=axes))
    answer(
        options,
        {"spec": spec.path, "file": target, "statement": found.statement, **found.as_dict()},
        f"{found}\n{found.statement}",
    )
    return 0


def _is_json(path: Path) -> bool:
    return path.suffix.lower() == ".json"


def _tolerance(text: str) -> float | str:
    """Return a tolerance as a share, or as a text with its per cent."""
    try:
        return float(text)
    except ValueError:
        return text.strip()


def run_evaluate(options: argparse.Namespace) -> int:
    """Run ``evaluate``: spec in, table of rates and errors out."""
    if options.tolerances is not None:
        return _run_tolerances(options)
    refuse_given(options, ("out", "force"), "the picture or certificate of --tolerances")
    if options.monitor is None:
        refuse_given(options, MONITOR_NAMES, "a monitor: name it with --monitor")
    with progress(quiet=options.quiet) as report_stage:
        spec, scenario, _, design = _prepared(options, report_stage)
        report_stage("running")

        watched: obsynth.types.Monitor | obsynth.ParameterMonitor | None = None
        if options.monitor is not None and isinstance(design.observer, obsynth.LinearObserver):
            watched = obsynth.monitor(design, scenario, options.monitor, **monitor_settings(design, options))
        elif options.monitor is not None:
            watched = _parameter_monitor(options)
        with chosen_executor(options.jobs, None) as executor:
            found = obsynth.evaluate(
                design,
                scenario,
                runs=options.runs,
                monitor=watched,
                executor=executor,
                progress=lambda done, total: report_stage(f"{done} of {total} runs"),
                plants=options.plants,
                **({} if options.confidence is None else {"confidence": options.confidence}),
            )
    from obsynth.comparison.comparing import design_beside_least, in_words
    from obsynth.report.scenarios import described, evaluation_report, final_threshold

    least = design_beside_least(design, scenario)
    sentences = [in_words(name, *pair, design.plant.units.get(name, "")) for name, pair in least.items()]
    told: dict[str, Any] | None = None
    if watched is not None:
        kind, statement = described(watched)
        told = {"kind": kind, "statement": statement, "final_threshold": final_threshold(watched)}
    answer(
        options,
        {
            "spec": spec.path,
            "monitor": told,
            "least_thresholds": {name: {"bound": pair[0], "least": pair[1]} for name, pair in least.items()},
            **found.as_dict(),
        },
        lambda: evaluation_report(
            design.name, found, monitor=watched, console=stdout_console(), units=design.plant.units, beside=sentences
        ),
    )
    return 0


def _parameter_monitor(options: argparse.Namespace) -> obsynth.ParameterMonitor:
    """Return the decision on parameters that is asked for."""
    table = {**PARAMETER_OPTIONS, "glr": ("false_alarms",)}
    refuse_idle(table, options.monitor, stated_settings(options), called=flag_of)
    change = (options.change or CHANGE) if options.monitor == "cusum" else None
    return obsynth.ParameterMonitor(options.monitor, false_alarms=options.false_alarms or FALSE_ALARMS, change=change)


def _compared_delay(spec: obsynth.Spec, options: argparse.Namespace) -> int:
    """Return rows by which the inputs of the log act later than linear designs on samples take them."""
    if options.input_delay == "auto":
        raise SpecError("--input-delay auto is for calibrate: give a number of rows.", path="--input-delay")
    told = options.input_delay if options.input_delay is not None else spec.input_delay(spec.plant)
    return told or 0


def run_compare(options: argparse.Namespace) -> int:
    """Run ``compare``: spec in, table and recommendation out; 3 where no method exists."""
    from obsynth.comparison.comparing import COMPARISON_PAGE

    with progress(quiet=options.quiet) as report_stage:
        report_stage(f"reading {options.system}")
        spec = obsynth.load_spec(options.system)
        if options.data is None:
            refuse_given(options, ("map", "scale", "time_column", "input_delay"), "a log: give --data")
        if options.out is not None:
            output_file(options.out, RESULT_FILE if _is_json(options.out) else COMPARISON_PAGE, options)
        plant, clock = _plant_and_clock(spec, options.sample_time)
        given = {} if spec.method == "auto" else {spec.method: spec.options}
        found = obsynth.compare(
            plant,
            scenario=spec.scenario,
            options=given,
            sample_time=clock,
            within=options.within,
            tolerance=options.tolerance,
            runs=options.runs,
            data=options.data,
            columns=columns_of(options),
            scales=numbers_of(options.scale),
            input_delay=_compared_delay(spec, options),
            progress=report_stage,
        )
        if options.out is not None:
            report_stage(f"writing {options.out}")
            if _is_json(options.out):
                found.save(options.out)
            else:
                write_atomically(options.out, found.page())
    from obsynth.report.scenarios import comparison_report

    answer(
        options,
        {"spec": spec.path, "statement": found.statement, **found.to_dict()},
        lambda: comparison_report(found, console=stdout_console(), file=options.out),
    )
    return 0 if found.recommended else PreconditionError.exit_code


def _plant_and_clock(spec: obsynth.Spec, sample_time: float | None) -> tuple[obsynth.DescriptorSystem, float | None]:
    """Return the plant before it was sampled, and the clock: some methods are continuous, and so are tolerances."""
    plant = spec.plant
    if not isinstance(plant, obsynth.DescriptorSystem):
        raise SpecError(
            "compare is for linear plants with constant matrices; of a plant of equations give the linear one that its "
            "spec makes with transform: {linearise: {at: equilibrium, faults: [...]}, sample_time: ...}.",
            path="plant",
        )
    if spec.transformation is None:
        return plant, sample_time
    source = spec.transformation.source
    # Faults and unknown inputs are those of the plant as written.
    return source, sample_time if sample_time is not None else (plant.dt or None)
