"""Direct feedthrough of a continuous filter, corrected such that no white noise passes to the error.

At infinite frequency the outputs are ``N v``, where v collects all signals that drive the plant, and the error of an
estimate ``D y`` is ``(D N - M) v``, where M is the reference model at infinity.  A design satisfies ``D N = M`` except
for rounding.  Any difference that is left makes the mean square under white noise infinite, so the nearest D with
``D N = M`` is taken, and T0, with ``T0 E = 0`` and ``C T E + D C = T0 A``, is computed from that D.
"""

from __future__ import annotations

from functools import reduce

import numpy as np
import scipy.linalg

from obsynth.methods.optimal_filter.fault_maps import FaultMap
from obsynth.methods.optimal_filter.realisation import left_kernel_of
from obsynth.methods.optimal_filter.realised_filter import RealisedFilter
from obsynth.methods.optimal_filter.weights import in_series
from obsynth.numerics.arrays import FloatArray
from obsynth.numerics.decoupling_windows import Model
from obsynth.numerics.ranks import RANK_TOLERANCE, but_rounding, product_but_rounding
from obsynth.plants.descriptor import DescriptorSystem
from obsynth.plants.pencil import structure_of
from obsynth.plants.plant_units import PlantUnits

#: Corrections, each by what the last one left: a small D keeps its digits.
CORRECTIONS = 3
#: Entries of D below this share of the largest of their row, before or after, are rounding of the corrections: what
#: they leave is less than what verification takes for the rounding of a row, 1e4 units in its last place.
ROUNDED_SHARE = 1e-13


def without_white_noise(plant: DescriptorSystem, fault_map: FaultMap, filters: list[Model]) -> list[Model]:
    """Return filters, from y in the plant's units, that pass at once what their fault map passes, and no more.

    ``plant``: continuous, with the disturbances that are decoupled.  Where its index is 2 or more they are returned as
    they are.
    """
    driven = fault_map.driven(plant)
    if structure_of(driven).index not in (0, 1):
        return filters
    units = PlantUnits.of(plant).rounded().outputs
    faults, disturbances, noise = _shown_at_once(driven)
    noise = noise[:, : noise.shape[1] - fault_map.undriven]
    shown = units[:, None] * np.hstack([faults, disturbances, noise])
    sizes = np.linalg.norm(shown, axis=0)
    sizes = np.where(sizes > 0.0, sizes, 1.0)
    weights, reference = fault_map.weights, fault_map.reference
    models = [model for model in (None if weights is None else weights.faults, reference) if model is not None]
    wanted = reduce(in_series, models)[3]
    wanted = np.hstack([wanted, np.zeros((len(wanted), shown.shape[1] - wanted.shape[1]))]) / sizes
    inverse = np.asarray(np.linalg.pinv(shown / sizes, rcond=RANK_TOLERANCE), dtype=np.float64)
    return [(a, b, c, _corrected(d / units, shown / sizes, wanted, inverse) * units) for a, b, c, d in filters]


