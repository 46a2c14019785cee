"""The verbs that run a scenario: ``simulate``, ``evaluate``, and ``compare``, which does so for every method."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING, Any

from obsynth.errors import PreconditionError, SpecError
from obsynth.files.outputs import write_atomically
from obsynth.monitoring.thresholds.options import CHANGE, FALSE_ALARMS, PARAMETER_OPTIONS, refuse_idle
from obsynth.monitoring.verbs.arguments import MONITOR_NAMES, stated_settings
from obsynth.monitoring.verbs.data_arguments import monitor_settings, stated_delay
from obsynth.plants.transformations.delays import linear_plant
from obsynth.report.terminal.arguments import columns_of, flag_of, numbers_of, refuse_given
from obsynth.report.terminal.output import emit, output_file, stdout_console
from obsynth.report.terminal.pictures import picture_kind, written_picture
from obsynth.report.terminal.specs import prepared
from obsynth.report.terminal.stages import progress
from obsynth.results.certificate_files import RESULT_FILE
from obsynth.studies.verbs.sweeps import chosen_executor

if TYPE_CHECKING:
    from obsynth.monitoring.thresholds.monitor import Monitor
    from obsynth.monitoring.thresholds.parameter_decisions import ParameterMonitor
    from obsynth.results.design import ObserverDesign
    from obsynth.simulation.scenario import Scenario

#: Said of runs of which only the seeds differ, where nothing is drawn.
_ALL_ALIKE = (
    "All runs are the same, as the scenario has neither noise nor a random signal: one run says as much, and the "
    "intervals have no meaning."
)


def _run_tolerances(options: argparse.Namespace) -> int:
    """Run ``evaluate --tolerances``: spec in, a table and a picture out."""
    from obsynth.studies.tolerance_study import tolerance_study

    if options.monitor not in (None, "pointwise"):
        raise SpecError("--tolerances compares two pointwise monitors: leave out --monitor.", path="--tolerances")
    unused = (
        "plants",
        "confidence",
        "jobs",
        "initial_error",
        "initial",
        "false_alarms",
        "window",
        "change",
        "disturbance_course",
    )
    refuse_given(options, unused, "one monitor on many runs, and --tolerances compares two on plants that it draws")
    with progress(quiet=options.quiet) as report_stage:
        kind = None if options.out is None else RESULT_FILE if _is_json(options.out) else picture_kind(options.out)
        spec, scenario, target, design = prepared(options, report_stage, kind)

        study = tolerance_study(
            design,
            scenario,
            tolerances=[_tolerance(item) for item in options.tolerances.split(",")],
            runs=options.runs,
            disturbance_bounds=numbers_of(options.disturbance) or None,
            noise_bound=options.noise_bound,
            progress=report_stage,
        )
    if target is not None and _is_json(target):
        study.save(target)
    elif target is not None:
        from obsynth.studies.plots.tolerances import plot_tolerances

        written_picture(target, 2, lambda axes: plot_tolerances(study, axes=axes))
    emit(
        options,
        {"spec": spec.path, "file": target, "statement": study.statement, **study.as_dict()},
        f"{study}\n{study.statement}",
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
    from obsynth.studies.evaluate import evaluate
    from obsynth.studies.tables import evaluation_report

    if options.tolerances is not None:
        return _run_tolerances(options)
    refuse_given(options, ("out", "force"), "the picture or certificate of --tolerances")
    if options.monitor is None:
        refuse_given(options, MONITOR_NAMES, "a monitor: name it with --monitor")
    with progress(quiet=options.quiet) as report_stage:
        spec, scenario, _, design = prepared(options, report_stage)
        report_stage("running")
        watched = _chosen_monitor(options, design, scenario)
        with chosen_executor(options.jobs, None) as executor:
            evaluation = evaluate(
                design,
                scenario,
                runs=options.runs,
                monitor=watched,
                executor=executor,
                progress=lambda done, total: report_stage(f"{done} of {total} runs"),
                plants=options.plants,
                **({} if options.confidence is None else {"confidence": options.confidence}),
            )
    least_data, sentences = _least_thresholds(design, scenario)
    if options.plants is None and evaluation.runs > 1 and not scenario.is_random:
        sentences = [_ALL_ALIKE, *sentences]
    emit(
        options,
        {
            "spec": spec.path,
            "monitor": _monitor_data(watched),
            "least_thresholds": least_data,
            **evaluation.as_dict(),
        },
        lambda: evaluation_report(
            design.name,
            evaluation,
            monitor=watched,
            console=stdout_console(),
            units=design.plant.units,
            beside=sentences,
        ),
    )
    return 0


def _chosen_monitor(
    options: argparse.Namespace, design: ObserverDesign, scenario: Scenario
) -> Monitor | ParameterMonitor | None:
    """Return the monitor that ``--monitor`` names, if any, as its other options set it."""
    from obsynth.monitoring.thresholds.parameter_decisions import ParameterMonitor
    from obsynth.monitoring.thresholds.residual_monitor import monitor
    from obsynth.observers.linear.observer import LinearObserver

    if options.monitor is None:
        return None
    if isinstance(design.observer, LinearObserver):
        return monitor(design, scenario, options.monitor, **monitor_settings(design, options))
    kinds = {**PARAMETER_OPTIONS, "glr": ("false_alarms",)}
    del kinds["learned"]
    if options.monitor not in kinds:
        raise SpecError(
            f"The monitor {options.monitor!r} is not for a recursive or nonlinear design: use one of "
            f"{', '.join(sorted(kinds))}.",
            path="--monitor",
        )
    refuse_idle(kinds, options.monitor, stated_settings(options), called=flag_of)
    return ParameterMonitor(
        options.monitor,
        false_alarms=options.false_alarms or FALSE_ALARMS,
        change=(options.change or CHANGE) if options.monitor == "cusum" else None,
    )


def _monitor_data(watched: Monitor | ParameterMonitor | None) -> dict[str, Any] | None:
    from obsynth.studies.tables import described, final_threshold

    if watched is None:
        return None
    kind, statement = described(watched)
    return {"kind": kind, "statement": statement, "final_threshold": final_threshold(watched)}


def _least_thresholds(design: ObserverDesign, scenario: Scenario) -> tuple[dict[str, Any], list[str]]:
    """Return each fault's bound beside the least possible one, as data and as sentences."""
    from obsynth.studies.least_thresholds import (
        design_beside_least,
        in_words,
        is_disturbed,
        is_moving,
        window_length,
    )

    least = design_beside_least(design, scenario)
    if not least:
        return {}, []
    (plant, _), units, moving = design.linear, design.plant.units, is_moving(design)
    noisy = bool(plant.Dw.any() or plant.Bw.any())
    data = {name: {"bound": bound, "least": lowest, "moving": moving} for name, (bound, lowest) in least.items()}
    settings: dict[str, Any] = {
        "disturbed": is_disturbed(design, scenario),
        "moving": moving,
        "noisy": noisy,
        "samples": window_length(plant),
    }
    sentences = [in_words(name, *pair, units.get(name, ""), **settings) for name, pair in least.items()]
    return data, sentences


