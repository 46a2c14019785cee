"""A plant within rounding of the data for which two faults first reach the outputs in the same direction.

``C (TA)^k T`` does not depend on the faults, so one column of Bf is changed: by what makes its first visible vector a
combination of the others', and leaves what came before it invisible.
"""

from __future__ import annotations

from fractions import Fraction
from typing import TYPE_CHECKING

import numpy as np

from obsynth.analysis.existence.distance import ROUNDING_LEVEL
from obsynth.analysis.existence.named_pencils import DIGITS
from obsynth.analysis.existence.numbers import numbers_of
from obsynth.analysis.existence.rational import WrittenNumbers
from obsynth.analysis.existence.verdicts import DECIDER
from obsynth.analysis.existence.witnesses import EntryChange, Unclear, Witness, rational_matrices
from obsynth.analysis.plant_units import PlantUnits
from obsynth.methods.fault_estimation_filter.detectability_indexes import (
    REFUSE_CONDITION,
    FaultDetectability,
    nonsingular_t,
    numbers_with_fault_states,
)
from obsynth.plants.descriptor import DescriptorSystem

if TYPE_CHECKING:
    from flint import fmpq_mat


def index_doubt(plant: DescriptorSystem, detectability: FaultDetectability) -> Unclear | None:
    """Return why the rank of Upsilon is unclear; ``None`` where it is not."""
    if not detectability.finite or not _is_in_doubt(plant, detectability):
        return None
    units, best = PlantUnits.of(plant).rounded(), None
    direction = _null_direction(detectability)
    for digits in DIGITS:
        found = _changed(plant, units, detectability.indexes, np.round(direction, digits))
        if found is not None and (best is None or found.size < best.size):
            best = found
        if best is not None and best.size <= ROUNDING_LEVEL:
            break
    size = 0.0 if best is None else best.size
    return Unclear(max(ROUNDING_LEVEL, size), best, f"has rank Upsilon = {detectability.rank.expected - 1}", DECIDER)


def _is_in_doubt(plant: DescriptorSystem, detectability: FaultDetectability) -> bool:
    """Whether the faults can be told apart on paper, but not in numbers."""
    rank = detectability.rank
    if rank.full or rank.means != "tolerance":
        return rank.means == "unclear" or (
            rank.means == "tolerance" and detectability.condition_number > REFUSE_CONDITION
        )
    # Of computed data only floating point has spoken: what they were rounded to may say otherwise.
    if numbers_of(plant) is None:
        return False
    found = _exact(plant)
    if found is None:
        return False
    from obsynth.proofs.exact_arithmetic import blocks

    a, c, faults, _ = found
    columns = [c * _moved(a, faults, fault, index) for fault, index in enumerate(detectability.indexes)]
    return int(blocks([columns]).rank()) == rank.expected


def _exact(plant: DescriptorSystem) -> tuple[fmpq_mat, fmpq_mat, fmpq_mat, fmpq_mat] | None:
    """Return ``T A``, C, ``T Bf`` and T of the plant as written, with its sensor faults as states."""
    numbers = numbers_with_fault_states(Witness((), 0.0).plant(plant))
    t = nonsingular_t(numbers) if isinstance(numbers, WrittenNumbers) else None
    if t is None or not isinstance(numbers, WrittenNumbers):
        return None
    return t * numbers.matrix("A"), numbers.matrix("C"), t * numbers.matrix("Bf"), t


def _moved(a: fmpq_mat, faults: fmpq_mat, fault: int, index: int | None) -> fmpq_mat:
    """Return the vector of a fault that becomes visible."""
    from flint import fmpq_mat

    rows = int(faults.nrows())
    vector = fmpq_mat(rows, 1, [faults[i, fault] for i in range(rows)])
    for _ in range(int(index or 1) - 1):
        vector = a * vector
    return vector


def _null_direction(detectability: FaultDetectability) -> np.ndarray:
    lengths = np.linalg.norm(detectability.Upsilon, axis=0)
    direction = np.linalg.svd(detectability.Upsilon / lengths)[2][-1] / lengths
    return np.asarray(direction / direction[int(np.argmax(np.abs(direction)))])


def _changed(
    plant: DescriptorSystem, units: PlantUnits, indexes: tuple[int | None, ...], direction: np.ndarray
) -> Witness | None:
    """Return the changes of the column of the fault whose share of the direction is one, where there are any."""
    found, chosen = _exact(plant), int(np.argmax(np.abs(direction)))
    if found is None:
        return None
    a, c, faults, t = found
    shares = [_scalar(Fraction(float(share))) for share in direction]
    parts = [c * _moved(a, faults, fault, index) * shares[fault] for fault, index in enumerate(indexes)]
    rest, maps, through = sum(parts[1:], start=parts[0]), list["fmpq_mat"](), t
    for _ in range(int(indexes[chosen] or 1)):
        maps.append(c * through)
        through = a * through
    order = np.argsort(-units.equations[: plant.nx], kind="stable")[::-1]
    solved = _solution(maps, rest, [int(i) for i in order])
    if solved is None:
        return None
    exact = rational_matrices(plant)["Bf"]
    changes = tuple(
        EntryChange("Bf", i, chosen, exact[i, chosen], exact[i, chosen] - delta) for i, delta in solved if delta
    )
    scale = units.equations * units.faults[chosen]
    size = max((float(scale[c.row] * abs(float(c.after - c.before))) for c in changes), default=0.0)
    return Witness(changes, size) if changes else None


def _solution(maps: list[fmpq_mat], rest: fmpq_mat, order: list[int]) -> list[tuple[int, Fraction]] | None:
    """Return delta with ``maps[-1] delta = rest``, and zero for all maps before it, on few equations in this order."""
    from flint import fmpq_mat

    from obsynth.proofs.exact_arithmetic import blocks, pivot_columns

    whole = blocks([[part] for part in maps])
    rows, outputs = int(whole.nrows()), int(rest.nrows())
    picked = fmpq_mat(rows, len(order), [whole[i, j] for i in range(rows) for j in order])
    right = fmpq_mat(rows, 1, [*([0] * (rows - outputs)), *(rest[i, 0] for i in range(outputs))])
    pivots = pivot_columns(picked)
    basis = fmpq_mat(rows, len(pivots), [picked[i, j] for i in range(rows) for j in pivots])
    if not pivots or blocks([[basis, right]]).rank() > len(pivots):
        return None
    found = (basis.transpose() * basis).solve(basis.transpose() * right)
    return [(order[j], Fraction(int(found[k, 0].p), int(found[k, 0].q))) for k, j in enumerate(pivots)]


def _scalar(value: Fraction) -> fmpq_mat:
    from flint import fmpq, fmpq_mat

    return fmpq_mat(1, 1, [fmpq(value.numerator, value.denominator)])