def _shown_at_once(plant: DescriptorSystem) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return the gains at infinite frequency from faults, disturbances and noise to the outputs (index at most 1).

    Gains that are rounding errors are set to zero: each signal is scaled by its own gain later.
    """
    answer = _answer(plant)
    answered, size = plant.C @ answer, np.abs(plant.C) @ np.abs(answer)
    ways = ((plant.Bf, plant.Df), (plant.Bd, plant.Dd), (plant.Bw, plant.Dw))
    faults, disturbances, noise = (
        but_rounding(through - answered @ driven, np.abs(through) + size @ np.abs(driven)) for driven, through in ways
    )
    return faults, disturbances, noise


def with_digits_of(plant: DescriptorSystem, fault_map: FaultMap, follower: RealisedFilter) -> RealisedFilter:
    """Return a filter that passes no white noise at once but by rounding, with the T0 that follows.

    ``plant``: continuous, of any index, with the disturbances that are decoupled.
    """
    index = structure_of(plant).index
    if follower.lag or index == 0:
        return follower
    if index == 1:
        D, C, answer = follower.D, plant.C, _answer(plant)
        follower = follower._replace(T0=but_rounding(D @ C @ answer, np.abs(D) @ np.abs(C) @ np.abs(answer)))
    return _without_rounding_passed(plant, fault_map, follower)


def _without_rounding_passed(plant: DescriptorSystem, fault_map: FaultMap, follower: RealisedFilter) -> RealisedFilter:
    """Return a filter with the direct feedthrough of its fault map, by changes of D and T0 within their rounding.

    With an index of 2 or more the feedthrough by the states depends on T as well; the part that D and T0 determine is
    ``D Dw - T0 Bw``.  With index 1, a T0 that is zero up to the digits lost in D is set to zero.
    """
    kernel = left_kernel_of(plant.E)
    weights, reference, none = fault_map.weights, fault_map.reference, np.zeros((len(follower.D), plant.nd))
    of_noise = None if weights is None or weights.noise is None else weights.noise[3]
    of_faults = None if weights is None or fault_map.exact else weights.faults
    ways = [(plant.Bf, plant.Df), (plant.Bd, plant.Dd), (plant.Bw, plant.Dw)]
    faults, disturbances, noise = (
        np.vstack([through, -product_but_rounding(kernel, driven)]) for driven, through in ways
    )
    models = [model for model in (of_faults, reference) if model is not None]
    passed = reduce(in_series, models)[3]
    faults = faults if of_faults is None else faults @ of_faults[3]
    noise = noise if of_noise is None else noise @ of_noise
    noise = noise[:, : noise.shape[1] - fault_map.undriven]
    shown = np.hstack([faults, disturbances, noise])
    wanted = np.hstack([passed, none, np.zeros((len(passed), noise.shape[1]))])
    rows = np.hstack([follower.D, follower.T0[:, : plant.nx] @ np.linalg.pinv(kernel)])
    kernel_sizes = np.linalg.norm(kernel / PlantUnits.of(plant).equations, axis=1)
    for i, row in enumerate(rows):
        # What passes of an input is rounding beside its own terms, as it is verified.
        entries = np.abs(row)
        terms = entries[:, None] * shown
        sizes = np.linalg.norm(terms, axis=0)
        sizes = np.where(sizes > 0.0, sizes, 1.0)
        inverse = np.linalg.pinv(terms / sizes, rcond=RANK_TOLERANCE)
        for _ in range(CORRECTIONS):
            row = row - (((row @ shown - wanted[i]) / sizes) @ inverse) * entries
        # Of what was nothing but rounding nothing is left, in any coordinate of T0.
        largest = entries.copy()
        largest[plant.ny :] = np.max(kernel_sizes * entries[plant.ny :], initial=0.0) / kernel_sizes
        rows[i] = np.where(np.abs(row) > ROUNDED_SHARE * largest, row, 0.0)
    return follower._replace(D=rows[:, : plant.ny], T0=rows[:, plant.ny :] @ kernel)


def _answer(plant: DescriptorSystem) -> FloatArray:
    """Return ``X = R (L A R)^-1 L``, L and R the kernels of E: ``-X g`` is what g does to the states at once."""
    units = PlantUnits.of(plant).rounded()
    equations, states = units.equations[:, None], units.states
    e, a = equations * plant.E * states, equations * plant.A * states
    left, right = scipy.linalg.null_space(e.T, rcond=RANK_TOLERANCE).T, scipy.linalg.null_space(e, rcond=RANK_TOLERANCE)
    answer = (states[:, None] * right) @ np.linalg.solve(left @ a @ right, left) * units.equations
    return np.asarray(answer, dtype=np.float64)


def _corrected(d: FloatArray, shown: FloatArray, wanted: FloatArray, inverse: FloatArray) -> FloatArray:
    # Where nothing may pass, what the corrections leave of D is rounding of its first entries.
    largest = np.max(np.abs(d), axis=1, initial=0.0)
    for _ in range(CORRECTIONS):
        d = d - (d @ shown - wanted) @ inverse
    largest = np.maximum(largest, np.max(np.abs(d), axis=1, initial=0.0))
    return np.where(np.abs(d) > ROUNDED_SHARE * largest[:, None], d, 0.0)
