"""From a record to a proof that it is not fault-free: the programme solved, its dual checked in exact arithmetic.

Certificates of alarms on disk, and their check without a solver.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from obsynth.errors import ObsynthError, PreconditionError, SpecError
from obsynth.experiments.alarm_window import Window, window_data, window_programme
from obsynth.files.inputs import read_json
from obsynth.files.outputs import FileKind, write_atomically
from obsynth.numerics.arguments import is_whole
from obsynth.numerics.arrays import FloatArray
from obsynth.plants.validation import index_of
from obsynth.results.checks import Check, VerificationReport
from obsynth.results.design import ObserverDesign
from obsynth.results.gain_sets import digest_of, loaded, restored
from obsynth.tolerances.result import EXACT_MODEL

SCHEMA_VERSION = 1
KIND = "obsynth alarm certificate"
CERTIFICATE = FileKind("an alarm certificate", b'"kind": "obsynth alarm certificate"')
#: Samples of a window.
WINDOW = 20
#: The solver of linear programmes may take so long; without an answer nothing is proved.
SOLVER_SECONDS = 60.0
#: Multipliers are kept to this many significant digits: any numbers prove a bound, and few digits stay readable.
MULTIPLIER_DIGITS = 12


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
    """

    proved: bool
    row: int
    window: int
    margin: float
    statement: str
    origin: str
    certificate: Mapping[str, Any]

    def save(self, path: str | Path) -> Path:
        """Write the certificate as one JSON document, atomically.

        Parameters
        ----------
        path : str or Path
            Where to write.

        Raises
        ------
        SpecError
            There is no proof to write, or the file cannot be written.
        """
        if not self.proved:
            raise SpecError("There is no proof to write: the alarm cannot be proved.", path="certificate")
        body = {"kind": KIND, "schema_version": SCHEMA_VERSION, "sha256": digest_of(self.certificate),
                "certificate": self.certificate}  # fmt: skip
        return write_atomically(path, json.dumps(body, indent=1, allow_nan=False) + "\n")

    def __str__(self) -> str:
        return self.statement


def proved_alarm(
    design: ObserverDesign, u: FloatArray, y: FloatArray, *, window: int = WINDOW,
    disturbance_bounds: Mapping[str, float] | None = None, noise_bound: float | None = None,
    initial_set: Mapping[str, Any] | None = None, state_bounds: Mapping[str, Any] | None = None,
) -> AlarmProof:  # fmt: skip
    """Return the proof for the last sample of a record ``u (steps, nu)``, ``y (steps, ny)`` of deviations."""
    question = Question.of(design, disturbance_bounds, noise_bound, initial_set, state_bounds, window)
    row, length = len(y), min(window, len(y))
    try:
        programme, origin = question.programme(design, u, y)
    except PreconditionError as error:
        return AlarmProof(False, row, length, 0.0, f"Cannot be proved: {error}", "", {})
    found = solved(programme)
    if found is None:
        text = "Cannot be proved: the solver of linear programmes gave no multipliers."
        return AlarmProof(False, row, length, 0.0, text, origin, {})
    equal, below = found
    margin = float(programme.proved_least(equal, below))
    if not margin > 0.0:
        text = (
            f"Cannot be proved: some plant within its tolerances, with disturbances and noise within their bounds, may "
            f"explain the last {length} samples without a fault (the relaxed programme has a solution)."
        )
        return AlarmProof(False, row, length, margin, text, origin, {})
    text = statement(design, length, origin)
    certificate = {
        **question.as_dict(), "u": u, "y": y, "row": row, "equal": equal, "below": below, "margin": margin,
        "origin": origin, "statement": text,
    }  # fmt: skip
    from obsynth.results.gain_sets import design_as_dict, plain

    return AlarmProof(True, row, length, margin, text, origin,
                      {**plain(certificate), "gain_set": design_as_dict(design)})  # fmt: skip


