r"""Scheduling parameters of a plant: their ranges and rates, the functions of them in its matrices, and the weights.

Every matrix is :math:`M_0 + \sum_k a_k(\rho) M_k` with functions :math:`a_k` of the measured parameters :math:`\rho`:
a parameter itself where it enters linearly, else a function whose range over the region is enclosed with a proof.  A
point is a mean of the :math:`2^q` corners of the box of the :math:`a_k`, with weights that are products of
:math:`(a_k - \underline a_k) / (\overline a_k - \underline a_k)` and one minus it.
"""

from __future__ import annotations

import itertools
import re
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from fractions import Fraction
from functools import cached_property, partial
from typing import Any

import numpy as np

from obsynth.errors import PreconditionError, SpecError
from obsynth.numerics.arguments import is_finite_number, shown
from obsynth.numerics.arrays import FloatArray, freeze, read_only
from obsynth.numerics.expressions import Expression, parse_expression
from obsynth.numerics.suggestions import there_are
from obsynth.proofs.intervals import range_over

#: 4,096 corners: more are not worth the time of a design (30 s with 64 vertices of 16 states).
MOST_FUNCTIONS = 12
#: What a weight given by its column may be off by: logs have about six digits.
WEIGHT_TOLERANCE = 1e-6
#: What a step of a parameter may exceed its rate by, from rounding of logs; certificates allow for twice as much.
RATE_TOLERANCE = 1e-6
#: Powers that are written as repeated factors.
SMALL_POWERS = range(2, 9)
#: Products of sums that have more terms are left as they are.
MOST_EXPANDED = 64
#: Whole numbers below this one are written without a point.
LARGEST_WHOLE = 1e15
#: Keys of a parameter as it is given.
PARAMETER_KEYS = ("range", "rate", "column", "unit", "measured")
#: Those that are texts, where they are there.
_TEXTS = {"column": "the name of a column of logs", "unit": "a unit"}

#: Functions that have one name in formulas and in numpy.
_NAMES = ["sin", "cos", "tan", "sinh", "cosh", "tanh", "exp", "log", "log10", "sqrt", "abs", "sign", "floor", "ceil"]

#: A name, a number, or one call whose argument has no brackets of its own.
_FACTOR = re.compile(r"[A-Za-z_]\w*(\([^()]*\))?|\d+(\.\d+)?")


