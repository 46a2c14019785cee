"""The verbs that take a gain set further: run on data, proved alarms, exports, pictures and pages."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any, TextIO

import obsynth
from obsynth.cli.arguments import STREAM, numbers_of, refuse_given
from obsynth.cli.output import answer, gains_to_hand_on, output_file, print_json, verified_again
from obsynth.errors import SpecError, VerificationError
from obsynth.files.outputs import FileKind, require_distinct, write_atomically
from obsynth.monitoring.verbs.data_arguments import (
    alarm_of_run,
    certificate_target,
    monitor_of,
    proof_of,
    protect_inputs,
    required_scenario,
    run_of,
    summary_of_run,
)
from obsynth.results.certificate_files import RESULT_FILE
from obsynth.results.design import unverified_mark
from obsynth.studies.verbs.sweeps import run_many

#: Formats of pictures, with the mark by which an older one may be replaced.
PICTURES = {".png": rb"\A\x89PNG", ".svg": rb"<svg", ".pdf": rb"\A%PDF"}


def run_run(options: argparse.Namespace) -> int:
    """Run ``run``: gain set and data in, estimates out."""
    if options.gains.is_dir():
        if options.input_delay is not None:
            raise SpecError(
                "--input-delay is for one gain set: state inputs.hold in the specs of a folder.", path="--input-delay"
            )
        return run_many(options)
    for name, given in (("--jobs", options.jobs is not None), ("--cluster", options.cluster is not None)):
        if given:
            raise SpecError(
                f"{name} spreads the gain sets of a folder: {options.gains} is one gain set. Leave {name} out.",
                path=name,
            )
    if options.state is None:
        refuse_given(options, ("state_every",), "the file of --state")
    if options.json and options.out == STREAM:
        raise SpecError("--json and the estimates cannot both go to stdout: give --out a file.", path="--json")
    out = _target(options)
    certificate = certificate_target(options)
    design, mark = gains_to_hand_on(options.gains, unverified=options.unverified)
    watched = monitor_of(design, options)
    found = run_of(
        design,
        options,
        watched,
        out,
        recovered=_recovered(options.recovered),
        outliers=options.outliers,
        smooth=options.smooth,
        lag=options.lag,
        state=options.state,
        **({} if options.state_every is None else {"state_every": options.state_every}),
    )
    proof = None if certificate is None else alarm_of_run(design, options, found, certificate)
    if options.json:
        print_json(
            {
                "command": "run",
                **({} if proof is None else {"proof": proof}),
                "gains": str(options.gains),
                "file": str(out),
                **found.as_dict(),
                **({"unverified": mark} if mark else {}),
                "monitor": None if watched is None else {"kind": watched.kind, "statement": watched.statement},
            }
        )
    elif not options.quiet:
        # The estimates themselves may be on stdout.
        stream = sys.stderr if out is sys.stdout else sys.stdout
        print(*([mark] if mark else []), summary_of_run(found, watched), sep="\n", file=stream)
        if proof is not None:
            print(proof["statement"], *(["Certificate:", proof["file"]] if proof["file"] else []), file=stream)
    return 0


def _recovered(names: list[str] | None) -> str | list[str] | None:
    return names[0] if names in (["all"], ["none"]) else names


def run_export(options: argparse.Namespace) -> int:
    """Run ``export``: gain set in, file for another program out."""
    from obsynth.exporting.files import export, exported_files

    design, mark = gains_to_hand_on(options.gains, unverified=options.unverified)
    for file, kind in exported_files(options.to).items():
        output_file(file, kind, options, option="--to")
    monitor = None
    if options.normal is not None:
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
    answer(options, {"gains": options.gains, "files": files, **({"unverified": mark} if mark else {})}, mark)
    return 0


def run_prove_alarm(options: argparse.Namespace) -> int:
    """Run ``prove-alarm``: 0 whether there is a proof or not; every failure is an error."""
    from obsynth.monitoring.alarms.proof_file import CERTIFICATE

    design = obsynth.load(options.gains)  # `prove_alarm` verifies it
    target = None if options.out is None else output_file(options.out, CERTIFICATE, options)
    found = proof_of(design, options, options.row, state_bounds=numbers_of(options.state_bound) or None)
    file = str(found.save(target)) if found.proved and target is not None else None
    answer(
        options,
        {
            "gains": options.gains,
            "proved": found.proved,
            "row": found.row,
            "window": found.window,
            "margin": found.margin,
            "statement": found.statement,
            "origin": found.origin,
            "file": file,
        },
        found.statement + (f"\nCertificate: {file}" if file else ""),
    )
    return 0


def run_report(options: argparse.Namespace) -> int:
    """Run ``report``: gain set in, verified again, one HTML page out."""
    require_distinct({"--gains": options.gains, "--system": options.system, "--out": options.out})
    if options.out.suffix.lower() == ".json":
        return _run_robustness(options)
    if options.data is None:
        own = ("gains", "unverified", "system", "out", "force", "json", "command")
        refuse_given(options, [name for name in vars(options) if name not in own], "a log: give --data")
    from obsynth.report.page import PAGE, html_report

    scenario = None if options.system is None else required_scenario(obsynth.load_spec(options.system))
    system = None if options.system is None else str(options.system)
    output_file(options.out, PAGE, options)
    design, report = verified_again(options.gains)
    design = design if report.passed else design.replace(report=report)
    run, watched = None, None
    if options.data is not None:
        protect_inputs(options)
        output_file(options.out, PAGE, options)
        watched = monitor_of(design, options, has_scenario=True)
        run = run_of(design, options, watched)
    file = html_report(
        design,
        options.out,
        report=report,
        gains_file=str(options.gains),
        scenario=scenario,
        system_file=system,
        run=run,
        data_file=options.data,
        statement="" if watched is None else watched.statement,
        rows=options.rows,
        command=options.command,
    )
    if mark := unverified_mark(report):
        print(f"Warning: {options.gains}: {mark}", file=sys.stderr)
    answer(options, {"gains": options.gains, "file": file, "passed": report.passed})
    return 0 if report.passed else VerificationError.exit_code


def _run_robustness(options: argparse.Namespace) -> int:
    """Write what holds for every plant within its tolerances as a certificate."""
    refuse_given(
        options,
        [name for name in vars(options) if name not in ("gains", "out", "force", "json", "command")],
        "the page: a certificate (.json) is of the gain set alone",
    )
    output_file(options.out, RESULT_FILE, options)
    design, _ = gains_to_hand_on(options.gains, unverified=False)
    found = obsynth.robustness(design)
    file = found.save(options.out)
    told = {"gains": options.gains, "file": file, "statement": found.statement, **found.as_dict()}
    answer(options, told, found.statement)
    return 0


def _target(options: argparse.Namespace) -> Path | TextIO:
    """Return where estimates go; refuse a hopeless place before any work is done."""
    from obsynth.monitoring.logs.log_run import STATE
    from obsynth.monitoring.logs.sinks import ESTIMATES
    from obsynth.monitoring.logs.sources import check_suffix

    named = {"--gains": options.gains, "--system": options.system, "--state": options.state}
    streams = {"--data": options.data, "--out": options.out}
    require_distinct({**named, **{name: file for name, file in streams.items() if file != STREAM}})
    protect_inputs(options)
    if options.state is not None:
        output_file(options.state, STATE, options, option="--state")
    if options.out == STREAM:
        return sys.stdout
    target = Path(options.out)
    check_suffix(target)
    return output_file(target, ESTIMATES, options)


def run_plot(options: argparse.Namespace) -> int:
    """Run ``plot``: gain set and data in, a picture or a window out."""
    target: Path | None = options.out
    if target is not None:
        kind = picture_kind(target)
        protect_inputs(options)
        output_file(target, kind, options)
    parts = [part.strip() for part in options.show.split(",") if part.strip()]
    design, mark = gains_to_hand_on(options.gains, unverified=options.unverified)
    watched = monitor_of(design, options, has_scenario=True)
    found = run_of(design, options, watched)
    from obsynth.monitoring.plots.data import panel_count, plot_data

    if target is not None:
        count = panel_count(found, parts, design=design)
        written_picture(target, count, lambda axes: plot_data(found, design=design, show=parts, axes=axes))
    else:
        import matplotlib as mpl
        import matplotlib.pyplot as plt

        if mpl.get_backend().lower() == "agg":
            raise SpecError(
                "There is no screen to open a window on: give --out a file (.png, .svg or .pdf).", path="--out"
            )
        plot_data(found, design=design, show=parts)
        plt.show()
    if options.json or not options.quiet:
        told = "\n".join([*([mark] if mark else []), summary_of_run(found, watched)])
        unverified = {"unverified": mark} if mark else {}
        answer(options, {"gains": options.gains, "file": target, **found.as_dict(), **unverified}, told)
    return 0


def picture_kind(target: Path) -> FileKind:
    """Return what kind of picture a file is to be, by its suffix."""
    suffix = target.suffix.lower()
    if suffix not in PICTURES:
        raise SpecError(f"{target} has an unknown suffix: use one of {', '.join(PICTURES)}.", path=str(target))
    return FileKind(f"a picture ({suffix})", PICTURES[suffix])


def written_picture(target: Path, count: int, draw: Callable[[list[Any]], Any]) -> None:
    """Write a picture of so many panels, one above the other; ``draw`` fills them."""
    from obsynth.report.plots.panels import image_of

    write_atomically(target, image_of(count, draw, kind=target.suffix[1:].lower()))
