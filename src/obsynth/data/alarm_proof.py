"""A proof of an alarm from measured data.

Certificates of alarms checked again, without a solver, with all that they rest on.
"""

from __future__ import annotations

import itertools
import json
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from obsynth.data.run import LogRun
from obsynth.data.sources import Data, samples
from obsynth.errors import ObsynthError, SpecError
from obsynth.experiments.alarm_proof import (
    ALARM_KIND,
    ALARM_VERSION,
    AlarmProof,
    assumptions_of,
    checked,
    programme_of,
    proved_alarm,
    rows_of_test,
    statement,
    statement_of,
)
from obsynth.experiments.assumptions import Log, file_digest
from obsynth.experiments.monitors.options import WINDOW
from obsynth.files.outputs import path_of
from obsynth.methods.guaranteed_test.method import is_guaranteed
from obsynth.methods.guaranteed_test.result import GuaranteedTest
from obsynth.methods.verifying import verify
from obsynth.numerics.arguments import FloatArray, arguments_checked, is_whole, whole_number
from obsynth.observers.linear.observer import WindowObserver
from obsynth.results.checks import Check, information
from obsynth.results.design import SHOWN_DIGITS, ObserverDesign, VerificationReport, loaded, opened, restored


@arguments_checked
def prove_alarm(
    design: ObserverDesign,
    data: Data,
    row: int,
    *,
    window: int = WINDOW,
    disturbance_bounds: Mapping[str, float] | None = None,
    noise_bound: float | None = None,
    initial_set: Mapping[str, Any] | None = None,
    state_bounds: Mapping[str, Any] | None = None,
    columns: Mapping[str, str] | None = None,
    scales: Mapping[str, float] | None = None,
    unverified: bool = False,
) -> AlarmProof:
    """Return a proof that measured data up to a row are not fault-free, or that there is none.

    The alarm of a guaranteed test is proved by one fraction for each equation of its window, on the bounds of its
    design: added up, the equations leave a sum of disturbances and noise that the bounds do not allow.  For other
    designs the window's samples are written as a linear programme over states, disturbances, noise and constants
    (products by McCormick); its dual is checked in rational arithmetic.  "Cannot be proved" is an answer, not an error.

    Parameters
    ----------
    design : ObserverDesign
        Linear, discrete in time; its plant's tolerances count.
    data : path, text stream or pandas.DataFrame
        As for `run_on_data`, without gaps from the first row to ``row`` (guaranteed tests: in the window).
    row : int
        Last row of the window, counted from 1.
    window : int, optional
        Samples.
    disturbance_bounds : mapping, optional
        Largest absolute value of each disturbance by name.
    noise_bound : float, optional
        Standard deviations that no component of the noise exceeds.
    initial_set : mapping, optional
        Bounds of the plant's states at the first row, as for `online_monitor`: bounds in the window follow from the
        observer, and what is proved is a fault since the first row.
    state_bounds : mapping, optional
        Without ``initial_set``: bounds of the absolute value of every state in the window.
    columns, scales : mapping, optional
        As for `run_on_data`.
    unverified : bool, optional
        Whether a design that fails its own verification gives the answer "cannot be proved" instead of an error.

    Returns
    -------
    AlarmProof
        `proved`, a sentence, and the certificate, which `AlarmProof.save` writes for ``obsynth verify``.

    Raises
    ------
    SpecError
        The data or an option is malformed, or nothing bounds a signal.
    VerificationError
        The design fails its own verification.

    Notes
    -----
    A. Neumaier and O. Shcherbina, "Safe bounds in linear and mixed-integer linear programming", Math. Programming 99,
    2004; G. McCormick, "Computability of global solutions to factorable nonconvex programs", 1976.
    """
    whole_number(row, "row", "the number of a row", least=2)
    if isinstance(design.observer, WindowObserver):
        raise SpecError(
            "prove-alarm is for plants with constant matrices: of this test obsynth verify proves the threshold of "
            "each row.",
            path="observer",
        )
    own = max(map(rows_of_test, GuaranteedTest.of(design).tests)) if is_guaranteed(design) else None
    if own is not None and window not in (WINDOW, own):
        raise SpecError(f"window is {window}: the window of this test has {own} samples.", path="window")
    values, nu = rows_of(design, data, row, columns, scales, own), design.linear[0].nu
    log = Log.of(Path(data), columns, scales) if isinstance(data, (str, Path)) else None
    return proved_alarm(
        design,
        values[:, :nu],
        values[:, nu:],
        window=window,
        disturbance_bounds=disturbance_bounds,
        noise_bound=noise_bound,
        initial_set=initial_set,
        state_bounds=state_bounds,
        log=log,
        unverified=unverified,
    )


