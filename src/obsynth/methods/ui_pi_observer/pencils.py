"""Pencils and null vectors of plants with unknown inputs and fault models, in floating point and as written."""

from __future__ import annotations

from collections.abc import Iterable
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from obsynth.analysis.existence.numbers import numbers_of
from obsynth.analysis.existence.rational import PlantNumbers, SystemFacts, WrittenNumbers
from obsynth.numerics.arrays import FloatArray
from obsynth.numerics.ranks import RANK_TOLERANCE, decide_rank
from obsynth.numerics.scaling import equilibrate_pencil
from obsynth.plants.descriptor import DescriptorSystem
from obsynth.plants.fault_models import Exosystem

if TYPE_CHECKING:
    from flint import fmpz_poly

#: An imaginary part below this share of an eigenvalue is not shown: it would not change its printed digits.
UNSEEN = 5e-7
#: Degree of the minimal polynomial of an eigenvalue, times columns of the pencil, above which its rank there is left
#: to floating point.
MOST_COLUMNS = 400


def number(value: complex) -> str:
    """Return a real or complex eigenvalue as text, a pair by its upper half."""
    return f"{value.real:.6g}" if _looks_real(value) else f"{value.real:.6g} +- {abs(value.imag):.6g}j"


def numbers(values: Iterable[complex]) -> list[str]:
    """Return eigenvalues as text, each pair once: one that rounding has made of a double real one as two numbers."""
    listed = [complex(value) for value in values]
    return [number(value) for value in listed if value.imag >= 0.0 or _looks_real(value)]


def _looks_real(value: complex) -> bool:
    return abs(value.imag) <= UNSEEN * abs(value)


def instability(value: complex, dt: float) -> float:
    """Return how unstable an eigenvalue is: its modulus, or its real part for ``dt == 0``."""
    return abs(value) if dt > 0.0 else value.real


def independent_disturbances(plant: DescriptorSystem) -> tuple[FloatArray, FloatArray]:
    """Return ``[Bd; Dd]`` as a basis of its range: repeated disturbances would make every rank too low."""
    whole = np.vstack([plant.Bd, plant.Dd])
    rank = decide_rank(whole).rank
    if rank == plant.nd:
        return plant.Bd, plant.Dd
    left = np.linalg.svd(whole, full_matrices=False)[0][:, :rank]
    return left[: plant.nx], left[plant.nx :]


def in_disturbances(
    plant: DescriptorSystem, inputs: FloatArray, direct: FloatArray, direction: NDArray[Any]
) -> FloatArray:
    """Return the size of each disturbance in a combination of independent ones."""
    whole, basis = np.vstack([plant.Bd, plant.Dd]), np.vstack([inputs, direct])
    return np.abs(np.linalg.pinv(whole) @ (basis @ direction)) if whole.size else np.zeros(0)


def kept_disturbances(plant: DescriptorSystem, numbers: PlantNumbers | None) -> list[int]:
    """Return the unknown inputs that are no combinations of those before them; all where the numbers are not known."""
    if numbers is None:
        return list(range(plant.nd))
    return numbers.independent_columns(numbers.blocks([[numbers.matrix("Bd")], [numbers.matrix("Dd")]]), plant.nd)


def kernel(matrix: NDArray[Any]) -> NDArray[Any]:
    """Return an orthonormal basis of the null space."""
    _, values, right = np.linalg.svd(matrix)
    rank = int(np.sum(values > RANK_TOLERANCE * max(float(values[0]), 1.0))) if values.size else 0
    return np.asarray(right[rank:].conj().T)


def equilibrated(matrix: NDArray[Any]) -> tuple[NDArray[Any], FloatArray]:
    """Return a complex matrix with rows and columns scaled by powers of two, and the factors of the columns."""
    size = np.abs(matrix)
    pencil = equilibrate_pencil(np.zeros_like(size), size)
    return pencil.rows[:, None] * matrix * pencil.columns, pencil.columns


