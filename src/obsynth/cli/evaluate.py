"""The verb ``evaluate``: a spec's design on the spec's scenario, many times."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING, Any

from obsynth.cli.arguments import add_json, add_quiet, add_system
from obsynth.cli.data_arguments import add_monitor_arguments
from obsynth.cli.output import print_json, progress, stdout_console
from obsynth.cli.simulate import required_scenario
from obsynth.cli.sweep import chosen_executor

if TYPE_CHECKING:
    from obsynth.experiments.monitors.monitor import Monitor
    from obsynth.observers.decisions import ParameterMonitor

_EVALUATE = "Design an observer from a spec, run the spec's scenario many times, and count alarms, delays and errors."


def add_evaluate_verb(verbs: Any) -> None:
    """Add the parser."""
    evaluate = verbs.add_parser("evaluate", help=_EVALUATE, description=_EVALUATE)
    add_system(evaluate)
    evaluate.add_argument(
        "--gains", type=Path, metavar="FILE", help="a gain set for the spec's plant: nothing is designed"
    )
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
    add_monitor_arguments(evaluate)
    add_json(evaluate)
    add_quiet(evaluate)
    evaluate.set_defaults(verb="evaluate")


def run_evaluate(options: argparse.Namespace) -> int:
    """Run ``evaluate``: spec in, table of rates and errors out."""
    from obsynth.cli.commands import designed_or_loaded
    from obsynth.cli.data_run import numbers_of, own_tolerances, ranges_of
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
    from obsynth.report.evaluation import described, evaluation_report, final_threshold

    if options.json:
        told: dict[str, Any] | None = None
        if watched is not None:
            kind, statement = described(watched)
            told = {"kind": kind, "statement": statement, "final_threshold": final_threshold(watched)}
        print_json({"command": "evaluate", "spec": str(spec.path), "monitor": told, **found.as_dict()})
        return 0
    evaluation_report(design.name, found, monitor=watched, console=stdout_console(), units=design.plant.units)
    return 0
