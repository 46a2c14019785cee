"""Decoupling of a shipped observer, computed as a transfer function from the plant, without its tracking matrix.

At each frequency the trajectories ``(x, d) e^{st}`` of the plant are the null space of ``[sE - A, -Bd]``, whether the
plant is regular or not.  Through ``y = C x + Dd d`` and the realisation they give estimates, whose errors must vanish.
"""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from obsynth.analysis.existence.augmented_pencils import equilibrated
from obsynth.numerics.arrays import ComplexArray, FloatArray
from obsynth.numerics.lapack import LAPACK_BLOCK
from obsynth.numerics.modal_response import pencils_at
from obsynth.numerics.ranks import RANK_TOLERANCE, numerical_rank
from obsynth.numerics.scaling import balancing_factors
from obsynth.numerics.spectra import boundary_points
from obsynth.observers.linear.modes import frequency_grid
from obsynth.observers.linear.observer import LinearObserver
from obsynth.plants.descriptor import DescriptorSystem
from obsynth.plants.plant_units import PlantUnits

#: Equations whose reciprocal condition is above this are independent to the tolerance of every rank.
FAR_FROM_SINGULAR = 1e3 * RANK_TOLERANCE

#: A signal below this share of what a trajectory of unit size could make of it is held not to be moved.
UNMOVED_SIGNAL = 1e-4

#: Points are taken together until their pencils have so many entries: 4 MB, of which a handful is held at once.
ENTRIES_AT_ONCE = 2**18


@dataclass(frozen=True)
class DecouplingNorm:
    """The largest gain found from the unknown inputs to the errors of the estimates."""

    relative: float  # error of an estimate over the terms it is computed from
    fault_gain: float  # error of a fault estimate for unit (x, d) in scaled units
    frequency: float  # where, rad/s

    def worse(self, errors: tuple[float, float] | None, frequency: float) -> DecouplingNorm:
        """Return the larger of this and the relative error and that of a fault at a frequency; ``None`` at a pole."""
        if errors is None:
            return DecouplingNorm(np.inf, np.inf, frequency) if np.isfinite(self.relative) else self
        relative, fault = errors
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
    moved = trajectories_of(scaled, points, [inputs for _, inputs in groups])
    # How many trajectories there are at almost every frequency: where there seem to be more, rounding hides the rest.
    counts = [min(basis.shape[1] for basis in bases) for bases in moved]
    norms = [DecouplingNorm(0.0, 0.0, 0.0) for _ in groups]
    for some in _point_slices(points, max(scaled.nx + scaled.nd, observer.order)):
        passing = _Passing.of(observer, units, points[some])
        for place, (rows, inputs) in enumerate(groups):
            if counts[place] == 0:
                continue
            bases = np.stack([basis[:, -counts[place] :] for basis in moved[place][some]])
            for frequency, missed in zip(frequencies[some], passing.misses(scaled, bases, rows, inputs), strict=True):
                norms[place] = norms[place].worse(missed, float(frequency))
    return norms


