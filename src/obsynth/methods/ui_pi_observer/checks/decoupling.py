r"""Decoupling of a shipped observer, measured as a transfer function from the plant itself, without its tracking map.

At each frequency the trajectories ``(x, d) e^{st}`` of the plant are the null space of ``[sE - A, -Bd]``, whether the
plant is regular or not.  Through ``y = C x + Dd d`` and the realisation they give estimates, whose errors must vanish.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from obsynth.analysis.plant_units import PlantUnits
from obsynth.methods.ui_pi_observer.pencils import equilibrated
from obsynth.numerics.arrays import ComplexArray, FloatArray
from obsynth.numerics.ranks import RANK_TOLERANCE
from obsynth.numerics.scaling import balancing_factors
from obsynth.numerics.spectra import boundary_points, eigenvalues, speeds
from obsynth.observers.linear.observer import LinearObserver
from obsynth.plants.descriptor import DescriptorSystem

#: Frequencies of the grid, and how far it reaches beyond the slowest and the fastest pole of the observer.
GRID_POINTS = 61
GRID_REACH = 30.0
#: Equations whose reciprocal condition is above this are independent to the tolerance of every rank.
FAR_FROM_SINGULAR = 1e3 * RANK_TOLERANCE
#: A signal below this share of what a trajectory of unit size could make of it is held not to be moved.
UNMOVED = 1e-4


@dataclass(frozen=True)
class DecouplingNorm:
    """The largest gain found from the unknown inputs to the errors of the estimates."""

    relative: float  # error of an estimate over the terms it is computed from
    fault_gain: float  # error of a fault estimate for unit (x, d) in scaled units
    frequency: float  # where, rad/s


def frequency_grid(observer: LinearObserver) -> FloatArray:
    """Return frequencies in rad/s around the poles of an observer, zero included; up to pi/dt in discrete time."""
    found = speeds(eigenvalues(observer.Az), observer.dt) if observer.order else np.ones(1)
    alive = found[np.isfinite(found) & (found > 0.0)]
    low = float(np.min(alive, initial=1.0 if not alive.size else np.inf)) / GRID_REACH
    high = float(np.max(alive, initial=1.0 if not alive.size else 0.0)) * GRID_REACH
    if observer.dt > 0.0:
        high = np.pi / observer.dt
        low = min(low, high / GRID_REACH)
    return np.concatenate([[0.0], np.geomspace(low, high, GRID_POINTS)])


def decoupling_norm(plant: DescriptorSystem, observer: LinearObserver) -> DecouplingNorm:
    """Return how much of any unknown input reaches the estimates of states (if any), faults and residuals."""
    if not all(np.all(np.isfinite(part)) for part in (observer.Az, observer.By, observer.Cz, observer.Dy)):
        return DecouplingNorm(float("nan"), float("nan"), float("nan"))
    frequencies = frequency_grid(observer)
    units = PlantUnits.of(plant).rounded()
    scaled = units.scaled_plant(plant)
    points = boundary_points(frequencies * (1.0 if units.discrete else units.time), scaled.dt)
    pencils = [np.hstack([point * scaled.E - scaled.A, -scaled.Bd]) for point in points]
    moved = [trajectories_at(pencil) for pencil in pencils]
    # How many trajectories there are at almost every frequency: where there seem to be more, rounding hides the rest.
    count = min(nullity for _, nullity in moved)
    worst = DecouplingNorm(0.0, 0.0, 0.0)
    if count == 0:
        return worst
    shipped = _Shipped.of(observer, units)
    for frequency, point, (basis, _) in zip(frequencies, points, moved, strict=True):
        found = shipped.misses(scaled, point, basis[:, -count:])
        if found is None:
            return DecouplingNorm(float("inf"), float("inf"), float(frequency))
        relative, fault = found
        if not relative <= worst.relative:
            worst = DecouplingNorm(relative, max(fault, worst.fault_gain), float(frequency))
        elif fault > worst.fault_gain:
            worst = DecouplingNorm(worst.relative, fault, worst.frequency)
    return worst


def trajectories_at(pencil: ComplexArray) -> tuple[ComplexArray, int]:
    """Return right singular vectors ``(n, n)``, least value last, and how many are null, scaled by powers of two."""
    from scipy.linalg.lapack import ztrcon

    scaled, columns = equilibrated(pencil)
    equations = len(scaled)
    # Of independent equations a tenth of the work gives the same null space; the condition is estimated to a small
    # factor, and only for pencils far from the tolerance.
    turned, triangle = np.linalg.qr(scaled.conj().T, mode="complete")
    if 0 < equations < scaled.shape[1] and ztrcon(triangle[:equations])[0] > FAR_FROM_SINGULAR:
        vectors, rank = columns[:, None] * turned, equations
    else:
        _, values, right = np.linalg.svd(scaled)
        rank = int(np.sum(values > RANK_TOLERANCE * values[0]))
        vectors = columns[:, None] * right.conj().T
    return vectors / np.linalg.norm(vectors, axis=0), vectors.shape[1] - rank


@dataclass(frozen=True, eq=False)
class _Shipped:
    """An observer of the first ``tracked`` states that reads scaled outputs in scaled time, its own states balanced."""

    Az: FloatArray
    By: FloatArray
    Cz: FloatArray
    Dy: FloatArray
    formed: FloatArray
    direct: FloatArray
    faults: slice
    tracked: int

    @classmethod
    def of(cls, observer: LinearObserver, units: PlantUnits) -> _Shipped:
        order, outputs, nx = observer.order, observer.By.shape[1], len(observer.state_names)
        rows = np.ones(len(observer.Cz))
        rows[:nx] = 1.0 / units.states[:nx]
        az, by = units.rate * observer.Az, units.rate * observer.By / units.outputs
        cz, dy = rows[:, None] * observer.Cz, rows[:, None] * observer.Dy / units.outputs
        system = np.zeros((order + outputs + len(cz),) * 2)
        system[:order, :order], system[:order, order : order + outputs] = az, by
        system[order + outputs :, :order] = cz
        states = balancing_factors(system)[:order]
        az, by, cz = az * states / states[:, None], by / states[:, None], cz * states
        # Bhat = Ahat D + K may cancel: what it is formed of says how well it can be known.
        offsets = (units.states[:nx] / states[:nx])[:, None] * np.abs(dy[:nx])
        formed = np.abs(by) + np.abs(az[:, :nx]) @ offsets
        # The same holds for a residual, y - C xhat with xhat = z + D y.
        return cls(az, by, cz, dy, formed, np.abs(dy) + np.abs(cz[:, :nx]) @ offsets, observer.fault_rows, nx)

    def misses(self, plant: DescriptorSystem, point: complex, trajectories: ComplexArray) -> tuple[float, float] | None:
        """Return the largest relative error of an estimate and that of a fault; ``None`` at a pole."""
        nx = self.tracked
        x, d = trajectories[: plant.nx], trajectories[plant.nx :]
        y = plant.C @ x + plant.Dd @ d
        try:
            resolvent = np.linalg.inv(point * np.eye(len(self.Az)) - self.Az)
        except np.linalg.LinAlgError:
            return None
        error = self.Cz @ (resolvent @ (self.By @ y)) + self.Dy @ y
        error[:nx] -= x[:nx]
        passed = np.abs(self.Cz) @ (np.abs(resolvent) @ self.formed) + self.direct
        size = passed @ (np.abs(plant.C) @ np.abs(x) + np.abs(plant.Dd) @ np.abs(d))
        size[:nx] += np.abs(x[:nx])
        # A signal that a trajectory does not move is rounding: it is judged by what trajectories of its size could do.
        possible = passed @ (np.sum(np.abs(plant.C), axis=1) + np.sum(np.abs(plant.Dd), axis=1))
        possible[:nx] += 1.0
        rows = np.maximum(np.max(size, axis=1), UNMOVED * possible)
        relative = float(np.max(np.max(np.abs(error), axis=1) / np.where(rows > 0.0, rows, 1.0), initial=0.0))
        return relative, float(np.max(np.linalg.norm(error[self.faults], axis=1), initial=0.0))