class _ExactPencil(NamedTuple):
    """The augmented pencil ``[Aa - s Ea, Bda; Ca, Dd]`` on the numbers as written, with the disturbances kept in it."""

    numbers: PlantNumbers
    Bd: Any
    Dd: Any
    kept: list[int]

    @classmethod
    def of(cls, numbers: PlantNumbers, plant: DescriptorSystem, model: Exosystem) -> _ExactPencil:
        kept = kept_disturbances(plant, numbers)
        bd, dd = (numbers.picked(numbers.matrix(name), kept) for name in ("Bd", "Dd"))
        below = numbers.zeros(plant.nx + model.order, 0)
        if kept:
            below = numbers.blocks([[bd], [numbers.zeros(model.order, len(kept))]])
        return cls(_augmented(numbers, plant, model), below, dd, kept)


class ExactDrops(NamedTuple):
    """Facts on the augmented pencil, and the disturbances that are kept in it."""

    facts: SystemFacts
    kept: list[int]


def exact_drops(plant: DescriptorSystem, model: Exosystem) -> ExactDrops | None:
    """Return the drops of the augmented pencil; ``None`` for too many states."""
    numbers = numbers_of(plant)
    if numbers is None:
        return None

    def decided() -> ExactDrops:
        pencil = _ExactPencil.of(numbers, plant, model)
        return ExactDrops(pencil.numbers.system(pencil.Bd, pencil.Dd), pencil.kept)

    key = ("drops", model.Phi.tobytes(), model.Cw.tobytes(), model.order)
    found: ExactDrops = numbers.remembered(key, decided)
    return found


def exact_loss(plant: DescriptorSystem, model: Exosystem, value: complex) -> int | None:
    """Return by how much (D3) falls short of its columns at an eigenvalue of Phi; ``None``: left to floating point."""
    numbers = numbers_of(plant)
    factor = _factor_of(model, value)
    if numbers is None or factor is None:
        return None
    found = _ExactPencil.of(numbers, plant, model)
    columns = plant.nx + model.order + len(found.kept)
    is_written = isinstance(numbers, WrittenNumbers)
    if columns * factor.degree() > MOST_COLUMNS if is_written else factor.degree() > 1:
        return None
    pencil: Any = found.numbers.pencil(found.Bd, found.Dd)  # type: ignore[attr-defined]
    if is_written:
        return columns - int(pencil.rank_at_root(factor))
    from flint import arb, fmpq

    return columns - int(pencil.rank_at(arb(fmpq(-factor[0], factor[1]))))


def _augmented(numbers: PlantNumbers, plant: DescriptorSystem, model: Exosystem) -> PlantNumbers:
    from obsynth.proofs.exact_arithmetic import blocks, identity, written_matrix, zeros_matrix

    count, nx = model.order, plant.nx
    own = numbers.as_own
    across, down = zeros_matrix(nx, count), zeros_matrix(count, nx)
    course = own(written_matrix(model.Cw))
    changed = {
        "E": numbers.blocks([[numbers.matrix("E"), own(across)], [own(down), own(identity(count))]]),
        "A": numbers.blocks(
            [
                [numbers.matrix("A"), numbers.product(numbers.matrix("Bf"), course)],
                [own(down), own(written_matrix(model.Phi))],
            ]
        ),
        "C": numbers.blocks([[numbers.matrix("C"), numbers.product(numbers.matrix("Df"), course)]]),
    }
    rational = {"E": blocks([[numbers.rational["E"], across], [down, identity(count)]])}
    return numbers.with_matrices(changed, rational=rational)


def _factor_of(model: Exosystem, value: complex) -> fmpz_poly | None:
    """Return the irreducible polynomial of Phi as written of which the value is a root."""
    from obsynth.proofs.exact_arithmetic import primitive, written_matrix

    polynomial = primitive(written_matrix(model.Phi).charpoly())
    factors = [factor for factor, _ in polynomial.factor()[1]]

    def size(factor: fmpz_poly) -> float:
        coefficients = [float(int(coefficient)) for coefficient in factor.coeffs()]
        scale = sum(abs(c) * abs(value) ** k for k, c in enumerate(coefficients)) or 1.0
        return abs(sum(c * value**k for k, c in enumerate(coefficients))) / scale

    return min(factors, key=size) if factors else None
