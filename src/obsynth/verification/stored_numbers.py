"""Errors from the stored numbers of a linear design, for which the identities hold to rounding and not exactly.

Rows bound the errors per unit of states and known inputs; where the plant is not stable, no finite gain from the
disturbances exists, and what can be said is after how long it matters.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from obsynth.numerics.arrays import SMALLEST, ComplexArray, FloatArray, remembered
from obsynth.numerics.modal_response import MOST_ENTRIES_AT_ONCE, pencils_at, resolved
from obsynth.numerics.modal_solves import STATES_FOR_MODES, ModalSolves
from obsynth.numerics.ranks import BOUNDARY_TOLERANCE
from obsynth.numerics.spectra import boundary_points
from obsynth.observers.linear.modes import modes_of, poles_of
from obsynth.observers.linear.observer import LinearObserver
from obsynth.plants.pencil import structure_of
from obsynth.proofs.balls import rounded_up
from obsynth.proofs.contraction import REMAINDER_OF_SUM, proved_contractions
from obsynth.results.checks import Check, information, upper_bound_check
from obsynth.results.design import ObserverDesign
from obsynth.verification.error_system import BOTH_BALLS, ByNumbers, ErrorModel, RemainderChannel, contraction_of

#: Claimed bounds have room for what rounding of the contraction can do on another machine; at most this share of them.
MOST_ROOM = 1.0

#: Up to so many states each bound is found by a sum of its own where another machine's is to be found again.
OWN_SUMS_UP_TO = 40

#: A gain is claimed for disturbances that last up to one over this, rad per sample: slower ones are reported.
SLOWEST_CLAIMED, CLAIM_POINTS = 1e-7, 120

#: With more states, of plant and observer together, fewer are looked at.
MANY_JOINT_STATES, FEWER_POINTS = 300, 40

#: A point is outside of all poles where its modulus is so many times the largest.
OUTSIDE = 1.5

#: Frequencies beyond that at which the time is looked for after which stored numbers matter, rad per sample.
SLOWER = tuple(10.0**-k for k in range(8, 17))

#: Multiple poles scatter; those this close to the boundary may be on it, and this far apart they are different ones.
ABOUT_THE_BOUNDARY, APART, MOST_ANGLES = 1e-2, 1e-2, 8

#: Beyond this distance (rad per sample) from such poles a gain is none that takes long to build up.
MOST_DISTANCE = 0.1

#: What rounding of the stored numbers leaves of an identity, relative to its terms.
IDENTITY_ROUNDING = 1e-11

#: Without a claimed gain stored numbers matter when they turn a unit disturbance into this error.
NOTICED = 1e-3

#: Tolerance of the comparison of gains found in double precision.
GAIN_TOLERANCE = 1e-9

_ON_THE_BOUNDARY = "the plant has a pole on the boundary of stability: no finite gain exists for stored numbers"

_WITNESS_SIGNALS = ("states", "inputs", "disturbances")

_ERROR_WITNESSES = ("state_error", "input_error", "disturbance_error")


@dataclass(frozen=True, eq=False)
class StoredErrors:
    """Upper bounds on the error of every row of output per unit of states, inputs and decoupled disturbances."""

    channel: RemainderChannel
    bounds: tuple[FloatArray, ...]
    room: FloatArray  # (rows, 1): factors, one or more

    @classmethod
    def of(cls, model: ErrorModel) -> StoredErrors | None:
        """Return the bounds; ``None`` where no contraction of the observer can be proved."""
        return _bounds_of(model.observer).of(model.numbers, lambda: cls._found(model))

    @classmethod
    def _found(cls, model: ErrorModel) -> StoredErrors | None:
        contraction = contraction_of(model.observer)
        if contraction is None:
            return None
        bounds = model.remainder.errors_per_unit(model.observer, contraction)
        if contraction.roundings > MOST_ROOM:
            # Which rate is proved is a matter of rounding: what is claimed holds by any.
            bounds = cls(model.remainder, bounds, np.ones(1))._by_all(model.observer, np.fmax).bounds
        if not all(np.all(np.isfinite(bound)) for bound in bounds):
            return None
        room = np.full((len(model.observer.Cz), 1), 1.0 + min(contraction.roundings, MOST_ROOM))
        # Sums that another machine takes closely are no larger, whichever term these end at.
        room[model.observer.fault_rows] *= 1.0 + REMAINDER_OF_SUM
        return cls(model.remainder, bounds, room if model.is_evaluated_exactly else BOTH_BALLS * room)

    def witnesses(self) -> dict[str, FloatArray]:
        """Return what a certificate claims of them, by name, such that every machine finds it again: rounded outwards.
        What has no column is left out."""
        return {
            name: np.where(bound > 0.0, rounded_up(self.room * bound, 2), 0.0)
            for name, bound in zip(_ERROR_WITNESSES, self.bounds, strict=True)
            if bound.shape[1]
        }

    def least(self, observer: LinearObserver) -> StoredErrors:
        """Return the least bounds by all contractions that are found, by the first with a sum of each: any of them is a
        proof."""
        return self._by_all(observer, np.fmin, closely=observer.order <= OWN_SUMS_UP_TO)

    def _by_all(self, observer: LinearObserver, chosen: np.ufunc, *, closely: bool = False) -> StoredErrors:
        bounds = self.bounds
        contractions = proved_contractions(observer.Az, discrete=observer.dt > 0.0, poles=poles_of(observer))
        for i, contraction in enumerate(contractions):
            others = self.channel.errors_per_unit(observer, contraction, closely=closely and not i)
            known = (np.where(np.isfinite(other), other, np.nan) for other in others)
            bounds = tuple(chosen(one, other) for one, other in zip(bounds, known, strict=True))
        return replace(self, bounds=bounds)


@remembered
def _bounds_of(_observer: LinearObserver) -> ByNumbers[StoredErrors | None]:
    return ByNumbers()


def stored_number_rows(design: ObserverDesign, model: ErrorModel, gamma: float | None = None) -> Iterator[Check]:
    """Yield the rows on stored numbers; ``gamma`` is the gain from the disturbances that is claimed, if any."""
    plant, observer = design.linear
    errors = StoredErrors.of(model)
    claimed = {name: design.certificate.matrices.get(name) for name in _ERROR_WITNESSES}
    if errors is None:
        yield information(
            "stored numbers",
            "what rounding of the stored numbers adds to the errors: no bound was found",
            np.nan,
            source="stored numbers",
            status="assumed",
        )
        if any(value is not None for value in claimed.values()):
            yield upper_bound_check(
                "stored numbers: states", "the claimed bounds are found again", np.nan, 0.0, source="stored numbers"
            )
        return
    pairs = [(bound, claimed[name]) for name, bound in zip(_ERROR_WITNESSES, errors.bounds, strict=True)]
    if any(
        shipped is not None and shipped.shape == bound.shape and np.any(bound > shipped) for bound, shipped in pairs
    ):
        errors = errors.least(observer)
    columns = (model.state_names, plant.input_names, plant.disturbance_names)
    for kind, name, bound, labels in zip(_WITNESS_SIGNALS, _ERROR_WITNESSES, errors.bounds, columns, strict=True):
        if bound.size:
            yield _per_unit(observer, kind, bound, claimed[name], labels)
        elif claimed[name] is not None:
            yield upper_bound_check(
                f"stored numbers: {kind}", "there is something to claim", 1.0, 0.0, source="certificate"
            )
    yield from _gain_rows(design, model, gamma)


def _per_unit(
    observer: LinearObserver, kind: str, bound: FloatArray, claimed: FloatArray | None, labels: tuple[str, ...]
) -> Check:
    outputs = bound[observer.fault_rows] if observer.fault_names else bound
    first = observer.fault_rows.start if observer.fault_names else 0
    i, j = np.unravel_index(int(np.argmax(outputs)), outputs.shape)
    text = f"largest to {observer.row_names[first + int(i)]}: {outputs[i, j]:.2g} per unit of {labels[int(j)]}"
    what = f"error of an estimate per unit of the plant's {kind}, from rounding of the stored numbers"
    name, source = f"stored numbers: {kind}", "the residuals of the identities, outward rounded"
    if claimed is None:
        row = information(name, what, float(outputs[i, j]), source=source, detail=f"{text}; no bound is claimed")
        return Check(**{**row.__dict__, "status": "proved"})
    if claimed.shape != bound.shape or not np.all(np.isfinite(claimed)):
        return upper_bound_check(name, what, np.nan, 0.0, source=source, detail="the claimed bound has another shape")
    allowed = claimed
    # Where nothing is claimed to be left, nothing may be.
    shares = np.where(allowed > 0.0, bound / np.where(allowed > 0.0, allowed, 1.0), np.inf)
    ratios = np.where(bound > allowed, shares, 0.0)
    largest_row, column = divmod(int(np.argmax(ratios)), ratios.shape[1])
    if not ratios[largest_row, column] > 0.0:
        largest_row, column = first + int(i), int(j)
    return upper_bound_check(
        name,
        f"{what}: at most as claimed",
        float(bound[largest_row, column]),
        float(allowed[largest_row, column]),
        source=source,
        kind="proved",
        detail=text,
    )


def _gain_rows(design: ObserverDesign, model: ErrorModel, gamma: float | None) -> Iterator[Check]:
    """Yield what plant and stored observer together make of disturbances."""
    plant, observer = design.linear
    if not plant.nd or not observer.fault_names:
        return
    # What a design lets through is no effect of rounding: it counts where its gain is claimed, or is to be zero.
    system = _Composite(model, of_rounding=gamma is None and not model.decoupled)
    unit = 1.0 if plant.dt > 0.0 else system.fastest
    level = NOTICED if gamma is None else float(gamma) * (1.0 + GAIN_TOLERANCE)
    if gamma is None and system.is_plant_stable:
        # How large the gain is matters to nothing then.
        frequencies = gains = nearest = np.zeros(0)
    else:
        frequencies, gains, nearest = system.swept(unit, level)
    verdict, seconds = _when_it_matters(system, level, unit, float(np.max(nearest, initial=0.0)))
    if gamma is not None:
        worst = int(np.argmax(gains))
        text = (
            f"gain d -> fault error of the plant and the stored observer, from {SLOWEST_CLAIMED:.0e} rad per sample up"
        )
        detail = f"largest of {len(frequencies)} frequencies at {frequencies[worst]:.2g} rad per sample; {verdict}"
        drifting = np.isfinite(seconds) and np.all(nearest <= MOST_DISTANCE)
        if nearest.size and drifting and model.rounding() <= IDENTITY_ROUNDING:
            # Nobody could store better numbers: no finite gain exists, and what can be said is for how long it holds.
            yield information(
                "gain with stored numbers",
                f"{text}; above gamma by rounding alone",
                float(gains[worst]),
                source="recomputed, plant included",
                detail=detail,
            )
        else:
            yield upper_bound_check(
                "gain with stored numbers",
                text,
                float(gains[worst]),
                level,
                source="recomputed, plant included",
                detail=detail,
            )
    yield information(
        "stored numbers: horizon",
        "seconds for which a unit disturbance may last before rounding of the stored numbers "
        + ("reaches the claimed gain" if gamma is not None else f"makes an error of {NOTICED:g} of it"),
        seconds,
        source="recomputed, plant included",
        detail=verdict,
    )


class _Composite:
    """The transfer from the disturbances to the fault error of a plant and its stored observer, at any frequency;
    ``of_rounding``: of what the plant's state leaves of the identities alone."""

    def __init__(self, model: ErrorModel, *, of_rounding: bool = False) -> None:
        self.plant, self.observer = plant, observer = model.plant, model.observer
        rows, channel = observer.fault_rows, model.remainder
        self.lags = model.lag + 1
        width = plant.nx * self.lags
        self.K, self.J = channel.K.midpoint[:, :width], channel.J.midpoint[rows, :width]
        self.driven = -model.disturbance
        self.direct = observer.Dy[rows] @ plant.Dd
        if of_rounding:
            self.driven, self.direct = 0.0 * self.driven, 0.0 * self.direct
        self.outputs = observer.Cz[rows]
        values = structure_of(plant).finite_eigenvalues
        self.poles: ComplexArray = np.asarray(values, dtype=np.complex128)
        own = np.abs(poles_of(observer)) if observer.order else np.ones(1)
        self.fastest = float(max(np.max(own, initial=0.0), np.finfo(np.float64).tiny))

    @property
    def is_plant_stable(self) -> bool:
        """Whether no pole of the plant is on the boundary of stability, as far as can be told, or outside."""
        return not self.poles.size or bool(np.all(self.distances < -BOUNDARY_TOLERANCE))

    @property
    def distances(self) -> FloatArray:
        """How far the plant's poles are outside the region of stability, relative to the largest in continuous time."""
        size = max(float(np.max(np.abs(self.poles), initial=0.0)), np.finfo(np.float64).tiny)
        return np.asarray(np.abs(self.poles) - 1.0 if self.plant.dt > 0.0 else self.poles.real / size)

    def swept(self, unit: float, level: float) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return frequencies, the gains there, and for those above a level how far the next pole on the boundary is."""
        discrete, poles = self.plant.dt > 0.0, self.poles
        few = self.plant.nx + self.observer.order <= MANY_JOINT_STATES
        points = CLAIM_POINTS if few else FEWER_POINTS
        frequencies = unit * np.geomspace(SLOWEST_CLAIMED, np.pi if discrete else 10.0, points)
        # The poles of the plant on the boundary or about it; scattered multiple ones have angles next to each other.
        near = poles[np.abs(np.abs(poles) - 1.0 if discrete else poles.real / unit) <= ABOUT_THE_BOUNDARY]
        sorted_angles = sorted(set(np.abs(np.angle(near) if discrete else near.imag).tolist()))
        distinct = [
            angle for i, angle in enumerate(sorted_angles) if not i or angle - sorted_angles[i - 1] > APART * unit
        ]
        angles = np.asarray(distinct[:MOST_ANGLES], dtype=np.float64)
        if few:
            # On both sides of each angle, ever closer to it.
            turning = angles[angles > SLOWEST_CLAIMED * unit][:, None]
            apart = unit * np.geomspace(SLOWEST_CLAIMED, MOST_DISTANCE, CLAIM_POINTS // 4)
            around = np.abs(np.concatenate([turning - apart, turning + apart], axis=1)).ravel()
            frequencies = np.concatenate([frequencies, np.minimum(around, np.pi) if discrete else around])
        gains = self.gains(frequencies)
        beyond = frequencies[gains > level]
        nearest = np.min(np.abs(beyond[:, None] - angles[None, :]), axis=1, initial=np.inf) / unit
        return frequencies, gains, np.asarray(nearest)

    def gains(self, frequencies: FloatArray) -> FloatArray:
        """Return the largest singular values at frequencies (rad per sample, or rad/s), a few of them at once."""
        dt = self.plant.dt
        points = boundary_points(frequencies / dt if dt > 0.0 else frequencies, dt)
        at_once = max(1, MOST_ENTRIES_AT_ONCE // max(self.plant.E.size, self.K.size, 1))
        parts = [points[i : i + at_once] for i in range(0, len(points), at_once)]
        try:
            return np.concatenate([self._gains_at(part) for part in parts])
        except np.linalg.LinAlgError:
            return np.array([self._gain_at(point) for point in points])

    def _gain_at(self, point: complex) -> float:
        """Return the largest singular value at a point; zero at a pole of the plant."""
        try:
            return float(self._gains_at(np.array([point]))[0])
        except np.linalg.LinAlgError:
            return 0.0

    def _gains_at(self, points: ComplexArray) -> FloatArray:
        # From the left, where the rows of fault errors are fewer than the disturbances.
        modal = self._observer_solves
        if modal is None:
            observer_response = np.concatenate([*resolved(None, self.observer.Az.T, self.outputs.T, points)]).transpose(
                0, 2, 1
            )
        else:
            observer_response = modal.rows(points, self.outputs)
        ages = np.split(observer_response @ self.K + self.J, self.lags, axis=2)
        readings = np.asarray(sum(part * points[:, None, None] ** -age for age, part in enumerate(ages)))
        modal = self._plant_solves
        if modal is None:
            pencils = pencils_at(self.plant.E.T, self.plant.A.T, points)
            through = np.linalg.solve(pencils, readings.transpose(0, 2, 1)).transpose(0, 2, 1)
        else:
            through = modal.rows(points, readings)
        whole = through @ self.plant.Bd + observer_response @ self.driven + self.direct
        finite = np.all(np.isfinite(whole), axis=(1, 2))
        return np.where(finite, np.linalg.norm(np.where(finite[:, None, None], whole, 0.0), 2, axis=(1, 2)), 0.0)

    @cached_property
    def _observer_solves(self) -> ModalSolves | None:
        observer = self.observer
        if observer.order < STATES_FOR_MODES:
            return None
        return ModalSolves.of(None, observer.Az, at=self._apart(poles_of(observer)), modes=modes_of(observer))

    @cached_property
    def _plant_solves(self) -> ModalSolves | None:
        if self.plant.nx < STATES_FOR_MODES:
            return None
        return ModalSolves.of(self.plant.E, self.plant.A, at=self._apart(self.poles))

    @staticmethod
    def _apart(poles: ComplexArray) -> float:
        """Return a point outside of all poles."""
        return OUTSIDE * max(float(np.max(np.abs(poles), initial=0.0)), SMALLEST)


def _when_it_matters(system: _Composite, level: float, unit: float, beyond: float) -> tuple[str, float]:
    """Return what to say of disturbances that last, and for how many seconds they may.

    ``beyond``: distance (in ``unit``) from a pole on the boundary at which the gain still exceeds the level; or zero.
    """
    dt, poles = system.plant.dt, system.poles
    per_unit = dt if dt > 0.0 else 1.0 / unit
    outside = system.distances > BOUNDARY_TOLERANCE
    seconds = per_unit / beyond if beyond > 0.0 else np.inf
    if system.is_plant_stable:
        return "the plant is stable: a finite gain exists", np.inf
    if outside.any():
        rate = float(np.max(np.log(np.abs(poles[outside])) / dt if dt > 0.0 else poles[outside].real))
        largest_remainder = max(
            float(np.max(np.abs(system.K), initial=0.0)), float(np.max(np.abs(system.J), initial=0.0))
        )
        seconds = min(seconds, float(np.log(max(level / max(largest_remainder, SMALLEST), 1.0)) / rate))
        return (
            "the plant has a pole outside the region of stability: no finite gain exists for stored numbers; where its "
            f"state is not held down, they matter after about {seconds:.3g} s"
        ), seconds
    if not np.isfinite(seconds):
        above = np.flatnonzero(system.gains(np.array(SLOWER) * unit) > level)
        seconds = per_unit / SLOWER[above[0]] if above.size else np.inf
    if np.isfinite(seconds):
        return (
            f"{_ON_THE_BOUNDARY}; they matter for disturbances that last longer than about "
            f"{seconds:.3g} s ({seconds / 86_400:.3g} days)"
        ), seconds
    seconds = per_unit / SLOWER[-1]
    return f"{_ON_THE_BOUNDARY}; they do not matter within {seconds:.3g} s", seconds
