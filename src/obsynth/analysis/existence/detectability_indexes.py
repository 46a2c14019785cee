"""Fault detectability indexes and matrix: bounded and relative in floating point, exact on the numbers as written.

Source: Wang 2015, Definitions 2 and 3, Theorem 2 (i). They are the same for every nonsingular T with ``T E + N C = I``.
"""

from __future__ import annotations

import random
from dataclasses import dataclass
from typing import Any, TypeAlias

import numpy as np
from flint import fmpq_mat

from obsynth.analysis.existence.condition import Condition
from obsynth.analysis.existence.plant_numbers import PlantNumbers, numbers_of
from obsynth.analysis.existence.statements import settled_rank
from obsynth.numerics.arrays import FloatArray, largest_singular_value
from obsynth.numerics.ranks import (
    CANCELLATION_TOLERANCE,
    DEAD_CHAIN_TOLERANCE,
    MARKOV_TOLERANCE,
    RankDecision,
    decide_rank,
)
from obsynth.numerics.scaling import Scaling
from obsynth.plants.descriptor import DescriptorSystem
from obsynth.plants.plant_units import PlantUnits
from obsynth.proofs.rational_matrices import blocks, identity, left_null_basis, picked_columns, zeros_matrix

#: Random choices of T after which none is taken to be nonsingular.
MOST_CHOICES = 20

#: Faults with at least this share of the largest in a dependence are named.
DEPENDENT_SHARE = 0.1

_PENCIL_SEED = 45

#: Indexes (``None``: the fault never reaches the outputs) and the rank of Upsilon (0 where one is missing).
ExactIndexes: TypeAlias = tuple[tuple[int | None, ...], int]

#: A fault detectability matrix with a larger condition number is usable but noisy: a note says so.
WARN_DETECTABILITY_CONDITION = 1e4

#: Above this rounding of data and gains is as large as what distinguishes the faults.
REFUSE_CONDITION = 1e12


def numbers_with_fault_states(plant: DescriptorSystem, numbers: PlantNumbers | None) -> PlantNumbers | None:
    """Return the numbers of a plant with its sensor faults appended as algebraic states."""
    chosen = [int(j) for j in np.flatnonzero(np.any(plant.Df != 0.0, axis=0))]
    if numbers is None or not chosen:
        return numbers
    nx, nf, count = plant.nx, plant.nf, len(chosen)
    across, down, square = zeros_matrix(nx, count), zeros_matrix(count, nx), zeros_matrix(count, count)
    selected = picked_columns(identity(nf), chosen)
    rows = selected.transpose()
    remaining = identity(nf) - selected * rows
    own = numbers.as_own
    changed: dict[str, Any] = {
        "E": blocks([[numbers.matrices["E"], own(across)], [own(down), own(square)]]),
        "A": blocks([[numbers.matrices["A"], own(across)], [own(down), own(-identity(count))]]),
        "Bf": blocks([[numbers.matrices["Bf"]], [own(rows)]]),
        "C": blocks([[numbers.matrices["C"], numbers.product(numbers.matrices["Df"], own(selected))]]),
        "Df": numbers.product(numbers.matrices["Df"], own(remaining)),
    }
    e, c, df = (numbers.rational[name] for name in ("E", "C", "Df"))
    rational = {"E": blocks([[e, across], [down, square]]), "C": blocks([[c, df * selected]]), "Df": df * remaining}
    return numbers.with_matrices(changed, rational=rational)


def exact_indexes(plant: DescriptorSystem) -> ExactIndexes | None:
    """Return them where ``rank [E; C]`` is full; ``None`` where that fails, or data were computed."""
    numbers = numbers_of(plant)
    if numbers is None or numbers.computed:
        return None  # a Markov parameter that is zero may have been computed as one that is not
    indexes: ExactIndexes | None = numbers.remembered("indexes", lambda: _decided_indexes(plant, numbers))
    return indexes


