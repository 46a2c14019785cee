"""Joint correction of T and B of a filter where one of them has lost digits.

A filter of least gain comes with a B that is right but for rounding, and a T that follows that B.  Where what rounding
makes of B reaches an estimate that nothing else does, or of faults that the outputs hardly show, no other T takes it
away: the nearest T and B are taken that keep all identities with the filter's A, C, D and T0.
"""

from __future__ import annotations

import numpy as np
import scipy.linalg

from obsynth.methods.optimal_filter.fault_maps import FaultMap
from obsynth.methods.optimal_filter.realised_filter import RealisedFilter
from obsynth.numerics.arrays import FloatArray
from obsynth.plants.descriptor import DescriptorSystem
from obsynth.plants.plant_units import PlantUnits
from obsynth.verification.error_system import with_past

#: Rows of T and B may be changed by this share of their largest number, where the plant is to be followed.
LOST_DIGITS = 1e-7
#: Entries of T and B that are smaller, of the largest of their row, are rounding of the corrections.
ROUNDED_NUMBER = 1e-16
#: Combinations of equations below this share of the largest are not corrected: a fault that outputs hardly show is.
SMALLEST_SEEN = 1e-12
#: Equations are solved so many times, each time for what is left.
SOLUTIONS = 3


def with_common_numbers(plant: DescriptorSystem, follower: RealisedFilter) -> RealisedFilter | None:
    """Return a filter whose T and B, changed by rounding, follow the plant; ``None`` where it is no rounding.

    ``plant``: with the disturbances that are decoupled.
    """
    system, wanted = _identities(plant, follower)
    corrected, changed = _corrected(plant, follower, system, wanted)
    return corrected if changed <= LOST_DIGITS else None


def with_fault_map(plant: DescriptorSystem, fault_map: FaultMap, follower: RealisedFilter) -> RealisedFilter:
    """Return a filter whose T and B follow the plant and make the faults pass by their fault map.

    Of faults that the outputs hardly show, what passes is a small difference of large numbers.
    """
    system, wanted = _identities(plant, follower)
    rows, passed = _faults_passed(plant, fault_map, follower)
    return _corrected(plant, follower, np.vstack([system, rows]), np.concatenate([wanted, passed]))[0]


def _identities(plant: DescriptorSystem, follower: RealisedFilter) -> tuple[FloatArray, FloatArray]:
    """Return the equations of T and B, row by row, that its identities are with A, C, D and T0."""
    a, c, own_states = follower.A, follower.C, np.eye(len(follower.A))
    e, own, _, shown = with_past(plant, follower.lag)
    bd = np.vstack([plant.Bd, np.zeros((len(e) - plant.nx, plant.nd))])
    system = np.vstack(
        [
            np.hstack([np.kron(a, e.T) - np.kron(own_states, own.T), np.kron(own_states, shown.T)]),
            np.hstack([np.kron(own_states, bd.T), -np.kron(own_states, plant.Dd.T)]),
            np.hstack([np.kron(c, e.T), np.zeros((len(c) * len(e), len(a) * plant.ny))]),
        ]
    )
    outputs = follower.T0 @ own - follower.D @ shown
    return system, np.concatenate([np.zeros(len(a) * (len(e) + plant.nd)), outputs.ravel()])


def _faults_passed(
    plant: DescriptorSystem, fault_map: FaultMap, follower: RealisedFilter
) -> tuple[FloatArray, FloatArray]:
    """Return the equations of T and B by which faults pass by their fault map, at more points than it has states."""
    count = len(follower.T[0]) - plant.nx
    bf = np.vstack([plant.Bf, np.zeros((count, plant.nf))])
    direct = follower.D @ plant.Df - follower.T0 @ bf
    rows, wanted = [], []
    for point, goal in fault_map.at_points(plant, follower.A):
        read = np.linalg.solve((point * np.eye(len(follower.A)) - follower.A).T, follower.C.T).T
        row, passed = np.hstack([np.kron(read, bf.T), -np.kron(read, plant.Df.T)]), (direct - goal).ravel()
        rows += [row.real, row.imag]
        wanted += [passed.real, passed.imag]
    return np.vstack(rows), np.concatenate(wanted)


def _corrected(
    plant: DescriptorSystem, follower: RealisedFilter, system: FloatArray, wanted: FloatArray
) -> tuple[RealisedFilter, float]:
    """Return a filter with the nearest T and B that solve equations, and the largest share of a row that was changed.

    Each row may change by shares of its largest number, in units in which the plant is near one; what is zero stays.
    """
    units = PlantUnits.of(plant).rounded()
    largest = (
        np.max(np.abs(part) / own, axis=1, keepdims=True, initial=0.0) * own
        for part, own in ((follower.T, np.tile(units.equations, 1 + follower.lag)), (follower.B, units.outputs))
    )
    sizes = np.concatenate([part.ravel() for part in largest])
    numbers = np.concatenate([follower.T.ravel(), follower.B.ravel()])
    scaled = system * sizes
    heights = np.max(np.abs(scaled), axis=1, initial=0.0)
    scale = 1.0 / np.where(heights > 0.0, heights, 1.0)
    changed = np.zeros(len(numbers))
    for _ in range(SOLUTIONS):
        missed = scale * (wanted - system @ (numbers + sizes * changed))
        changed += scipy.linalg.lstsq(scale[:, None] * scaled, missed, lapack_driver="gelsy", cond=SMALLEST_SEEN)[0]
    numbers = numbers + sizes * changed
    numbers = np.where(np.abs(numbers) > ROUNDED_NUMBER * sizes, numbers, 0.0)
    t, b = np.split(numbers, [follower.T.size])
    corrected = follower._replace(T=t.reshape(follower.T.shape), B=b.reshape(follower.B.shape))
    return corrected, float(np.max(np.abs(changed), initial=0.0))
