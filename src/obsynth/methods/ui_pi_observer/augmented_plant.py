"""The plant behind an unknown-input PI observer: faults as states, unknown inputs removed; and its realisation.

Share Pasand, Aliyari, Taghirad, (4), (10)-(13), (19), (20), with Df and Dd, and without the Moore-Penrose ``E#``, with
which U loses rank.  With ``xa = [x; w]``, ``z+ = Ahat z + Jhat u + Bhat y``, ``xahat = z + D_a y`` is unbiased if

    U_a Ea + D_a Ca = I,   D_a Dd = 0,   U_a Bda = K_a Dd,   Ahat = U_a Aa - K_a Ca,   Bhat = Ahat D_a + K_a.

Outputs that show d directly are solved for it: ``d1 = Dd^+ (y - C x - Df f)`` is put into the equations of the states.

Pencils and null vectors of plants with unknown inputs and fault models, in floating point and as written.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from flint import fmpz_poly
from numpy.typing import NDArray

from obsynth.analysis.existence.statements import Evaluator, PlantNumbers, SystemFacts
from obsynth.analysis.plant_units import PlantUnits
from obsynth.errors import SpecError
from obsynth.numerics.arguments import FloatArray, largest_singular_value, require_shape
from obsynth.numerics.ranks import RANK_TOLERANCE, decide_rank, numerical_rank, product_but_rounding, real_but_rounding
from obsynth.numerics.scaling import equilibrating_factors
from obsynth.numerics.spectra import pole_text
from obsynth.observers.linear.observer import LinearObserver
from obsynth.plants.descriptor import DescriptorSystem
from obsynth.plants.fault_models import Exosystem, stated_eigenvalues
from obsynth.proofs.exact_arithmetic import blocks, identity, primitive, written_matrix, zeros_matrix


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


@dataclass(frozen=True, eq=False)
class Decoupled:
    """A solution of ``U E + Dhat C = I``, ``Dhat Dd = 0``; with any Z so are ``U + Z free_U``, ``Dhat + Z free_D``."""

    U: FloatArray  # (nx, nx)
    Dhat: FloatArray  # (nx, ny)
    free_U: FloatArray  # (n_free, nx)
    free_D: FloatArray  # (n_free, ny)
    seen: FloatArray  # (ny2, ny), orthonormal rows: outputs that no disturbance reaches directly
    injection: FloatArray  # (nx, ny): the part Bd Dd^+ of the equations that is fed with y


def direct_part(plant: DescriptorSystem) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return the outputs without direct disturbance, ``Bd Dd^+``, and a basis of the disturbances left."""
    if not plant.Dd.any():
        return np.eye(plant.ny), np.zeros((plant.nx, plant.ny)), _range_basis(plant.Bd)
    left, values, right = np.linalg.svd(plant.Dd)
    rank = numerical_rank(values)
    inverse = right[:rank].T @ (left[:, :rank] / values[:rank]).T
    return left[:, rank:].T, plant.Bd @ inverse, _range_basis(plant.Bd @ right[rank:].T)


def _range_basis(matrix: FloatArray) -> FloatArray:
    if matrix.shape[1] == 0 or not matrix.any():
        return np.zeros((matrix.shape[0], 0))
    lengths = np.linalg.norm(matrix, axis=0)
    left, values, _ = np.linalg.svd(matrix / np.where(lengths > 0.0, lengths, 1.0), full_matrices=False)
    return np.asarray(left[:, : numerical_rank(values)])


def decouple(plant: DescriptorSystem) -> Decoupled:
    r"""Return U and Dhat with ``U E + Dhat C = I``, ``U Bd2 = 0`` and ``ker U = im Bd2``; (D1) must hold.

    With the annihilator Bp of Bd2 and ``Q = [Bp E; C2]``: ``[Ut Dt] = Q^+ + Z N``, N a basis of the left null space of
    Q, and Z such that Ut has full column rank: the polar factor of what makes ``[Ut; N_U]`` orthogonal.
    """
    seen, injection, remaining = direct_part(plant)
    nx, left_over = plant.nx, plant.nx - remaining.shape[1]
    kept = np.linalg.svd(remaining)[0][:, remaining.shape[1] :].T if remaining.shape[1] else np.eye(nx)
    stacked = np.vstack([kept @ plant.E, seen @ plant.C])
    q, r = np.linalg.qr(stacked, mode="complete")
    inverse = np.linalg.solve(r[:nx], q[:, :nx].T)
    inverse = inverse + (np.eye(nx) - inverse @ stacked) @ inverse
    null = q[:, nx:].T
    ut, dt = inverse[:, :left_over], inverse[:, left_over:]
    nu, nd = null[:, :left_over], null[:, left_over:]
    # What A leaves open a fixed matrix decides, and not the orientation of somebody's singular vectors.
    generic = np.random.default_rng(0).standard_normal((nx, nx))
    z = _completing(ut, nu, plant.A.T @ kept.T, generic @ kept.T)
    return Decoupled((ut + z @ nu) @ kept, (dt + z @ nd) @ seen, nu @ kept, nd @ seen, seen, injection)


