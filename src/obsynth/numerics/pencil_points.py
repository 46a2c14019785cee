"""Whether a tall pencil loses rank at given points.

In the Schur basis of the part on the range of E it is ``[T - z I; W]``, T triangular, few rows W: one Schur form, then
a cheap QR (``tpqrt``) at each point and inverse iteration, in a tenth of the time of all singular values.  Where E is
ill-conditioned the generalised Schur form keeps both bases orthonormal: ``[T - z S; W]``, S triangular as well.
"""

from __future__ import annotations

from functools import cached_property
from typing import Any, NamedTuple, TypeAlias

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

#: Where all of them are null directions, so many are looked for, and then all.
MANY_DIRECTIONS = 64

#: Steps in which a computed zero is improved before the pencil there is judged.
ZERO_STEPS = 4

#: A zero that moves further than this, relative to its size or one, is another one.
ZERO_REACH = 1e-2

#: Of more rows W so many combinations are looked at first: full rank with them is full rank with all.
FEW_ROWS = 32


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
    sizes = np.abs(triangle)
    norm = float(np.sqrt(np.max(np.sum(sizes, axis=0)) * np.max(np.sum(sizes, axis=1))))
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


class _SchurForm(NamedTuple):
    """``[A - z E]`` turned to ``[T - z S; W]``; columns of ``basis`` are the new states."""

    t: ComplexArray  # T (n, n), upper triangular
    s: ComplexArray | None  # S (n, n), upper triangular; ``None`` for the identity
    basis: ComplexArray  # (n, n), unitary
    below: ComplexArray  # W (m - n, n)
    condition: float  # factor between singular values of this and of the pencil, from one side to the other

    def triangle(self, point: complex, below: ComplexArray) -> ComplexArray:
        """Return the triangular factor at a point of T - z S above rows ``below``."""
        if self.s is None:
            triangle = np.array(self.t, order="F")
            np.einsum("ii->i", triangle)[:] -= point
        else:
            triangle = np.asfortranarray(self.t - point * self.s)
        if not len(below):
            return triangle
        block = min(TPQRT_BLOCK, len(triangle))
        # What is below the diagonal stays as it was: zero.
        rows = np.array(below, dtype=np.complex128, order="F")
        return np.asarray(lapack.ztpqrt(0, block, triangle, rows, overwrite_a=1, overwrite_b=1)[0])


