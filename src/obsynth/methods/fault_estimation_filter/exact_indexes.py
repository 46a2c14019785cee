"""Detectability indexes and the rank of Upsilon on the numbers of the plant as written, without any tolerance.

They are the same for every nonsingular T with ``T E + N C = I``: a rational one is taken.
"""

from __future__ import annotations

import random
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from obsynth.analysis.existence.numbers import PlantNumbers, numbers_of
from obsynth.plants.descriptor import DescriptorSystem

if TYPE_CHECKING:
    from flint import fmpq_mat

#: Random choices of T after which none is taken to be nonsingular.
MOST_CHOICES = 20
_SEED = 45


@dataclass(frozen=True)
class ExactIndexes:
    """Indexes (``None``: the fault never reaches the outputs) and the rank of Upsilon (0 where one is missing)."""

    indexes: tuple[int | None, ...]
    rank: int


def numbers_with_fault_states(plant: DescriptorSystem) -> PlantNumbers | None:
    """Return the numbers of a plant with its sensor faults appended as algebraic states."""
    from flint import fmpq_mat

    from obsynth.proofs.exact_pencils import blocks, identity, zeros_matrix

    chosen = [int(j) for j in np.flatnonzero(np.any(plant.Df != 0.0, axis=0))]
    numbers = numbers_of(plant)
    if numbers is None or not chosen:
        return numbers
    nx, nf, count = plant.nx, plant.nf, len(chosen)
    across, down, square = zeros_matrix(nx, count), zeros_matrix(count, nx), zeros_matrix(count, count)
    rows = fmpq_mat(count, nf, [int(i == j) for i in chosen for j in range(nf)])
    kept = fmpq_mat(nf, nf, [int(i == j and i not in chosen) for i in range(nf) for j in range(nf)])
    shown = fmpq_mat(nf, count, [int(i == j) for i in range(nf) for j in chosen])
    own = numbers.as_own
    changed: dict[str, Any] = {
        "E": numbers.blocks([[numbers.matrix("E"), own(across)], [own(down), own(square)]]),
        "A": numbers.blocks([[numbers.matrix("A"), own(across)], [own(down), own(-identity(count))]]),
        "Bf": numbers.blocks([[numbers.matrix("Bf")], [own(rows)]]),
        "C": numbers.blocks([[numbers.matrix("C"), numbers.product(numbers.matrix("Df"), own(shown))]]),
        "Df": numbers.product(numbers.matrix("Df"), own(kept)),
    }
    e, c, df = (numbers.rational[name] for name in ("E", "C", "Df"))
    rational = {"E": blocks([[e, across], [down, square]]), "C": blocks([[c, df * shown]]), "Df": df * kept}
    return numbers.with_matrices(changed, rational=rational)


def exact_indexes(plant: DescriptorSystem) -> ExactIndexes | None:
    """Return them where ``rank [E; C]`` is full; ``None`` where that fails, or data were computed."""
    numbers = numbers_of(plant)
    if numbers is None or numbers.computed:
        return None  # a Markov parameter that is zero may have been computed as one that is not
    found: ExactIndexes | None = numbers.remembered("indexes", lambda: _decided_indexes(plant))
    return found


def _decided_indexes(plant: DescriptorSystem) -> ExactIndexes | None:
    numbers = numbers_with_fault_states(plant)
    if numbers is None:
        return None
    t = _nonsingular_t(numbers)
    if t is None:
        return None
    left: Any = numbers.as_own(t)
    ta, c = numbers.product(left, numbers.matrix("A")), numbers.matrix("C")
    order, indexes, columns = int(t.ncols()), list[int | None](), list[Any]()
    for fault in range(plant.nf):
        vector = numbers.product(left, numbers.picked(numbers.matrix("Bf"), [fault]))
        for step in range(1, order + 1):
            shown = numbers.product(c, vector)
            if not numbers.is_zero(shown):
                indexes.append(step)
                columns.append(shown)
                break
            vector = numbers.product(ta, vector)
        else:
            indexes.append(None)
    rank = numbers.rank(numbers.blocks([columns])) if None not in indexes and columns else 0
    return ExactIndexes(tuple(indexes), rank)


def _nonsingular_t(numbers: PlantNumbers) -> fmpq_mat | None:
    """Return a rational nonsingular T with ``T E + N C = I``."""
    from flint import fmpq_mat

    from obsynth.proofs.exact_pencils import blocks, null_basis

    e, c = numbers.rational["E"], numbers.rational["C"]
    stacked, order = blocks([[e], [c]]), int(e.ncols())
    if stacked.rank() < order:
        return None
    inverse = (stacked.transpose() * stacked).solve(stacked.transpose())
    free, rng = null_basis(stacked.transpose()).transpose(), random.Random(_SEED)
    for size in range(MOST_CHOICES):
        mix = fmpq_mat(order, int(free.nrows()), [rng.randint(-size, size) for _ in range(order * int(free.nrows()))])
        both = inverse + mix * free
        t = fmpq_mat(order, order, [both[i, j] for i in range(order) for j in range(order)])
        if t.det() != 0:
            return t
    return None