def statement(design: ObserverDesign, length: int, origin: str) -> str:
    """Return what a proof says, with everything it rests on."""
    uncertain = design.linear[0].uncertainty
    box = None if uncertain is None or not uncertain.box.names else uncertain.box
    outside = f"; it {EXACT_MODEL}" if box is None else f", or {box.sentence}"
    linear = "" if box is None or uncertain is None or not uncertain.not_covered else f"; {uncertain.not_covered}"
    since = "since the start" if "start" in origin else "in the window (states within their stated bounds)"
    return (
        f"Proved: the last {length} samples are not explained without a fault {since} by any plant within its "
        f"tolerances, disturbances and noise within their bounds, and a start within its set (bounds of the state: "
        f"{origin}): a fault{outside}{linear}."
    )


@dataclass(frozen=True, eq=False)
class Question:
    """What is asked of a record: bounds of what is unknown, and the window's length."""

    bounds: FloatArray
    noise_bound: float
    initial_set: Mapping[str, Any] | None
    state_bounds: Mapping[str, Any] | None
    window: int

    @classmethod
    def of(
        cls, design: ObserverDesign, disturbance_bounds: Mapping[str, float] | None, noise_bound: float | None,
        initial_set: Mapping[str, Any] | None, state_bounds: Mapping[str, Any] | None, window: int,
    ) -> Question:  # fmt: skip
        """Return what is asked of a discrete linear design, checked."""
        plant, _ = design.linear
        if not plant.is_discrete:
            raise SpecError("A window is proved for sampled designs: this one is continuous in time.", path="gains")
        if not is_whole(window) or window < 2:
            raise SpecError(f"window is {window!r}: give a whole number of samples, 2 or more.", path="window")
        bounds = np.full(plant.nd, np.nan)
        for name, value in (disturbance_bounds or {}).items():
            bounds[index_of(name, plant.disturbance_names, what="disturbance_bounds")] = value
        if not np.all(bounds >= 0.0) or not np.isfinite(bounds).all():
            missing = [name for name, bound in zip(plant.disturbance_names, bounds, strict=True) if not bound >= 0.0]
            raise SpecError(f"The disturbance {(missing or ['?'])[0]!r} has no bound: give disturbance_bounds "
                            "(--disturbance), finite and 0 or more.", path="disturbance_bounds")  # fmt: skip
        if plant.nw and noise_bound is None:
            raise SpecError("Noise has no bound: give noise_bound (--noise-bound), in standard deviations.",
                            path="noise_bound")  # fmt: skip
        if initial_set is None and state_bounds is None:
            raise SpecError("Nothing bounds the state: give initial_set (--initial), or state_bounds.",
                            path="initial_set")  # fmt: skip
        return cls(bounds, float(noise_bound or 0.0) if plant.nw else 0.0, initial_set, state_bounds, window)

    def programme(self, design: ObserverDesign, u: FloatArray, y: FloatArray) -> tuple[Window, str]:
        """Return the programme of the last samples of a record, and where its bounds of the state come from."""
        affine, data, origin = window_data(
            design, u, y, self.window, bounds=self.bounds, noise_bound=self.noise_bound, initial_set=self.initial_set,
            state_bounds=self.state_bounds,
        )  # fmt: skip
        bounds = np.concatenate([self.bounds, np.full(affine.plant.nw, self.noise_bound)])
        return window_programme(affine, bounds, data), origin

    def as_dict(self) -> dict[str, Any]:
        """Return plain data."""
        return {
            "bounds": self.bounds, "noise_bound": self.noise_bound, "window": self.window,
            "initial_set": None if self.initial_set is None else _listed(self.initial_set),
            "state_bounds": None if self.state_bounds is None else _listed(self.state_bounds),
        }  # fmt: skip


def _listed(given: Mapping[str, Any]) -> dict[str, Any]:
    return {name: list(value) if isinstance(value, (list, tuple)) else value for name, value in given.items()}