def _completing(ut: FloatArray, nu: FloatArray, wanted: FloatArray, generic: FloatArray) -> FloatArray:
    """Return Z such that ``ut + Z nu`` has full column rank; ``[ut; nu]`` has, so what ut lacks, nu sees.

    Kernel directions of ut go outside its range, near where ``wanted`` sends them, or else ``generic``: no choice hangs
    on rounding.
    """
    rows, columns = ut.shape
    if columns == 0 or nu.shape[0] == 0:
        return np.zeros((rows, nu.shape[0]))
    left, values, right = np.linalg.svd(ut)
    largest = float(values[0]) if values.size and values[0] > 0.0 else 1.0
    rank = numerical_rank(values)
    lacking = columns - rank
    if lacking == 0:
        return np.zeros((rows, nu.shape[0]))
    kernel = right[rank:].T
    free = left[:, rank:]
    scale = float(np.linalg.norm(wanted))
    outside = free @ _nearest_isometry(free.T @ wanted @ kernel, free.T @ generic @ kernel, scale)
    shown = nu @ kernel
    return np.asarray(outside @ np.linalg.pinv(shown) * largest)


def _nearest_isometry(matrix: FloatArray, otherwise: FloatArray, scale: float) -> FloatArray:
    """Return the matrix ``(m, n)``, ``m >= n``, with orthonormal columns that is nearest: the polar factor.
    Directions in which the matrix is nothing beside ``scale`` go where ``otherwise (m, n)`` sends them."""
    left, values, right = np.linalg.svd(matrix)
    rank = numerical_rank(values, scale=scale)
    found = left[:, :rank] @ right[:rank]
    if rank < matrix.shape[1]:
        outer, inner = left[:, rank:], right[rank:]
        turned = np.linalg.svd(outer.T @ otherwise @ inner.T, full_matrices=False)
        found = found + outer @ turned[0] @ turned[2] @ inner
    return np.asarray(found)


