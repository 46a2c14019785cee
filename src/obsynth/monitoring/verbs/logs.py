"""The verbs that run a gain set on a log: ``run``, ``prove-alarm`` and ``plot``."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path
from typing import TextIO

from obsynth.errors import SpecError
from obsynth.files.outputs import require_distinct
from obsynth.monitoring.run_summary import summary_of_run
from obsynth.monitoring.verbs.alarm_proofs import alarm_of_run, certificate_target, proof_of
from obsynth.monitoring.verbs.data_arguments import monitor_of, protect_inputs, run_of
from obsynth.report.terminal.arguments import STREAM, numbers_of, refuse_given
from obsynth.report.terminal.output import emit, gains_to_hand_on, output_file, print_json
from obsynth.report.terminal.pictures import picture_kind, written_picture
from obsynth.results.registered import registered


def run_run(options: argparse.Namespace) -> int:
    """Run ``run``: gain set and data in, estimates out."""
    if options.follow is not None:
        _require_followable(options)
        options.data = options.follow
    if options.gains.is_dir():
        if options.input_delay is not None:
            raise SpecError(
                "--input-delay is for one gain set: state inputs.hold in the specs of a folder.", path="--input-delay"
            )
        return int(registered("run_many")(options))
    for name, is_given in (("--jobs", options.jobs is not None), ("--cluster", options.cluster is not None)):
        if is_given:
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
    run = run_of(
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
    proof = None if certificate is None else alarm_of_run(design, options, run, certificate)
    if options.json:
        print_json(
            {
                "command": "run",
                **({} if proof is None else {"proof": proof}),
                "gains": str(options.gains),
                "file": str(out),
                **run.as_dict(),
                **({"unverified": mark} if mark else {}),
                "monitor": None if watched is None else {"kind": watched.kind, "statement": watched.statement},
            }
        )
    elif not options.quiet:
        # The estimates themselves may be on stdout.
        stream = sys.stderr if out is sys.stdout else sys.stdout
        print(*([mark] if mark else []), summary_of_run(run, watched, design.plant.units), sep="\n", file=stream)
        if proof is not None:
            print(proof["statement"], *(["Certificate:", proof["file"]] if proof["file"] else []), file=stream)
    return 0


def _require_followable(options: argparse.Namespace) -> None:
    """Refuse what a log without an end cannot be run with."""
    from obsynth.monitoring.logs.sources import TEXT_SUFFIXES

    refused = {
        "--out": options.out != STREAM and "a file is written when the log ends, as this one does not: leave --out out",
        "--prove": options.prove is not None and "it reads a log twice: give --data",
        "--smooth": options.smooth and "it needs the whole log: give --lag, or --data",
        "--gains": options.gains.is_dir() and "one log is followed by one gain set: give its file",
        "--follow": (options.follow == STREAM or Path(options.follow).suffix.lower() not in TEXT_SUFFIXES)
        and f"a text log is needed ({', '.join(TEXT_SUFFIXES)}); a stream is followed by --data -",
    }
    for name, why in refused.items():
        if why:
            raise SpecError(f"--follow does not go with {name} here: {why}.", path=name)


def _recovered(names: list[str] | None) -> str | list[str] | None:
    return names[0] if names in (["all"], ["none"]) else names


def run_prove_alarm(options: argparse.Namespace) -> int:
    """Run ``prove-alarm``: 0 whether there is a proof or not; every failure is an error."""
    from obsynth.monitoring.alarms.proof_file import CERTIFICATE
    from obsynth.results.gain_sets import load

    design = load(options.gains)  # `prove_alarm` verifies it
    target = None if options.out is None else output_file(options.out, CERTIFICATE, options)
    proof = proof_of(design, options, options.row, state_bounds=numbers_of(options.state_bound) or None)
    file = str(proof.save(target)) if proof.proved and target is not None else None
    emit(
        options,
        {
            "gains": options.gains,
            "proved": proof.proved,
            "row": proof.row,
            "window": proof.window,
            "margin": proof.margin,
            "statement": proof.statement,
            "origin": proof.origin,
            "file": file,
        },
        proof.statement + (f"\nCertificate: {file}" if file else ""),
    )
    return 0


def _target(options: argparse.Namespace) -> Path | TextIO:
    """Return where estimates go; refuse a hopeless place before any work is done."""
    from obsynth.monitoring.logs.saved_run import STATE
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
    run = run_of(design, options, watched)
    from obsynth.monitoring.plots.data import panel_count, plot_data

    if target is not None:
        count = panel_count(run, parts, design=design)
        written_picture(target, count, lambda axes: plot_data(run, design=design, show=parts, axes=axes))
    else:
        import matplotlib as mpl
        import matplotlib.pyplot as plt

        if mpl.get_backend().lower() == "agg":
            raise SpecError(
                "There is no screen to open a window on: give --out a file (.png, .svg or .pdf).", path="--out"
            )
        plot_data(run, design=design, show=parts)
        plt.show()
    if options.json or not options.quiet:
        text = "\n".join([*([mark] if mark else []), summary_of_run(run, watched, design.plant.units)])
        unverified = {"unverified": mark} if mark else {}
        emit(options, {"gains": options.gains, "file": target, **run.as_dict(), **unverified}, text)
    return 0
