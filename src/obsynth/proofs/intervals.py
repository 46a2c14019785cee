"""The range of an expression over a box: plain interval arithmetic with outward rounding, tightened by bisection.

Natural interval extensions are exact for monotone functions of one occurrence, where affine arithmetic is far too wide
near the edge of a domain (``0.5 / sqrt(s)`` on [0.02, 0.4]: [0.79, 3.54] against [-56, 60]).  Boxes with the least
lower or the largest upper bound are halved, best first (Moore, Kearfott, Cloud, *Introduction to Interval Analysis*,
chapter 11), until the range is known to a share of its width, between bounds that are attained.
"""

from __future__ import annotations

import heapq
import itertools
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, TypeAlias

import numpy as np

from obsynth.errors import PreconditionError
from obsynth.numerics.arrays import SMALLEST
from obsynth.numerics.expressions import Expression, step_function
from obsynth.proofs.affine_numbers import FUNCTION_ROUNDINGS

#: To which share of its width a range is sought.
RANGE_SHARE = 1e-3
#: Boxes that are tried for one range: a function of two parameters takes some hundreds for one part in a thousand.
MOST_BOXES = 4096

#: A box: least and largest value of each argument.
Part: TypeAlias = tuple[tuple[float, float], ...]


@dataclass(frozen=True)
class Interval:
    """All real numbers from ``low`` to ``high``."""

    low: float
    high: float

    # numpy's operations on an Interval are its own.
    __array_ufunc__ = None

    @classmethod
    def of(cls, value: Any) -> Interval:
        """Return an interval as it is, or the one that holds a number alone."""
        return value if isinstance(value, Interval) else cls(float(value), float(value))

    @classmethod
    def outward(cls, low: float, high: float, roundings: float = 1.0) -> Interval:
        """Return the interval with ends moved outward by what so many roundings may have cost."""
        if not (math.isfinite(low) and math.isfinite(high)):
            raise _unbounded("it is not finite everywhere")
        if roundings == 1.0:
            return cls(math.nextafter(low, -math.inf), math.nextafter(high, math.inf))
        for _ in range(int(roundings)):
            low, high = math.nextafter(low, -math.inf), math.nextafter(high, math.inf)
        return cls(low, high)

    @property
    def is_point(self) -> bool:
        """Whether it holds one number alone."""
        return self.low == self.high

    def __add__(self, other: Any) -> Interval:
        """Return all sums."""
        addend = Interval.of(other)
        if addend.low == addend.high == 0.0:
            return self
        low, high = self.low + addend.low, self.high + addend.high
        outside = Interval.outward(low, high)
        return Interval(
            low if _is_exact_sum(self.low, addend.low, low) else outside.low,
            high if _is_exact_sum(self.high, addend.high, high) else outside.high,
        )

    def __neg__(self) -> Interval:
        """Return all negatives; exact."""
        return Interval(-self.high, -self.low)

    def __sub__(self, other: Any) -> Interval:
        """Return all differences."""
        return self + (-Interval.of(other))

    def __mul__(self, other: Any) -> Interval:
        """Return all products."""
        factor = Interval.of(other)
        for interval, constant in ((self, factor), (factor, self)):
            if constant.is_point and constant.low in (1.0, -1.0):
                return interval if constant.low > 0.0 else -interval
        # A product with zero is exact; one of small numbers may be rounded to zero.
        return _hull_of_rounded(
            [None if x == 0.0 or y == 0.0 else x * y for x in (self.low, self.high) for y in (factor.low, factor.high)]
        )

    def __truediv__(self, other: Any) -> Interval:
        """Return all quotients; refused where the divisor can be zero."""
        divisor = Interval.of(other)
        if divisor.low <= 0.0 <= divisor.high:
            raise _unbounded(f"a divisor lies between {divisor.low:.4g} and {divisor.high:.4g} and can be zero")
        return _hull_of_rounded(
            [None if x == 0.0 else x / y for x in (self.low, self.high) for y in (divisor.low, divisor.high)]
        )

    def __pow__(self, other: Any) -> Interval:
        """Return all powers."""
        exponent = Interval.of(other)
        if exponent.is_point and exponent.low.is_integer():
            return self._whole_power(int(exponent.low))
        if self.low >= 0.0 and exponent.is_point and exponent.low > 0.0:
            power = Interval.outward(self.low**exponent.low, self.high**exponent.low, FUNCTION_ROUNDINGS)
            return Interval(max(power.low, 0.0), power.high)
        if not self.low > 0.0:
            raise _unbounded(
                f"the base of a power lies between {self.low:.4g} and {self.high:.4g}: it must be positive"
            )
        if exponent.is_point:
            ends = self.low**exponent.low, self.high**exponent.low
            return Interval.outward(min(ends), max(ends), FUNCTION_ROUNDINGS)
        return _increasing(math.exp)(exponent * _increasing(math.log)(self))

    def _whole_power(self, n: int) -> Interval:
        if n < 0:
            return Interval(1.0, 1.0) / self._whole_power(-n)
        if n <= 1:
            return self if n else Interval(1.0, 1.0)
        low, high = self.low**n, self.high**n
        if n % 2 == 0:
            least = 0.0 if self.low <= 0.0 <= self.high else min(low, high)
            power = Interval.outward(least, max(low, high), FUNCTION_ROUNDINGS)
            return Interval(max(power.low, 0.0), power.high)
        return Interval.outward(low, high, FUNCTION_ROUNDINGS)


