"""The verbs ``export`` and ``report``: files for other programs, and pages, from a gain set."""

from __future__ import annotations

import argparse
import sys

import obsynth
from obsynth.errors import VerificationError
from obsynth.files.outputs import require_distinct
from obsynth.report.terminal.arguments import numbers_of, refuse_given
from obsynth.report.terminal.output import emit, gains_to_hand_on, output_file, verified_again
from obsynth.report.terminal.stages import progress
from obsynth.results.certificate_files import RESULT_FILE
from obsynth.results.design import unverified_mark


def run_export(options: argparse.Namespace) -> int:
    """Run ``export``: gain set in, file for another program out."""
    from obsynth.exporting.files import export, exported_files

    design, mark = gains_to_hand_on(options.gains, unverified=options.unverified)
    for file, kind in exported_files(options.to).items():
        output_file(file, kind, options, option="--to")
    monitor = None
    if getattr(options, "normal", None) is not None:
        monitor = obsynth.online_monitor(design, "learned", normal=options.normal, unverified=options.unverified)
    files = export(
        design,
        options.to,
        sample_time=options.sample_time,
        **({} if options.fmi is None else {"fmi": options.fmi}),
        thresholds=numbers_of(options.threshold) or None,
        warm_up=options.warm_up,
        monitor=monitor,
        precision=options.precision,
        outliers=options.outliers,
        checker=options.checker,
        unverified=options.unverified,
    )
    emit(options, {"gains": options.gains, "files": files, **({"unverified": mark} if mark else {})}, mark)
    return 0


def run_report(options: argparse.Namespace) -> int:
    """Run ``report``: gain set in, verified again, one HTML page out."""
    require_distinct({"--gains": options.gains, "--system": options.system, "--out": options.out})
    if options.out.suffix.lower() == ".json":
        return _run_robustness(options)
    data = getattr(options, "data", None)
    if data is None:
        own = ("gains", "unverified", "system", "out", "force", "json", "quiet", "command")
        refuse_given(options, [name for name in vars(options) if name not in own], "a log: give --data")
    from obsynth.report.page import PAGE, html_report

    scenario = None if options.system is None else obsynth.load_spec(options.system).scenario
    system = None if options.system is None else str(options.system)
    output_file(options.out, PAGE, options)
    with progress(quiet=options.quiet) as report_stage:
        report_stage("verifying again")
        design, report = verified_again(options.gains)
    design = design if report.passed else design.replace(report=report)
    run, watched = None, None
    if data is not None:
        from obsynth.monitoring.verbs.data_arguments import monitor_of, protect_inputs, run_of

        protect_inputs(options)
        output_file(options.out, PAGE, options)
        watched = monitor_of(design, options, has_scenario=True)
        run = run_of(design, options, watched)
    with progress(quiet=options.quiet) as report_stage:
        report_stage("drawing the page")
        file = html_report(
            design,
            options.out,
            report=report,
            gains_file=str(options.gains),
            scenario=scenario,
            system_file=system,
            run=run,
            data_file=data,
            statement="" if watched is None else watched.statement,
            rows=getattr(options, "rows", None),
            command=options.command,
        )
    if mark := unverified_mark(report):
        print(f"Warning: {options.gains}: {mark}", file=sys.stderr)
    if options.system is not None and scenario is None:
        print(f"Note: {options.system} has no scenario: the page shows no simulation of one.", file=sys.stderr)
    emit(options, {"gains": options.gains, "file": file, "passed": report.passed})
    return 0 if report.passed else VerificationError.exit_code


def _run_robustness(options: argparse.Namespace) -> int:
    """Write what holds for every plant within its tolerances as a certificate."""
    refuse_given(
        options,
        [name for name in vars(options) if name not in ("gains", "out", "force", "json", "quiet", "command")],
        "the page: a certificate (.json) is of the gain set alone",
    )
    output_file(options.out, RESULT_FILE, options)
    design, _ = gains_to_hand_on(options.gains, unverified=False)
    result = obsynth.robustness(design)
    file = result.save(options.out)
    payload = {"gains": options.gains, "file": file, "statement": result.statement, **result.as_dict()}
    emit(options, payload, result.statement)
    return 0