def _point_slices(points: ComplexArray, order: int) -> list[slice]:
    """Return the points in parts whose matrices of an order fit into the room for them."""
    size = max(1, ENTRIES_AT_ONCE // max(1, order**2))
    return [slice(start, start + size) for start in range(0, len(points), size)]


def trajectories_of(
    plant: DescriptorSystem, points: ComplexArray, groups: Sequence[Sequence[int]]
) -> list[list[ComplexArray]]:
    """Return, for each group of unknown inputs, trajectories ``(nx + inputs, count)`` at each point, of unit norm."""
    bases_by_group: list[list[ComplexArray]] = [[] for _ in groups]
    for some in _point_slices(points, plant.nx + plant.nd):
        none = np.zeros_like(plant.Bd)
        pencils = pencils_at(np.hstack([plant.E, none]), np.hstack([plant.A, plant.Bd]), points[some])
        null_bases, columns, sure = _null_spaces(pencils)
        for bases, inputs in zip(bases_by_group, groups, strict=True):
            own = [*range(plant.nx), *(plant.nx + np.array(inputs, dtype=np.intp))]
            bases += _of_some(pencils, own, null_bases, columns, sure)
    return bases_by_group


def _of_some(
    pencils: ComplexArray,
    own: Sequence[int],
    null_bases: list[ComplexArray],
    columns: FloatArray,
    sure: NDArray[np.bool_],
) -> list[ComplexArray]:
    """Return the part of null spaces that is zero outside some columns: combinations without the others."""
    outside = np.setdiff1d(np.arange(pencils.shape[2]), own)
    if not len(outside):
        return _of_unit_norm(null_bases, columns)
    restricted: list[ComplexArray | None] = [None] * len(null_bases)
    if sure.any():
        places = np.flatnonzero(sure)
        sure_bases = np.stack([null_bases[place] for place in places])
        _, values, right = np.linalg.svd(sure_bases[:, outside])
        # Independent as they are, the others can be left out; or the null space is looked for by itself.
        left_out = (
            values[:, -1] > FAR_FROM_SINGULAR if 0 < values.shape[1] == len(outside) else np.zeros(len(places), bool)
        )
        combinations = np.conj(np.swapaxes(right[left_out, len(outside) :], 1, 2))
        combined = (sure_bases[left_out] @ combinations)[:, own]
        for place, basis in zip(
            places[left_out], _of_unit_norm([*combined], columns[places[left_out]][:, own]), strict=True
        ):
            restricted[place] = basis
    remaining = [place for place, basis in enumerate(restricted) if basis is None]
    if remaining:
        bases, scales, _ = _null_spaces(pencils[remaining][:, :, own])
        for place, basis in zip(remaining, _of_unit_norm(bases, scales), strict=True):
            restricted[place] = basis
    return [basis for basis in restricted if basis is not None]


def _of_unit_norm(bases: Sequence[ComplexArray], scales: FloatArray) -> list[ComplexArray]:
    """Return bases ``(n, count)`` with rows times their scales ``(k, n)``, each column of unit norm."""
    if len({basis.shape[1] for basis in bases}) > 1:
        return [_of_unit_norm([basis], own[None])[0] for basis, own in zip(bases, scales, strict=True)]
    if not len(bases):
        return []
    scaled = np.stack(bases) * scales[:, :, None]
    return [*(scaled / np.linalg.norm(scaled, axis=1, keepdims=True))]


def _null_spaces(pencils: ComplexArray) -> tuple[list[ComplexArray], FloatArray, NDArray[np.bool_]]:
    """Return bases ``(n, count)`` of the null spaces of ``(k, m, n)``, orthonormal, the least singular value last, in
    columns scaled by powers of two, with these ``(k, n)``, and whether the equations are independent beyond doubt."""
    from obsynth.numerics.lapack import zgecon, zunmqr

    scaled, columns = equilibrated(pencils)
    points, equations, count = scaled.shape
    bases, sure = list[ComplexArray](), np.zeros(points, dtype=bool)
    # Of independent equations a tenth of the work gives the same null space; the condition is estimated to a small
    # factor, and only for pencils far from the tolerance.
    if 0 < equations <= count:
        packed, factors = np.linalg.qr(np.conj(np.swapaxes(scaled, 1, 2)), mode="raw")
        # A triangle is its own LU factor; LAPACK's estimate for triangles is not in the oldest SciPy.
        triangles = np.tril(packed[:, :, :equations])
        sizes = np.max(np.sum(np.abs(triangles), axis=2), axis=1)
        for place in range(points):
            sure[place] = zgecon(triangles[place].T, sizes[place])[0] > FAR_FROM_SINGULAR
    last = np.eye(count, dtype=np.complex128)[:, equations:]
    for place in range(points):
        if sure[place] and last.size:
            room = LAPACK_BLOCK * last.shape[1]
            bases.append(zunmqr("L", "N", packed[place].T, factors[place], last, room)[0])
        elif sure[place]:
            bases.append(last)
        else:
            _, values, right = np.linalg.svd(scaled[place])
            bases.append(right[numerical_rank(values) :].conj().T)
    return bases, columns, sure


@dataclass(frozen=True, eq=False)
class _Passing:
    """An observer of the first ``tracked`` states at some points: what it makes of scaled outputs, and of the sizes of
    their terms."""

    through: ComplexArray
    passed: FloatArray
    faults: slice
    tracked: int

    @classmethod
    def of(cls, observer: LinearObserver, units: PlantUnits, points: ComplexArray) -> _Passing:
        """Return it at points in scaled time, with the observer's own states balanced."""
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
        direct = np.abs(dy) + np.abs(cz[:, :nx]) @ offsets
        resolvents = _inverses(pencils_at(None, az, points))
        passed = np.abs(cz) @ (np.abs(resolvents) @ formed) + direct
        return cls(cz @ (resolvents @ by) + dy, passed, observer.fault_rows, nx)

    def misses(
        self, plant: DescriptorSystem, trajectories: ComplexArray, rows: Sequence[int], inputs: Sequence[int]
    ) -> list[tuple[float, float] | None]:
        """Return, at each point, the largest relative error of an estimate in some rows, and that of a fault; ``None``
        at a pole."""
        tracked, dd, picked = self.tracked, plant.Dd[:, list(inputs)], list(rows)
        states = np.array([row for row in picked if row < tracked], dtype=np.intp)
        x, d = trajectories[:, : plant.nx], trajectories[:, plant.nx :]
        error = self.through[:, picked] @ (plant.C @ x + dd @ d)
        error[:, : len(states)] -= x[:, states]
        passed = self.passed[:, picked]
        size = passed @ (np.abs(plant.C) @ np.abs(x) + np.abs(dd) @ np.abs(d))
        size[:, : len(states)] += np.abs(x[:, states])
        # A signal that a trajectory does not move is rounding: it is judged by what trajectories of its size could do.
        possible = passed @ (np.sum(np.abs(plant.C), axis=1) + np.sum(np.abs(dd), axis=1))
        possible[:, : len(states)] += 1.0
        terms = np.maximum(np.max(size, axis=2), UNMOVED_SIGNAL * possible)
        shares = np.max(np.abs(error), axis=2) / np.where(terms > 0.0, terms, 1.0)
        faults = [place for place, row in enumerate(picked) if row in range(self.through.shape[1])[self.faults]]
        relative = np.max(shares, axis=1, initial=0.0)
        absolute = np.max(np.linalg.norm(error[:, faults], axis=2), axis=1, initial=0.0)
        poles = [bool(np.isnan(through).any()) for through in self.through]
        return [
            None if pole else (float(share), float(fault))
            for pole, share, fault in zip(poles, relative, absolute, strict=True)
        ]


def _inverses(matrices: ComplexArray) -> ComplexArray:
    """Return the inverses of ``(k, n, n)``, of a singular one nothing but NaN."""
    try:
        return np.asarray(np.linalg.inv(matrices))
    except np.linalg.LinAlgError:
        pass
    inverses = np.full_like(matrices, np.nan)
    for place, matrix in enumerate(matrices):
        with suppress(np.linalg.LinAlgError):
            inverses[place] = np.linalg.inv(matrix)
    return inverses
