"""From a record to a proof that it is not fault-free: the programme solved, its dual checked in exact arithmetic."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from obsynth.errors import PreconditionError, SpecError, VerificationError
from obsynth.files.outputs import FileKind, write_atomically
from obsynth.methods.guaranteed_test.method import is_guaranteed
from obsynth.methods.guaranteed_test.programs import SOLVED_STATUS
from obsynth.methods.guaranteed_test.result import GuaranteedTest
from obsynth.methods.verifying import verify
from obsynth.monitoring.alarms.multipliers import refuted, rows_of_test, statement_of
from obsynth.monitoring.alarms.proof_window import Programme, window_data, window_programme
from obsynth.monitoring.thresholds.guaranteed import refuse_bounds
from obsynth.monitoring.thresholds.options import DISTURBANCES, WINDOW
from obsynth.numerics.arguments import chosen, whole_number
from obsynth.numerics.arrays import FloatArray, require_no_overflow
from obsynth.plants.noise import require_noise
from obsynth.plants.signal_names import index_of
from obsynth.results.certificate_files import ALARM_KIND, SHOWN_DIGITS, sealed
from obsynth.results.design import ObserverDesign
from obsynth.results.gain_set_writing import design_as_dict, plain
from obsynth.verification.assumptions import Assumptions, LogReference

ALARM_VERSION = 1

CERTIFICATE = FileKind("an alarm certificate", b'"kind": "obsynth alarm certificate"', suffix=".json")

#: Algorithms of HiGHS, and how long each may take: the simplex method alone may go in circles for ever.
ALGORITHMS, SOLVER_SECONDS = ("highs-ipm", "highs"), 60.0

#: Multipliers are kept to this many significant digits: any numbers prove a bound, and few digits stay readable.
MULTIPLIER_DIGITS = 12

#: The stated margin is smaller than the one found by this share: matrices are made anew where it is checked.
MARGIN_SHARE = 1e-3


@dataclass(frozen=True, eq=False)
class AlarmProof:
    """Whether a record up to a row is proved not to be fault-free; see `obsynth.prove_alarm`.

    Parameters
    ----------
    proved : bool
        Whether nothing explains the data without a fault since the start.
    row : int
        Last row of the window, from 1.
    window : int
        Samples of the window.
    margin : float
        Proved lower bound of the share by which all bounds at once would have to be exceeded; 0 or less: no proof.
    statement : str
        What is proved, or why it cannot be.
    origin : str
        Where the bounds of the state come from.
    certificate : mapping
        Everything that `obsynth verify` needs; empty without a proof.

    Examples
    --------
    >>> import obsynth
    >>> import pandas as pd
    >>> plant = obsynth.uncertain_system(
    ...     {"A": [["a"]], "B": [[1]], "C": [[1]], "Bf": [[1]], "dt": 1.0}, {"a": {"nominal": 0.5, "tolerance": "5 %"}}
    ... )
    >>> design = obsynth.fault_estimation_filter(plant)
    >>> log = pd.DataFrame({"time": range(4), "u1": 0.0, "y1": [0.0, 0.0, 0.0, 1.0]})
    >>> proof = obsynth.prove_alarm(design, log, 4, initial_set={"x1": 0.1})
    >>> proof.proved, proof.row
    (True, 4)
    """

    proved: bool
    row: int
    window: int
    margin: float
    statement: str
    origin: str
    certificate: Mapping[str, Any]

    def save(self, path: str | Path) -> Path:
        """Write the certificate as one JSON document, atomically; without a proof the file says that there is none, and
        `obsynth verify` refuses it.

        Parameters
        ----------
        path : str or Path
            Where to write.

        Raises
        ------
        SpecError
            The file cannot be written.
        """
        body = self.certificate if self.proved else {"proved": False, "row": self.row, "statement": self.statement}
        return write_atomically(path, sealed(ALARM_KIND, ALARM_VERSION, body), kind=CERTIFICATE)

    def __repr__(self) -> str:
        return self.statement


def proved_alarm(
    design: ObserverDesign,
    u: FloatArray,
    y: FloatArray,
    *,
    window: int = WINDOW,
    disturbance_bounds: Mapping[str, float] | None = None,
    noise_bound: float | None = None,
    initial_set: Mapping[str, Any] | None = None,
    state_bounds: Mapping[str, Any] | None = None,
    log: LogReference | None = None,
    unverified: bool = False,
    disturbance: str = "any",
) -> AlarmProof:
    """Return the proof for the last sample of a record ``u (steps, nu)``, ``y (steps, ny)`` of deviations.
    A design that fails its own verification proves nothing: `VerificationError`, unless ``unverified``, and then no
    alarm is proved."""
    if is_guaranteed(design):
        stated = {
            "disturbance_bounds": disturbance_bounds, "noise_bound": noise_bound, "initial_set": initial_set,
            "state_bounds": state_bounds, "disturbance": None if disturbance == "any" else disturbance,
        }  # fmt: skip
        refuse_bounds(stated)
        return _proved_by_test(design, u, y, log, unverified=unverified)
    assumed = assumptions_of(design, disturbance_bounds, noise_bound, initial_set, state_bounds, window, disturbance)
    row, length = len(y), min(window, len(y))
    if (failing := _failing(design, unverified=unverified)) is not None:
        return AlarmProof(False, row, length, 0.0, failing, "", {})
    try:
        programme, origin = programme_of(design, assumed, window, u, y)
    except PreconditionError as error:
        return AlarmProof(False, row, length, 0.0, f"Cannot be proved: {error}", "", {})
    multipliers = solved(programme)
    if multipliers is None:
        text = "Cannot be proved: the linear-programming solver returned no multipliers."
        return AlarmProof(False, row, length, 0.0, text, origin, {})
    equal, below = multipliers
    margin = float(programme.proved_least(equal, below))
    if not margin > 0.0:
        text = (
            f"Cannot be proved: with {assumed.phrase()}{assumed.movement}, some plant may produce the last "
            f"{length} samples without a fault (the relaxed linear programme has a solution)."
        )
        return AlarmProof(False, row, length, margin, text, origin, {})
    margin *= 1.0 - MARGIN_SHARE
    gain_set = design_as_dict(design)
    text = statement(assumed, window, row, origin, log, gain_set["sha256"])
    certificate = {
        "bounds": assumed.bounds,
        "noise_bound": assumed.noise_bound,
        "disturbance": assumed.disturbance,
        "window": window,
        "initial_set": None if initial_set is None else _as_lists(initial_set),
        "state_bounds": None if state_bounds is None else _as_lists(state_bounds),
        "u": u,
        "y": y,
        "row": row,
        "equal": equal,
        "below": below,
        "margin": margin,
        "origin": origin,
        "statement": text,
        "log": None if log is None else log.as_dict(),
    }
    return AlarmProof(True, row, length, margin, text, origin, {**plain(certificate), "gain_set": gain_set})


def _failing(design: ObserverDesign, *, unverified: bool) -> str | None:
    """Return why a design that fails its own verification proves nothing; raise it unless ``unverified``."""
    report = verify(design)
    if report.passed:
        return None
    failing = ", ".join(check.name for check in report.failures)
    if not unverified:
        raise VerificationError(
            f"The gain set {design.name!r} fails its own verification ({failing}): no alarm can be proved by it.",
            report=report,
        )
    return f"Cannot be proved: the gain set is unverified ({failing} fails)."


def _proved_by_test(
    design: ObserverDesign, u: FloatArray, y: FloatArray, log: LogReference | None, *, unverified: bool
) -> AlarmProof:
    """Return the proof of a guaranteed test: a fraction for each equation of its window."""
    bank, row = GuaranteedTest.of(design), len(y)
    most = max(map(rows_of_test, bank.tests))
    if (failing := _failing(design, unverified=unverified)) is not None:
        return AlarmProof(False, row, most, 0.0, failing, "", {})
    refutation = refuted(design, u, y)
    if refutation is None:
        text = f"Cannot be proved: within the bounds of the design, the last {most} samples may be without a fault."
        return AlarmProof(False, row, most, 0.0, text, "", {})
    place, rows, numbers = refutation
    gain_set = design_as_dict(design)
    text = statement_of(bank.tests[place], bank.groups[place], row, log, gain_set["sha256"])
    certificate = {
        **numbers, "u": u[-rows:], "y": y[-rows:], "row": row, "statement": text,
        "log": None if log is None else log.as_dict(),
    }  # fmt: skip
    return AlarmProof(True, row, rows, numbers["margin"], text, "", {**plain(certificate), "gain_set": gain_set})


def statement(assumed: Assumptions, window: int, row: int, origin: str, log: LogReference | None, gain_set: str) -> str:
    """Return what a proof says, with everything it rests on."""
    uncertain = assumed.plant.uncertainty
    linear = (
        "" if assumed.box is None or uncertain is None or not uncertain.not_covered else f"; {uncertain.not_covered}"
    )
    outside = "a model that is not exact" if assumed.box is None else assumed.box.sentence
    since = "since row 1" if assumed.initial_set is not None else "in these rows"
    source = "a record" if log is None else f"{log.name} (sha256 {log.sha256[:SHOWN_DIGITS]})"
    first = row - min(window, row) + 1
    return (
        f"Proved: rows {first} to {row} of {source} cannot occur without a fault {since}, with {assumed.phrase()}"
        f"{assumed.movement}: "
        f"there is a fault, or {outside}{linear}. Bounds of the state: {origin}. Assumptions "
        f"{assumed.digest[:SHOWN_DIGITS]}, gain set {gain_set[:SHOWN_DIGITS]}."
    )


def assumptions_of(
    design: ObserverDesign,
    disturbance_bounds: Mapping[str, float] | None,
    noise_bound: float | None,
    initial_set: Mapping[str, Any] | None,
    state_bounds: Mapping[str, Any] | None,
    window: int,
    disturbance: str = "any",
) -> Assumptions:
    """Return what is assumed of all that is unknown to a discrete linear design, checked, as is the window's length."""
    plant, _ = design.linear
    if not plant.is_discrete:
        raise SpecError("A window is proved for sampled designs: this one is continuous in time.", path="gains")
    whole_number(window, "window", "a whole number of samples", least=2)
    bounds = np.full(plant.nd, np.nan)
    for name, value in (disturbance_bounds or {}).items():
        bounds[index_of(name, plant.disturbance_names, what="disturbance_bounds")] = value
    if not np.all(bounds >= 0.0) or not np.isfinite(bounds).all():
        missing = [name for name, bound in zip(plant.disturbance_names, bounds, strict=True) if not bound >= 0.0]
        raise SpecError(
            f"The disturbance {(missing or ['?'])[0]!r} has no bound: give disturbance_bounds "
            "(--disturbance), finite and 0 or more.",
            path="disturbance_bounds",
        )
    if initial_set is not None and state_bounds is not None:
        raise SpecError("Bounds of the state follow from initial_set: leave state_bounds out.", path="state_bounds")
    if plant.nw and noise_bound is None:
        raise SpecError(
            "Noise has no bound: give noise_bound (--noise-bound), in standard deviations.", path="noise_bound"
        )
    require_noise(noise_bound, noisy=bool(plant.Bw.any() or plant.Dw.any()))
    if initial_set is None and state_bounds is None:
        raise SpecError("Nothing bounds the state: give initial_set (--initial), or state_bounds.", path="initial_set")
    require_no_overflow(noise_bound or 0.0, "noise_bound", "noise_bound")
    chosen(disturbance, "disturbance", DISTURBANCES)
    noise = float(noise_bound or 0.0) if plant.nw else 0.0
    return Assumptions(plant, bounds, noise, initial_set, state_bounds, disturbance=disturbance)


