"""Zeros far outside the unit circle: which of those computed are zeros, and in which units to look at them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from obsynth.numerics.arrays import FloatArray, read_only
from obsynth.numerics.pencil_points import FEW_COLUMNS, smallest_singular
from obsynth.numerics.pencils import FiniteZeros, finite_zeros
from obsynth.numerics.ranks import BOUNDARY_RANK_TOLERANCE, CLUSTER_TOLERANCE
from obsynth.numerics.scaling import EquilibratedPencil, equilibrate_pencil, power_of_two_below

#: Steps in which a computed zero is improved before the pencil there is judged.
NEWTON_STEPS = 4


def system_zeros(E: FloatArray, A: FloatArray, *, nx: int) -> FiniteZeros:
    """Return the finite zeros of a system pencil ``(nx + ny, nx + nu)`` without those that are only nearly infinite.

    Far out a pencil with zeros at infinity is nearly singular everywhere, beside ``z E``: a chain of k states shows
    with ``z^-k``.  A candidate there counts only when the pencil is singular to rounding in units that suit its size.
    """
    found = finite_zeros(E, A, to_the_end=False)
    if not found.values.size:
        return found
    # Both of a pair are judged by the upper one.
    upper = [complex(z.real, abs(z.imag)) for z in found.values]
    kept = np.array([abs(z) <= 1.0 or _is_singular(E, A, z, found.normal_rank, nx=nx) for z in upper], dtype=bool)
    values = found.values[kept]
    values.setflags(write=False)
    return replace(found, values=values)


def _is_singular(E: FloatArray, A: FloatArray, value: complex, normal_rank: int, *, nx: int) -> bool:
    """Whether the rank drops at, or within the accuracy of, a computed zero."""
    pencil = equilibrated_at(E, A, value, nx=nx)
    point, best = value, np.inf
    for _ in range(NEWTON_STEPS):
        matrix = pencil.A - point * pencil.E
        if matrix.shape[0] >= matrix.shape[1] == normal_rank >= FEW_COLUMNS:
            found = smallest_singular(matrix)
            largest, smallest, v = found.largest, float(found.values[0]), found.right[:, 0]
            u = (matrix @ v).conj()
            u = u / (float(np.linalg.norm(u)) or 1.0)
        else:
            left, sizes, right = np.linalg.svd(matrix)
            largest, smallest = float(sizes[0]), float(sizes[normal_rank - 1])
            u, v = left[:, normal_rank - 1].conj(), right[normal_rank - 1].conj()
        if largest == 0.0:
            return True
        best = min(best, smallest / largest)
        if best <= BOUNDARY_RANK_TOLERANCE:
            return True
        slope = u @ pencil.E @ v
        # A zero far out is known only to the rounding of the largest: Newton's method on u' (A - z E) v finds the rest.
        step = (u @ (pencil.A - point * pencil.E) @ v) / slope if slope != 0.0 else 0.0
        if abs(point + step - value) > CLUSTER_TOLERANCE * abs(value):
            break
        point = point + step
    return False


def equilibrated_at(E: FloatArray, A: FloatArray, value: complex, *, nx: int) -> EquilibratedPencil:
    """Return the pencil with states, equations and outputs in units that suit a point of this modulus.

    Beside a large ``z E`` the inputs and outputs would vanish: the states are measured in the units that ``z x`` has.
    """
    size = float(power_of_two_below(np.array(max(1.0, abs(value)))))
    columns = np.where(np.arange(E.shape[1]) < nx, 1.0 / size, 1.0)
    # Scaled with the modulus at that point, then taken apart again, so that the factors are those of A - z E.
    scaled = equilibrate_pencil(size * columns * E, columns * A)
    return EquilibratedPencil(scaled.E / size, scaled.A, scaled.rows, read_only(scaled.columns * columns))