def _decided_indexes(plant: DescriptorSystem, known: PlantNumbers) -> ExactIndexes | None:
    numbers = numbers_with_fault_states(plant, known)
    if numbers is None:
        return None
    t = nonsingular_t(numbers)
    if t is None:
        return None
    own_t: Any = numbers.as_own(t)
    ta, c = numbers.product(own_t, numbers.matrices["A"]), numbers.matrices["C"]
    order, indexes, columns = int(t.ncols()), list[int | None](), list[Any]()
    for fault in range(plant.nf):
        vector = numbers.product(own_t, numbers.columns("Bf", [fault]))
        for step in range(1, order + 1):
            response = numbers.product(c, vector)
            if numbers.rank(response):
                indexes.append(step)
                columns.append(response)
                break
            vector = numbers.product(ta, vector)
        else:
            indexes.append(None)
    rank = numbers.rank(blocks([columns])) if None not in indexes and columns else 0
    return tuple(indexes), rank


def nonsingular_t(numbers: PlantNumbers) -> fmpq_mat | None:
    """Return a rational nonsingular T with ``T E + N C = I``."""
    e, c = numbers.rational["E"], numbers.rational["C"]
    stacked, order = blocks([[e], [c]]), int(e.ncols())
    if stacked.rank() < order:
        return None
    inverse = (stacked.transpose() * stacked).solve(stacked.transpose())
    free, rng = left_null_basis(stacked), random.Random(_PENCIL_SEED)
    for size in range(MOST_CHOICES):
        mix = fmpq_mat(order, int(free.nrows()), [rng.randint(-size, size) for _ in range(order * int(free.nrows()))])
        solution = inverse + mix * free
        t = picked_columns(solution, range(order))
        if t.det() != 0:
            return t
    return None


@dataclass(frozen=True, eq=False)
class FaultDetectability:
    """Indexes ``rho_i`` (``None``: no effect on the outputs) and matrices of ``(TA, C)`` for the fault directions
    ``TF``.

    ``Psi (nx, nf)``: columns ``(TA)^(rho_i - 1) T f_i``, else zero; ``Upsilon = C Psi``.
    """

    indexes: tuple[int | None, ...]
    Psi: FloatArray
    Upsilon: FloatArray
    rank: RankDecision
    condition_number: float  # of Upsilon with columns of unit length

    @property
    def finite(self) -> bool:
        """Whether every fault reaches the outputs."""
        return all(index is not None for index in self.indexes)

    def chain(self, ta: FloatArray, tf: FloatArray) -> list[FloatArray]:
        """Return the powers ``[TF, TA TF, ...]`` up to the largest index, one matrix ``(nx, nf)`` each."""
        powers = [tf]
        for _ in range(max((index or 1) for index in self.indexes) - 1):
            powers.append(ta @ powers[-1])
        return powers


def fault_detectability(
    ta: FloatArray,
    c: FloatArray,
    tf: FloatArray,
    *,
    plant: DescriptorSystem,
    scaling: Scaling | None = None,
    exact: ExactIndexes | None = None,
) -> FaultDetectability:
    """Return the detectability indexes (19) and matrices (20), with the exact ones where these are known.
    What shows is judged in units of the plant's own; ``scaling``: those of the matrices, if not the given ones."""
    if exact is None:
        units = PlantUnits.of(plant).rounded()
        states, outputs = units.states, units.outputs
        if scaling is not None:
            states, outputs = states / scaling.states, outputs / scaling.outputs
        own_a, own_c, own_f = ta * states / states[:, None], outputs[:, None] * c * states, tf / states[:, None]
        size = largest_singular_value(own_c)
        visible = [_first_visible(own_a, own_c, own_f[:, i], size) for i in range(tf.shape[1])]
        results = [(index, states * vector) for index, vector in visible]
    else:
        results = [_at_index(ta, tf[:, i], index) for i, index in enumerate(exact[0])]
    psi = np.column_stack([vector for _, vector in results]) if results else np.zeros((ta.shape[0], 0))
    upsilon = c @ psi
    lengths = np.linalg.norm(upsilon, axis=0)
    unit = upsilon / np.where(lengths == 0.0, 1.0, lengths)
    values = np.linalg.svd(unit, compute_uv=False) if unit.size else np.ones(1)
    invertible = unit.shape[0] >= unit.shape[1] and values[-1] > 0.0
    condition = float(values[0] / values[-1]) if invertible else np.inf
    rank = decide_rank(unit, expected=tf.shape[1], tolerance=1.0 / REFUSE_CONDITION)
    rank = settled_rank(rank, None if exact is None else exact[1])
    return FaultDetectability(tuple(index for index, _ in results), psi, upsilon, rank, condition)


