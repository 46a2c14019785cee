"""Certificates of alarms checked again, without a solver, with all that they rest on."""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from obsynth.errors import ObsynthError
from obsynth.files.inputs import path_of
from obsynth.methods.verifying import verify
from obsynth.monitoring.alarms.multipliers import checked, statement_of
from obsynth.monitoring.alarms.proof_file import ALARM_VERSION, assumptions_of, programme_of, statement
from obsynth.monitoring.alarms.proving import rows_of
from obsynth.numerics.arguments import arguments_checked, is_whole
from obsynth.numerics.arrays import FloatArray
from obsynth.results.certificate_files import ALARM_KIND, SHOWN_DIGITS, opened
from obsynth.results.checks import Check, information, with_verdict
from obsynth.results.design import ObserverDesign
from obsynth.results.gain_set_writing import restored
from obsynth.results.gain_sets import loaded
from obsynth.results.verification_report import VerificationReport
from obsynth.verification.assumptions import LogReference, file_digest


@arguments_checked
def verify_alarm(path: str | Path, *, data: str | Path | None = None) -> VerificationReport:
    """Check the certificate of an alarm again, without a solver, with all that it rests on.

    Parameters
    ----------
    path : str or Path
        What `prove_alarm` (or ``obsynth prove-alarm``) wrote.
    data : str or Path, optional
        The log that it names: its digest and its rows are then compared; else they are assumed.

    Returns
    -------
    VerificationReport
        It fails where the file was changed, the gain set inside fails, or the multipliers prove nothing.

    Raises
    ------
    SpecError
        The file is no certificate.

    Examples
    --------
    >>> from tempfile import TemporaryDirectory
    >>> import pandas as pd
    >>> import obsynth
    >>> plant = obsynth.uncertain_system(
    ...     {"A": [["a"]], "B": [[1]], "C": [[1]], "Bf": [[1]], "dt": 1.0},
    ...     {"a": {"nominal": 0.5, "tolerance": "5 %"}},
    ... )
    >>> design = obsynth.fault_estimation_filter(plant)
    >>> log = pd.DataFrame({"time": range(6), "u1": 0.0, "y1": [0.0, 0.0, 0.0, 1.0, 0.5, 0.25]})  # row 4 jumps
    >>> proof = obsynth.prove_alarm(design, log, 4, initial_set={"x1": 0.1})
    >>> with TemporaryDirectory() as folder:
    ...     _ = proof.save(f"{folder}/alarm.json")
    ...     print(obsynth.verify_alarm(f"{folder}/alarm.json").passed)
    True
    """
    again = "prove the alarm again (obsynth prove-alarm)"
    _, body, intact = opened(path_of(path), (ALARM_KIND,), ALARM_VERSION, "certificate of an alarm", again)
    checks = [_row("digest", "the file is as it was written", float(intact), 1.0, intact)]
    try:
        for check in _checked(body, None if data is None else Path(data)):
            checks.append(check)  # those before an error stay
    except (ObsynthError, KeyError, TypeError, ValueError, IndexError, AttributeError, ArithmeticError) as error:
        checks.append(_row("contents", f"the certificate can be read ({error})", 0.0, 1.0, False))
    return VerificationReport.of(checks)


def _checked(body: Mapping[str, Any], log_file: Path | None) -> Iterator[Check]:
    if not body.get("proved", True):
        yield _row("proof", f"there is a proof ({body['statement']})", 0.0, 1.0, False)
        return
    data = restored({name: value for name, value in body.items() if name != "gain_set"})
    design = loaded(json.dumps(body["gain_set"]).encode(), "the certificate's gain set")
    plant, _ = design.linear
    u = np.asarray(data["u"], dtype=np.float64).reshape(len(data["u"]), plant.nu)
    y = np.asarray(data["y"], dtype=np.float64).reshape(len(data["y"]), plant.ny)
    by_test = "multipliers" in data
    log = None if data["log"] is None else LogReference.from_dict(data["log"])
    yield gain_set_row(design, body["gain_set"]["sha256"])
    yield _log_row(log, log_file, design, u, y, last=data["row"] if by_test else len(y))
    if by_test:
        yield from _checked_by_test(design, body, data, u, y, log)
        return
    if "disturbance" not in data:
        # Held and moving disturbances reach different rows: a proof that names neither proves nothing.
        words = "the certificate says what disturbances do between samples (disturbance: any or held)"
        yield _row("assumptions", words, 0.0, 1.0, False, detail="it does not: prove the alarm again")
        return
    bounds = np.asarray(data["bounds"], dtype=np.float64)
    assumed = assumptions_of(
        design,
        dict(zip(plant.disturbance_names, bounds.tolist(), strict=True)),
        data["noise_bound"] if plant.nw else None,
        data["initial_set"],
        data["state_bounds"],
        data["window"],
        data["disturbance"],
    )
    programme, origin = programme_of(design, assumed, data["window"], u, y)
    equal, below = np.asarray(data["equal"]), np.asarray(data["below"])
    fits = equal.shape == (len(programme.equal.right),) and below.shape == (len(programme.below.right),)
    margin = float(programme.proved_least(equal, below)) if fits else float("nan")
    conclusion = statement(assumed, data["window"], len(y), origin, log, body["gain_set"]["sha256"])
    rows = len(y) == data["row"] and len(u) == len(y)
    is_stated = conclusion == data["statement"] and origin == data["origin"]
    proof = _row(
        "proof",
        "least excess over all bounds, from the multipliers, in exact arithmetic",
        margin,
        0.0,
        margin > 0.0,
        kind="proved",
    )
    yield from _conclusions(proof, conclusion, float(data["margin"]), rows=rows, is_stated=is_stated)