def programme_of(
    design: ObserverDesign, assumed: Assumptions, window: int, u: FloatArray, y: FloatArray
) -> tuple[Programme, str]:
    """Return the programme of the last samples of a record, and where its bounds of the state come from."""
    affine, data, origin = window_data(design, assumed, window, u, y)
    bounds = np.concatenate([affine.disturbance_bounds(assumed.bounds), np.full(affine.plant.nw, assumed.noise_bound)])
    return window_programme(affine, bounds, data), origin


def _as_lists(bounds: Mapping[str, Any]) -> dict[str, Any]:
    return {name: list(value) if isinstance(value, (list, tuple)) else value for name, value in bounds.items()}


def solved(programme: Programme) -> tuple[FloatArray, FloatArray] | None:
    """Return multipliers of equations and inequalities (0 or less) by HiGHS; `None` where it gives none."""
    from scipy.optimize import linprog

    equal, below = programme.matrices()
    cost = np.zeros(len(programme.lower))
    cost[-1] = 1.0
    equations = {"A_eq": equal, "b_eq": programme.equal.right} if programme.equal.right else {}
    for algorithm in ALGORITHMS:
        solution = linprog(
            cost,
            A_ub=below,
            b_ub=programme.below.right,
            bounds=np.stack([programme.lower, programme.upper], axis=1),
            method=algorithm,
            options={"time_limit": SOLVER_SECONDS},
            **equations,
        )
        if solution.status == SOLVED_STATUS:
            break
    else:
        return None
    multipliers = (
        solution.eqlin.marginals if programme.equal.right else (),
        np.minimum(solution.ineqlin.marginals, 0.0),
    )
    equal, below = (np.array([float(f"{value:.{MULTIPLIER_DIGITS}g}") for value in part]) for part in multipliers)
    return equal, below
