"""Matrices of real balls in any precision (python-flint's Arb), and the signs of a quadratic form decided with them.

Formed again with more digits and factored as :math:`L D L^T` until the pivots are decided: if every one is a ball to
the right of zero, each symmetric member is positive definite (Sylvester's law of inertia holds for every member).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Protocol, Self, TypeVar

import flint
import numpy as np

from obsynth.numerics.arrays import FloatArray
from obsynth.proofs.balls import Ball

#: The arithmetics in which a matrix can be formed so that sums and products hold those of all members.
Enclosed = TypeVar("Enclosed", Ball, "ExtendedBall")

#: Digits to try, in bits.
PRECISION_BITS = (128, 512, 2048)

#: Digits (bits) in which all eigenvalues of a matrix are enclosed, and the largest order of which they are: .8 s at 57.
EIGENVALUE_BITS = (212, 848)

MOST_ENCLOSED = 80


class Formula(Protocol):
    """How a matrix is formed, in an arithmetic of whoever calls it: ``formula(Ball)`` for double precision."""

    def __call__(self, kind: type[Enclosed], /) -> Enclosed:
        """Return the matrix with what forming it may have cost."""


def block(rows: Sequence[Sequence[Enclosed]]) -> Enclosed:
    """Return the set of block matrices with the given rows of blocks."""
    return type(rows[0][0]).blocks(rows)


def prove_by_ball_arithmetic(formula: Formula) -> tuple[float | None, str]:
    """Try to prove that every symmetric member of a matrix is positive definite, with as many digits as it takes.

    Returns a proved lower bound and the digits that decided; ``None`` and the reason without a proof."""
    reason = ""
    for bits in PRECISION_BITS:
        # A local precision: the one in python-flint's context is for the whole process.
        with flint.ctx.workprec(bits):
            matrix = formula(ExtendedBall)
            pivot = undecided_pivot(matrix.entries())
            if pivot is None:
                return _lower_bound(matrix), f"{bits} bits"
        place, is_certain, is_hopeless = pivot
        if is_certain:
            return None, f"pivot {place} is not positive: not positive definite"
        reason = f"{bits} bits of ball arithmetic leave the sign of pivot {place} open: singular, or next to it"
        if is_hopeless:
            break
    return None, reason


def enclosed_eigenvalues(matrix: FloatArray) -> tuple[Any, ...] | None:
    """Return balls (``flint.acb``), each with one eigenvalue of ``matrix`` as stored; ``None`` without a proof."""
    order = len(matrix)
    if not 0 < order <= MOST_ENCLOSED or not np.all(np.isfinite(matrix)):
        return None
    for bits in EIGENVALUE_BITS:
        with flint.ctx.workprec(bits):
            try:
                return tuple(flint.acb_mat(order, order, np.ravel(matrix).tolist()).eig(multiple=True))
            except ValueError:  # the enclosures found at this precision do not hold
                continue
    return None


def middles(matrix: Any) -> FloatArray:
    """Return the middles of an ``arb_mat (n, m)`` in double precision."""
    numbers = np.array([float(value.mid()) for value in matrix.entries()])
    return numbers.reshape(int(matrix.nrows()), int(matrix.ncols()))


def middle_of(ball: Any) -> complex:
    """Return the middle of a complex ball, to double precision."""
    return complex(float(ball.real.mid()), float(ball.imag.mid()))


def undecided_pivot(rows: list[list[Any]]) -> tuple[int, bool, bool] | None:
    """Return the place of the first pivot of ``L D L'`` not certainly positive, if any, whether it certainly is not,
    and whether digits do not help, as it is not finite; only the upper triangle is read."""
    size = len(rows)
    for k, pivot_row in enumerate(rows):
        pivot = pivot_row[k]
        if not pivot > 0:
            return k + 1, bool(pivot <= 0), not pivot.is_finite()
        for i in range(k + 1, size):
            factor, row = pivot_row[i] / pivot, rows[i]
            for j in range(i, size):
                row[j] -= factor * pivot_row[j]
    return None


def _lower_bound(matrix: ExtendedBall) -> float:
    """Return ``1 / trace(X^-1)``, rounded down: no more than the smallest eigenvalue of a definite member X."""
    try:
        trace = matrix.content.inv().trace().upper()
    except ZeroDivisionError:
        return float(np.nextafter(0.0, 1.0))
    bound = float((1 / trace).lower()) if trace > 0 and trace.is_finite() else 0.0
    return max(float(np.nextafter(bound, 0.0)), float(np.nextafter(0.0, 1.0)))


def arb_matrix(matrix: FloatArray) -> Any:
    """Return a matrix as python-flint's, exactly."""
    rows, columns = np.shape(matrix)
    return flint.arb_mat(rows, columns, np.ravel(matrix).tolist())


@dataclass(frozen=True, eq=False)
class ExtendedBall:
    """All real matrices within radii of midpoints that have the digits of python-flint's current precision."""

    content: Any

    @classmethod
    def exact(cls, matrix: FloatArray) -> Self:
        """Return the ball that holds ``matrix`` alone, whatever the precision."""
        return cls(arb_matrix(matrix))

    @classmethod
    def of(cls, ball: Ball) -> Self:
        """Return the ball with the midpoint and radius of ``ball``."""
        rows, columns = ball.shape
        pairs = zip(np.ravel(ball.midpoint).tolist(), np.ravel(ball.radius).tolist(), strict=True)
        content = [flint.arb(middle, radius) if radius else flint.arb(middle) for middle, radius in pairs]
        return cls(flint.arb_mat(rows, columns, content))

    @classmethod
    def blocks(cls, rows: Sequence[Sequence[Self]]) -> Self:
        """Return the ball of the block matrix with the given rows of blocks."""
        joined: list[Any] = []
        height = 0
        for row in rows:
            parts = [part.entries() for part in row]
            height += row[0].shape[0]
            for i in range(row[0].shape[0]):
                joined += [value for part in parts for value in part[i]]
        return cls(flint.arb_mat(height, sum(part.shape[1] for part in rows[0]), joined))

    def entries(self) -> list[list[Any]]:
        """Return the entries as lists of ``flint.arb``."""
        return [list(row) for row in self.content.tolist()]

    @property
    def shape(self) -> tuple[int, ...]:
        """Rows and columns."""
        return int(self.content.nrows()), int(self.content.ncols())

    @property
    def T(self) -> Self:
        """The transpose."""
        return type(self)(self.content.transpose())

    def __add__(self, other: Self) -> Self:
        """Return the ball of all sums of members."""
        return type(self)(self.content + other.content)

    def __neg__(self) -> Self:
        """Return the ball of the negative members; exact."""
        return type(self)(-self.content)

    def __sub__(self, other: Self) -> Self:
        """Return the ball of all differences of members."""
        return type(self)(self.content - other.content)

    def __matmul__(self, other: Self) -> Self:
        """Return the ball of all products of members."""
        return type(self)(self.content * other.content)

    def scaled(self, factor: float) -> Self:
        """Return the ball of ``factor`` times every member."""
        return type(self)(self.content * flint.arb(factor))