class PencilPoints:
    """A tall pencil ``A - z E (m, n)``, E of full column rank, judged at points; ``scales`` are the norms of E, A."""

    def __init__(self, E: FloatArray, A: FloatArray, scales: tuple[float, float]) -> None:
        self.E, self.A, self.scales = E, A, scales
        self._decided: dict[complex, RankDecision] = {}

    def nullity(self, point: complex) -> int:
        """Return how many singular values at a point are below the tolerance of every rank."""
        if point not in self._decided and self._is_full_in_few_rows(point):
            return 0
        decision = self.rank(point)
        return decision.expected - decision.rank

    def _is_full_in_few_rows(self, point: complex) -> bool:
        """Whether a large pencil has full rank at a point already with a few combinations of its rows."""
        surplus = self.E.shape[0] - self.E.shape[1]
        if self.E.shape[1] < FEW_COLUMNS or surplus <= 2 * FEW_ROWS or self._schur is None:
            return False
        least = iterated(self._schur.triangle(point, self._few_rows), 1)[0]
        return bool(least[0] > RANK_TOLERANCE * self._scale(point) * self._schur.condition)

    def _scale(self, point: complex) -> float:
        """Return the size at a point that the tolerance is relative to."""
        return self.scales[1] + abs(point) * self.scales[0]

    def rank(self, point: complex) -> RankDecision:
        """Decide whether the columns are independent at a point; in large pencils by the smallest singular values."""
        if point not in self._decided:
            self._decided[point] = self._rank(point)
        return self._decided[point]

    def _rank(self, point: complex) -> RankDecision:
        scale = self._scale(point)
        if self.E.shape[1] < FEW_COLUMNS or self._schur is None:
            return self._by_all_values(point)
        # In the basis of the Schur form values are those of the pencil up to the condition of E.
        triangle = self._schur.triangle(point, self._schur.below)
        least = iterated(triangle, 1)[0]
        if least[0] > RANK_TOLERANCE * scale * self._schur.condition:
            return rank_from(least / self._schur.condition, scale=scale, expected=1)
        for count in (MOST_DIRECTIONS, min(MANY_DIRECTIONS, len(triangle))):
            basis = np.linalg.qr(self._schur.basis @ iterated(triangle, count)[1])[0]
            values = np.asarray(np.linalg.svd((self.A - point * self.E) @ basis, compute_uv=False))
            decision = rank_from(values, scale=scale, expected=count)
            if decision.rank:
                return decision
        return self._by_all_values(point)

    def _by_all_values(self, point: complex) -> RankDecision:
        """Decide the same by all singular values: more directions are lost than are looked for."""
        values = np.asarray(np.linalg.svd(self.A - point * self.E, compute_uv=False))
        return rank_from(values, scale=self._scale(point), expected=len(values))

    def smallest(self, point: complex) -> float:
        """Return the smallest singular value at a point relative to the largest, up to the condition of E."""
        if self.E.shape[1] < FEW_COLUMNS or self._schur is None:
            values, _, largest = smallest_singular(self.A - point * self.E)
        else:
            values, _, largest = iterated(self._schur.triangle(point, self._schur.below), 1)
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
    def _few_rows(self) -> ComplexArray:
        """A few orthonormal combinations of the rows W: they map no vector to more than all rows do."""
        below = self.E[:0] if self._schur is None else self._schur.below
        mixing = np.linalg.qr(np.random.default_rng(0).normal(size=(len(below), FEW_ROWS)))[0]
        return np.asarray(mixing.T @ below, dtype=np.complex128)

    @cached_property
    def _schur(self) -> _SchurForm | None:
        """The pencil in Schur form; ``None`` where LAPACK does not find it."""
        columns = self.E.shape[1]
        basis, square = np.linalg.qr(self.E, mode="complete")
        turned, top = basis.T @ self.A, square[:columns]
        sizes = np.linalg.svd(top, compute_uv=False)
        if not sizes[-1] * SAFE_BASIS_CONDITION > sizes[0]:
            return _generalised_schur(turned[:columns], top, turned[columns:])
        t, u = scipy.linalg.rsf2csf(*scipy.linalg.schur(np.linalg.solve(top, turned[:columns]), check_finite=False))
        # The leading part is divided by E; the rows below are brought to its size.
        below = np.asarray(turned[columns:] @ u / sizes[0])
        return _SchurForm(np.asfortranarray(np.triu(t)), None, u, below, float(sizes[0] / sizes[-1] / sizes[-1]))


def _generalised_schur(a: FloatArray, e: FloatArray, rest: FloatArray) -> _SchurForm | None:
    """Return ``[a - z e; rest]`` in generalised Schur form; ``None`` where LAPACK does not find it.

    The real form takes two fifths of the time of the complex one.  What is left of pairs is made triangular block by
    block."""
    try:
        real_t, real_s, _, real_basis = scipy.linalg.qz(a, e, output="real", check_finite=False)
    except np.linalg.LinAlgError:
        return None
    t, s, basis = (part.astype(np.complex128) for part in (real_t, real_s, real_basis))
    for i in np.flatnonzero(np.diagonal(real_t, -1)):
        pair = slice(i, i + 2)
        _, _, left, right = scipy.linalg.qz(t[pair, pair], s[pair, pair], output="complex", check_finite=False)
        for matrix in (t, s):
            matrix[pair, i:] = left.conj().T @ matrix[pair, i:]
            matrix[: i + 2, pair] = matrix[: i + 2, pair] @ right
        basis[:, pair] = basis[:, pair] @ right
    return _SchurForm(np.asfortranarray(np.triu(t)), np.asfortranarray(np.triu(s)), basis, rest @ basis, 1.0)
