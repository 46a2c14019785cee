"""Numbers that depend on bounded unknowns: the arithmetic of expressions, with a proved remainder.

A smooth function is replaced by its tangent; half the largest second derivative on the number's range, times the square
of its radius, goes into the remainder.

Matrices that depend on bounded unknowns: ``c + sum_i q_i G_i + R`` with ``|q_i| <= 1`` and ``|R| <= r``.

Affine parts are kept as they are; products and inverses put their second order, and all rounding, into the remainder.
What is enclosed is the matrix at every q in the box, also where q is the same in several matrices.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np

from obsynth.errors import PreconditionError
from obsynth.numerics.arguments import SMALLEST, FloatArray
from obsynth.numerics.expressions import step_function
from obsynth.proofs.balls import UNDERFLOW, UNIT_ROUNDOFF, gamma, rounded_up
from obsynth.proofs.contraction import inverse_bound, spectral_radius_bound

#: What elementary functions of the C library may miss by, in units of rounding (at most 2 are seen in practice).
FUNCTION_ROUNDINGS = 8.0
#: Powers up to this one are Taylor's; every other exponent needs a positive base.
LARGEST_POWER = 64


@dataclass(frozen=True, eq=False)
class AffineNumber:
    """All numbers ``center + sum q_i parts[i] + R`` with ``|q_i| <= 1`` and ``|R| <= radius``."""

    __array_ufunc__ = None

    center: float
    parts: FloatArray
    radius: float

    @property
    def spread(self) -> float:
        """Largest distance from the centre, rounded up."""
        return (float(np.abs(self.parts).sum()) + self.radius) * (1.0 + 2.0 * (len(self.parts) + 3) * UNIT_ROUNDOFF)

    @property
    def interval(self) -> tuple[float, float]:
        """Least and largest value, rounded outward."""
        slack = 2.0 * UNIT_ROUNDOFF * (abs(self.center) + self.spread)
        return self.center - self.spread - slack, self.center + self.spread + slack

    @property
    def magnitude(self) -> float:
        """Largest absolute value."""
        return max(map(abs, self.interval))

    def lifted(self, other: Any) -> AffineNumber:
        """Return ``other`` as a number of the same unknowns."""
        return other if isinstance(other, AffineNumber) else AffineNumber(float(other), 0.0 * self.parts, 0.0)

    @property
    def is_whole(self) -> bool:
        """Whether this is one whole number: sums and products of these are exact."""
        return not self.spread and self.center.is_integer() and abs(self.center) < 2.0**26

    def _rounded(self, center: float, parts: FloatArray, radius: float, size: float) -> AffineNumber:
        rounding = (len(parts) + 6.0) * UNIT_ROUNDOFF * size + UNDERFLOW
        return AffineNumber(float(center), parts, (radius + rounding) * (1.0 + 8.0 * UNIT_ROUNDOFF))

    def __add__(self, other: Any) -> AffineNumber:
        """Return the sum at the same q."""
        given = self.lifted(other)
        if given.center == 0.0 and not given.spread:
            return self
        if self.center == 0.0 and not self.spread:
            return given
        if self.is_whole and given.is_whole:
            return self.lifted(self.center + given.center)
        size = self.magnitude + given.magnitude
        return self._rounded(self.center + given.center, self.parts + given.parts, self.radius + given.radius, size)

    def __neg__(self) -> AffineNumber:
        """Return the negative; exact."""
        return AffineNumber(-self.center, -self.parts, self.radius)

    def __sub__(self, other: Any) -> AffineNumber:
        """Return the difference at the same q."""
        return self + (-self.lifted(other))

    def __mul__(self, other: Any) -> AffineNumber:
        """Return the product at the same q."""
        given = self.lifted(other)
        for one, two in ((self, given), (given, self)):
            if not two.spread and two.center in (0.0, 1.0, -1.0):
                return AffineNumber(one.center * two.center, one.parts * two.center, one.radius * abs(two.center))
        if self.is_whole and given.is_whole:
            return self.lifted(self.center * given.center)
        affine, theirs = float(np.abs(self.parts).sum()), float(np.abs(given.parts).sum())
        radius = affine * theirs + self.radius * given.magnitude + self.magnitude * given.radius
        return self._rounded(
            self.center * given.center,
            self.center * given.parts + given.center * self.parts,
            radius,
            self.magnitude * given.magnitude,
        )

    def __truediv__(self, other: Any) -> AffineNumber:
        """Return the quotient at the same q."""
        given = self.lifted(other)
        if not given.spread and given.center and math.frexp(given.center)[0] in (0.5, -0.5):
            return self * (1.0 / given.center)
        return self * given.reciprocal()

    def reciprocal(self) -> AffineNumber:
        """Return one over this; refused where it can be zero."""
        low, high = self.interval
        if low <= 0.0 <= high:
            raise _unbounded(
                f"A divisor lies between {low:.4g} and {high:.4g} in the box and can be zero: the box "
                "leaves the matrices unbounded. Give smaller tolerances."
            )
        least = min(abs(low), abs(high))
        return self.through(1.0 / self.center, -1.0 / self.center**2, 2.0 / least**3)

    def through(self, value: float, slope: float, curvature: float) -> AffineNumber:
        """Return a smooth function of this: its value and slope at the centre, its second derivative at most."""
        if not all(map(math.isfinite, (value, slope, curvature))):
            raise _unbounded("An expression is not finite everywhere in the box: give smaller tolerances.")
        second = 0.5 * curvature * self.spread**2 * (1.0 + 16.0 * UNIT_ROUNDOFF)
        rounding = FUNCTION_ROUNDINGS * UNIT_ROUNDOFF * (abs(value) + abs(slope) * self.spread)
        exact = value == round(value) and not self.spread and abs(value) in (0.0, 1.0)
        radius = abs(slope) * self.radius + second + (0.0 if exact else rounding)
        return self._rounded(value, slope * self.parts, radius, abs(value) + abs(slope) * self.spread)

    def __pow__(self, other: Any) -> AffineNumber:
        """Return the power at the same q."""
        exponent = self.lifted(other)
        n = exponent.center
        if not exponent.spread and n.is_integer() and 0.0 <= n <= LARGEST_POWER:
            if n <= 1.0:
                return self if n else self.lifted(1.0)
            return self.through(
                self.center**n, n * self.center ** (n - 1.0), n * (n - 1.0) * self.magnitude ** (n - 2.0)
            )
        if not exponent.spread and n.is_integer() and -LARGEST_POWER <= n < 0.0:
            return (self ** (-n)).reciprocal()
        low, high = self.interval
        if not low > 0.0:
            raise _unbounded(
                f"The base of a power lies between {low:.4g} and {high:.4g} in the box: a power that is "
                "no whole number needs a positive one."
            )
        if exponent.spread:
            return _exp(exponent * _log(self))
        steepest = max(abs(n * (n - 1.0)) * low ** (n - 2.0), abs(n * (n - 1.0)) * high ** (n - 2.0))
        return self.through(self.center**n, n * self.center ** (n - 1.0), steepest)


def _unbounded(text: str) -> PreconditionError:
    return PreconditionError(text, condition="boundedness")


def _exp(x: AffineNumber) -> AffineNumber:
    high = _finite(math.exp, x.interval[1])
    return x.through(math.exp(x.center), math.exp(x.center), high)


def _positive(x: AffineNumber, name: str) -> float:
    low, high = x.interval
    if not low > 0.0:
        raise _unbounded(
            f"The argument of {name} lies between {low:.4g} and {high:.4g} in the box: it must be positive."
        )
    return low


def _log(x: AffineNumber) -> AffineNumber:
    low = _positive(x, "log")
    return x.through(math.log(x.center), 1.0 / x.center, 1.0 / low**2)


def _sqrt(x: AffineNumber) -> AffineNumber:
    low = _positive(x, "sqrt")
    root = math.sqrt(x.center)
    return x.through(root, 0.5 / root, 0.25 * low**-1.5)


def _tan(x: AffineNumber) -> AffineNumber:
    low, high = x.interval
    if math.floor(low / math.pi + 0.5) != math.floor(high / math.pi + 0.5):
        raise _unbounded(f"The argument of tan lies between {low:.4g} and {high:.4g} in the box and meets a pole.")
    steepest = max(abs(math.tan(low)), abs(math.tan(high)))
    t = math.tan(x.center)
    return x.through(t, 1.0 + t * t, 2.0 * steepest * (1.0 + steepest**2))


def _arc(function: Callable[[float], float], sign: float, name: str) -> Callable[[AffineNumber], AffineNumber]:
    def taken(x: AffineNumber) -> AffineNumber:
        size = x.magnitude
        if not size < 1.0:
            raise _unbounded(f"The argument of {name} reaches {size:.4g} in the box: keep it inside -1 .. 1.")
        slope = sign / math.sqrt(1.0 - x.center**2)
        return x.through(function(x.center), slope, size * (1.0 - size**2) ** -1.5)

    return taken


def _finite(function: Callable[[float], float], value: float) -> float:
    try:
        return function(value)
    except OverflowError:
        return math.inf


#: Upper bounds of second derivatives: 3 sqrt(3) / 8 = 0.6496 of atan, 4 / (3 sqrt(3)) = 0.7699 of tanh.
ATAN_CURVATURE, TANH_CURVATURE = 0.65, 0.77


def _jumps(function: Callable[[Any], Any], name: str) -> Callable[[AffineNumber], AffineNumber]:
    def taken(x: AffineNumber) -> AffineNumber:
        low, high = (float(function(end)) for end in x.interval)
        if low != high or (name == "sign" and x.interval[0] * x.interval[1] < 0.0):
            raise _unbounded(f"{name} of an expression jumps inside the box: give smaller tolerances.")
        return x.lifted(low)

    return taken


def _absolute(x: AffineNumber) -> AffineNumber:
    low, high = x.interval
    if low >= 0.0 or high <= 0.0:
        return x if low >= 0.0 else -x
    # Between the signs: half the range about its middle, without an affine part.
    half = max(-low, high) / 2.0
    return AffineNumber(half, 0.0 * x.parts, half * (1.0 + 4.0 * UNIT_ROUNDOFF))


def _extreme(x: AffineNumber, y: AffineNumber, *, largest: bool) -> AffineNumber:
    low, high = (x - y).interval
    if high <= 0.0 or low >= 0.0:
        return x if (high <= 0.0) != largest else y
    apart = _absolute(x - y)
    return (x + y + (apart if largest else -apart)) * 0.5


def _definite(compare: Callable[[float, float], Any]) -> Callable[[AffineNumber, AffineNumber], bool]:
    def taken(x: AffineNumber, y: AffineNumber) -> bool:
        low, high = (x - y).interval
        if bool(compare(low, 0.0)) != bool(compare(high, 0.0)):
            raise _unbounded("A comparison (where) has both answers inside the box: give smaller tolerances.")
        return bool(compare(low, 0.0))

    return taken


_OF_ONE: dict[Callable[..., Any], Callable[[AffineNumber], AffineNumber]] = {
    np.negative: lambda x: -x,
    np.sin: lambda x: x.through(math.sin(x.center), math.cos(x.center), 1.0),
    np.cos: lambda x: x.through(math.cos(x.center), -math.sin(x.center), 1.0),
    np.sinh: lambda x: x.through(
        _finite(math.sinh, x.center), _finite(math.cosh, x.center), _finite(math.sinh, x.magnitude)
    ),
    np.cosh: lambda x: x.through(
        _finite(math.cosh, x.center), _finite(math.sinh, x.center), _finite(math.cosh, x.magnitude)
    ),
    np.tan: _tan,
    np.arctan: lambda x: x.through(math.atan(x.center), 1.0 / (1.0 + x.center**2), ATAN_CURVATURE),
    np.tanh: lambda x: x.through(math.tanh(x.center), 1.0 - math.tanh(x.center) ** 2, TANH_CURVATURE),
    np.exp: _exp,
    np.log: _log,
    np.log10: lambda x: _log(x) * (1.0 / math.log(10.0)),
    np.sqrt: _sqrt,
    np.arcsin: _arc(math.asin, 1.0, "asin"),
    np.arccos: _arc(math.acos, -1.0, "acos"),
    np.abs: _absolute,
    np.sign: _jumps(np.sign, "sign"),
    np.floor: _jumps(np.floor, "floor"),
    np.ceil: _jumps(np.ceil, "ceil"),
    step_function: _jumps(step_function, "step"),
}
_OF_TWO: dict[Callable[..., Any], Callable[[AffineNumber, AffineNumber], Any]] = {
    np.add: lambda x, y: x + y,
    np.subtract: lambda x, y: x - y,
    np.multiply: lambda x, y: x * y,
    np.divide: lambda x, y: x / y,
    np.power: lambda x, y: x**y,
    np.minimum: partial(_extreme, largest=False),
    np.maximum: partial(_extreme, largest=True),
    np.less: _definite(np.less),
    np.less_equal: _definite(np.less_equal),
    np.greater: _definite(np.greater),
    np.greater_equal: _definite(np.greater_equal),
}


def affine_translation(count: int) -> Callable[[Callable[..., Any]], Callable[..., Any]]:
    """Return the translation of numpy's operations for `Expression.translated`, for ``count`` unknowns."""
    zero = AffineNumber(0.0, np.zeros(count), 0.0)

    def translated(operation: Callable[..., Any]) -> Callable[..., Any]:
        if operation is np.where:
            return lambda condition, first, second: first if condition else second
        if operation in _OF_ONE:
            one = _OF_ONE[operation]
            return lambda x: one(zero.lifted(x))
        two = _OF_TWO[operation]
        return lambda x, y: two(zero.lifted(x), zero.lifted(y))

    return translated


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
        return _up(np.abs(self.parts).sum(axis=0), self.count + 1)

    @property
    def magnitude(self) -> FloatArray:
        """Upper bound of the absolute value on the whole box."""
        return _up(np.abs(self.center) + self.spread + self.radius, 3)

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
        return AffineMatrix(self.center + other.center, self.parts + other.parts, _up(radius, 5))

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

    def after(self, left: FloatArray) -> AffineMatrix:
        """Return ``left`` times every member."""
        return AffineMatrix.exact(left, self.count) @ self

    def scaled(self, factor: float) -> AffineMatrix:
        """Return ``factor`` times every member."""
        radius = abs(factor) * (self.radius + gamma(self.count + 2) * self.magnitude)
        return AffineMatrix(factor * self.center, factor * self.parts, _up(radius, 5))

    def enlarged(self, radius: FloatArray) -> AffineMatrix:
        """Return this with a larger remainder."""
        return AffineMatrix(self.center, self.parts, _up(self.radius + radius, 2))

    def on(self, lower: FloatArray, upper: FloatArray) -> AffineMatrix:
        """Return the same matrix on the sub-box ``lower <= q <= upper``, as a function of new unknowns in -1 .. 1."""
        middle, half = (lower + upper) / 2.0, (upper - lower) / 2.0
        rounding = gamma(4 * self.count + 4) * self.magnitude
        return AffineMatrix(self.at(middle), self.parts * half[:, None, None], _up(self.radius + rounding, 3))

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
    series = (deviation + np.eye(size)).enlarged(_up(bound @ (bound @ neumann), 2 * size + 4))
    return series @ near