def _at_index(ta: FloatArray, direction: FloatArray, index: int | None) -> tuple[int | None, FloatArray]:
    """Return the vector ``(TA)^(index - 1) direction``."""
    if index is None:
        return None, np.zeros_like(direction)
    for _ in range(index - 1):
        direction = ta @ direction
    return index, direction


def _first_visible(ta: FloatArray, c: FloatArray, direction: FloatArray, size: float) -> tuple[int | None, FloatArray]:
    """Return the index of one fault and the vector that shows; by Cayley-Hamilton nx steps suffice."""
    growth: float | None = None
    vector, bound = direction, float(np.linalg.norm(direction))
    for step in range(1, ta.shape[0] + 1):
        length = float(np.linalg.norm(vector))
        if length <= DEAD_CHAIN_TOLERANCE * bound or length == 0.0:
            break
        if float(np.linalg.norm(c @ vector)) > MARKOV_TOLERANCE * size * length:
            return step, vector
        growth = max(largest_singular_value(ta), 1.0) if growth is None else growth
        vector, bound = ta @ vector, bound * growth
    return None, np.zeros_like(direction)


def detectability_conditions(
    detectability: FaultDetectability, fault_names: tuple[str, ...], output_scales: FloatArray
) -> tuple[Condition, ...]:
    """Return the conditions on indexes and matrix; ``output_scales (ny,)`` give norms in the user's units."""
    hidden = tuple(name for name, index in zip(fault_names, detectability.indexes, strict=True) if index is None)
    largest = max((index for index in detectability.indexes if index is not None), default=0)
    finite = Condition(
        "finite detectability indexes",
        "every fault reaches the outputs",
        not hidden,
        float(largest),
        float(detectability.Psi.shape[0]),
        "Wang 2015, eq. (19)",
        f"fault {', '.join(map(repr, hidden))} reaches no output: measure something that it acts on."
        if hidden
        else f"indexes {', '.join(map(str, detectability.indexes))}",
        signals=hidden,
    )
    if hidden:
        return (finite,)
    rank, user_units = detectability.rank, detectability.Upsilon / output_scales[:, None]
    # Where the rank was decided exactly, nearness to losing it has been judged with it.
    usable = rank.full and (rank.means == "exact" or detectability.condition_number <= REFUSE_CONDITION)
    mixed = () if usable else _dependent_faults(detectability.Upsilon, fault_names)
    independent = Condition(
        "rank Upsilon",
        "the first responses of the outputs to the faults are linearly independent (rank Upsilon = nf)",
        usable,
        detectability.condition_number,
        REFUSE_CONDITION,
        "Wang 2015, Theorem 2 (i)",
        f"{rank.describe()}, condition number {_significant(detectability.condition_number)}, "
        f"||Upsilon|| = {largest_singular_value(user_units):.3g}"
        + (
            f"; {_names(mixed)} cannot be distinguished at first sight. Leave one out, or measure more."
            if mixed
            else "."
        ),
        signals=mixed,
    )
    return finite, independent


def _significant(condition_number: float) -> str:
    """Return the number to the digits that are not rounding: none beyond what a double holds."""
    most = 1.0 / CANCELLATION_TOLERANCE
    return f"{condition_number:.3g}" if condition_number < most else f"above {most:.0e}"


def _names(faults: tuple[str, ...]) -> str:
    return f"the faults {', '.join(map(repr, faults))}"


def _dependent_faults(upsilon: FloatArray, names: tuple[str, ...]) -> tuple[str, ...]:
    lengths = np.linalg.norm(upsilon, axis=0)
    direction = np.abs(np.linalg.svd(upsilon / lengths)[2][-1])
    return tuple(
        name for name, size in zip(names, direction, strict=True) if size > DEPENDENT_SHARE * np.max(direction)
    )
