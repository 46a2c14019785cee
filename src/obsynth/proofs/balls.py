r"""Matrices with guaranteed error bounds: sums and products of balls contain those of every member, in any BLAS order.

A `Ball` is every real matrix within ``radius`` of ``midpoint``, entry by entry; an overflow leaves entries that are not
finite, about which nothing is claimed.  Higham, *Accuracy and Stability*, 2nd ed., section 3.1, with
:math:`u = 2^{-53}`, :math:`\gamma_k = k u / (1 - k u)`: a dot product of length k in any order, with or without fused
multiply-add, misses at most :math:`\gamma_k |x|^T |y|`, plus :math:`k\,2^{-1074}` where products underflow.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Self

import numpy as np
from numpy.typing import NDArray

from obsynth.numerics.arrays import FloatArray

#: Unit roundoff of IEEE double precision.
UNIT_ROUNDOFF = 2.0**-53

#: Twice the smallest positive number: more than one underflow can lose.
UNDERFLOW = 2.0**-1073

#: Powers of two up to this exponent have doubles as products.
LARGEST_EXPONENT = 500

#: Rows of a large matrix that are looked at at once: as many as a processor keeps near.
PANEL_ROWS = 128


def gamma(terms: int) -> float:
    """Return an upper bound on ``k u / (1 - k u)`` for ``k = terms`` (far below ``1 / u``)."""
    return terms * UNIT_ROUNDOFF * (1.0 + 2.0 * (terms + 2) * UNIT_ROUNDOFF)


def rounded_up(value: FloatArray, operations: int) -> FloatArray:
    """Return an upper bound on a non-negative exact value that was computed with ``operations`` roundings."""
    return value * (1.0 + 2.0 * (operations + 2) * UNIT_ROUNDOFF) + (operations + 1) * UNDERFLOW


@dataclass(frozen=True, eq=False)
class Ball:
    """All real matrices within ``radius`` (not negative) of ``midpoint``, entry by entry, ``(rows, cols)`` each."""

    midpoint: FloatArray
    radius: FloatArray

    @classmethod
    def exact(cls, matrix: FloatArray) -> Self:
        """Return the ball that holds ``matrix`` alone: floating-point numbers are exact data."""
        return cls(np.asarray(matrix, dtype=np.float64), np.zeros(np.shape(matrix)))

    @classmethod
    def of(cls, matrix: Ball | FloatArray) -> Self:
        """Return a ball as it is, or the one that holds a matrix alone."""
        return cls(matrix.midpoint, matrix.radius) if isinstance(matrix, Ball) else cls.exact(matrix)

    @classmethod
    def blocks(cls, rows: Sequence[Sequence[Self]]) -> Self:
        """Return the ball of the block matrix with the given rows of blocks."""
        heights, widths = [row[0].shape[0] for row in rows], [ball.shape[1] for ball in rows[0]]
        midpoint, radius = (np.zeros((sum(heights), sum(widths))) for _ in range(2))
        bottom = 0
        for row, height in zip(rows, heights, strict=True):
            right = 0
            for ball, width in zip(row, widths, strict=True):
                place = slice(bottom, bottom + height), slice(right, right + width)
                midpoint[place], radius[place] = ball.midpoint, ball.radius
                right += width
            bottom += height
        return cls(midpoint, radius)

    @property
    def shape(self) -> tuple[int, ...]:
        """Rows and columns."""
        return tuple(self.midpoint.shape)

    @property
    def T(self) -> Self:
        """The transpose."""
        return type(self)(self.midpoint.T, self.radius.T)

    def __add__(self, other: Self) -> Self:
        """Return the ball of all sums of members."""
        with np.errstate(over="ignore", invalid="ignore"):
            total = self.midpoint + other.midpoint
            radius = rounded_up(self.radius + other.radius + UNIT_ROUNDOFF * np.abs(total), 3)
        return type(self)(total, radius)

    def __neg__(self) -> Self:
        """Return the ball of the negative members; exact."""
        return type(self)(-self.midpoint, self.radius)

    def __sub__(self, other: Self) -> Self:
        """Return the ball of all differences of members."""
        return self + (-other)

    def __matmul__(self, other: Self) -> Self:
        """Return the ball of all products of members."""
        length = self.shape[1]
        size, other_size = np.abs(self.midpoint), np.abs(other.midpoint)
        with np.errstate(over="ignore", invalid="ignore"):
            # gamma multiplies the product, not a factor: what a factor loses by underflow, the other may magnify.
            spread = gamma(length + 1) * (size @ other_size)
            if not other.is_exact:
                spread = spread + size @ other.radius
            if not self.is_exact:
                spread = spread + self.radius @ (other_size + other.radius)
            radius = rounded_up(spread, 2 * length + 6) + 3 * length * UNDERFLOW
            return type(self)(self.midpoint @ other.midpoint, radius)

    def scaled(self, factor: float) -> Self:
        """Return the ball of ``factor`` times every member."""
        with np.errstate(over="ignore", invalid="ignore"):
            product = factor * self.midpoint
            radius = abs(factor) * self.radius + UNIT_ROUNDOFF * np.abs(product) + UNDERFLOW
            return type(self)(product, rounded_up(radius, 4))

    @property
    def magnitude(self) -> FloatArray:
        """Upper bounds on the absolute values of the entries of every member."""
        return rounded_up(np.abs(self.midpoint) + self.radius, 2)

    @property
    def frobenius_norm(self) -> float:
        """Upper bound on the Frobenius norm of every member, and so on its 2-norm."""
        size = self.magnitude
        return float(rounded_up(np.asarray(np.sqrt(np.sum(size**2))), size.size + 6))

    def widened(self, share: float) -> Ball:
        """Return the ball of every member times a number that is off one by at most ``share``."""
        radius = self.radius + share * (np.abs(self.midpoint) + self.radius)
        return Ball(self.midpoint, rounded_up(radius, 4))

    def added(self, radius: float) -> Ball:
        """Return the ball of all sums with a matrix of entries of at most so much."""
        return Ball(self.midpoint, rounded_up(self.radius + radius, 2))

    @property
    def is_finite(self) -> bool:
        """Whether anything is claimed: no entry overflowed."""
        return bool(np.isfinite(self.midpoint).all() and np.isfinite(self.radius).all())

    @property
    def is_exact(self) -> bool:
        """Whether there is one member alone."""
        return not self.radius.any()

    def congruent(self, exponents: NDArray[np.int64]) -> Ball:
        """Return ``diag(2^k) X diag(2^k)``, k the ``exponents``: exact but for underflow."""
        middle, radius = np.empty(self.shape), np.empty(self.shape)
        # Where every factor is a double, one product is as exact as `ldexp`, at a fraction of its time.
        units = np.ldexp(1.0, exponents) if np.max(np.abs(exponents), initial=0) <= LARGEST_EXPONENT else None
        with np.errstate(over="ignore"):
            for start in range(0, len(exponents), PANEL_ROWS):
                rows = slice(start, start + PANEL_ROWS)
                if units is not None:
                    factors = units[rows, None] * units
                    np.multiply(self.midpoint[rows], factors, out=middle[rows])
                    np.multiply(self.radius[rows], factors, out=radius[rows])
                else:
                    total = exponents[rows, None] + exponents
                    np.ldexp(self.midpoint[rows], total, out=middle[rows])
                    np.ldexp(self.radius[rows], total, out=radius[rows])
            radius += UNDERFLOW
        return Ball(middle, radius)