@dataclass(frozen=True, eq=False)
class Scheduling:
    """Measured parameters, and the functions of them on which the matrices of a plant depend linearly.

    Parameters
    ----------
    names : tuple of str
        The parameters, in order.
    low, high : FloatArray
        Ends of their ranges.
    rates : tuple of float or None
        Largest change in a second, where it is stated.
    functions : tuple of str
        Texts in the parameters; empty where the parameters are the weights of the vertices themselves.
    columns : mapping of str to str, optional
        The column of a log that holds a parameter, where it has another name.
    units : mapping of str to str, optional
        Units of parameters.

    Raises
    ------
    SpecError
        An empty range, a rate that is not positive, too many functions, or an unknown name in one.
    PreconditionError
        A function is not bounded over the region, or jumps there.

    Examples
    --------
    >>> scheduling = Scheduling(("v",), [1.0], [3.0], (None,), ("v",))
    >>> scheduling.weights({"v": 1.5}).tolist()
    [0.75, 0.25]
    """

    names: tuple[str, ...]
    low: FloatArray
    high: FloatArray
    rates: tuple[float | None, ...]
    functions: tuple[str, ...]
    columns: Mapping[str, str] = field(default_factory=dict)
    units: Mapping[str, str] = field(default_factory=dict)

    def __post_init__(self) -> None:
        low, high = (np.asarray(ends, dtype=np.float64).ravel() for ends in (self.low, self.high))
        names = tuple(self.names)
        if not names or len({len(names), len(low), len(high), len(self.rates)}) != 1:
            raise SpecError("Give name, range and rate of one or more scheduling parameters.", path="scheduling")
        for name, one, other, rate in zip(names, low, high, self.rates, strict=True):
            _require_range(name, float(one), float(other))
            _require_rate(name, rate)
        if len(self.functions) > MOST_FUNCTIONS:
            raise SpecError(
                f"The matrices depend on {len(self.functions)} functions of the scheduling parameters, which makes "
                f"2 ** {len(self.functions)} vertices: at most {MOST_FUNCTIONS} functions are taken. Write numbers "
                "for those that change least (constants, for a parameter), or one formula where several are nearly the "
                "same.",
                path="scheduling",
            )
        freeze(self, "columns", "units", low=low, high=high)
        rates = tuple(None if rate is None else float(rate) for rate in self.rates)
        for key, value in (("names", names), ("functions", tuple(self.functions)), ("rates", rates)):
            object.__setattr__(self, key, value)
        for expression in self.expressions:
            unknown = sorted(expression.names - set(names))
            if unknown:
                raise SpecError(
                    f"{expression.text!r} has {unknown[0]!r}, which is no scheduling parameter; "
                    f"{there_are(unknown[0], names)}",
                    path="scheduling",
                )
        if self.functions:
            _ = self.corners  # refused here, where it is made

    @property
    def gives_weights(self) -> bool:
        """Whether the parameters are the weights of the vertices themselves."""
        return not self.functions

    @property
    def is_linear(self) -> bool:
        """Whether every function is a parameter itself."""
        return self.functions == self.names[: len(self.functions)] or set(self.functions) <= set(self.names)

    @cached_property
    def expressions(self) -> tuple[Expression, ...]:
        """The functions, parsed."""
        return tuple(parse_expression(text) for text in self.functions)

    @cached_property
    def bounds(self) -> FloatArray:
        """``(q, 2)``: ends of the range of every function over the region, enclosed with outward rounding."""
        box = {name: (float(a), float(b)) for name, a, b in zip(self.names, self.low, self.high, strict=True)}
        ranges = [range_of_function(expression, box) for expression in self.expressions]
        return read_only(np.array(ranges, dtype=np.float64).reshape(len(ranges), 2))

    @cached_property
    def corners(self) -> FloatArray:
        """``(N, q)``: values of the functions at every vertex; the last function changes first."""
        if self.gives_weights:
            return read_only(np.eye(len(self.names)))
        return read_only(np.array(list(itertools.product(*self.bounds)), dtype=np.float64))

    @property
    def count(self) -> int:
        """Number of vertices."""
        return len(self.names) if self.gives_weights else 2 ** len(self.functions)

    def vertex_name(self, place: int) -> str:
        """Return a vertex in words, such as ``vertex 3 (v = 2, w = 0.5)``."""
        if self.gives_weights:
            return f"vertex {place + 1}"
        values = zip(self.functions, self.corners[place], strict=True)
        return f"vertex {place + 1} ({', '.join(f'{name} = {value:.6g}' for name, value in values)})"

    def values(self, point: Mapping[str, float] | Sequence[float] | FloatArray) -> FloatArray:
        """Return the parameters in order; raise `SpecError` for a missing or an unknown one."""
        if isinstance(point, Mapping):
            if set(point) != set(self.names):
                given = ", ".join(map(repr, point)) or "none"
                raise SpecError(
                    f"Scheduling parameters that are given: {given}; give {', '.join(self.names)}.", path="scheduling"
                )
            point = [point[name] for name in self.names]
        try:
            values = np.asarray(point, dtype=np.float64).ravel()
        except (TypeError, ValueError):
            raise SpecError(
                f"Scheduling parameters are {shown(point)}: give numbers, by name or in order.", path="scheduling"
            ) from None
        if values.shape != (len(self.names),):
            raise SpecError(f"Give {len(self.names)} scheduling parameters.", path="scheduling")
        return values

    def is_inside(self, values: FloatArray) -> bool:
        """Whether parameters ``(p,)`` are all there and in the region."""
        inside = bool(np.all((values >= self.low) & (values <= self.high)))  # NaN is not
        return inside and (not self.gives_weights or abs(float(values.sum()) - 1.0) <= WEIGHT_TOLERANCE)

    def nearest(self, values: FloatArray) -> FloatArray:
        """Return parameters ``(p,)`` moved into their ranges, one by one."""
        return np.minimum(np.maximum(values, self.low), self.high)

    def weights(self, point: Mapping[str, float] | Sequence[float] | FloatArray) -> FloatArray:
        """Return the weights ``(N,)`` of the vertices at parameters, which are moved into their ranges first.

        Raises `SpecError` for a parameter that is missing, unknown or NaN.
        """
        values = self.nearest(self.values(point))
        if np.isnan(values).any():
            missing = self.names[int(np.argmax(np.isnan(values)))]
            raise SpecError(f"{missing} is NaN: there are no weights without its value.", path=f"scheduling.{missing}")
        if self.gives_weights:
            total = float(values.sum())
            return values / total if total > 0.0 else np.full(len(values), 1.0 / len(values))
        weights = np.ones(1)
        for function, (low, high) in zip(self._functions, self.bounds.tolist(), strict=True):
            share = min(max((function(values) - low) / (high - low), 0.0), 1.0)
            weights = np.outer(weights, (1.0 - share, share)).ravel()
        return weights

    @cached_property
    def _functions(self) -> tuple[Callable[[FloatArray], float], ...]:
        """The functions of parameters ``(p,)``."""

        def function_of(expression: Expression) -> Callable[[FloatArray], float]:
            if expression.text in self.names:
                place = self.names.index(expression.text)
                return lambda values: float(values[place])
            return lambda values: float(expression(dict(zip(self.names, values, strict=True))))

        return tuple(map(function_of, self.expressions))

    def step_of(self, dt: float) -> float | None:
        """Return by how much the weight of the second of two vertices can change within a sample, where it is known."""
        rate = self.rate_of_weight
        return None if rate is None else rate * dt

    def usable_step_of(self, dt: float) -> float | None:
        """Return the same where a certificate can use it: where the parameter cannot cross its range in a sample."""
        step = self.step_of(dt)
        return step if step is not None and step < 1.0 else None

    @property
    def read_names(self) -> tuple[str, ...]:
        """The columns of a log that the parameters are read from."""
        return tuple(self.columns.get(name, name) for name in self.names)

    @property
    def rated_names(self) -> tuple[str, ...]:
        """The parameters whose rates are stated."""
        return tuple(name for name, rate in zip(self.names, self.rates, strict=True) if rate is not None)

    @property
    def rate_of_weight(self) -> float | None:
        """By how much the weight of the second of two vertices can change in a second, where it is known."""
        if self.count != 2 or len(self.names) != 1 or self.rates[0] is None or self.functions != self.names:
            return None
        return self.rates[0] * (1.0 + 2.0 * RATE_TOLERANCE) / float(self.high[0] - self.low[0])

    def sentence(self) -> str:
        """Return the region in words."""
        parts = []
        for name, low, high in zip(self.names, self.low, self.high, strict=True):
            unit = f" {self.units[name]}" if name in self.units else ""
            parts.append(f"{name} in [{low:.6g}, {high:.6g}]{unit}")
        return ", ".join(parts)

    def as_dict(self) -> dict[str, Any]:
        """Return the fields, as the constructor takes them."""
        return {
            "names": list(self.names),
            "low": self.low,
            "high": self.high,
            "rates": list(self.rates),
            "functions": list(self.functions),
            "columns": dict(self.columns),
            "units": dict(self.units),
        }

    @classmethod
    def from_dict(cls, data: Mapping[str, Any]) -> Scheduling:
        """Return what `as_dict` described."""
        return cls(
            tuple(data["names"]),
            data["low"],
            data["high"],
            tuple(data["rates"]),
            tuple(data["functions"]),
            dict(data["columns"]),
            dict(data["units"]),
        )