def run_compare(options: argparse.Namespace) -> int:
    """Run ``compare``: spec in, table and recommendation out; 3 where no method exists."""
    from obsynth.specs.loader import load_spec
    from obsynth.studies.comparing import compare
    from obsynth.studies.comparison import COMPARISON_PAGE

    with progress(quiet=options.quiet) as report_stage:
        report_stage(f"reading {options.system}")
        spec = load_spec(options.system)
        if options.data is None:
            refuse_given(options, ("map", "scale", "time_column", "input_delay"), "a log: give --data")
        if options.out is not None:
            output_file(options.out, RESULT_FILE if _is_json(options.out) else COMPARISON_PAGE, options)
        method_options = {} if spec.method == "auto" else {spec.method: spec.options}
        rows = stated_delay(options)
        comparison = compare(
            spec.transformation or linear_plant(spec.plant),
            scenario=spec.scenario,
            options=method_options,
            sample_time=options.sample_time,
            within=options.within,
            tolerance=options.tolerance,
            runs=options.runs,
            data=options.data,
            columns=columns_of(options),
            scales=numbers_of(options.scale),
            input_delay=(spec.input_delay(spec.plant) if rows is None else rows) or 0,
            progress=report_stage,
        )
        if options.out is not None:
            report_stage(f"writing {options.out}")
            if _is_json(options.out):
                comparison.save(options.out)
            else:
                write_atomically(options.out, comparison.page())
    from obsynth.studies.tables import comparison_report

    emit(
        options,
        {"spec": spec.path, "statement": comparison.statement, **comparison.to_dict()},
        lambda: comparison_report(comparison, console=stdout_console(), file=options.out),
    )
    return 0 if comparison.recommended else PreconditionError.exit_code
