"""Whether a tall pencil loses rank at given points.

In the Schur basis of the part on the range of E it is ``[T - z I; W]``, T triangular, few rows W: one Schur form, then
a cheap QR (``tpqrt``) at each point and inverse iteration, in a tenth of the time of all singular values.
"""

from __future__ import annotations

from functools import cached_property
from typing import Any, TypeAlias

import numpy as np
import scipy
from numpy.typing import NDArray

from obsynth.numerics import lapack
from obsynth.numerics.arrays import ComplexArray, FloatArray
from obsynth.numerics.ranks import RANK_TOLERANCE, RankDecision, rank_from
from obsynth.numerics.square_root_estimation import TPQRT_BLOCK

#: Matrices with fewer columns are decomposed as a whole.
FEW_COLUMNS = 80

#: Steps of inverse iteration: values that decide are smaller than the next by many digits, and each step squares that.
NULL_DIRECTION_STEPS = 4

#: Singular values, smallest first, right singular vectors as columns, and a bound on the largest value.
Smallest: TypeAlias = tuple[FloatArray, NDArray[Any], float]

#: Above this condition of its leading part the Schur basis is not orthonormal enough to judge the pencil in it.
SAFE_BASIS_CONDITION = 1e5

#: Points without meaning, at which a pencil has its normal rank; where several are tried, the clearest is used.
GENERIC_POINTS = (0.7391, -1.3247, 1.9561, -0.4142)

#: Most null directions that are looked for at a point.
MOST_DIRECTIONS = 4

#: Steps in which a computed zero is improved before the pencil there is judged.
ZERO_STEPS = 4

#: A zero that moves further than this, relative to its size or one, is another one.
ZERO_REACH = 1e-2


def smallest_singular(matrix: NDArray[Any], count: int = 1) -> Smallest:
    """Return the smallest singular values of a matrix ``(m, n)``, ``m >= n``, or more, with right singular vectors."""
    if matrix.shape[1] < FEW_COLUMNS:
        _, values, right = np.linalg.svd(matrix)
        order = slice(None, -count - 1, -1)
        return values[order], right[order].conj().T, float(values[0])
    return iterated(np.asarray(scipy.linalg.qr(matrix, mode="r", check_finite=False)[0][: matrix.shape[1]]), count)


def iterated(triangle: NDArray[Any], count: int) -> Smallest:
    """Return the smallest singular values of an upper triangular matrix by inverse iteration."""
    size = triangle.shape[0]
    norm = float(np.sqrt(np.linalg.norm(triangle, 1) * np.linalg.norm(triangle, np.inf)))
    if norm == 0.0:
        return np.zeros(count), np.eye(size, count), 0.0
    work = np.array(triangle, order="F")
    diagonal = np.einsum("ii->i", work)
    # An exact zero would be divided by: as small as rounding, it does as well.
    small = np.abs(diagonal) < np.finfo(float).eps * norm
    diagonal[small] = np.finfo(float).eps * norm
    solve = lapack.ztrtrs if np.iscomplexobj(work) else lapack.dtrtrs
    basis = np.random.default_rng(0).normal(size=(size, count)).astype(work.dtype)
    with np.errstate(over="ignore", invalid="ignore"):
        for _ in range(NULL_DIRECTION_STEPS):
            inner = solve(work, basis, trans=2)[0]
            inner /= np.max(np.abs(inner), axis=0, initial=0.0) + np.finfo(float).tiny
            basis = solve(work, inner)[0]
            # One direction is orthonormal by its length.
            basis = basis / np.linalg.norm(basis) if count == 1 else np.linalg.qr(basis)[0]
    if count == 1:
        return np.array([np.linalg.norm(triangle @ basis)]), basis, norm
    _, values, turned = np.linalg.svd(triangle @ basis, full_matrices=False)
    return values[::-1], basis @ turned[::-1].conj().T, norm


