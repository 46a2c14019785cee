"""The certificate of ``run --prove``: where it is written, and the proof of the first alarm of a run."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING, Any

from obsynth.errors import SpecError
from obsynth.monitoring.thresholds.options import WINDOW
from obsynth.monitoring.verbs.data_arguments import with_input_delay
from obsynth.report.terminal.arguments import STREAM, columns_of, numbers_of, ranges_of
from obsynth.report.terminal.output import output_file

if TYPE_CHECKING:
    from obsynth.monitoring.alarms.proof_file import AlarmProof
    from obsynth.monitoring.logs.run import DataRun
    from obsynth.results.design import ObserverDesign

#: A proof is tried of the windows that end at the alarm and so many windows later: a fault shows more with time.
_LATER = (0.0, 0.1, 0.25, 0.5, 0.95)


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