def rows_of(
    design: ObserverDesign,
    data: Data,
    row: int,
    columns: Mapping[str, str] | None = None,
    scales: Mapping[str, float] | None = None,
    complete: int | None = None,
) -> FloatArray:
    """Return the rows of data up to one, ``(row, nu + ny)``, as a design reads them; refuse what has gaps.

    ``complete``: so many of the last rows have to be without gaps; all by default.
    """
    run = LogRun(design, columns, scales)
    found, flawed, count, status = list[FloatArray](), list[tuple[bool, bool, int]](), 0, ""
    for count, (time, values) in enumerate(itertools.islice(samples(data, run.signals), row), 1):
        status = run.clock.stale(time)
        if status:
            # The same rows are left out as in a run.
            continue
        _, missing = run.clock.advance(time, count)
        flawed.append((bool(missing and found), not np.isfinite(values).all(), count))
        found.append(values)
    if count < row:
        raise SpecError(f"The data have {count} rows: row {row} is not among them.", path="row")
    if status:
        raise SpecError(f"Row {row} is left out ({status}): give another one.", path="row")
    for place, (gap, blank, number) in enumerate(flawed[-(complete or len(flawed)) :]):
        # Of what is before the first row of a window nothing is asked.
        if blank or (gap and (place or complete is None)):
            raise SpecError(f"Row {number} has a gap before it or misses a sample: give complete rows.", path="data")
    return np.array(found)


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
    data = restored({name: value for name, value in body.items() if name != "gain_set"})
    design = loaded(json.dumps(body["gain_set"]).encode(), "the certificate's gain set")
    plant, _ = design.linear
    u = np.asarray(data["u"], dtype=np.float64).reshape(-1, plant.nu)
    y = np.asarray(data["y"], dtype=np.float64).reshape(-1, plant.ny)
    by_test = "multipliers" in data
    log = None if data["log"] is None else Log.from_dict(data["log"])
    yield gain_set_row(design, body["gain_set"]["sha256"])
    yield _log_row(log, log_file, design, u, y, last=data["row"] if by_test else len(y))
    if by_test:
        yield from _checked_by_test(design, body, data, u, y, log)
        return
    bounds = np.asarray(data["bounds"], dtype=np.float64)
    assumed = assumptions_of(
        design,
        dict(zip(plant.disturbance_names, bounds.tolist(), strict=True)),
        data["noise_bound"] if plant.nw else None,
        data["initial_set"],
        data["state_bounds"],
        data["window"],
    )
    programme, origin = programme_of(design, assumed, data["window"], u, y)
    equal, below = np.asarray(data["equal"]), np.asarray(data["below"])
    fits = equal.shape == (len(programme.equal.right),) and below.shape == (len(programme.below.right),)
    margin = float(programme.proved_least(equal, below)) if fits else float("nan")
    said = statement(assumed, data["window"], len(y), origin, log, body["gain_set"]["sha256"])
    rows = len(y) == data["row"] and len(u) == len(y)
    told = said == data["statement"] and origin == data["origin"]
    proof = _row(
        "proof",
        "least excess over all bounds, from the multipliers, in exact arithmetic",
        margin,
        0.0,
        margin > 0.0,
        kind="proved",
    )
    yield from _conclusions(proof, said, float(data["margin"]), rows=rows, told=told)


def gain_set_row(design: ObserverDesign, digest: str, name: str = "gain set") -> Check:
    """Return the row on a gain set inside a certificate, verified like any other."""
    report = verify(design)
    failing = ", ".join(check.name for check in report.failures)
    return _row(
        name,
        f"the gain set inside ({design.name}, {digest[:SHOWN_DIGITS]}) verifies: {len(report.checks)} checks",
        float(len(report.failures)),
        0.0,
        report.passed,
        detail=f"fails: {failing}" if failing else "",
    )


def _log_row(
    log: Log | None, file: Path | None, design: ObserverDesign, u: FloatArray, y: FloatArray, last: int
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
    log: Log | None,
) -> Iterator[Check]:
    """Yield the rows on a certificate of a guaranteed test."""
    row = data["row"]
    ((test, group, margin),) = checked(design, data, u, y)
    said = statement_of(test, group, row, log, body["gain_set"]["sha256"])
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
    yield from _conclusions(proof, said, float(data["margin"]), rows=rows, told=said == data["statement"])


def _conclusions(proof: Check, said: str, stated: float, *, rows: bool, told: bool) -> list[Check]:
    """Return the rows on what a certificate says, with that on its proof."""
    margin = proof.value
    return [
        _row("rows", "the record ends at the stated row", float(rows), 1.0, rows),
        _row("statement", said, float(told), 1.0, told),
        proof,
        _row("margin", "the stated margin is not above what is proved", stated, margin, 0.0 < stated <= margin),
    ]
