"""Invariant zeros of a system with their directions, and which of them lie outside the stability region."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from obsynth.numerics.arrays import ComplexArray, FloatArray, read_only
from obsynth.numerics.pencil_points import FEW_COLUMNS, MOST_DIRECTIONS, ZERO_STEPS, PencilPoints, smallest_singular
from obsynth.numerics.pencils import FiniteZeros, finite_zeros
from obsynth.numerics.ranks import (
    BOUNDARY_NEIGHBOURHOOD,
    BOUNDARY_RANK_TOLERANCE,
    BOUNDARY_TOLERANCE,
    CLUSTER_TOLERANCE,
    NEGLIGIBLE_INPUT,
    RANK_TOLERANCE,
    numerical_rank,
)
from obsynth.numerics.scaling import EquilibratedPencil, equilibrate_pencil

#: Points at which a pencil is tested, as fractions of the way from a zero to the nearest point of the boundary.
_PATH_TO_BOUNDARY = (1.0, 0.75, 0.5, 0.25)


def system_zeros(E: FloatArray, A: FloatArray, *, nx: int) -> FiniteZeros:
    """Return the finite zeros of a system pencil ``(nx + ny, nx + nu)``, without rounded zeros at infinity.

    At a large ``z`` a pencil with zeros at infinity is nearly singular relative to ``z E`` (a chain of k states has a
    singular value like ``z^-k``).  A large candidate therefore counts only if the pencil is singular to rounding in
    units that suit its size.
    """
    zeros = finite_zeros(E, A, to_the_end=False)
    if not zeros.values.size:
        return zeros
    # The pencil is real: a conjugate pair is decided at its member in the upper half plane.
    upper = [complex(z.real, abs(z.imag)) for z in zeros.values]
    confirmed = np.array([abs(z) <= 1.0 or _is_singular(E, A, z, zeros.normal_rank, nx=nx) for z in upper], dtype=bool)
    return replace(zeros, values=read_only(zeros.values[confirmed], np.complex128))


def _is_singular(E: FloatArray, A: FloatArray, value: complex, normal_rank: int, *, nx: int) -> bool:
    """Whether the rank drops at, or within the accuracy of, a computed zero."""
    pencil = equilibrated_at(E, A, value, nx=nx)
    point, best = value, np.inf
    for _ in range(ZERO_STEPS):
        matrix = pencil.A - point * pencil.E
        if matrix.shape[0] >= matrix.shape[1] == normal_rank >= FEW_COLUMNS:
            values, vectors, largest = smallest_singular(matrix)
            smallest, v = float(values[0]), vectors[:, 0]
            u = (matrix @ v).conj()
            u = u / (float(np.linalg.norm(u)) or 1.0)
        else:
            left_vectors, sizes, right_vectors = np.linalg.svd(matrix)
            largest, smallest = float(sizes[0]), float(sizes[normal_rank - 1])
            u, v = left_vectors[:, normal_rank - 1].conj(), right_vectors[normal_rank - 1].conj()
        if largest == 0.0:
            return True
        best = min(best, smallest / largest)
        if best <= BOUNDARY_RANK_TOLERANCE:
            return True
        slope = u @ pencil.E @ v
        # A large zero has the absolute error of the largest one: refine it by Newton's method on u' (A - z E) v.
        step: Any = (u @ (pencil.A - point * pencil.E) @ v) / slope if slope != 0.0 else 0.0
        if abs(point + step - value) > CLUSTER_TOLERANCE * abs(value):
            break
        point = point + step
    return False


def size_of_point(value: complex) -> float:
    """Return the largest power of two not above the modulus of a point, or 1."""
    return math.ldexp(1.0, math.frexp(max(1.0, abs(value)))[1] - 1)


def equilibrated_at(E: FloatArray, A: FloatArray, value: complex, *, nx: int) -> EquilibratedPencil:
    """Return the equilibrated pencil in units for points of this modulus, in which ``z x`` instead of x is near one.

    In other units inputs and outputs would be negligible beside a large ``z E``.
    """
    size = size_of_point(value)
    columns = np.where(np.arange(E.shape[1]) < nx, 1.0 / size, 1.0)
    # E is multiplied by the modulus for the scaling and divided again, so that the factors suit A - z E.
    scaled = equilibrate_pencil(size * columns * E, columns * A)
    return EquilibratedPencil(scaled.E / size, scaled.A, scaled.rows, read_only(scaled.columns * columns))


@dataclass(frozen=True, eq=False)
class Zero:
    """An invariant zero with its direction of unit norm.

    ``input_share`` is the norm of the input's part of the direction in equilibrated units.
    """

    value: complex
    state_direction: ComplexArray
    input_direction: ComplexArray
    input_share: float

    @property
    def is_unobservable_mode(self) -> bool:
        """Whether the direction has no input part: the zero is an unobservable mode."""
        return self.input_share <= NEGLIGIBLE_INPUT


def is_outside(value: complex, dt: float) -> bool:
    """Whether an eigenvalue or zero counts as not strictly stable, by its distance from the boundary alone."""
    if dt > 0.0:
        return bool(abs(value) >= 1.0 - BOUNDARY_TOLERANCE)
    return bool(complex(value).real >= -BOUNDARY_TOLERANCE * max(1.0, abs(value)))


def are_outside(E: FloatArray, A: FloatArray, zeros: FiniteZeros, dt: float) -> tuple[bool, ...]:
    """Decide for each finite zero of ``A - z E`` whether it counts as not strictly stable.

    Rounding moves a zero of multiplicity k by about ``eps^(1/k)``.  A zero near the boundary therefore also counts as
    outside if the pencil is singular to working precision all the way to the nearest boundary point.
    """
    tested: PencilPoints | EquilibratedPencil | None = None
    outside: dict[complex, bool] = {}
    for value in map(complex, zeros.values):
        distance = abs(abs(value) - 1.0) if dt > 0.0 else abs(value.real)
        # The pencil is real, so that both zeros of a conjugate pair lie on the same side.
        if (other := value.conjugate()) in outside:
            outside[value] = outside[other]
        elif is_outside(value, dt) or distance > BOUNDARY_NEIGHBOURHOOD * max(1.0, abs(value)):
            outside[value] = is_outside(value, dt)
        else:
            if tested is None:
                tested = pencil = equilibrate_pencil(E, A)
                # A large pencil of full column rank is reduced once, for fast tests at many points.
                if min(E.shape[0], zeros.normal_rank) >= E.shape[1] >= FEW_COLUMNS:
                    tested = PencilPoints(pencil.E, pencil.A, (1.0, 1.0))
            outside[value] = _reaches_boundary(tested, value, dt, zeros.normal_rank)
    return tuple(outside[value] for value in map(complex, zeros.values))


def zero_at(E: FloatArray, A: FloatArray, value: complex, B: FloatArray, C: FloatArray, D: FloatArray) -> Zero:
    """Return a zero of ``[A - z E, B; C, D]`` with its direction; the caller knows that it lies at ``value``."""
    wide_e, wide_a = system_pencil(E, A, B, C, D)
    nx = E.shape[0]
    pencil = equilibrated_at(wide_e, wide_a, value, nx=nx)
    basis = smallest_part_first(_kernel(pencil, value, least=1), slice(nx, None))
    return _zero_along(basis[:, 0], value, pencil.columns, nx=nx)


def zeros_of_system(
    E: FloatArray, A: FloatArray, B: FloatArray, C: FloatArray, D: FloatArray | None = None, *, dt: float
) -> tuple[FiniteZeros, tuple[Zero, ...], tuple[Zero, ...]]:
    """Return the zeros of ``[A - z E, B; C, D]``: their values, with directions, and those not strictly stable."""
    e, a = system_pencil(E, A, B, C, D)
    finite = system_zeros(e, a, nx=E.shape[0])
    zeros = zeros_with_directions(e, a, finite, nx=E.shape[0])
    outside = tuple(zero for zero, out in zip(zeros, are_outside(e, a, finite, dt), strict=True) if out)
    return finite, zeros, outside


def system_pencil(
    E: FloatArray, A: FloatArray, B: FloatArray, C: FloatArray, D: FloatArray | None
) -> tuple[FloatArray, FloatArray]:
    """Return the matrices ``[E, 0; 0, 0]`` and ``[A, B; C, D]`` of the pencil ``[A - z E, B; C, D]``."""
    feedthrough = np.zeros((C.shape[0], B.shape[1])) if D is None else D
    padded = np.zeros((E.shape[0] + C.shape[0], E.shape[1] + B.shape[1]))
    padded[: E.shape[0], : E.shape[1]] = E
    return padded, np.block([[A, B], [C, feedthrough]])


def _reaches_boundary(pencil: PencilPoints | EquilibratedPencil, value: complex, dt: float, normal_rank: int) -> bool:
    """Whether the pencil is singular to working precision all the way from a zero to the stability boundary."""
    point = value / abs(value) if dt > 0.0 else complex(0.0, value.imag)
    # Several points on the way: at the boundary alone another zero may make the pencil singular.
    for fraction in _PATH_TO_BOUNDARY:
        place = value + fraction * (point - value)
        place = place if place.imag else place.real
        if isinstance(pencil, PencilPoints):
            smallest = pencil.smallest(place)
        else:
            singular_values = np.linalg.svd(pencil.A - place * pencil.E, compute_uv=False)
            smallest = singular_values[normal_rank - 1] / singular_values[0] if singular_values[0] else 0.0
        if smallest > BOUNDARY_RANK_TOLERANCE:
            return False
    return True


def zeros_with_directions(
    E: FloatArray, A: FloatArray, finite: FiniteZeros, *, nx: int, selected: Callable[[complex], bool] = lambda _: True
) -> tuple[Zero, ...]:
    """Return the zeros of the system pencil ``A - z E`` with their directions.

    ``selected`` chooses zeros by their values; it has to treat both zeros of a conjugate pair alike.
    """
    values = [complex(value) for value in finite.values]
    zeros: list[Zero] = []
    for i, value in enumerate(values):
        if not selected(value):
            continue
        if value.imag < 0.0:
            # `finite_zeros` returns exact conjugate pairs, upper half plane first.
            state, driving = (
                read_only(part.conj(), np.complex128) for part in (zeros[-1].state_direction, zeros[-1].input_direction)
            )
            zeros.append(Zero(value, state, driving, zeros[-1].input_share))
            continue
        pencil = equilibrated_at(E, A, value, nx=nx)
        kernel = _kernel(pencil, value, least=pencil.A.shape[1] - finite.normal_rank + 1)
        basis = smallest_part_first(kernel, slice(nx, None))
        # The zeros of one cluster take different directions of the null space.
        place = sum(abs(value - other) <= CLUSTER_TOLERANCE * max(1.0, abs(value)) for other in values[:i])
        zeros.append(_zero_along(basis[:, min(place, basis.shape[1] - 1)], value, pencil.columns, nx=nx))
    return tuple(zeros)


def _kernel(pencil: EquilibratedPencil, value: complex, *, least: int) -> NDArray[Any]:
    """Return an orthonormal null basis of the pencil at ``value``, with ``least`` columns or more."""
    matrix = pencil.A - (value if value.imag else value.real) * pencil.E
    if matrix.shape[0] >= matrix.shape[1] >= FEW_COLUMNS and least <= MOST_DIRECTIONS:
        values, vectors, largest = smallest_singular(matrix, MOST_DIRECTIONS)
        count = max(least, int(np.sum(values <= RANK_TOLERANCE * largest)))
        return np.asarray(vectors[:, :count])
    _, singular_values, right = np.linalg.svd(matrix)
    return np.asarray(right[min(numerical_rank(singular_values), matrix.shape[1] - least) :].conj().T)


def smallest_part_first(basis: NDArray[Any], part: slice) -> NDArray[Any]:
    """Rotate an orthonormal basis so that the norm of the rows ``part`` grows from the first to the last column."""
    if basis.shape[1] == 1 or basis[part].size == 0:
        return basis
    _, _, rotation = np.linalg.svd(basis[part])
    return np.asarray(basis @ rotation.conj().T[:, ::-1])


def _zero_along(direction: NDArray[Any], value: complex, scale: FloatArray, *, nx: int) -> Zero:
    """Return a zero with its direction in the original units, of unit norm and with a positive largest entry."""
    original = scale * direction
    leading = original[np.argmax(np.abs(original))]
    original = original * (abs(leading) / leading / np.linalg.norm(original))
    share = float(np.linalg.norm(direction[nx:]))
    state, driving = (read_only(part, np.complex128) for part in (original[:nx], original[nx:]))
    return Zero(value, state, driving, share)
