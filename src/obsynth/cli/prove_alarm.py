"""The verb ``prove-alarm``."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING, Any

from obsynth.cli.arguments import add_force, add_gains, add_json, output_file
from obsynth.cli.output import print_json
from obsynth.errors import SpecError

if TYPE_CHECKING:
    from obsynth.data.run import DataRun
    from obsynth.results.design import ObserverDesign

_PROVE = "Prove that data up to a row are not explained without a fault by any plant within its tolerances."


def add_prove_alarm_verb(verbs: Any) -> None:
    """Add the parser."""
    from obsynth.cli.data_arguments import pair

    parser = verbs.add_parser("prove-alarm", help=_PROVE, description=_PROVE)
    add_gains(parser)
    parser.add_argument("--data", type=Path, required=True, metavar="FILE", help="CSV or Parquet file, as for run")
    parser.add_argument("--row", type=int, required=True, metavar="K", help="last row of the window, from 1")
    parser.add_argument("--window", type=int, default=20, metavar="N", help="samples (default: 20)")
    parser.add_argument("--out", type=Path, metavar="FILE", help="write the certificate (JSON) if there is a proof")
    for flag, name, what in (
        ("--map", "SIGNAL=COLUMN", "column of a signal where the names differ; may be repeated"),
        ("--scale", "SIGNAL=FACTOR", "the column's value times the factor is in the signal's unit; may be repeated"),
        ("--disturbance", "NAME=BOUND", "largest absolute value of a disturbance; may be repeated"),
        ("--initial", "STATE=BOUND", "bound of a state at the first row (or LOW:HIGH); may be repeated"),
        ("--state-bound", "STATE=BOUND", "without --initial: bound of a state in the window; may be repeated"),
    ):
        parser.add_argument(flag, type=pair, action="append", default=[], metavar=name, help=what)
    parser.add_argument("--noise-bound", type=float, metavar="N", help="standard deviations that no noise exceeds")
    add_json(parser)
    add_force(parser)
    parser.set_defaults(verb="prove-alarm")


#: Rows from the alarm on at whose windows a proof is tried, in windows.
_LATER = (0.0, 0.1, 0.25, 0.5, 0.95)


def certificate_target(options: argparse.Namespace) -> Path | None:
    """Return where ``run --prove`` writes its certificate; refuse what cannot be proved before any work is done."""
    if options.prove is None:
        return None
    from obsynth.experiments.alarm_proofs.proof import CERTIFICATE

    if options.monitor != "pointwise":
        raise SpecError("--prove is for alarms of --monitor pointwise.", path="--prove")
    if options.data == "-" or options.state is not None:
        raise SpecError("--prove reads the data again from their first row on: give --data a file, and no --state.",
                        path="--prove")  # fmt: skip
    return output_file(options.prove, CERTIFICATE, options, option="--prove")


def alarm_of_run(design: ObserverDesign, options: argparse.Namespace, found: DataRun, target: Path) -> dict[str, Any]:
    """Return whether the first alarm of a run is proved, in words, and the certificate's file."""
    from obsynth.cli.data_run import numbers_of, ranges_of
    from obsynth.data.alarm_proof import prove_alarm

    row = found.alarm_rows.get("pointwise")
    if row is None:
        return {"proved": False, "row": None, "statement": "No alarm: there is nothing to prove.", "file": None}
    tried = [min(row + int(share * options.window), found.rows) for share in _LATER]
    for last in dict.fromkeys(max(number, 2) for number in tried):
        proof = prove_alarm(
            design, Path(options.data), last, window=options.window, columns=dict(options.map),
            scales=numbers_of(options.scale), disturbance_bounds=numbers_of(options.disturbance),
            noise_bound=options.noise_bound, initial_set=ranges_of(options.initial) or None,
        )  # fmt: skip
        if proof.proved:
            file = proof.save(target)
            return {"proved": True, "row": last, "statement": proof.statement, "file": str(file)}
    return {"proved": False, "row": row, "statement": proof.statement, "file": None}


def run_prove_alarm(options: argparse.Namespace) -> int:
    """Run ``prove-alarm``: 0 whether there is a proof or not; every failure is an error."""
    from obsynth.cli.data_run import numbers_of, ranges_of
    from obsynth.data.alarm_proof import prove_alarm
    from obsynth.experiments.alarm_proofs.proof import CERTIFICATE
    from obsynth.results.gain_sets import load

    design = load(options.gains)
    target = None if options.out is None else output_file(options.out, CERTIFICATE, options)
    found = prove_alarm(
        design, options.data, options.row, window=options.window, columns=dict(options.map),
        scales=numbers_of(options.scale), disturbance_bounds=numbers_of(options.disturbance),
        noise_bound=options.noise_bound, initial_set=ranges_of(options.initial) or None,
        state_bounds=numbers_of(options.state_bound) or None,
    )  # fmt: skip
    file = found.save(target) if found.proved and target is not None else None
    if options.json:
        print_json({
            "command": "prove-alarm", "gains": str(options.gains), "proved": found.proved, "row": found.row,
            "window": found.window, "margin": found.margin, "statement": found.statement, "origin": found.origin,
            "file": None if file is None else str(file),
        })  # fmt: skip
        return 0
    print(found.statement)
    if file is not None:
        print(f"Certificate: {file}")
    return 0
