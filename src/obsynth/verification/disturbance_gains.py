"""Gain from disturbances to the fault errors of a plant and its stored observer, at low frequencies and near poles.

With stored numbers the identities of an observer hold only to rounding, so that states of the plant leak into the
errors.  If the plant is not stable, no finite gain from the disturbances exists.  The question is then how long a
disturbance may last before rounding matters.
"""

from __future__ import annotations

from functools import cached_property

import numpy as np

from obsynth.numerics.arrays import SMALLEST, ComplexArray, FloatArray
from obsynth.numerics.modal_response import MOST_ENTRIES_AT_ONCE, pencils_at, resolved
from obsynth.numerics.modal_solves import STATES_FOR_MODES, ModalSolves
from obsynth.numerics.ranks import BOUNDARY_TOLERANCE
from obsynth.numerics.spectra import boundary_points
from obsynth.observers.linear.modes import modes_of, poles_of
from obsynth.plants.pencil import structure_of
from obsynth.results.number_texts import duration
from obsynth.verification.error_system import ErrorModel

#: The lowest frequency (rad per sample) of a claimed gain, and the number of frequencies.  Slower disturbances are only
#: reported.
SLOWEST_CLAIMED, CLAIM_POINTS = 1e-7, 120

#: With more states, of plant and observer together, the gain is computed at fewer frequencies.
MANY_JOINT_STATES, FEWER_POINTS = 300, 40

#: Modulus of a point outside all poles, as a multiple of the largest pole.
OUTSIDE = 1.5

#: Lower frequencies (rad per sample) at which the gain is tested for the time after which stored numbers matter.
SLOWER = tuple(10.0**-k for k in range(8, 17))

#: Rounding scatters multiple poles.  Poles this close to the boundary may lie on it, poles with angles this far apart
#: count as different, and at most so many angles are examined.
ABOUT_THE_BOUNDARY, APART, MOST_ANGLES = 1e-2, 1e-2, 8

#: Largest distance (rad per sample) from a pole on the boundary at which a gain takes long to build up.
MOST_DISTANCE = 0.1

_ON_THE_BOUNDARY = "the plant has a pole on the boundary of stability: no finite gain exists for stored numbers"


class PlantWithStoredObserver:
    """The transfer function from disturbances to fault errors of a plant with its stored observer.

    With ``of_rounding`` only the paths through the remainders of the identities count, without the ones by which the
    design itself lets disturbances through.
    """

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
        """Whether all poles of the plant are inside the boundary of stability, by more than a tolerance."""
        return not self.poles.size or bool(np.all(self.distances < -BOUNDARY_TOLERANCE))

    @property
    def distances(self) -> FloatArray:
        """Distances of the plant's poles from the region of stability, negative inside; relative in continuous time."""
        size = max(float(np.max(np.abs(self.poles), initial=0.0)), np.finfo(np.float64).tiny)
        return np.asarray(np.abs(self.poles) - 1.0 if self.plant.dt > 0.0 else self.poles.real / size)

    def swept(self, unit: float, level: float) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return frequencies, the gains there, and the distances to boundary poles where a gain exceeds ``level``."""
        discrete, poles = self.plant.dt > 0.0, self.poles
        few = self.plant.nx + self.observer.order <= MANY_JOINT_STATES
        points = CLAIM_POINTS if few else FEWER_POINTS
        frequencies = unit * np.geomspace(SLOWEST_CLAIMED, np.pi if discrete else 10.0, points)
        # Poles of the plant near the boundary; those of a scattered multiple pole have nearly equal angles.
        near = poles[np.abs(np.abs(poles) - 1.0 if discrete else poles.real / unit) <= ABOUT_THE_BOUNDARY]
        sorted_angles = sorted(set(np.abs(np.angle(near) if discrete else near.imag).tolist()))
        distinct = [
            angle for i, angle in enumerate(sorted_angles) if not i or angle - sorted_angles[i - 1] > APART * unit
        ]
        angles = np.asarray(distinct[:MOST_ANGLES], dtype=np.float64)
        if few:
            # More frequencies on both sides of each angle, ever closer to it.
            resonances = angles[angles > SLOWEST_CLAIMED * unit][:, None]
            offsets = unit * np.geomspace(SLOWEST_CLAIMED, MOST_DISTANCE, CLAIM_POINTS // 4)
            around = np.abs(np.concatenate([resonances - offsets, resonances + offsets], axis=1)).ravel()
            frequencies = np.concatenate([frequencies, np.minimum(around, np.pi) if discrete else around])
        gains = self.gains(frequencies)
        beyond = frequencies[gains > level]
        nearest = np.min(np.abs(beyond[:, None] - angles[None, :]), axis=1, initial=np.inf) / unit
        return frequencies, gains, np.asarray(nearest)

    def gains(self, frequencies: FloatArray) -> FloatArray:
        """Return the largest singular values at frequencies, in rad per sample or, in continuous time, rad/s."""
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
        """Return the largest singular values at points of the plane."""
        # Solve from the left: there are fewer rows of fault errors than disturbances.
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
        return ModalSolves.of(None, observer.Az, at=self._point_outside(poles_of(observer)), modes=modes_of(observer))

    @cached_property
    def _plant_solves(self) -> ModalSolves | None:
        if self.plant.nx < STATES_FOR_MODES:
            return None
        return ModalSolves.of(self.plant.E, self.plant.A, at=self._point_outside(self.poles))

    @staticmethod
    def _point_outside(poles: ComplexArray) -> float:
        """Return a positive point that is larger than the modulus of all poles."""
        return OUTSIDE * max(float(np.max(np.abs(poles), initial=0.0)), SMALLEST)


def duration_limit(system: PlantWithStoredObserver, level: float, unit: float, beyond: float) -> tuple[str, float]:
    """Return a sentence on lasting disturbances, and for how many seconds a unit disturbance may last.

    Parameters
    ----------
    system : PlantWithStoredObserver
        The plant with its stored observer.
    level : float
        The gain, or error, that counts as noticeable.
    unit : float
        Unit of frequencies: 1 per sample, or the fastest rate in 1/s.
    beyond : float
        Largest distance (in ``unit``) from a pole on the boundary at which the gain exceeds the level, or zero.
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
            f"state is not held down, they matter after about {duration(seconds)}"
        ), seconds
    if not np.isfinite(seconds):
        above = np.flatnonzero(system.gains(np.array(SLOWER) * unit) > level)
        seconds = per_unit / SLOWER[above[0]] if above.size else np.inf
    if np.isfinite(seconds):
        return (
            f"{_ON_THE_BOUNDARY}; they matter for disturbances that last longer than about {duration(seconds)}"
        ), seconds
    seconds = per_unit / SLOWER[-1]
    return f"{_ON_THE_BOUNDARY}; they do not matter within {duration(seconds)}", seconds