class PencilPoints:
    """A tall pencil ``A - z E (m, n)``, E of full column rank, judged at points; ``scales`` are the norms of E, A."""

    def __init__(self, E: FloatArray, A: FloatArray, scales: tuple[float, float]) -> None:
        self.E, self.A, self.scales = E, A, scales

    def nullity(self, point: complex) -> int:
        """Return how many singular values at a point are below the tolerance of every rank."""
        decision = self.rank(point)
        return decision.expected - decision.rank

    def rank(self, point: complex) -> RankDecision:
        """Decide whether the columns are independent at a point; in large pencils by the smallest singular values."""
        scale = self.scales[1] + abs(point) * self.scales[0]
        if self.E.shape[1] < FEW_COLUMNS or self._schur is None:
            values = np.asarray(np.linalg.svd(self.A - point * self.E, compute_uv=False))
            return rank_from(values, scale=scale, expected=len(values))
        count = min(MOST_DIRECTIONS, self.E.shape[1])
        # In the basis of the Schur form values are those of the pencil up to the condition of E.
        triangle = self._triangle(point)
        least = iterated(triangle, 1)[0]
        if least[0] > RANK_TOLERANCE * scale * self._schur[3]:
            return rank_from(least / self._schur[3], scale=scale, expected=1)
        vectors = self._schur[1] @ iterated(triangle, count)[1]
        basis = np.linalg.qr(vectors)[0]
        values = np.asarray(np.linalg.svd((self.A - point * self.E) @ basis, compute_uv=False))
        return rank_from(values, scale=scale, expected=count)

    def smallest(self, point: complex) -> float:
        """Return the smallest singular value at a point relative to the largest, up to the condition of E."""
        if self.E.shape[1] < FEW_COLUMNS or self._schur is None:
            values, _, largest = smallest_singular(self.A - point * self.E)
        else:
            values, _, largest = iterated(self._triangle(point), 1)
        return float(values[0]) / largest if largest else 0.0

    def confirmed(self, point: complex) -> complex | None:
        """Return a computed zero, improved where that is needed; ``None`` where the pencil has full rank all around."""
        if self.nullity(point):
            return point
        place = point
        for _ in range(ZERO_STEPS):
            matrix = self.A - place * self.E
            left_vectors, _, right_vectors = np.linalg.svd(matrix, full_matrices=False)
            u, v = left_vectors[:, -1].conj(), right_vectors[-1].conj()
            slope = u @ self.E @ v
            if slope == 0.0:
                return None
            place = place + (u @ matrix @ v) / slope
            if not abs(place - point) <= ZERO_REACH * max(1.0, abs(point)):
                return None
            if self.nullity(place):
                return complex(place.real, place.imag if point.imag else 0.0)
        return None

    @cached_property
    def _schur(self) -> tuple[ComplexArray, ComplexArray, ComplexArray, float] | None:
        """Return T, the basis, the rows below, and the condition of E; ``None`` where that is too large."""
        columns = self.E.shape[1]
        basis, square = np.linalg.qr(self.E, mode="complete")
        turned, top = basis.T @ self.A, square[:columns]
        sizes = np.linalg.svd(top, compute_uv=False)
        if not sizes[-1] * SAFE_BASIS_CONDITION > sizes[0]:
            return None
        t, u = scipy.linalg.rsf2csf(*scipy.linalg.schur(np.linalg.solve(top, turned[:columns]), check_finite=False))
        # The leading part is divided by E; the rows below are brought to its size.
        return (
            np.asfortranarray(np.triu(t)),
            u,
            np.asarray(turned[columns:] @ u / sizes[0]),
            float(sizes[0] / sizes[-1] / sizes[-1]),
        )

    def _triangle(self, point: complex) -> NDArray[Any]:
        schur = self._schur
        triangle = np.array(schur[0] if schur else self.A, order="F")
        np.einsum("ii->i", triangle)[:] -= point
        below = np.array(schur[2] if schur else self.E, dtype=np.complex128, order="F")
        if not below.shape[0]:
            return triangle
        reduced, _, _, _ = lapack.ztpqrt(
            0, min(TPQRT_BLOCK, triangle.shape[0]), triangle, below, overwrite_a=1, overwrite_b=1
        )
        # What is below the diagonal stays as it was: zero.
        return np.asarray(reduced)
