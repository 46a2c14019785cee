"""Slopes of an expression over a box: its partial derivatives, enclosed by interval arithmetic and bisection.

Value and derivative are carried together through the expression (forward differentiation), each as an interval with
outward rounding: the natural extensions of a function and of its derivative.  By the mean value theorem the difference
of two values is the difference of the arguments times a number between the bounds.  Where an absolute value, a least or
a largest one has an edge, the slope lies between those on both sides, and the same is true (Clarke); a jump is refused.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np

from obsynth.errors import PreconditionError
from obsynth.numerics.expressions import Expression, parse_expression, step_function
from obsynth.proofs.intervals import Interval, Range, enclosed_range, interval_operation

#: So many ranges of slopes are kept: the largest plants have 64 slopes.
MOST_KEPT = 256

_ONE, _ZERO = Interval(1.0, 1.0), Interval(0.0, 0.0)


@dataclass(frozen=True)
class _Dual:
    """A value and its derivative, both enclosed."""

    value: Interval
    slope: Interval

    # numpy's operations on these are their own.
    __array_ufunc__ = None

    @classmethod
    def of(cls, number: Any) -> _Dual:
        return number if isinstance(number, _Dual) else cls(Interval.of(number), _ZERO)


def slope_over(expression: Expression, name: str, box: Mapping[str, tuple[float, float]]) -> Range:
    """Return the range of the derivative of an expression by one of its names over a box.

    Parameters
    ----------
    expression : Expression
        Of names that are all in the box.
    name : str
        By what it is differentiated.
    box : mapping of str to pair of float
        Least and largest value of each name.

    Raises
    ------
    PreconditionError
        The slope is not bounded on the box, or the expression may jump there.

    Examples
    --------
    >>> from obsynth.numerics.expressions import parse_expression
    >>> found = slope_over(parse_expression("sqrt(s)"), "s", {"s": (0.02, 0.4)})
    >>> round(found.low, 3), round(found.high, 3)
    (0.791, 3.536)
    """
    names = sorted(expression.names)
    return _slope_over(expression.text, name, tuple((each, float(box[each][0]), float(box[each][1])) for each in names))


@lru_cache(maxsize=MOST_KEPT)
def _slope_over(text: str, name: str, box: tuple[tuple[str, float, float], ...]) -> Range:
    # Existence, design and verification ask for the same slopes; of three arguments one takes seconds.
    expression, names = parse_expression(text), [each for each, _, _ in box]
    ends = [(low, high) for _, low, high in box]

    def enclosure(part: tuple[tuple[float, float], ...]) -> Interval:
        values = {
            each: _Dual(Interval(*pair), _ONE if each == name else _ZERO)
            for each, pair in zip(names, part, strict=True)
        }
        try:
            return _Dual.of(expression.translated(values, _operation)).slope
        except OverflowError:
            raise PreconditionError(f"The slope of {expression.text!r} overflows.", condition="boundedness") from None
        except PreconditionError as error:
            text = f"The slope of {expression.text!r} by {name}: {error}"
            raise PreconditionError(text, condition="boundedness") from None

    def value(point: Any) -> float:
        try:
            slope = enclosure(tuple((float(x), float(x)) for x in point))
        except PreconditionError:
            return float("nan")
        return 0.5 * (slope.low + slope.high)

    return enclosed_range(enclosure, value, ends)


def _operation(operation: Callable[..., Any]) -> Callable[..., Any]:
    """Return numpy's operation on values with derivatives."""
    values = interval_operation(operation)

    def done(*operands: Any) -> _Dual:
        parts = [_Dual.of(part) for part in operands]
        value = values(*(part.value for part in parts))
        if all(part.slope == _ZERO for part in parts):
            return _Dual(value, _ZERO)
        if operation in _TWO:
            first, second = parts
            return _Dual(value, _TWO[operation](first, second, value))
        return _Dual(value, _ONES[operation](parts[0].value, value) * parts[0].slope)

    return done


def _hull(first: Interval, second: Interval) -> Interval:
    return Interval(min(first.low, second.low), max(first.high, second.high))


def _power(base: _Dual, exponent: _Dual, value: Interval) -> Interval:
    if exponent.slope == _ZERO and exponent.value.is_point:
        n = exponent.value.low
        if n == 0.0:
            return _ZERO
        return exponent.value * base.value ** Interval.of(n - 1.0) * base.slope if n != 1.0 else base.slope
    logarithm = _function(np.log)(base.value)
    return value * (exponent.slope * logarithm + exponent.value * base.slope / base.value)


def _chosen(first: bool) -> Callable[[_Dual, _Dual, Interval], Interval]:
    """Return the slope of the least (or largest) of two."""

    def slope(one: _Dual, other: _Dual, _: Interval) -> Interval:
        lower, upper = (one, other) if first else (other, one)
        if lower.value.high < upper.value.low:
            return one.slope
        if upper.value.high < lower.value.low:
            return other.slope
        return _hull(one.slope, other.slope)

    return slope


_TWO: dict[Callable[..., Any], Callable[[_Dual, _Dual, Interval], Interval]] = {
    np.add: lambda a, b, _: a.slope + b.slope,
    np.subtract: lambda a, b, _: a.slope - b.slope,
    np.multiply: lambda a, b, _: a.slope * b.value + a.value * b.slope,
    np.divide: lambda a, b, value: (a.slope - value * b.slope) / b.value,
    np.power: _power,
    np.minimum: _chosen(True),
    np.maximum: _chosen(False),
}


def _function(operation: Callable[..., Any]) -> Callable[[Interval], Interval]:
    function: Callable[[Interval], Interval] = interval_operation(operation)
    return function


def _absolute(x: Interval, _: Interval) -> Interval:
    if x.low > 0.0:
        return _ONE
    return Interval(-1.0, -1.0) if x.high < 0.0 else Interval(-1.0, 1.0)


#: Derivatives of functions of one argument, from the argument and the value.
_ONES: dict[Callable[..., Any], Callable[[Interval, Interval], Interval]] = {
    np.negative: lambda x, y: Interval(-1.0, -1.0),
    np.sin: lambda x, y: _function(np.cos)(x),
    np.cos: lambda x, y: -_function(np.sin)(x),
    np.tan: lambda x, y: _ONE + y**2,
    np.arcsin: lambda x, y: _ONE / _function(np.sqrt)(_ONE - x**2),
    np.arccos: lambda x, y: -(_ONE / _function(np.sqrt)(_ONE - x**2)),
    np.arctan: lambda x, y: _ONE / (_ONE + x**2),
    np.sinh: lambda x, y: _function(np.cosh)(x),
    np.cosh: lambda x, y: _function(np.sinh)(x),
    np.tanh: lambda x, y: _ONE / _function(np.cosh)(x) ** 2,
    np.exp: lambda x, y: y,
    np.log: lambda x, y: _ONE / x,
    np.log10: lambda x, y: _ONE / (x * _function(np.log)(Interval(10.0, 10.0))),
    np.sqrt: lambda x, y: _ONE / (Interval(2.0, 2.0) * y),
    np.abs: _absolute,
    # Constant where their values are: a jump was refused with the value.
    np.sign: lambda x, y: _ZERO,
    np.floor: lambda x, y: _ZERO,
    np.ceil: lambda x, y: _ZERO,
    step_function: lambda x, y: _ZERO,
}