def _hull_of_rounded(values: Sequence[float | None]) -> Interval:
    """Return the interval that holds what each value was rounded from; `None` is an exact zero."""
    rounded = [value for value in values if value is not None]
    if not rounded:
        return Interval(0.0, 0.0)
    hull = Interval.outward(min(rounded), max(rounded))
    return hull if len(rounded) == len(values) else Interval(min(hull.low, 0.0), max(hull.high, 0.0))


@dataclass(frozen=True)
class Range:
    """What an expression can be over a box: between ``low`` and ``high``, and it is near both."""

    low: float
    high: float
    attained_low: float  # values at points of the box
    attained_high: float
    boxes: int


def range_over(expression: Expression, box: Mapping[str, tuple[float, float]]) -> Range:
    """Return the range of an expression over a box of its names.

    Parameters
    ----------
    expression : Expression
        Of names that are all in the box.
    box : mapping of str to pair of float
        Least and largest value.

    Raises
    ------
    PreconditionError
        The expression is not finite on the box, or jumps there.

    Examples
    --------
    >>> from obsynth.numerics.expressions import parse_expression
    >>> found = range_over(parse_expression("x**2 - x"), {"x": (0.0, 1.0)})
    >>> -0.2505 < found.low <= -0.25, 0.0 <= found.high < 1e-3
    (True, True)
    """
    names = sorted(expression.names)
    start = [(float(box[name][0]), float(box[name][1])) for name in names]

    def by_name(values: Sequence[Any]) -> dict[str, Any]:
        return dict(zip(names, values, strict=True))

    return enclosed_range(
        lambda part: interval_of(expression, by_name(part)), lambda point: float(expression(by_name(point))), start
    )


def enclosed_range(
    enclosure: Callable[[Part], Interval],
    value: Callable[[Sequence[float]], float],
    box: Sequence[tuple[float, float]],
) -> Range:
    """Return the range of a function over a box, halving parts of it best first.

    Parameters
    ----------
    enclosure : callable
        From a part of the box to an interval that holds all values there; `PreconditionError` where it has none.
    value : callable
        From a point to a value near the function's.
    box : sequence of pair of float
        Least and largest value of each argument.

    Raises
    ------
    PreconditionError
        The function is not bounded on the box, as far as halving tells.
    """
    start = tuple(box)
    middle = [0.5 * (low + high) for low, high in start]
    corners = itertools.islice(itertools.product(*start), MOST_BOXES)
    known = [number for point in (*corners, middle) if math.isfinite(number := value(point))]
    attained_low, attained_high, boxes = min(known, default=math.inf), max(known, default=-math.inf), 1
    width = max(attained_high - attained_low, 0.0)
    ends: dict[float, float] = {}
    for sign in (1.0, -1.0):
        best = attained_low if sign > 0.0 else -attained_high
        count, bound, best = _least(enclosure, value, start, sign, best, width)
        boxes += count
        ends[sign] = bound
        if sign > 0.0:
            attained_low = best
        else:
            attained_high = -best
    return Range(ends[1.0], -ends[-1.0], attained_low, attained_high, boxes)


