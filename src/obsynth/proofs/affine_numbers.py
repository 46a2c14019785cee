"""Numbers that depend on bounded unknowns: the arithmetic of expressions, with a proved remainder.

A smooth function is replaced by its tangent; half the largest second derivative on the number's range, times the square
of its radius, goes into the remainder.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np

from obsynth.errors import PreconditionError
from obsynth.numerics.arrays import FloatArray
from obsynth.numerics.expressions import step_function
from obsynth.proofs.balls import UNDERFLOW, UNIT_ROUNDOFF

#: What elementary functions of the C library may miss by, in units of rounding (at most 2 are seen in practice).
FUNCTION_ROUNDINGS = 8.0

#: Powers up to this one are Taylor's; every other exponent needs a positive base.
LARGEST_POWER = 64

#: Upper bounds of second derivatives: 3 sqrt(3) / 8 = 0.6496 of atan, 4 / (3 sqrt(3)) = 0.7699 of tanh.
ATAN_CURVATURE, TANH_CURVATURE = 0.65, 0.77


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
        addend = self.lifted(other)
        if addend.center == 0.0 and not addend.spread:
            return self
        if self.center == 0.0 and not self.spread:
            return addend
        if self.is_whole and addend.is_whole:
            return self.lifted(self.center + addend.center)
        size = self.magnitude + addend.magnitude
        return self._rounded(self.center + addend.center, self.parts + addend.parts, self.radius + addend.radius, size)

    def __neg__(self) -> AffineNumber:
        """Return the negative; exact."""
        return AffineNumber(-self.center, -self.parts, self.radius)

    def __sub__(self, other: Any) -> AffineNumber:
        """Return the difference at the same q."""
        return self + (-self.lifted(other))

    def __mul__(self, other: Any) -> AffineNumber:
        """Return the product at the same q."""
        factor = self.lifted(other)
        for number, constant in ((self, factor), (factor, self)):
            if not constant.spread and constant.center in (0.0, 1.0, -1.0):
                return AffineNumber(
                    number.center * constant.center,
                    number.parts * constant.center,
                    number.radius * abs(constant.center),
                )
        if self.is_whole and factor.is_whole:
            return self.lifted(self.center * factor.center)
        affine, theirs = float(np.abs(self.parts).sum()), float(np.abs(factor.parts).sum())
        radius = affine * theirs + self.radius * factor.magnitude + self.magnitude * factor.radius
        return self._rounded(
            self.center * factor.center,
            self.center * factor.parts + factor.center * self.parts,
            radius,
            self.magnitude * factor.magnitude,
        )

    def __truediv__(self, other: Any) -> AffineNumber:
        """Return the quotient at the same q."""
        divisor = self.lifted(other)
        if not divisor.spread and divisor.center and math.frexp(divisor.center)[0] in (0.5, -0.5):
            return self * (1.0 / divisor.center)
        return self * divisor.reciprocal()

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
            function = _OF_ONE[operation]
            return lambda x: function(zero.lifted(x))
        operator = _OF_TWO[operation]
        return lambda x, y: operator(zero.lifted(x), zero.lifted(y))

    return translated