def _require_range(name: str, low: float, high: float) -> None:
    if not (np.isfinite(low) and np.isfinite(high) and low < high):
        raise SpecError(
            f"The range of {name!r} is [{low:g}, {high:g}]: give [low, high], finite and the lower one first. A "
            "parameter that does not change is a constant: write its value.",
            path=f"scheduling.{name}.range",
        )


def _require_rate(name: str, rate: Any) -> None:
    if rate is not None and not (is_finite_number(rate) and rate > 0.0):
        raise SpecError(
            f"The rate of {name!r} is {shown(rate)}: give its largest change in a second, above 0, or leave it out "
            "for any change. A parameter that does not change has a tolerance (obsynth.uncertain_system).",
            path=f"scheduling.{name}.rate",
        )


def range_of_function(expression: Expression, box: Mapping[str, tuple[float, float]]) -> tuple[float, float]:
    """Return the ends of the range of a function over a box of its parameters.

    Raises
    ------
    PreconditionError
        It is not bounded, jumps, or is the same everywhere.
    """
    if expression.text in box:
        return box[expression.text]
    known = range_over(expression, box)
    if not known.low < known.high:
        raise PreconditionError(
            f"{expression.text!r} is {known.low:.6g} everywhere in the region: write that number.", condition="range"
        )
    return known.low, known.high