def interval_of(expression: Expression, box: Mapping[str, tuple[float, float]]) -> Interval:
    """Return the natural interval extension of an expression over a box."""
    values = {name: Interval(*map(float, box[name])) for name in expression.names}
    try:
        return Interval.of(expression.translated(values, interval_operation))
    except OverflowError:
        raise _unbounded(f"{expression.text!r} overflows") from None
    except PreconditionError as error:
        raise PreconditionError(f"{expression.text!r}: {error}", condition="boundedness") from None


def _least(
    enclosure: Callable[[Part], Interval],
    value: Callable[[Sequence[float]], float],
    start: Part,
    sign: float,
    best: float,
    width: float,
) -> tuple[int, float, float]:
    """Return how many boxes were tried, a lower bound of ``sign`` times the function, and a value that it takes."""

    def bound(part: Part) -> float:
        interval = enclosure(part)
        return interval.low if sign > 0.0 else -interval.high

    trouble: PreconditionError | None = None
    try:
        waiting = [(bound(start), start)]
    except PreconditionError as error:
        # A domain that looks left on the whole box may be kept on its parts.
        waiting, trouble = [(-math.inf, start)], error
    count, done = 0, math.inf
    while waiting and count < MOST_BOXES:
        low, part = waiting[0]
        if best - low <= RANGE_SHARE * width or not start:
            break
        heapq.heappop(waiting)
        shares = [(b - a) / max(last - first, SMALLEST) for (a, b), (first, last) in zip(part, start, strict=True)]
        place = shares.index(max(shares))
        middle = 0.5 * (part[place][0] + part[place][1])
        if not part[place][0] < middle < part[place][1]:
            done = min(done, low)
            continue
        attained = value([0.5 * (a + b) for a, b in part])
        best = min(best, sign * attained) if math.isfinite(attained) else best
        for ends in ((part[place][0], middle), (middle, part[place][1])):
            child = (*part[:place], ends, *part[place + 1 :])
            count += 1
            try:
                heapq.heappush(waiting, (max(bound(child), low), child))
            except PreconditionError as error:
                trouble = trouble or error
                heapq.heappush(waiting, (-math.inf, child))
    low = min([done, *(entry[0] for entry in waiting[:1])])
    if not math.isfinite(low) and trouble is not None:
        raise trouble
    return count, low, best


def _is_exact_sum(x: float, y: float, total: float) -> bool:
    """Whether a floating-point sum of two numbers is their sum (Knuth's two-sum has no rest)."""
    part = total - x
    return (x - (total - part)) + (y - part) == 0.0


def _unbounded(text: str) -> PreconditionError:
    return PreconditionError(f"{text} on the region. Give a smaller range.", condition="boundedness")


def _increasing(function: Callable[[float], float]) -> Callable[[Interval], Interval]:
    def taken(x: Interval) -> Interval:
        try:
            return Interval.outward(function(x.low), function(x.high), FUNCTION_ROUNDINGS)
        except ValueError:
            raise _unbounded(f"the argument of {function.__name__} lies between {x.low:.4g} and {x.high:.4g}") from None

    return taken


def _not_negative(function: Callable[[float], float]) -> Callable[[Interval], Interval]:
    """Return an increasing function without negative values: no rounding makes it one."""
    increasing = _increasing(function)

    def taken(x: Interval) -> Interval:
        interval = increasing(x)
        return Interval(max(interval.low, 0.0), interval.high)

    return taken


def _waves(function: Callable[[float], float], first_peak: float) -> Callable[[Interval], Interval]:
    """Return a function of period 2 pi that is 1 at ``first_peak`` and -1 half a turn later."""

    def taken(x: Interval) -> Interval:
        ends = function(x.low), function(x.high)
        hull = Interval.outward(min(ends), max(ends), FUNCTION_ROUNDINGS)
        low, high = hull.low, hull.high
        # A little early: a peak that may lie within is taken to lie within.
        slack = FUNCTION_ROUNDINGS * np.finfo(np.float64).eps * (1.0 + max(abs(x.low), abs(x.high)))
        for peak, value in ((first_peak, 1.0), (first_peak + math.pi, -1.0)):
            turns = math.ceil((x.low - peak - slack) / (2.0 * math.pi))
            if peak + 2.0 * math.pi * turns <= x.high + slack:
                low, high = (low, 1.0) if value > 0.0 else (-1.0, high)
        return Interval(max(low, -1.0), min(high, 1.0))

    return taken