def gain_set_row(design: ObserverDesign, digest: str, name: str = "gain set") -> Check:
    """Return the row on a gain set inside a certificate, verified like any other."""
    report = verify(design)
    failing = ", ".join(check.name for check in report.failures)
    count = len(with_verdict(report.checks))
    return _row(
        name,
        f"the gain set inside ({design.name}, {digest[:SHOWN_DIGITS]}) verifies: {count} checks",
        float(len(report.failures)),
        0.0,
        report.passed,
        detail=f"fails: {failing}" if failing else "",
    )


def _log_row(
    log: LogReference | None, file: Path | None, design: ObserverDesign, u: FloatArray, y: FloatArray, last: int
) -> Check:
    """Return the row on the log: compared where it is given, else assumed; ``last``: its row that y ends with."""
    if file is None:
        name = "a record that no file holds" if log is None else f"{log.name}, sha256 {log.sha256}"
        return information(
            "log",
            f"the rows are those of {name}: assumed, as the log was not given (--data)",
            float(len(y)),
            source="certificate",
            status="assumed",
        )
    if log is None:
        return _row("log", "the certificate names the log", 0.0, 1.0, False)
    if file_digest(file) != log.sha256:
        return _row(
            "log", f"{file.name} is the log that the certificate names ({log.sha256[:SHOWN_DIGITS]})", 0.0, 1.0, False
        )
    values = rows_of(design, file, last, dict(log.columns), dict(log.scales), len(y))[-len(y) :]
    equal = bool(np.array_equal(values, np.hstack([u, y])))
    return _row(
        "log",
        f"rows {last - len(y) + 1} to {last} are those of {file.name}, sha256 {log.sha256[:SHOWN_DIGITS]}",
        float(equal),
        1.0,
        equal,
    )


def _row(
    name: str, claim: str, value: float, bound: float, passed: bool, *, kind: Any = "computed", detail: str = ""
) -> Check:
    source = "linear programme with safe dual bounds (Neumaier and Shcherbina 2004)"
    return Check(name, claim, value, bound, value - bound, bool(passed), source, kind, detail)


def _checked_by_test(
    design: ObserverDesign,
    body: Mapping[str, Any],
    data: Mapping[str, Any],
    u: FloatArray,
    y: FloatArray,
    log: LogReference | None,
) -> Iterator[Check]:
    """Yield the rows on a certificate of a guaranteed test."""
    row = data["row"]
    ((test, group, margin),) = checked(design, data, u, y)
    conclusion = statement_of(test, group, row, log, body["gain_set"]["sha256"])
    rows = is_whole(row) and row >= len(y) > 0
    proof = Check(
        "proof",
        "share by which all bounds would have to be exceeded: each equation times its number, added up in fractions",
        margin,
        0.0,
        margin,
        bool(margin > 0.0),
        "duality of linear programmes",
        "proved",
    )
    yield from _conclusions(
        proof, conclusion, float(data["margin"]), rows=rows, is_stated=conclusion == data["statement"]
    )


def _conclusions(proof: Check, conclusion: str, stated: float, *, rows: bool, is_stated: bool) -> list[Check]:
    """Return the rows on what a certificate says, with that on its proof."""
    margin = proof.value
    return [
        _row("rows", "the record ends at the stated row", float(rows), 1.0, rows),
        _row("statement", conclusion, float(is_stated), 1.0, is_stated),
        proof,
        _row("margin", "the stated margin is not above what is proved", stated, margin, 0.0 < stated <= margin),
    ]