def parameters_of(scheduling: Any) -> dict[str, dict[str, Any]]:
    """Return scheduling parameters as ``{name: {range, rate, column, unit}}``; raise `SpecError` for anything else."""
    if not isinstance(scheduling, Mapping) or not scheduling:
        raise SpecError("scheduling must name one or more parameters, such as {v: {range: [1, 3]}}.", path="scheduling")
    checked = {}
    for name, entry in scheduling.items():
        path = f"scheduling.{name}"
        entry = entry if isinstance(entry, Mapping) else {"range": entry}
        unknown = sorted(set(map(str, entry)) - set(PARAMETER_KEYS))
        if unknown:
            raise SpecError(
                f"A parameter has no key {unknown[0]!r}; {there_are(unknown[0], PARAMETER_KEYS)}", path=path
            )
        ends = entry.get("range")
        if not (isinstance(ends, (list, tuple, np.ndarray)) and len(ends) == 2 and all(map(is_finite_number, ends))):
            raise SpecError(f"The range of {name!r} is {shown(ends)}: give [low, high], both finite.", path=path)
        if entry.get("measured", True) is not True:
            raise SpecError(
                f"{name!r} is not measured: an estimated parameter proves nothing about the estimate (the product of "
                "its error and the state is no disturbance of known size). Take the nonlinear model "
                "(obsynth.region_observer), or give the parameter a tolerance (obsynth.uncertain_system).",
                path=f"{path}.measured",
            )
        _require_range(str(name), *map(float, ends))
        _require_rate(str(name), entry.get("rate"))
        for key, meaning in _TEXTS.items():
            if entry.get(key) is not None and not (isinstance(entry[key], str) and entry[key].strip()):
                raise SpecError(
                    f"The {key} of {name!r} is {shown(entry[key])}: give {meaning}, as text.", path=f"{path}.{key}"
                )
        checked[str(name)] = {**entry, "range": [float(ends[0]), float(ends[1])]}
    _require_own_columns(checked)
    return checked


def _require_own_columns(parameters: Mapping[str, Mapping[str, Any]]) -> None:
    """Refuse two parameters that are read from one column: they are one parameter."""
    owners: dict[str, str] = {}
    for name, entry in parameters.items():
        column = str(entry.get("column") or name)
        if column in owners:
            raise SpecError(
                f"{owners[column]!r} and {name!r} are read from the same column {column!r}: write one parameter in the "
                "entries of both.",
                path=f"scheduling.{name}.column",
            )
        owners[column] = name


@dataclass(frozen=True, eq=False)
class LinearForm:
    """A number that is linear in functions of scheduling parameters: ``constant + sum parts[text] text``, exactly."""

    constant: Fraction
    parts: Mapping[str, Fraction] = field(default_factory=dict)

    @classmethod
    def of(cls, value: Any) -> LinearForm:
        """Return a form as it is, or that of a number."""
        return value if isinstance(value, LinearForm) else cls(Fraction(float(value)))

    @property
    def text(self) -> str:
        """An expression of the same value, in one order of terms."""
        terms = [
            _bracketed(name) if factor == 1 else f"{_number(factor)} * {_bracketed(name)}"
            for name, factor in sorted(self.parts.items())
        ]
        return " + ".join([*([_number(self.constant)] if self.constant or not terms else []), *terms])

    def plus(self, other: LinearForm, sign: int) -> LinearForm:
        """Return the sum, or the difference."""
        parts = dict(self.parts)
        for name, factor in other.parts.items():
            parts[name] = parts.get(name, Fraction(0)) + sign * factor
        return LinearForm(self.constant + sign * other.constant, {name: f for name, f in parts.items() if f})

    def times(self, factor: Fraction) -> LinearForm:
        """Return a multiple."""
        return LinearForm(self.constant * factor, {name: f * factor for name, f in self.parts.items() if f * factor})

    @property
    def monomial(self) -> tuple[Fraction, str] | None:
        """Factor and function of a multiple of one function; `None` of anything else."""
        if self.constant or len(self.parts) != 1:
            return None
        ((text, factor),) = self.parts.items()
        return factor, text


