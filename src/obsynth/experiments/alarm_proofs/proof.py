"""From a record to a proof that it is not fault-free: the programme solved, its dual checked in exact arithmetic."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from obsynth.analysis.transformations.uncertain_plant import AffinePlant, affine_plant
from obsynth.errors import PreconditionError, SpecError
from obsynth.experiments.alarm_proofs.window import OUTWARD, Window, WindowData, window_programme
from obsynth.experiments.monitors.adaptive_bound import adaptive_bound
from obsynth.experiments.monitors.adaptive_monitor import start_of
from obsynth.experiments.monitors.adaptive_record import thresholds_of_records
from obsynth.files.outputs import FileKind, write_atomically
from obsynth.numerics.arguments import is_finite_number, is_whole
from obsynth.numerics.arrays import FloatArray
from obsynth.plants.validation import index_of
from obsynth.results.design import ObserverDesign
from obsynth.results.gain_sets import digest_of
from obsynth.tolerances.result import EXACT_MODEL
from obsynth.tolerances.robustness import structure_of
from obsynth.tolerances.tracking import tracking_of

#: Where the bounds of the state come from.
REPLAY, STATED = "replay from the start", "stated"


def window_data(
    design: ObserverDesign, u: FloatArray, y: FloatArray, length: int, *, bounds: FloatArray, noise_bound: float,
    initial_set: Mapping[str, Any] | None, state_bounds: Mapping[str, Any] | None,
) -> tuple[AffinePlant, WindowData, str]:  # fmt: skip
    """Return the plant over its box, the last ``length`` samples with bounds of the state, and where these come from.

    Without stated ones they come from the observer run again from the start, and its error.
    """
    affine = affine_plant(design.linear[0])
    first = max(0, len(y) - length)
    if initial_set is None:
        low, high = _stated(affine, state_bounds or {}, len(y) - first)
        return affine, WindowData(u[first:], y[first:], low, high), STATED
    _, observer = design.linear
    tracking = tracking_of(design, affine)
    structure = structure_of(
        design, affine, tracking, bounds=bounds, noise_bound=noise_bound, faults=False, states=True
    )
    start = start_of(affine, tracking, None, initial_set, np.zeros(observer.order))
    bound = adaptive_bound(structure, observer, start, varying=affine.box.variation == "varying")
    estimates = observer.run(y, u if u.shape[1] else None)
    rows = np.hstack([estimates.states, estimates.faults, estimates.residuals])
    read = rows @ structure.reading.T
    found = thresholds_of_records(bound, read[None], u[None], y[None])
    middle = read - found.shift[0]
    width = (found.total - np.abs(found.shift))[0] + OUTWARD * (np.abs(read) + found.total[0])
    low, high = (middle - width)[first:], (middle + width)[first:]
    return affine, WindowData(u[first:], y[first:], low, high), REPLAY


def _stated(affine: AffinePlant, given: Mapping[str, Any], steps: int) -> tuple[FloatArray, FloatArray]:
    names = affine.plant.state_names
    missing = [name for name in names if name not in given]
    if missing:
        raise SpecError(f"Nothing bounds the state {missing[0]!r}: give initial_set (--initial), or its bound.",
                        path="initial_set")  # fmt: skip
    sizes = []
    for name in names:
        if not (is_finite_number(given[name]) and given[name] >= 0.0):
            raise SpecError(f"The bound of {name!r} is {given[name]!r}: give a number, 0 or more.", path="state_bounds")
        sizes.append(float(given[name]))
    back = np.abs(2.0 * np.eye(len(names)) - affine.coordinates) @ np.array(sizes)
    high = np.tile(back, (steps, 1))
    return -high, high


SCHEMA_VERSION = 1
KIND = "obsynth alarm certificate"
CERTIFICATE = FileKind("an alarm certificate", b'"kind": "obsynth alarm certificate"')


def document(certificate: Mapping[str, Any]) -> str:
    """Return the text of the file."""
    body = {"kind": KIND, "schema_version": SCHEMA_VERSION, "sha256": digest_of(certificate),
            "certificate": certificate}  # fmt: skip
    return json.dumps(body, indent=1, allow_nan=False) + "\n"


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
        return write_atomically(path, document(self.certificate))

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
    y = np.asarray(found.eqlin.marginals) if programme.equal.right else np.zeros(0)
    return _short(y), _short(np.minimum(found.ineqlin.marginals, 0.0))


def _short(values: FloatArray) -> FloatArray:
    return np.array([float(f"{value:.{MULTIPLIER_DIGITS}g}") for value in values])