def paper_decoupling(
    plant: DescriptorSystem, *, e_sharp: FloatArray, c_sharp: FloatArray, g: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return L, U and Dhat, (10), (11), for ``e_sharp (nx, nx)``, ``c_sharp (nx, ny)`` and ``g (nx, ny)``."""
    nx, ny = plant.nx, plant.ny
    shapes = {"E_sharp": (e_sharp, (nx, nx)), "C_sharp": (c_sharp, (nx, ny)), "G": (g, (nx, ny))}
    for name, (matrix, shape) in shapes.items():
        require_shape(matrix.shape, shape, name)
    if plant.Dd.any():
        raise SpecError("E_sharp, C_sharp and G are for plants without Dd: leave them out.", path="E_sharp")
    miss = np.abs(e_sharp @ plant.E + c_sharp @ plant.C - np.eye(nx))
    size = np.abs(e_sharp) @ np.abs(plant.E) + np.abs(c_sharp) @ np.abs(plant.C) + np.eye(nx)
    if np.max(miss) > RANK_TOLERANCE * np.max(size):
        raise SpecError(f"E_sharp E + C_sharp C misses the identity by {np.max(miss):.3g}.", path="E_sharp")
    shown = plant.C @ e_sharp @ plant.Bd
    # Judged against its factors, not against its own norm: it may be nothing but rounding.
    norms = [largest_singular_value(part) for part in (plant.C, e_sharp, plant.Bd)] if plant.nd else [1.0]
    rank = decide_rank(shown, expected=plant.nd, scale=float(np.prod(norms)), equilibrated=False)
    if not rank.full:
        raise SpecError(
            f"With this E_sharp, C E# Bd has {rank.describe()}: choose another E_sharp, or leave it out.",
            path="E_sharp",
        )
    remaining = np.eye(nx) - g @ plant.C
    if not decide_rank(remaining, expected=nx, equilibrated=False).full:
        raise SpecError("I - G C is singular, which adds an unobservable mode: choose another G.", path="G")
    inverse: FloatArray = np.zeros((0, ny))
    if plant.nd:
        # By normal equations, so that simple numbers stay exact; one refinement makes up for their condition.
        inverse = np.asarray(np.linalg.solve(shown.T @ shown, shown.T), dtype=np.float64)
        inverse = inverse + (np.eye(plant.nd) - inverse @ shown) @ inverse
    basis = e_sharp @ plant.Bd @ inverse
    correction = basis + g @ (np.eye(ny) - plant.C @ basis)
    u = remaining @ (np.eye(nx) - basis @ plant.C) @ e_sharp
    return correction, u, c_sharp + correction @ (np.eye(ny) - plant.C @ c_sharp)


def realise(
    plant: DescriptorSystem, model: Exosystem, gains: tuple[FloatArray, FloatArray, FloatArray], seen: FloatArray
) -> tuple[LinearObserver, dict[str, FloatArray]]:
    """Return the observer with gains ``U (na, na)``, ``D (na, ny)`` and ``K (na, ny)`` of the augmented plant, and its
    matrices by the paper's letters; ``seen (nr, ny)``."""
    u, d, k = gains
    augmented = AugmentedPlant.of(plant, model)
    nx, na = plant.nx, augmented.order
    a_hat = u @ augmented.A - k @ augmented.C
    # Rows that follow nothing, or show nothing, are zero: rounding would be all that their identities are judged by.
    b_hat = product_but_rounding(a_hat, d, k)
    j_hat = u @ augmented.B
    faults = np.hstack([np.zeros((plant.nf, nx)), model.Cw])
    rows = np.vstack([np.eye(nx, na), faults, -seen @ augmented.C])
    shown = np.vstack([np.zeros((nx + plant.nf, plant.ny)), seen])
    direct = product_but_rounding(rows, d, shown)
    names = (
        plant.output_names if np.array_equal(seen, np.eye(plant.ny)) else tuple(f"r{i + 1}" for i in range(len(seen)))
    )
    observer = LinearObserver(
        Az=a_hat,
        Bu=j_hat - b_hat @ plant.D,
        By=b_hat,
        Cz=rows,
        Du=-direct @ plant.D,
        Dy=direct,
        dt=plant.dt,
        input_names=plant.input_names,
        output_names=plant.output_names,
        state_names=plant.state_names,
        fault_names=plant.fault_names,
        residual_names=names,
        state_delays=(0,) * nx,
        fault_delays=(0,) * plant.nf,
    )
    letters = {"U_a": u, "D_a": d, "K_a": k, "Ahat": a_hat, "Bhat": b_hat, "Jhat": j_hat}
    return observer, letters


def combinations_seen(plant: DescriptorSystem) -> FloatArray:
    """Return the combinations of outputs that no disturbance reaches directly, each of unit length."""
    if not plant.Dd.any():
        return np.eye(plant.ny)
    units = PlantUnits.of(plant)
    seen = direct_part(units.scaled_plant(plant))[0] * units.outputs
    return np.asarray(seen / np.linalg.norm(seen, axis=1, keepdims=True))


#: An imaginary part below this share of an eigenvalue is not shown: it would not change its printed digits.
UNSEEN = 5e-7


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
    kept = judge.kept_disturbances
    bd, dd = (numbers.columns(name, kept) for name in ("Bd", "Dd"))
    below = numbers.zeros(judge.plant.nx + model.order, 0)
    if kept:
        below = blocks([[bd], [numbers.zeros(model.order, len(kept))]])
    return _augmented(numbers, judge.plant, model), below, dd, kept


def exact_drops(judge: Evaluator, model: Exosystem) -> tuple[SystemFacts, list[int]] | None:
    """Return facts on the augmented pencil ``[Aa - s Ea, Bda; Ca, Dd]``, and the disturbances that are kept in it;
    ``None`` for too many states."""
    numbers = judge.numbers
    if numbers is None:
        return None

    def decided() -> tuple[SystemFacts, list[int]]:
        whole, below, direct, kept = _exact_pencil(judge, numbers, model)
        return whole.system(below, direct), kept

    key = ("drops", model.Phi.tobytes(), model.Cw.tobytes(), model.order)
    found: tuple[SystemFacts, list[int]] = numbers.remembered(key, decided)
    return found


def exact_loss(judge: Evaluator, model: Exosystem, value: complex) -> int | None:
    """Return by how much (D3) falls short of its columns at an eigenvalue of Phi; ``None``: left to floating point."""
    factor = _factor_of(model, value)
    if judge.numbers is None or factor is None:
        return None
    whole, below, direct, kept = _exact_pencil(judge, judge.numbers, model)
    rank = whole.rank_at_root(below, direct, factor)
    return None if rank is None else judge.plant.nx + model.order + len(kept) - rank


def _augmented(numbers: PlantNumbers, plant: DescriptorSystem, model: Exosystem) -> PlantNumbers:
    count, nx = model.order, plant.nx
    own = numbers.as_own
    across, down = zeros_matrix(nx, count), zeros_matrix(count, nx)
    course = own(written_matrix(model.Cw))
    changed = {
        "E": blocks([[numbers.matrices["E"], own(across)], [own(down), own(identity(count))]]),
        "A": blocks(
            [
                [numbers.matrices["A"], numbers.product(numbers.matrices["Bf"], course)],
                [own(down), own(written_matrix(model.Phi))],
            ]
        ),
        "C": blocks([[numbers.matrices["C"], numbers.product(numbers.matrices["Df"], course)]]),
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
