r"""Matrices with guaranteed error bounds: midpoint and radius, rounding included.

A `Ball` stands for every real matrix within ``radius`` of ``midpoint``, entry by entry.  Sums and products
of balls contain every sum and product of members, whatever the order in which BLAS adds up.  A ball that overflowed
has an entry that is not finite, and every product with it too: nothing is claimed about it.

The bound (Higham, *Accuracy and Stability of Numerical Algorithms*, 2nd ed., section 3.1): with unit
roundoff :math:`u = 2^{-53}` and :math:`\gamma_k = k u / (1 - k u)`, a dot product of length k computed in
any order, with or without fused multiply-add, differs from the exact one by at most
:math:`\gamma_k |x|^T |y|`, plus :math:`k\,2^{-1074}` where products underflow.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from obsynth.numerics.arrays import FloatArray

#: Unit roundoff of IEEE double precision.
UNIT_ROUNDOFF = 2.0**-53
#: Twice the smallest positive number: more than one underflow can lose.
UNDERFLOW = 2.0**-1073


def gamma(terms: int) -> float:
    """Return an upper bound on ``k u / (1 - k u)`` for ``k = terms`` (far below ``1 / u``)."""
    return terms * UNIT_ROUNDOFF * (1.0 + 2.0 * (terms + 2) * UNIT_ROUNDOFF)


def rounded_up(value: FloatArray, operations: int) -> FloatArray:
    """Return an upper bound on a non-negative exact value that was computed with ``operations`` roundings."""
    return value * (1.0 + 2.0 * (operations + 2) * UNIT_ROUNDOFF) + (operations + 1) * UNDERFLOW


@dataclass(frozen=True, eq=False)
class Ball:
    """All real matrices within ``radius`` of ``midpoint``, entry by entry.

    Parameters
    ----------
    midpoint, radius : FloatArray
        ``(rows, cols)`` each; the radius is not negative.
    """

    midpoint: FloatArray
    radius: FloatArray

    @classmethod
    def exact(cls, matrix: FloatArray) -> Ball:
        """Return the ball that holds ``matrix`` alone: floating-point numbers are exact data."""
        return cls(np.asarray(matrix, dtype=np.float64), np.zeros(np.shape(matrix)))

    @property
    def shape(self) -> tuple[int, ...]:
        """Rows and columns."""
        return tuple(self.midpoint.shape)

    @property
    def T(self) -> Ball:
        """The transpose."""
        return Ball(self.midpoint.T, self.radius.T)

    def __add__(self, other: Ball) -> Ball:
        """Return the ball of all sums of members."""
        with np.errstate(over="ignore", invalid="ignore"):
            total = self.midpoint + other.midpoint
            radius = rounded_up(self.radius + other.radius + UNIT_ROUNDOFF * np.abs(total), 3)
        return Ball(total, radius)

    def __neg__(self) -> Ball:
        """Return the ball of the negative members; exact."""
        return Ball(-self.midpoint, self.radius)

    def __sub__(self, other: Ball) -> Ball:
        """Return the ball of all differences of members."""
        return self + (-other)

    def __matmul__(self, other: Ball) -> Ball:
        """Return the ball of all products of members."""
        length = self.shape[1]
        size, other_size = np.abs(self.midpoint), np.abs(other.midpoint)
        with np.errstate(over="ignore", invalid="ignore"):
            # gamma multiplies the product, not a factor: what a factor loses by underflow, the other may magnify.
            rounding = gamma(length + 1) * (size @ other_size)
            spread = rounding + size @ other.radius + self.radius @ (other_size + other.radius)
            radius = rounded_up(spread, 2 * length + 6) + 3 * length * UNDERFLOW
            return Ball(self.midpoint @ other.midpoint, radius)

    def congruent(self, exponents: NDArray[np.int64]) -> Ball:
        """Return ``diag(2^k) X diag(2^k)``, k the ``exponents``: exact but for underflow."""
        total = exponents[:, None] + exponents
        with np.errstate(over="ignore"):
            return Ball(np.ldexp(self.midpoint, total), np.ldexp(self.radius, total) + UNDERFLOW)


def block(rows: list[list[Ball]]) -> Ball:
    """Return the ball of the block matrix with the given rows of blocks."""
    return Ball(
        np.block([[b.midpoint for b in row] for row in rows]), np.block([[b.radius for b in row] for row in rows])
    )
