"""Pencils of a plant with unknown inputs and fault models, and their null vectors, in floating point and exactly."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from flint import fmpz_poly
from numpy.typing import NDArray

from obsynth.analysis.existence.plant_numbers import PlantNumbers, SystemFacts
from obsynth.analysis.existence.statements import Evaluator
from obsynth.numerics.arrays import FloatArray
from obsynth.numerics.ranks import RANK_TOLERANCE, decide_rank, real_but_rounding
from obsynth.numerics.scaling import equilibrating_factors
from obsynth.numerics.spectra import pole_text
from obsynth.plants.descriptor import DescriptorSystem
from obsynth.plants.faults import Exosystem, stated_eigenvalues
from obsynth.proofs.exact_doubles import written_matrix
from obsynth.proofs.polynomial_roots import primitive
from obsynth.proofs.rational_matrices import blocks, identity, zeros_matrix

#: An imaginary part below this share of an eigenvalue is not shown: it would not change its printed digits.
UNSEEN = 5e-7


@dataclass(frozen=True, eq=False)
class AugmentedPlant:
    """A plant whose state holds the exosystem of its faults: ``xa = [x; w]``, ``na = nx + nw``."""

    E: FloatArray  # (na, na)
    A: FloatArray  # (na, na)
    B: FloatArray  # (na, nu)
    Bd: FloatArray  # (na, nd)
    C: FloatArray  # (ny, na)
    D: FloatArray  # (ny, nu)
    Dd: FloatArray  # (ny, nd)
    names: tuple[str, ...]  # of the states

    @classmethod
    def of(cls, plant: DescriptorSystem, model: Exosystem) -> AugmentedPlant:
        """Return the augmented plant, eq. (13) with ``Bf Cw`` and ``Df Cw``."""
        nx, count = plant.nx, model.order
        e, a = np.eye(nx + count), np.zeros((nx + count, nx + count))
        e[:nx, :nx], a[:nx, :nx], a[:nx, nx:], a[nx:, nx:] = plant.E, plant.A, plant.Bf @ model.Cw, model.Phi

        def below(matrix: FloatArray) -> FloatArray:
            return np.vstack([matrix, np.zeros((count, matrix.shape[1]))])

        c = np.hstack([plant.C, plant.Df @ model.Cw])
        return cls(e, a, below(plant.B), below(plant.Bd), c, plant.D, plant.Dd, (*plant.state_names, *model.names))

    @property
    def order(self) -> int:
        """Number of states."""
        return int(self.E.shape[0])

    def below(self, matrix: FloatArray) -> FloatArray:
        """Return what enters the equations ``(nx, any)`` of the plant, and nothing of the model: ``(na, any)``."""
        return np.vstack([matrix, np.zeros((self.order - len(matrix), matrix.shape[1]))])


def shipped_model(matrices: Mapping[str, FloatArray], faults: int) -> Exosystem:
    """Return the exosystem of a certificate, with ``Phi (nw, nw)`` and ``Cw (nf, nw)``."""
    phi = matrices["Phi"]
    names = tuple(f"w{i + 1}" for i in range(len(phi)))
    return Exosystem(phi, matrices["Cw"], names, stated_eigenvalues(phi), ("as shipped",) * faults)


def number(value: complex) -> str:
    """Return a real or complex eigenvalue as text, a pair by its upper half; a real part of rounding is none."""
    imaginary = 0.0 if _looks_real(value) else value.imag
    return pole_text(complex(real_but_rounding(value), imaginary), 6, pair=True)


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
    disturbances = np.vstack([plant.Bd, plant.Dd])
    rank = decide_rank(disturbances).rank
    if rank == plant.nd:
        return plant.Bd, plant.Dd
    left_vectors = np.linalg.svd(disturbances, full_matrices=False)[0][:, :rank]
    return left_vectors[: plant.nx], left_vectors[plant.nx :]


def in_disturbances(
    plant: DescriptorSystem, inputs: FloatArray, direct: FloatArray, direction: NDArray[Any]
) -> FloatArray:
    """Return the size of each disturbance in a combination of independent ones."""
    disturbances, basis = np.vstack([plant.Bd, plant.Dd]), np.vstack([inputs, direct])
    return np.abs(np.linalg.pinv(disturbances) @ (basis @ direction)) if disturbances.size else np.zeros(0)


def kernel(matrix: NDArray[Any]) -> NDArray[Any]:
    """Return an orthonormal basis of the null space."""
    _, values, right = np.linalg.svd(matrix)
    rank = int(np.sum(values > RANK_TOLERANCE * max(float(values[0]), 1.0))) if values.size else 0
    return np.asarray(right[rank:].conj().T)


def equilibrated(matrix: NDArray[Any]) -> tuple[NDArray[Any], FloatArray]:
    """Return complex matrices ``(..., m, n)`` with rows and columns scaled by powers of two, and the factors of the
    columns ``(..., n)``."""
    rows, columns = equilibrating_factors(np.abs(matrix))
    return rows[..., :, None] * matrix * columns[..., None, :], columns


def _exact_pencil(
    judge: Evaluator, numbers: PlantNumbers, model: Exosystem
) -> tuple[PlantNumbers, Any, Any, list[int]]:
    """Return the augmented plant on the numbers as written, Bda and Dd, and the disturbances kept in these."""
    disturbances = judge.independent_disturbances
    bd, dd = (numbers.columns(name, disturbances) for name in ("Bd", "Dd"))
    below = numbers.zeros(judge.plant.nx + model.order, 0)
    if disturbances:
        below = blocks([[bd], [numbers.zeros(model.order, len(disturbances))]])
    return _augmented(numbers, judge.plant, model), below, dd, disturbances


def exact_drops(judge: Evaluator, model: Exosystem) -> tuple[SystemFacts, list[int]] | None:
    """Return facts on the augmented pencil ``[Aa - s Ea, Bda; Ca, Dd]``, and the disturbances that are kept in it;
    ``None`` for too many states."""
    numbers = judge.numbers
    if numbers is None:
        return None

    def decided() -> tuple[SystemFacts, list[int]]:
        augmented, below, direct, disturbances = _exact_pencil(judge, numbers, model)
        return augmented.system(below, direct), disturbances

    key = ("drops", model.Phi.tobytes(), model.Cw.tobytes(), model.order)
    facts: tuple[SystemFacts, list[int]] = numbers.remembered(key, decided)
    return facts


def exact_loss(judge: Evaluator, model: Exosystem, value: complex) -> int | None:
    """Return by how much (D3) falls short of its columns at an eigenvalue of Phi; ``None``: left to floating point."""
    factor = _factor_of(model, value)
    if judge.numbers is None or factor is None:
        return None
    augmented, below, direct, disturbances = _exact_pencil(judge, judge.numbers, model)
    rank = augmented.rank_at_root(below, direct, factor)
    return None if rank is None else judge.plant.nx + model.order + len(disturbances) - rank


def _augmented(numbers: PlantNumbers, plant: DescriptorSystem, model: Exosystem) -> PlantNumbers:
    count, nx = model.order, plant.nx
    own = numbers.as_own
    across, down = zeros_matrix(nx, count), zeros_matrix(count, nx)
    fault_outputs = own(written_matrix(model.Cw))
    changed = {
        "E": blocks([[numbers.matrices["E"], own(across)], [own(down), own(identity(count))]]),
        "A": blocks(
            [
                [numbers.matrices["A"], numbers.product(numbers.matrices["Bf"], fault_outputs)],
                [own(down), own(written_matrix(model.Phi))],
            ]
        ),
        "C": blocks([[numbers.matrices["C"], numbers.product(numbers.matrices["Df"], fault_outputs)]]),
    }
    rational = {"E": blocks([[numbers.rational["E"], across], [down, identity(count)]])}
    return numbers.with_matrices(changed, rational=rational)


def _factor_of(model: Exosystem, value: complex) -> fmpz_poly | None:
    """Return the irreducible polynomial of Phi as written of which the value is a root."""
    polynomial = primitive(written_matrix(model.Phi).charpoly())
    factors = [factor for factor, _ in polynomial.factor()[1]]

    def size(factor: fmpz_poly) -> float:
        coefficients = [float(int(coefficient)) for coefficient in factor.coeffs()]
        scale = sum(abs(c) * abs(value) ** k for k, c in enumerate(coefficients)) or 1.0
        return abs(sum(c * value**k for k, c in enumerate(coefficients))) / scale

    return min(factors, key=size) if factors else None
