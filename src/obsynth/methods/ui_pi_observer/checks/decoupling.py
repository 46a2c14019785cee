r"""Decoupling of a shipped observer, measured as a transfer function from the plant itself, without its tracking map.

At each frequency the trajectories ``(x, d) e^{st}`` of the plant are the null space of ``[sE - A, -Bd]``, whether the
plant is regular or not.  Through ``y = C x + Dd d`` and the realisation they give estimates, whose errors must vanish.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from obsynth.analysis.plant_units import PlantUnits
from obsynth.methods.ui_pi_observer.pencils import equilibrated
from obsynth.numerics.arrays import ComplexArray, FloatArray
from obsynth.numerics.lapack import LAPACK_BLOCK
from obsynth.numerics.ranks import RANK_TOLERANCE
from obsynth.numerics.scaling import balancing_factors
from obsynth.numerics.spectra import boundary_points
from obsynth.observers.linear.derived import frequency_grid
from obsynth.observers.linear.observer import LinearObserver
from obsynth.plants.descriptor import DescriptorSystem

#: Equations whose reciprocal condition is above this are independent to the tolerance of every rank.
FAR_FROM_SINGULAR = 1e3 * RANK_TOLERANCE
#: A signal below this share of what a trajectory of unit size could make of it is held not to be moved.
UNMOVED_SIGNAL = 1e-4


@dataclass(frozen=True)
class DecouplingNorm:
    """The largest gain found from the unknown inputs to the errors of the estimates."""

    relative: float  # error of an estimate over the terms it is computed from
    fault_gain: float  # error of a fault estimate for unit (x, d) in scaled units
    frequency: float  # where, rad/s

    def worse(self, found: tuple[float, float] | None, frequency: float) -> DecouplingNorm:
        """Return the larger of this and the relative error and that of a fault at a frequency; ``None`` at a pole."""
        if found is None:
            return DecouplingNorm(np.inf, np.inf, frequency) if np.isfinite(self.relative) else self
        relative, fault = found
        if not relative <= self.relative:
            return DecouplingNorm(relative, max(fault, self.fault_gain), frequency)
        return DecouplingNorm(self.relative, max(fault, self.fault_gain), self.frequency)


def decoupling_norm(plant: DescriptorSystem, observer: LinearObserver) -> DecouplingNorm:
    """Return how much of any unknown input reaches the estimates of states (if any), faults and residuals."""
    return decoupling_norms(plant, observer, [(range(len(observer.Cz)), range(plant.nd))])[0]


def decoupling_norms(
    plant: DescriptorSystem, observer: LinearObserver, groups: Sequence[tuple[Sequence[int], Sequence[int]]]
) -> list[DecouplingNorm]:
    """Return, for each group of rows and unknown inputs, how much of the inputs reaches those rows.

    The trajectories of all inputs are found once at each frequency: those of some are the combinations without the
    others.
    """
    if not all(np.all(np.isfinite(part)) for part in (observer.Az, observer.By, observer.Cz, observer.Dy)):
        return [DecouplingNorm(float("nan"), float("nan"), float("nan"))] * len(groups)
    frequencies = frequency_grid(observer)
    units = PlantUnits.of(plant).rounded()
    scaled = units.scaled_plant(plant)
    points = boundary_points(frequencies * (1.0 if units.discrete else units.time), scaled.dt)
    moved = [trajectories_of(scaled, point, [inputs for _, inputs in groups]) for point in points]
    # How many trajectories there are at almost every frequency: where there seem to be more, rounding hides the rest.
    counts = [min(at[place].shape[1] for at in moved) for place in range(len(groups))]
    found = [DecouplingNorm(0.0, 0.0, 0.0) for _ in groups]
    shipped = _Shipped.of(observer, units)
    for frequency, point, bases in zip(frequencies, points, moved, strict=True):
        passing = shipped.at(scaled, point)
        for place, (rows, inputs) in enumerate(groups):
            if counts[place] == 0:
                continue
            basis = bases[place][:, -counts[place] :]
            found[place] = found[place].worse(
                None if passing is None else passing.misses(basis, rows, inputs), float(frequency)
            )
    return found


def trajectories_of(plant: DescriptorSystem, point: complex, groups: Sequence[Sequence[int]]) -> list[ComplexArray]:
    """Return the trajectories ``(nx + inputs, count)`` at a point for some groups of unknown inputs, of unit norm."""
    pencil, nx = np.hstack([point * plant.E - plant.A, -plant.Bd]), plant.nx
    whole, columns, sure = _null_space(pencil)
    found = []
    for inputs in groups:
        own = [*range(nx), *(nx + np.array(inputs, dtype=np.intp))]
        absent = np.delete(whole, own, axis=0)
        if len(absent):
            _, values, right = np.linalg.svd(absent)
            # Independent as they are, the others can be left out; or the null space is looked for by itself.
            if sure and len(values) == len(absent) and values[-1] > FAR_FROM_SINGULAR:
                basis = (whole @ right[len(absent) :].conj().T)[own] * columns[own, None]
            else:
                basis, scales, _ = _null_space(pencil[:, own])
                basis = scales[:, None] * basis
        else:
            basis = whole * columns[:, None]
        found.append(basis / np.linalg.norm(basis, axis=0))
    return found


def _null_space(pencil: ComplexArray) -> tuple[ComplexArray, FloatArray, bool]:
    """Return a basis ``(n, count)`` of the null space, orthonormal, the least singular value last, in columns scaled
    by powers of two, with these, and whether the equations are independent beyond doubt."""
    from obsynth.numerics.lapack import zgecon, zgeqrf, zunmqr

    scaled, columns = equilibrated(pencil)
    equations, count = scaled.shape
    # Of independent equations a tenth of the work gives the same null space; the condition is estimated to a small
    # factor, and only for pencils far from the tolerance.
    if 0 < equations < count:
        packed, factors, _, _ = zgeqrf(scaled.conj().T)
        # A triangle is its own LU factor; LAPACK's estimate for triangles is not in the oldest SciPy.
        triangle = np.triu(packed[:equations])
        if zgecon(triangle, np.linalg.norm(triangle, 1))[0] > FAR_FROM_SINGULAR:
            last = np.eye(count, dtype=np.complex128)[:, equations:]
            return zunmqr("L", "N", packed, factors, last, LAPACK_BLOCK * last.shape[1])[0], columns, True
    _, values, right = np.linalg.svd(scaled)
    rank = int(np.sum(values > RANK_TOLERANCE * values[0]))
    return right[rank:].conj().T, columns, False


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

    def at(self, plant: DescriptorSystem, point: complex) -> _Passing | None:
        """Return what passes at a point; ``None`` at a pole."""
        try:
            resolvent = np.linalg.inv(point * np.eye(len(self.Az)) - self.Az)
        except np.linalg.LinAlgError:
            return None
        passed = np.abs(self.Cz) @ (np.abs(resolvent) @ self.formed) + self.direct
        return _Passing(self, plant, self.Cz @ (resolvent @ self.By) + self.Dy, passed)


@dataclass(frozen=True, eq=False)
class _Passing:
    """An observer at a point: what it makes of outputs, and of the sizes of their terms."""

    shipped: _Shipped
    plant: DescriptorSystem
    through: ComplexArray
    passed: FloatArray

    def misses(self, trajectories: ComplexArray, rows: Sequence[int], inputs: Sequence[int]) -> tuple[float, float]:
        """Return the largest relative error of an estimate in some rows, and that of a fault."""
        plant, tracked = self.plant, self.shipped.tracked
        dd, picked = plant.Dd[:, list(inputs)], list(rows)
        states = np.array([row for row in picked if row < tracked], dtype=np.intp)
        x, d = trajectories[: plant.nx], trajectories[plant.nx :]
        error = self.through[picked] @ (plant.C @ x + dd @ d)
        error[: len(states)] -= x[states]
        passed = self.passed[picked]
        size = passed @ (np.abs(plant.C) @ np.abs(x) + np.abs(dd) @ np.abs(d))
        size[: len(states)] += np.abs(x[states])
        # A signal that a trajectory does not move is rounding: it is judged by what trajectories of its size could do.
        possible = passed @ (np.sum(np.abs(plant.C), axis=1) + np.sum(np.abs(dd), axis=1))
        possible[: len(states)] += 1.0
        terms = np.maximum(np.max(size, axis=1), UNMOVED_SIGNAL * possible)
        relative = float(np.max(np.max(np.abs(error), axis=1) / np.where(terms > 0.0, terms, 1.0), initial=0.0))
        faults = [place for place, row in enumerate(picked) if row in range(len(self.through))[self.shipped.faults]]
        return relative, float(np.max(np.linalg.norm(error[faults], axis=1), initial=0.0))
