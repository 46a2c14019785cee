"""The verbs that run a scenario: ``simulate``, ``evaluate``, and ``compare``, which does so for every method."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING, Any

from obsynth.cli.arguments import add_force, add_json, add_quiet, add_spec_gains, output_file, spec_verb
from obsynth.cli.data_arguments import add_monitor_arguments
from obsynth.cli.output import print_json, progress, stdout_console
from obsynth.cli.sweep import chosen_executor
from obsynth.errors import PreconditionError, SpecError
from obsynth.files.inputs import protect

if TYPE_CHECKING:
    from obsynth.experiments.monitors.monitor import Monitor
    from obsynth.observers.decisions import ParameterMonitor
    from obsynth.plants.descriptor import DescriptorSystem
    from obsynth.spec import Spec


_SIMULATE = "Design an observer from a spec, and simulate it on the spec's scenario."


def add_simulate_verb(verbs: Any) -> None:
    """Add the parser."""
    simulate = spec_verb(verbs, "simulate", _SIMULATE)
    add_spec_gains(simulate)
    simulate.add_argument("--out", type=Path, metavar="FILE", help="write every signal to this file (CSV)")
    add_json(simulate)
    add_force(simulate)
    add_quiet(simulate)


def run_simulate(options: argparse.Namespace) -> int:
    """Run ``simulate``: spec in, table of errors out, and every signal in a file if asked."""
    from obsynth.cli.commands import designed_or_loaded, spec_output
    from obsynth.cli.data_run import required_scenario
    from obsynth.experiments.simulation import SIGNALS, simulate
    from obsynth.spec import load_spec

    with progress(quiet=options.quiet) as report_stage:
        report_stage(f"reading {options.system}")
        spec = load_spec(options.system)
        scenario = required_scenario(spec)
        if options.gains is not None:
            protect(options.gains)
        target = None if options.out is None else spec_output(options.out, SIGNALS, spec, options, option="--out")
        design = designed_or_loaded(spec, options.gains, report_stage)
        report_stage("simulating")
        found = simulate(design, scenario)
        written = None if target is None else str(found.write_csv(target))
    if options.json:
        print_json({"command": "simulate", "spec": str(spec.path), "file": written, **found.summary()})
        return 0
    from obsynth.report.scenarios import simulation_report

    simulation_report(design.name, found, console=stdout_console(), units=design.plant.units, file=written)
    return 0


_EVALUATE = "Design an observer from a spec, run the spec's scenario many times, and count alarms, delays and errors."


def add_evaluate_verb(verbs: Any) -> None:
    """Add the parser."""
    evaluate = spec_verb(verbs, "evaluate", _EVALUATE)
    add_spec_gains(evaluate)
    evaluate.add_argument(
        "--runs", type=int, default=100, metavar="N", help="how many, each with its seed (default: 100)"
    )
    evaluate.add_argument(
        "--confidence", type=float, default=0.95, metavar="P", help="of the intervals (default: 0.95)"
    )
    evaluate.add_argument(
        "--plants", type=int, metavar="N", help="draw N plants from the tolerances, half of them vertices"
    )
    evaluate.add_argument("--jobs", type=int, default=1, metavar="N", help="processes (default: 1)")
    evaluate.add_argument(
        "--tolerances", metavar="LIST",
        help="instead, a fixed bound beside the adaptive threshold for these tolerances, such as 0,1%%,2%%,5%%",
    )  # fmt: skip
    evaluate.add_argument(
        "--out", type=Path, metavar="FILE", help="with --tolerances: write the picture (.png, .svg or .pdf)"
    )
    add_monitor_arguments(evaluate)
    add_json(evaluate)
    add_force(evaluate)
    add_quiet(evaluate)


def _run_tolerances(options: argparse.Namespace) -> int:
    """Run ``evaluate --tolerances``: spec in, a table and a picture out."""
    from obsynth.cli.commands import designed_or_loaded, spec_output
    from obsynth.cli.data_commands import picture_kind, written_picture
    from obsynth.cli.data_run import numbers_of, required_scenario
    from obsynth.spec import load_spec

    if options.plants is not None or options.monitor not in (None, "pointwise"):
        raise SpecError("--tolerances compares two pointwise monitors on plants that it draws itself: leave out "
                        "--plants and --monitor.", path="--tolerances")  # fmt: skip
    with progress(quiet=options.quiet) as report_stage:
        report_stage(f"reading {options.system}")
        spec = load_spec(options.system)
        scenario = required_scenario(spec)
        target = options.out
        if target is not None:
            spec_output(target, picture_kind(target), spec, options, option="--out")
        design = designed_or_loaded(spec, options.gains, report_stage)
        from obsynth.experiments.tolerance_study import tolerance_study

        found = tolerance_study(
            design, scenario, tolerances=[_tolerance(item) for item in options.tolerances.split(",")],
            runs=options.runs, disturbance_bounds=numbers_of(options.disturbance) or None,
            noise_bound=options.noise_bound, progress=report_stage,
        )  # fmt: skip
    if target is not None:
        from obsynth.plotting.trade_off import plot_tolerances

        written_picture(target, 2, lambda axes: plot_tolerances(found, axes=axes))
    if options.json:
        file = None if target is None else str(target)
        print_json({"command": "evaluate", "spec": str(spec.path), "file": file, **found.as_dict()})
        return 0
    print(found)
    if target is not None:
        print(f"Written: {target}")
    return 0


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
    if options.out is not None:
        raise SpecError("--out is for the picture of --tolerances.", path="--out")
    from obsynth.cli.commands import designed_or_loaded
    from obsynth.cli.data_run import numbers_of, own_tolerances, ranges_of, required_scenario
    from obsynth.spec import load_spec

    with progress(quiet=options.quiet) as report_stage:
        report_stage(f"reading {options.system}")
        spec = load_spec(options.system)
        scenario = required_scenario(spec)
        design = designed_or_loaded(spec, options.gains, report_stage)
        report_stage("running")
        from obsynth.experiments.monitors.residual_monitor import monitor
        from obsynth.experiments.monte_carlo import evaluate
        from obsynth.observers.decisions import ParameterMonitor
        from obsynth.observers.linear.observer import LinearObserver

        watched: Monitor | ParameterMonitor | None = None
        if options.monitor is not None and isinstance(design.observer, LinearObserver):
            watched = monitor(
                design, scenario, options.monitor, disturbance_bounds=numbers_of(options.disturbance),
                noise_bound=options.noise_bound, initial_error=options.initial_error, window=options.window,
                false_alarms=options.false_alarms, change=options.change,
                initial_set=ranges_of(options.initial) or None, constants=own_tolerances(design, options.monitor),
            )  # fmt: skip
        elif options.monitor is not None:
            watched = ParameterMonitor(options.monitor, false_alarms=options.false_alarms, change=options.change)
        with chosen_executor(options.jobs, None) as executor:
            found = evaluate(
                design, scenario, runs=options.runs, monitor=watched, executor=executor,
                progress=lambda done, total: report_stage(f"{done} of {total} runs"), confidence=options.confidence,
                plants=options.plants,
            )  # fmt: skip
    from obsynth.report.scenarios import described, evaluation_report, final_threshold

    if options.json:
        told: dict[str, Any] | None = None
        if watched is not None:
            kind, statement = described(watched)
            told = {"kind": kind, "statement": statement, "final_threshold": final_threshold(watched)}
        print_json({"command": "evaluate", "spec": str(spec.path), "monitor": told, **found.as_dict()})
        return 0
    evaluation_report(design.name, found, monitor=watched, console=stdout_console(), units=design.plant.units)
    return 0


_COMPARE = "Design by every method that exists for a spec's plant, and show them side by side on its scenario."


def add_compare_verb(verbs: Any) -> None:
    """Add the parser."""
    compare = spec_verb(verbs, "compare", _COMPARE)
    compare.add_argument("--data", type=Path, metavar="FILE", help="a log (CSV) to replay through every method")
    compare.add_argument("--out", type=Path, metavar="FILE", help="write a page (HTML) with table and picture")
    compare.add_argument("--runs", type=int, default=20, metavar="N", help="drawn runs of the scenario (default: 20)")
    compare.add_argument(
        "--tolerance", type=float, default=0.0, metavar="T", help="relative error of parameters that is drawn (0.05)"
    )
    compare.add_argument(
        "--within", type=float, metavar="SECONDS", help="90 %% of a step must be shown within this time"
    )
    compare.add_argument("--sample-time", type=float, metavar="SECONDS", help="the clock of a continuous plant")
    add_force(compare)
    add_json(compare)
    add_quiet(compare)


def run_compare(options: argparse.Namespace) -> int:
    """Run ``compare``: spec in, table and recommendation out; 3 where no method exists."""
    from obsynth.comparison.comparing import compare
    from obsynth.comparison.result import COMPARISON_PAGE
    from obsynth.files.outputs import write_atomically
    from obsynth.spec import load_spec

    with progress(quiet=options.quiet) as report_stage:
        report_stage(f"reading {options.system}")
        spec = load_spec(options.system)
        if options.out is not None:
            output_file(options.out, COMPARISON_PAGE, options)
        plant, clock = _plant_and_clock(spec, options.sample_time)
        given = {} if spec.method == "auto" else {spec.method: spec.options}
        found = compare(
            plant, scenario=spec.scenario, options=given, sample_time=clock, within=options.within,
            tolerance=options.tolerance, runs=options.runs, data=options.data, progress=report_stage,
        )  # fmt: skip
        if options.out is not None:
            report_stage(f"writing {options.out}")
            write_atomically(options.out, found.page())
    if options.json:
        print_json({"command": "compare", "spec": str(spec.path), **found.to_dict()})
    else:
        from obsynth.report.scenarios import comparison_report

        comparison_report(found, console=stdout_console(), file=options.out)
    return 0 if found.recommended else PreconditionError.exit_code


def _plant_and_clock(spec: Spec, sample_time: float | None) -> tuple[DescriptorSystem, float | None]:
    """Return the plant before it was sampled, and the clock: some methods are continuous, and so are tolerances."""
    from obsynth.plants.descriptor import DescriptorSystem

    plant = spec.plant
    if not isinstance(plant, DescriptorSystem):
        raise SpecError("compare is for linear plants with constant matrices.", path="plant")
    if spec.transformation is None:
        return plant, sample_time
    source = spec.transformation.source
    # Faults and unknown inputs are those of the plant as written.
    return source, sample_time if sample_time is not None else (plant.dt or None)
