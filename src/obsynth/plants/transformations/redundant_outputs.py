"""Outputs that depend on others: a plant with independent outputs, which are weighted means of those that are measured.

``[C Df Dd] = Q [C Df Dd]_p`` for a choice p of independent rows, so ``y - D u = Q (y - D u)_p + noise``. The outputs of
the merged plant are ``y_p = M y`` with ``M = (Q' R^-1 Q)^-1 Q' R^-1`` (Gauss and Markov: the least variance of all
unbiased means; R is the noise of the outputs, the identity where none is stated). A sensor that shows nothing, or only
a known input, has a row of zeros in Q and no weight in M.

Any M makes outputs of the plant: those that nearly depend on others may be merged in the same way, and the merged plant
is exact, ``C_p = M C``.  What the small differences between them show, at the price of their noise, is left unused.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from obsynth.numerics.arrays import FloatArray, read_only, remembered
from obsynth.numerics.ranks import (
    NEARLY_DEPENDENT,
    but_rounding,
    first_independent,
    product_but_rounding,
    rounding_rank,
)
from obsynth.numerics.sparse import is_sparse
from obsynth.plants.descriptor import DescriptorSystem
from obsynth.plants.plant_units import PlantUnits
from obsynth.proofs.exact_doubles import written_matrix
from obsynth.proofs.rational_matrices import pivot_columns

#: White noise that is added to noise without any in some direction, as a share of its largest: perfect sensors have a
#: weight of nearly one then, and a mean stays unbiased to as many digits.
LEAST_NOISE_SHARE = 1e-6

#: Rows whose lengths differ by less than this share are as long as each other.
ALIKE = 1e-6


@dataclass(frozen=True, eq=False)
class MergedOutputs:
    """A plant with independent outputs, and the weights ``M (np, ny)`` of the outputs as measured; ``exact``: the
    outputs depend on each other as written, not within rounding alone."""

    plant: DescriptorSystem
    weights: FloatArray
    exact: bool


@remembered
def merged_outputs(plant: DescriptorSystem) -> MergedOutputs | None:
    """Return the plant with its dependent outputs merged; ``None`` where all are independent (or matrices sparse)."""
    if is_sparse(plant.C) or plant.ny == 0:
        return None
    output_rows = np.hstack([plant.C, plant.Df, plant.Dd])
    picked, q, exact = _independent(output_rows)
    if not picked or len(picked) == plant.ny:
        return None
    weights = _weights(q, plant.Dw)
    names = [plant.output_names[i] for i in picked]
    merged = plant.replace(
        C=plant.C[list(picked)],
        Df=plant.Df[list(picked)],
        Dd=plant.Dd[list(picked)],
        D=weights @ plant.D,
        Dw=weights @ plant.Dw,
        output_names=names,
    )
    return MergedOutputs(merged, read_only(weights), exact)


@remembered
def nearly_merged_outputs(plant: DescriptorSystem) -> MergedOutputs | None:
    """Return the plant with outputs merged that nearly depend on others; ``None`` where there are none but those of
    `merged_outputs`."""
    if is_sparse(plant.C) or plant.ny < 2:
        return None
    # What is nearly dependent, and by how much a sensor counts without stated noise, is no matter of units.
    own = PlantUnits.of(plant)
    scaled = own.outputs[:, None] * np.hstack(
        [plant.C * own.states, plant.Df * own.faults, plant.Dd * own.disturbances]
    )
    lengths = np.linalg.norm(scaled, axis=1)
    moving = np.flatnonzero(lengths)
    if not len(moving):
        return None
    units = scaled[moving] / lengths[moving, None]
    values = np.linalg.svd(units, compute_uv=False)
    count = int(np.sum(values > NEARLY_DEPENDENT * values[0]))
    if count == rounding_rank(units):
        return None
    picked = [int(moving[place]) for place in _most_independent(units, count)]
    combinations = np.linalg.lstsq((scaled[picked] / lengths[picked, None]).T, units.T, rcond=None)[0].T
    combinations = but_rounding(combinations, np.ones_like(combinations))
    q = np.zeros((len(scaled), count))
    q[moving] = combinations * lengths[moving, None] / lengths[picked]
    weights = _weights(q, own.outputs[:, None] * plant.Dw) * own.outputs / own.outputs[picked, None]
    merged = {name: product_but_rounding(weights, getattr(plant, name)) for name in ("C", "D", "Df", "Dd", "Dw")}
    names = [plant.output_names[i] for i in picked]
    return MergedOutputs(plant.replace(**merged, output_names=names), read_only(weights), False)


def picked_outputs(plant: DescriptorSystem, merged: MergedOutputs) -> MergedOutputs:
    """Return the plant with the sensors alone that give merged outputs their names: a mean of sensors that differ a
    little may show at once, by that difference, what each of them shows a sample later."""
    picked = [plant.output_names.index(name) for name in merged.plant.output_names]
    rows = {name: getattr(plant, name)[picked] for name in ("C", "D", "Df", "Dd", "Dw")}
    alone = plant.replace(**rows, output_names=merged.plant.output_names)
    return MergedOutputs(alone, read_only(np.eye(plant.ny)[picked]), merged.exact)


def _independent(output_rows: FloatArray) -> tuple[list[int], FloatArray, bool]:
    """Return independent rows, the first ones where the numbers as written say which; Q: all rows from these; whether
    the numbers as written have this rank.  Rows that differ by rounding (a copy in another unit) depend on each
    other."""
    lengths = np.linalg.norm(output_rows, axis=1)
    moving = np.flatnonzero(lengths)
    units = output_rows[moving] / lengths[moving, None]
    count = rounding_rank(units) if len(moving) else 0
    picked = pivot_columns(written_matrix(output_rows).transpose()) if count else []
    # As written a copy may differ from its sensor in the last digit, and be taken in place of another one.
    exact = len(picked) == count and (not count or rounding_rank(output_rows[picked] / lengths[picked, None]) == count)
    if not exact:
        picked = [int(moving[place]) for place in _first_independent(units, count)]
    q = np.zeros((len(output_rows), count))
    if count:
        unit_rows = output_rows[picked] / lengths[picked, None]
        combinations = np.linalg.lstsq(unit_rows.T, units.T, rcond=None)[0].T
        q[moving] = but_rounding(combinations, np.ones_like(combinations)) * lengths[moving, None] / lengths[picked]
        q[picked] = np.eye(count)
    return picked, q, exact


def _first_independent(units: FloatArray, count: int) -> list[int]:
    """Return the first rows that are independent within rounding: a sensor that is added changes no choice; where
    rounding leaves fewer than ``count``, the most independent ones."""
    picked = first_independent(units, count)
    return picked if len(picked) == count else _most_independent(units, count)


def _most_independent(units: FloatArray, count: int) -> list[int]:
    """Return ``count`` rows, each with the most that those before leave of it; of rows alike the first, whatever
    rounding does."""
    remainder, picked = units, list[int]()
    for _ in range(count):
        sizes = np.linalg.norm(remainder, axis=1)
        place = int(np.flatnonzero(sizes >= (1.0 - ALIKE) * np.max(sizes))[0])
        direction = remainder[place] / sizes[place]
        remainder = remainder - np.outer(remainder @ direction, direction)
        picked.append(place)
    return sorted(picked)


def _weights(q: FloatArray, noise: FloatArray) -> FloatArray:
    """Return M of outputs whose noise has the columns ``noise (ny, nw)``; weights that are rounding are none: plants
    side by side would be joined by them."""
    covariance = noise @ noise.T
    largest = float(np.max(np.diag(covariance), initial=0.0))
    covariance = covariance + LEAST_NOISE_SHARE**2 * largest * np.eye(len(q)) if largest > 0.0 else np.eye(len(q))
    factor = np.linalg.cholesky(covariance)
    whitened = np.linalg.solve(factor, q)
    weights = np.asarray(np.linalg.lstsq(whitened, np.linalg.solve(factor, np.eye(len(q))), rcond=None)[0])
    deviations = np.sqrt(np.diag(covariance))
    largest_of_row = np.max(np.abs(weights) * deviations, axis=1, initial=0.0, keepdims=True)
    return but_rounding(weights, largest_of_row / deviations)