#: Terms of the series of an exponential.
TERMS = 14


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
    bound, rest = small.magnitude, np.eye(size)
    for k in range(1, TERMS + 2):
        rest = _up(bound @ rest / k, size + 3)
    # Which entries of a power, the first or later, can be other than zero.
    found = bound > 0.0
    for _ in range(len(bound).bit_length()):
        found = found | (found.astype(np.float64) @ found.astype(np.float64) > 0.0)
    series = series.enlarged(np.where(found, 2.0 * float(rest.sum(axis=1).max(initial=0.0)), 0.0))
    for _ in range(doublings):
        series = series @ series
    return series


def affine_zero_order_hold(a: AffineMatrix, inputs: AffineMatrix, step: float) -> tuple[AffineMatrix, AffineMatrix]:
    """Return ``exp(A h)`` and its integral times the inputs, for unknowns that rest during a sample."""
    nx, width = inputs.shape
    zero = AffineMatrix.exact(np.zeros((width, nx + width)), a.count)
    block = affine_block([[a, inputs]])
    whole = affine_exponential(affine_block([[block], [zero]]).scaled(step))
    return whole[:nx, :nx], whole[:nx, nx:]


def _up(value: FloatArray, operations: int) -> FloatArray:
    """Round up what was computed with so many roundings, where it is not zero for want of terms."""
    return np.where(value > 0.0, rounded_up(value, operations), 0.0)