def linear_form(
    expression: Expression, constants: Mapping[str, float], names: Sequence[str], *, expanded: bool = False
) -> LinearForm:
    """Return an expression as a linear form of functions of parameters ``names``; ``constants`` are numbers.

    Numbers are taken out of products, powers and quotients, so that multiples of one function are one; products of sums
    are functions as they are, or sums of products where they are ``expanded``."""
    values: dict[str, Any] = {name: LinearForm(Fraction(0), {name: Fraction(1)}) for name in names}
    values |= {name: LinearForm.of(value) for name, value in constants.items() if name not in values}
    return LinearForm.of(expression.translated(values, partial(_linear_operation, expanded=expanded)))


def _linear_operation(operation: Callable[..., Any], *, expanded: bool) -> Callable[..., Any]:
    def done(*operands: Any) -> LinearForm:
        forms = [LinearForm.of(value) for value in operands]
        if not any(form.parts for form in forms) and operation not in (np.add, np.subtract, np.multiply, np.divide):
            return LinearForm.of(operation(*(float(form.constant) for form in forms)))
        if operation is np.negative:
            return forms[0].times(Fraction(-1))
        if operation in (np.add, np.subtract):
            return forms[0].plus(forms[1], 1 if operation is np.add else -1)
        if operation is np.multiply and not all(form.parts for form in forms):
            fixed, moving = sorted(forms, key=lambda form: bool(form.parts))
            return moving.times(fixed.constant)
        if operation is np.divide and not forms[1].parts and forms[1].constant:
            return forms[0].times(1 / forms[1].constant)
        if operation is np.power and not forms[1].parts and forms[1].constant in (0, 1):
            return forms[0] if forms[1].constant else LinearForm(Fraction(1))
        if operation is np.multiply:
            return _product(forms[0], forms[1], expanded=expanded)
        monomials = [form.monomial for form in forms]
        if operation is np.power and forms[1].constant == Fraction(1, 2) and not forms[1].parts:
            return LinearForm(Fraction(0), {f"sqrt({forms[0].text})": Fraction(1)})
        if operation is np.power and monomials[0] and not forms[1].parts and forms[1].constant in SMALL_POWERS:
            return _power(*monomials[0], int(forms[1].constant))
        if operation is np.power and not forms[1].parts and -forms[1].constant in (Fraction(1, 2), 1, *SMALL_POWERS):
            below = done(forms[0], LinearForm(-forms[1].constant)) if forms[1].constant != -1 else forms[0]
            return _quotient(LinearForm(Fraction(1)), below)
        if operation is np.divide and (any(monomials) or not forms[0].parts) and forms[1].parts:
            return _quotient(*forms)
        text = (
            TEXTS_OF_OPERATIONS[operation](*(form.text for form in forms)) if operation in TEXTS_OF_OPERATIONS else None
        )
        if text is None:
            raise SpecError(
                "An entry of a matrix chooses between formulas (a comparison or where), which may jump: that is no "
                "plant over a region. Give a smooth formula.",
                path="scheduling",
            )
        return LinearForm(Fraction(0), {text: Fraction(1)})

    return done


def _quotient(above: LinearForm, below: LinearForm) -> LinearForm:
    """Return a quotient whose divisor moves: numbers are taken out of both, and all that divides is one product."""
    number, (factors, divisors) = _factor_and_fraction(above)
    divisor, (more, under) = _factor_and_fraction(below)
    if under:  # nothing is cancelled: as written there is no value where what divides the divisor is zero
        more = [_text_of_fraction(more, under)]
    text = _text_of_fraction(factors, [*divisors, *more])
    return LinearForm(Fraction(0), {text: number / divisor} if number else {})


def _factor_and_fraction(form: LinearForm) -> tuple[Fraction, tuple[list[str], list[str]]]:
    """Return a number and what is multiplied and divided; a sum is one factor."""
    if not form.parts:
        return form.constant, ([], [])
    if form.monomial is None:
        return Fraction(1), ([form.text], [])
    factor, text = form.monomial
    return factor, _fraction(text)


def _power(factor: Fraction, text: str, times: int) -> LinearForm:
    """Return a small power of a multiple of one function."""
    factors, divisors = _fraction(text)
    return LinearForm(Fraction(0), {_text_of_fraction(factors * times, divisors * times): factor**times})