def _tan(x: Interval) -> Interval:
    if math.floor(x.low / math.pi + 0.5) != math.floor(x.high / math.pi + 0.5):
        raise _unbounded(f"the argument of tan lies between {x.low:.4g} and {x.high:.4g} and meets a pole")
    return _increasing(math.tan)(x)


def _cosh(x: Interval) -> Interval:
    ends = math.cosh(x.low), math.cosh(x.high)
    least = 1.0 if x.low <= 0.0 <= x.high else min(ends)
    return Interval.outward(least, max(ends), FUNCTION_ROUNDINGS)


def _acos(x: Interval) -> Interval:
    if not -1.0 <= x.low <= x.high <= 1.0:
        raise _unbounded(f"the argument of acos lies between {x.low:.4g} and {x.high:.4g}")
    return -_increasing(math.asin)(x) + Interval.outward(math.pi / 2.0, math.pi / 2.0)


def _absolute(x: Interval) -> Interval:
    if x.low >= 0.0 or x.high <= 0.0:
        return x if x.low >= 0.0 else -x
    return Interval(0.0, max(-x.low, x.high))


def _constant(function: Callable[[Any], Any], name: str) -> Callable[[Interval], Interval]:
    """Return a function with jumps, where it has none."""

    def taken(x: Interval) -> Interval:
        low, high = float(function(x.low)), float(function(x.high))
        if low != high or (name == "sign" and x.low <= 0.0 <= x.high and not x.is_point):
            raise _unbounded(f"{name} jumps between {x.low:.4g} and {x.high:.4g}")
        return Interval(low, high)

    return taken


_OF_ONE: dict[Callable[..., Any], Callable[[Interval], Interval]] = {
    np.negative: lambda x: -x,
    np.sin: _waves(math.sin, math.pi / 2.0),
    np.cos: _waves(math.cos, 0.0),
    np.tan: _tan,
    np.arcsin: _increasing(math.asin),
    np.arccos: _acos,
    np.arctan: _increasing(math.atan),
    np.sinh: _increasing(math.sinh),
    np.cosh: _cosh,
    np.tanh: _increasing(math.tanh),
    np.exp: _not_negative(math.exp),
    np.log: _increasing(math.log),
    np.log10: _increasing(math.log10),
    np.sqrt: _not_negative(math.sqrt),
    np.abs: _absolute,
    np.sign: _constant(np.sign, "sign"),
    np.floor: _constant(np.floor, "floor"),
    np.ceil: _constant(np.ceil, "ceil"),
    step_function: _constant(step_function, "step"),
}
_OF_TWO: dict[Callable[..., Any], Callable[[Interval, Interval], Any]] = {
    np.add: lambda x, y: x + y,
    np.subtract: lambda x, y: x - y,
    np.multiply: lambda x, y: x * y,
    np.divide: lambda x, y: x / y,
    np.power: lambda x, y: x**y,
    np.minimum: lambda x, y: Interval(min(x.low, y.low), min(x.high, y.high)),
    np.maximum: lambda x, y: Interval(max(x.low, y.low), max(x.high, y.high)),
}


def interval_operation(operation: Callable[..., Any]) -> Callable[..., Any]:
    """Return numpy's operation on intervals, for `Expression.translated`."""
    if operation in _OF_ONE:
        function = _OF_ONE[operation]
        return lambda x: function(Interval.of(x))
    if operation in _OF_TWO:
        operator = _OF_TWO[operation]
        return lambda x, y: operator(Interval.of(x), Interval.of(y))
    # Both branches are possible until a comparison is decided: a choice between formulas may jump.
    raise _unbounded(f"{getattr(operation, '__name__', 'where')} chooses between formulas, which may jump")
