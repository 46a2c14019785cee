"""(D3) and the fixed modes on the numbers of plant and fault model as written."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from obsynth.analysis.existence.numbers import PlantNumbers, SystemFacts, WrittenNumbers, numbers_of
from obsynth.plants.descriptor import DescriptorSystem
from obsynth.plants.exosystems import Exosystem

if TYPE_CHECKING:
    from flint import fmpz_poly

#: Degree of the minimal polynomial of an eigenvalue, times columns of the pencil, above which its rank there is left
#: to floating point.
MOST_COLUMNS = 400


@dataclass(frozen=True, eq=False)
class ExactDrops:
    """Facts on the augmented pencil, and the disturbances that are kept in it."""

    facts: SystemFacts
    kept: list[int]


def exact_drops(plant: DescriptorSystem, model: Exosystem) -> ExactDrops | None:
    """Return the drops of the augmented pencil ``[Aa - s Ea, Bda; Ca, Dd]``; ``None`` for too many states."""
    numbers = numbers_of(plant)
    if numbers is None:
        return None
    key = ("drops", model.Phi.tobytes(), model.Cw.tobytes(), model.order)
    found: ExactDrops = numbers.remembered(key, lambda: _drops(numbers, plant, model))
    return found


def _drops(numbers: PlantNumbers, plant: DescriptorSystem, model: Exosystem) -> ExactDrops:
    kept = numbers.independent_columns(numbers.blocks([[numbers.matrix("Bd")], [numbers.matrix("Dd")]]), plant.nd)
    augmented = _augmented(numbers, plant, model)
    bd = numbers.picked(numbers.matrix("Bd"), kept)
    below = (
        numbers.blocks([[bd], [numbers.zeros(model.order, len(kept))]])
        if kept
        else numbers.zeros(plant.nx + model.order, 0)
    )
    return ExactDrops(augmented.system(below, numbers.picked(numbers.matrix("Dd"), kept)), kept)


def exact_loss(plant: DescriptorSystem, model: Exosystem, value: complex) -> int | None:
    """Return by how much the pencil of (D3) falls short of its columns at an eigenvalue of Phi.

    ``None`` where that is left to floating point: irrational eigenvalues of sampled plants, or too many states.
    """
    numbers = numbers_of(plant)
    factor = _factor_of(model, value)
    if numbers is None or factor is None:
        return None
    kept = numbers.independent_columns(numbers.blocks([[numbers.matrix("Bd")], [numbers.matrix("Dd")]]), plant.nd)
    augmented = _augmented(numbers, plant, model)
    bd, dd = (numbers.picked(numbers.matrix(name), kept) for name in ("Bd", "Dd"))
    below = numbers.blocks([[bd], [numbers.zeros(model.order, len(kept))]])
    columns = plant.nx + model.order + len(kept)
    if isinstance(augmented, WrittenNumbers):
        if columns * factor.degree() > MOST_COLUMNS:
            return None
        return columns - augmented.pencil(below, dd).rank_at_root(factor)
    if factor.degree() > 1:
        return None
    from flint import arb, fmpq

    pencil: Any = augmented.pencil(below, dd)  # type: ignore[attr-defined]
    return columns - int(pencil.rank_at(arb(fmpq(-factor[0], factor[1]))))


def _augmented(numbers: PlantNumbers, plant: DescriptorSystem, model: Exosystem) -> PlantNumbers:
    from obsynth.proofs.exact_pencils import blocks, identity, zeros_matrix
    from obsynth.proofs.written_numbers import written_matrix

    count, nx = model.order, plant.nx
    own = numbers.as_own
    across, down = zeros_matrix(nx, count), zeros_matrix(count, nx)
    course = own(written_matrix(model.Cw))
    changed = {
        "E": numbers.blocks([[numbers.matrix("E"), own(across)], [own(down), own(identity(count))]]),
        "A": numbers.blocks([
            [numbers.matrix("A"), numbers.product(numbers.matrix("Bf"), course)],
            [own(down), own(written_matrix(model.Phi))],
        ]),
        "C": numbers.blocks([[numbers.matrix("C"), numbers.product(numbers.matrix("Df"), course)]]),
    }  # fmt: skip
    rational = {"E": blocks([[numbers.rational["E"], across], [down, identity(count)]])}
    return numbers.with_matrices(changed, rational=rational)


def _factor_of(model: Exosystem, value: complex) -> fmpz_poly | None:
    """Return the irreducible polynomial of Phi as written of which the value is a root."""
    from obsynth.proofs.root_location import primitive
    from obsynth.proofs.written_numbers import written_matrix

    polynomial = primitive(written_matrix(model.Phi).charpoly())
    factors = [factor for factor, _ in polynomial.factor()[1]]

    def size(factor: fmpz_poly) -> float:
        coefficients = [float(int(coefficient)) for coefficient in factor.coeffs()]
        scale = sum(abs(c) * abs(value) ** k for k, c in enumerate(coefficients)) or 1.0
        return abs(sum(c * value**k for k, c in enumerate(coefficients))) / scale

    return min(factors, key=size) if factors else None