def solved(programme: Window) -> tuple[FloatArray, FloatArray] | None:
    """Return multipliers of equations and inequalities (0 or less) by HiGHS; `None` where it gives none."""
    from scipy.optimize import linprog

    equal, below = programme.matrices()
    cost = np.zeros(len(programme.lower))
    cost[-1] = 1.0
    given = {"A_eq": equal, "b_eq": programme.equal.right} if programme.equal.right else {}
    found = linprog(
        cost, A_ub=below, b_ub=programme.below.right, bounds=np.stack([programme.lower, programme.upper], axis=1),
        method="highs", options={"time_limit": SOLVER_SECONDS}, **given,
    )  # fmt: skip
    if found.status != 0:
        return None
    multipliers = (found.eqlin.marginals if programme.equal.right else (), np.minimum(found.ineqlin.marginals, 0.0))
    equal, below = (np.array([float(f"{value:.{MULTIPLIER_DIGITS}g}") for value in part]) for part in multipliers)
    return equal, below


#: The stated margin may differ from the one found again by this share: matrices are made anew.
SAME_MARGIN = 1e-3


def verify_alarm(path: str | Path) -> VerificationReport:
    """Check the certificate of an alarm again, without a solver.

    Parameters
    ----------
    path : str or Path
        What `prove_alarm` (or ``obsynth prove-alarm``) wrote.

    Returns
    -------
    VerificationReport
        It fails where the file was changed, or the multipliers prove nothing.

    Raises
    ------
    SpecError
        The file is no certificate.
    """
    source = Path(path)
    content = read_json(source)
    if not isinstance(content, dict) or content.get("kind") != KIND:
        raise SpecError(f"{source} is no certificate of an alarm.", path=str(source))
    body = content.get("certificate")
    if content.get("schema_version") != SCHEMA_VERSION or not isinstance(body, dict):
        raise SpecError(f"{source} has an unknown schema version.", path=str(source))
    intact = content.get("sha256") == digest_of(body)
    checks = [_row("digest", "the file is as it was written", float(intact), 1.0, intact)]
    try:
        checks += _checked(body)
    except (ObsynthError, KeyError, TypeError, ValueError, IndexError, AttributeError) as error:
        checks.append(_row("contents", f"the certificate can be read ({error})", 0.0, 1.0, False))
    return VerificationReport.of(checks)


def _checked(body: Mapping[str, Any]) -> list[Check]:
    data = restored({name: value for name, value in body.items() if name != "gain_set"})
    design = loaded(json.dumps(body["gain_set"]).encode(), "the certificate's gain set")
    plant, _ = design.linear
    u = np.asarray(data["u"], dtype=np.float64).reshape(-1, plant.nu)
    y = np.asarray(data["y"], dtype=np.float64).reshape(-1, plant.ny)
    bounds = np.asarray(data["bounds"], dtype=np.float64)
    question = Question.of(
        design, dict(zip(plant.disturbance_names, bounds.tolist(), strict=True)), data["noise_bound"],
        data["initial_set"], data["state_bounds"], data["window"],
    )  # fmt: skip
    programme, origin = question.programme(design, u, y)
    equal, below = np.asarray(data["equal"]), np.asarray(data["below"])
    fits = equal.shape == (len(programme.equal.right),) and below.shape == (len(programme.below.right),)
    margin = float(programme.proved_least(equal, below)) if fits else float("nan")
    said = statement(design, min(question.window, len(y)), origin)
    rows = len(y) == data["row"] and len(u) == len(y)
    stated = float(data["margin"])
    return [
        _row("rows", "the record ends at the stated row", float(rows), 1.0, rows),
        _row("statement", "the sentence is that of these bounds", float(said == data["statement"]), 1.0,
             said == data["statement"]),
        _row("proof", "least excess over all bounds, from the multipliers, in exact arithmetic", margin, 0.0,
             margin > 0.0, kind="proved"),
        _row("margin", "the stated margin is not above what is proved", stated, margin * (1.0 + SAME_MARGIN),
             bool(0.0 < stated <= margin * (1.0 + SAME_MARGIN))),
    ]  # fmt: skip


def _row(name: str, claim: str, value: float, bound: float, passed: bool, *, kind: Any = "computed") -> Check:
    source = "linear programme with safe dual bounds (Neumaier and Shcherbina 2004)"
    return Check(name, claim, value, bound, value - bound, bool(passed), source, kind)
