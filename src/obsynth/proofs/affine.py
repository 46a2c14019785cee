"""Matrices that depend on bounded unknowns: ``c + sum_i q_i G_i + R`` with ``|q_i| <= 1`` and ``|R| <= r``.

Affine parts are kept as they are; products and inverses put their second order, and all rounding, into the remainder.
What is enclosed is the matrix at every q in the box, also where q is the same in several matrices.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from obsynth.errors import PreconditionError
from obsynth.numerics.arrays import SMALLEST, FloatArray
from obsynth.proofs.balls import gamma, rounded_up
from obsynth.proofs.nonnegative_matrices import inverse_bound, spectral_radius_bound

#: Terms of the series of an exponential.
TERMS = 14


@dataclass(frozen=True, eq=False)
class AffineMatrix:
    """All matrices ``center + sum q_i parts[i] + R``: ``(rows, cols)``, ``(p, rows, cols)``, ``|R| <= radius``."""

    __array_ufunc__ = None

    center: FloatArray
    parts: FloatArray
    radius: FloatArray

    @classmethod
    def exact(cls, matrix: FloatArray, count: int) -> AffineMatrix:
        """Return ``matrix`` as a function of ``count`` unknowns that does not depend on them."""
        center = np.asarray(matrix, dtype=np.float64)
        return cls(center, np.zeros((count, *center.shape)), np.zeros(center.shape))

    @property
    def shape(self) -> tuple[int, ...]:
        """Rows and columns."""
        return tuple(self.center.shape)

    @property
    def count(self) -> int:
        """Number of unknowns."""
        return len(self.parts)

    @property
    def spread(self) -> FloatArray:
        """What the affine parts add to the centre at most, rounded up."""
        return _rounded_up(np.abs(self.parts).sum(axis=0), self.count + 1)

    @property
    def magnitude(self) -> FloatArray:
        """Upper bound of the absolute value on the whole box."""
        return _rounded_up(np.abs(self.center) + self.spread + self.radius, 3)

    @property
    def is_certain(self) -> bool:
        """Whether there is one matrix alone."""
        return not (self.parts.any() or self.radius.any())

    def at(self, q: FloatArray) -> FloatArray:
        """Return the affine part at ``q (p,)``."""
        return np.asarray(self.center + np.tensordot(q, self.parts, 1))

    def lifted(self, other: AffineMatrix | FloatArray) -> AffineMatrix:
        """Return ``other`` as an affine matrix of the same unknowns."""
        return other if isinstance(other, AffineMatrix) else AffineMatrix.exact(other, self.count)

    def __add__(self, other: AffineMatrix | FloatArray) -> AffineMatrix:
        """Return all sums at the same q."""
        other = self.lifted(other)
        if not other.center.any() and other.is_certain:
            return self
        if not self.center.any() and self.is_certain:
            return other
        size = self.magnitude + other.magnitude
        radius = self.radius + other.radius + gamma(self.count + 2) * size
        return AffineMatrix(self.center + other.center, self.parts + other.parts, _rounded_up(radius, 5))

    def __neg__(self) -> AffineMatrix:
        """Return the negative; exact."""
        return AffineMatrix(-self.center, -self.parts, self.radius)

    def __sub__(self, other: AffineMatrix | FloatArray) -> AffineMatrix:
        """Return all differences at the same q."""
        return self + (-self.lifted(other))

    def __matmul__(self, other: AffineMatrix | FloatArray) -> AffineMatrix:
        """Return all products at the same q; the second order goes into the remainder."""
        other = self.lifted(other)
        length = self.shape[1]
        mine, theirs = self.magnitude, other.magnitude
        parts = self.center @ other.parts + self.parts @ other.center
        radius = gamma(length + self.count + 3) * (mine @ theirs)
        if self.parts.any() and other.parts.any():
            radius = radius + self.spread @ other.spread
        if other.radius.any():
            radius = radius + mine @ other.radius
        if self.radius.any():
            radius = radius + self.radius @ theirs
        # A sum without a single term is zero, and stays so.
        reached = (mine > 0.0).astype(np.float64) @ (theirs > 0.0).astype(np.float64) > 0.0
        return AffineMatrix(
            self.center @ other.center, parts, np.where(reached, rounded_up(radius, 2 * length + 12), 0.0)
        )

    def after(self, factor: FloatArray) -> AffineMatrix:
        """Return ``factor`` times every member."""
        return AffineMatrix.exact(factor, self.count) @ self

    def scaled(self, factor: float) -> AffineMatrix:
        """Return ``factor`` times every member."""
        radius = abs(factor) * (self.radius + gamma(self.count + 2) * self.magnitude)
        return AffineMatrix(factor * self.center, factor * self.parts, _rounded_up(radius, 5))

    def enlarged(self, radius: FloatArray) -> AffineMatrix:
        """Return this with a larger remainder."""
        return AffineMatrix(self.center, self.parts, _rounded_up(self.radius + radius, 2))

    def on(self, lower: FloatArray, upper: FloatArray) -> AffineMatrix:
        """Return the same matrix on the sub-box ``lower <= q <= upper``, as a function of new unknowns in -1 .. 1."""
        middle, half = (lower + upper) / 2.0, (upper - lower) / 2.0
        rounding = gamma(4 * self.count + 4) * self.magnitude
        return AffineMatrix(self.at(middle), self.parts * half[:, None, None], _rounded_up(self.radius + rounding, 3))

    def __getitem__(self, places: tuple[Sequence[int] | slice, Sequence[int] | slice]) -> AffineMatrix:
        """Return rows and columns, by slices or lists of numbers."""
        rows = np.arange(self.shape[0])[places[0]]
        columns = np.arange(self.shape[1])[places[1]]
        grid = np.ix_(rows, columns)
        return AffineMatrix(self.center[grid], self.parts[:, grid[0], grid[1]], self.radius[grid])


def affine_block(rows: Sequence[Sequence[AffineMatrix]]) -> AffineMatrix:
    """Return the matrix with the given rows of blocks."""
    # Blocks are joined along the last two axes, whatever is before these.
    center, parts, radius = (
        np.block([[getattr(item, part) for item in row] for row in rows]) for part in ("center", "parts", "radius")
    )
    return AffineMatrix(center, parts, radius)


def affine_inverse(matrix: AffineMatrix) -> AffineMatrix:
    """Return the inverse; `PreconditionError` unless it is proved to exist on the whole box."""
    size = len(matrix.center)
    if not size:
        return matrix
    try:
        near = np.asarray(np.linalg.inv(matrix.center), dtype=np.float64)
    except np.linalg.LinAlgError as error:
        raise PreconditionError("A matrix is singular at the middle of the box.", condition="regularity") from error
    # X = X0^-1 (I - D): the inverse is (I + D + D D (I - D)^-1) X0.
    deviation = -matrix.after(near) + np.eye(size)
    bound = deviation.magnitude
    neumann = inverse_bound(bound)
    if neumann is None:
        raise PreconditionError(
            f"A matrix is not proved regular on the whole box (spectral radius {spectral_radius_bound(bound):.3g} of "
            "the deviation, which must be below 1): give smaller tolerances.",
            condition="regularity",
        )
    series = (deviation + np.eye(size)).enlarged(_rounded_up(bound @ (bound @ neumann), 2 * size + 4))
    return series @ near


def affine_exponential(matrix: AffineMatrix) -> AffineMatrix:
    """Return the exponential: Taylor's series of ``2^-s X`` with its rest bounded, squared s times."""
    size = len(matrix.center)
    largest = float(matrix.magnitude.sum(axis=1).max(initial=0.0))
    if not np.isfinite(largest):
        raise PreconditionError("A matrix is not bounded on the box.", condition="boundedness")
    doublings = max(0, int(np.ceil(np.log2(max(largest, SMALLEST) * 2.0))))
    small, identity = matrix.scaled(2.0**-doublings), np.eye(size)
    series = AffineMatrix.exact(identity, matrix.count)
    for k in range(TERMS, 0, -1):
        series = (small @ series).scaled(1.0 / k) + identity
    # With row sums of at most 1/2, the terms that are left out are less than twice the first of them.
    bound, remainder = small.magnitude, np.eye(size)
    for k in range(1, TERMS + 2):
        remainder = _rounded_up(bound @ remainder / k, size + 3)
    # Which entries of a power, the first or later, can be other than zero.
    pattern = bound > 0.0
    for _ in range(len(bound).bit_length()):
        pattern = pattern | (pattern.astype(np.float64) @ pattern.astype(np.float64) > 0.0)
    series = series.enlarged(np.where(pattern, 2.0 * float(remainder.sum(axis=1).max(initial=0.0)), 0.0))
    for _ in range(doublings):
        series = series @ series
    return series


def affine_zero_order_hold(a: AffineMatrix, inputs: AffineMatrix, step: float) -> tuple[AffineMatrix, AffineMatrix]:
    """Return ``exp(A h)`` and its integral times the inputs, for unknowns that rest during a sample."""
    nx, width = inputs.shape
    zero = AffineMatrix.exact(np.zeros((width, nx + width)), a.count)
    block = affine_block([[a, inputs]])
    transition = affine_exponential(affine_block([[block], [zero]]).scaled(step))
    return transition[:nx, :nx], transition[:nx, nx:]


def _rounded_up(value: FloatArray, operations: int) -> FloatArray:
    """Round up what was computed with so many roundings, where it is not zero for want of terms."""
    return np.where(value > 0.0, rounded_up(value, operations), 0.0)