def _product(one: LinearForm, other: LinearForm, *, expanded: bool) -> LinearForm:
    """Return the product of two forms that both move."""
    if expanded and len(one.parts) * len(other.parts) <= MOST_EXPANDED:
        total = one.times(other.constant).plus(other.times(one.constant), 1)
        total = LinearForm(one.constant * other.constant, total.parts)
        for (x, a), (y, b) in itertools.product(one.parts.items(), other.parts.items()):
            total = total.plus(LinearForm(Fraction(0), {_text_of_product(_fraction(x), _fraction(y)): a * b}), 1)
        return total
    (factor, fraction), (factor_of_other, fraction_of_other) = map(_factor_and_fraction, (one, other))
    return LinearForm(Fraction(0), {_text_of_product(fraction, fraction_of_other): factor * factor_of_other})


def _text_of_product(one: tuple[list[str], list[str]], other: tuple[list[str], list[str]]) -> str:
    return _text_of_fraction([*one[0], *other[0]], [*one[1], *other[1]])


def _fraction(text: str) -> tuple[list[str], list[str]]:
    """Return the factors of a function and those of what it is divided by."""
    parts = _split(text, " / ")
    if len(parts) != 2 or any(len(_split(text, sign)) > 1 for sign in (" + ", " - ")):
        return _factors(text), []
    above, below = map(_without_brackets, parts)
    return ([] if above == "1" else _factors(above)), _factors(below)


def _factors(text: str) -> list[str]:
    """Return the factors of a function, as often as each is one: itself alone where it is no product."""
    if any(len(_split(text, sign)) > 1 for sign in (" + ", " - ", " / ")):
        return [text]
    factors = list[str]()
    for part in _split(text, " * "):
        base, _, power = part.rpartition(" ** ")
        times = int(power) if base and power.isdigit() and int(power) in SMALL_POWERS else 0
        factors += [_without_brackets(base)] * times if times else [_without_brackets(part)]
    return factors


def _split(text: str, sign: str) -> list[str]:
    """Return the parts of a text between signs that stand in no brackets."""
    parts, depth, begun = list[str](), 0, 0
    for i, character in enumerate(text):
        depth += (character == "(") - (character == ")")
        if depth == 0 and text.startswith(sign, i):
            parts.append(text[begun:i])
            begun = i + len(sign)
    return [*parts, text[begun:]]


def _without_brackets(text: str) -> str:
    """Return a text without the brackets that hold all of it."""
    depths = list(itertools.accumulate((letter == "(") - (letter == ")") for letter in text))
    held = text.startswith("(") and depths.index(0) == len(text) - 1
    return _without_brackets(text[1:-1]) if held else text


def _text_of_fraction(factors: list[str], divisors: list[str]) -> str:
    """Return a product, or a quotient of two, in one order of what is multiplied."""
    above = _text_of_factors(factors) if factors else "1"
    return TEXTS_OF_OPERATIONS[np.divide](above, _text_of_factors(divisors)) if divisors else above


def _text_of_factors(factors: list[str]) -> str:
    """Return a product in one order of its factors, each of which is written once."""
    counts = Counter(map(_bracketed, factors)) if len(factors) > 1 else {factors[0]: 1}
    return " * ".join(text if count == 1 else f"{text} ** {count}" for text, count in sorted(counts.items()))


def _number(value: Fraction) -> str:
    number = float(value)
    return str(int(number)) if number.is_integer() and abs(number) < LARGEST_WHOLE else repr(number)


def _bracketed(text: str) -> str:
    """Return a text as a factor."""
    return text if _FACTOR.fullmatch(text) else f"({text})"


TEXTS_OF_OPERATIONS: dict[Callable[..., Any], Callable[..., str]] = {
    **{getattr(np, name): partial("{}({})".format, name) for name in _NAMES},
    np.arcsin: lambda x: f"asin({x})",
    np.arccos: lambda x: f"acos({x})",
    np.arctan: lambda x: f"atan({x})",
    np.multiply: lambda x, y: f"{_bracketed(min(x, y))} * {_bracketed(max(x, y))}",
    np.divide: lambda x, y: f"{_bracketed(x)} / {_bracketed(y)}",
    np.power: lambda x, y: f"{_bracketed(x)} ** {_bracketed(y)}",
    np.minimum: lambda x, y: f"min({x}, {y})",
    np.maximum: lambda x, y: f"max({x}, {y})",
}
