"""A small arithmetic language for data: parsed into a tree of known operations, never executed as code.

Numbers, names, ``+ - * / **``, parentheses, a fixed list of functions, and ``where(a > b, c, d)``, which is c where
a > b and d elsewhere; in equations of a DAE also ``der(...)``, the derivative with respect to time of any expression.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, TypeAlias

import numpy as np

from obsynth.errors import SpecError

#: Longer texts and deeper nestings are refused: nobody writes them by hand.
MAXIMUM_LENGTH = 2000
MAXIMUM_DEPTH = 50

#: From an operation on numbers to the one that stands for it on other values, such as symbols.
Translation: TypeAlias = Callable[[Callable[..., Any]], Callable[..., Any]]
Evaluator: TypeAlias = Callable[[Mapping[str, Any], Translation], Any]

_TOKEN = re.compile(r"\s*(?:((?:\d+\.?\d*|\.\d+)(?:[eE][+-]?\d+)?)|([A-Za-z_]\w*)|(\*\*|[<>]=?|[-+*/(),]))", re.ASCII)


def step_function(value: Any) -> Any:
    """Return 1 where ``value >= 0`` and 0 elsewhere."""
    return np.where(np.asarray(value) >= 0.0, 1.0, 0.0)


#: Functions of one argument; ``step(x)`` is 1 where ``x >= 0`` and 0 elsewhere.
FUNCTIONS: Mapping[str, Callable[[Any], Any]] = {
    "sin": np.sin,
    "cos": np.cos,
    "tan": np.tan,
    "asin": np.arcsin,
    "acos": np.arccos,
    "atan": np.arctan,
    "sinh": np.sinh,
    "cosh": np.cosh,
    "tanh": np.tanh,
    "exp": np.exp,
    "log": np.log,
    "log10": np.log10,
    "sqrt": np.sqrt,
    "abs": np.abs,
    "sign": np.sign,
    "floor": np.floor,
    "ceil": np.ceil,
    "step": step_function,
}
#: Functions of two arguments.
FUNCTIONS_OF_TWO: Mapping[str, Callable[[Any, Any], Any]] = {"min": np.minimum, "max": np.maximum}
NAMED_NUMBERS: Mapping[str, float] = {"pi": float(np.pi)}
#: What may stand in the first place of ``where``.
COMPARISONS: Mapping[str, Callable[[Any, Any], Any]] = {
    "<": np.less,
    "<=": np.less_equal,
    ">": np.greater,
    ">=": np.greater_equal,
}
#: Words that other languages decide with; names of these would be read as mistakes.
DECIDING_WORDS = frozenset({"if", "else", "and", "or", "not"})


def _as_it_is(operation: Callable[..., Any]) -> Callable[..., Any]:
    """Translate nothing: numbers and arrays."""
    return operation


@dataclass(frozen=True)
class Expression:
    """An expression that was parsed: its text, the names whose values it needs, and what ``der(...)`` is taken of."""

    text: str
    names: frozenset[str]
    _evaluator: Evaluator = field(repr=False, compare=False)
    rates: Mapping[str, Expression] = field(default_factory=dict, compare=False)

    def __reduce__(self) -> tuple[Any, ...]:
        """Return what makes it again in another process: its text."""
        return _parsed, (self.text, bool(self.rates))

    def __call__(self, values: Mapping[str, Any]) -> Any:
        """Return the value, NaN or infinite where there is none; ``values`` are numbers or arrays by name."""
        # What is not finite is found by the caller, who knows where it came from.
        with np.errstate(all="ignore"):
            return self._evaluator(values, _as_it_is)

    def translated(self, values: Mapping[str, Any], translation: Translation) -> Any:
        """Return the value on other things than numbers."""
        return self._evaluator(values, translation)


def _parsed(text: str, rates: bool) -> Expression:
    return parse_expression(text, rates=rates)


def parse_expression(text: str, *, rates: bool = False) -> Expression:
    """Parse a text into an expression."""
    if len(text) > MAXIMUM_LENGTH:
        raise SpecError(f"An expression has {len(text)} characters: at most {MAXIMUM_LENGTH} are read.")
    parser = _Parser(text, rates=rates)
    evaluator = parser.whole()
    return Expression(text, frozenset(parser.names), evaluator, dict(parser.rates))


class _Parser:
    """Recursive descent: sum, term, sign, power, atom."""

    def __init__(self, text: str, *, rates: bool) -> None:
        self.text, self.tokens, self.names = text, _tokens(text), set[str]()
        self.position = self.depth = 0
        self.rates, self.rates_allowed = dict[str, Expression](), rates

    def whole(self) -> Evaluator:
        found = self.sum()
        if self.peek():
            raise self.error(f"{self.peek()!r} is not expected here")
        return found

    def peek(self) -> str:
        return self.tokens[self.position] if self.position < len(self.tokens) else ""

    def take(self, *wanted: str) -> str:
        token = self.peek()
        if token and token in wanted:
            self.position += 1
            return token
        return ""

    def error(self, reason: str) -> SpecError:
        decides = " To decide, write where(a > b, c, d): c where a > b, d elsewhere."
        hint = decides if DECIDING_WORDS.intersection(self.tokens) or COMPARISONS.keys() & set(self.tokens) else ""
        return SpecError(
            f"{self.text!r} is no valid expression: {reason}. Allowed are numbers, names, + - * / **, parentheses "
            f"and the functions {', '.join([*FUNCTIONS, *FUNCTIONS_OF_TWO, 'where'])}.{hint}"
        )

    def sum(self) -> Evaluator:
        first, rest = self.term(), []
        while operator := self.take("+", "-"):
            rest.append((np.add if operator == "+" else np.subtract, self.term()))
        return _chain(first, rest)

    def term(self) -> Evaluator:
        first, rest = self.signed(), []
        while operator := self.take("*", "/"):
            rest.append((np.multiply if operator == "*" else np.divide, self.signed()))
        return _chain(first, rest)

    def signed(self) -> Evaluator:
        self.depth += 1
        if self.depth > MAXIMUM_DEPTH:
            raise self.error(f"it is nested more than {MAXIMUM_DEPTH} times")
        sign = self.take("+", "-")
        found = self.signed() if sign else self.power()
        self.depth -= 1
        return _unary(np.negative, found) if sign == "-" else found

    def power(self) -> Evaluator:
        base = self.atom()
        return _binary(np.power, base, self.signed()) if self.take("**") else base

    def atom(self) -> Evaluator:
        if self.take("("):
            inner = self.sum()
            self.close()
            return inner
        token = self.peek()
        if not token or token in DECIDING_WORDS or not (token[0].isalnum() or token[0] in "._"):
            raise self.error(f"{token!r} is not expected here" if token else "it ends too early")
        self.position += 1
        if token[0].isdigit() or token[0] == ".":
            number = np.float64(token)
            return lambda values, _: number
        if self.take("("):
            return self.function(token)
        if token in NAMED_NUMBERS:
            constant = NAMED_NUMBERS[token]
            return lambda values, _: constant
        self.names.add(token)
        return lambda values, _: values[token]

    def function(self, name: str) -> Evaluator:
        if name == "der" and self.rates_allowed:
            return self.rate()
        if name == "where":
            return self.choice()
        first = self.sum()
        if name in FUNCTIONS:
            self.close()
            return _unary(FUNCTIONS[name], first)
        if name not in FUNCTIONS_OF_TWO:
            raise self.error(f"there is no function {name!r}")
        if not self.take(","):
            raise self.error(f"{name} needs two arguments")
        second = self.sum()
        self.close()
        return _binary(FUNCTIONS_OF_TWO[name], first, second)

    def choice(self) -> Evaluator:
        """Read ``a > b, c, d)``; of the values that are not chosen none is wanted, so that they need not exist."""
        left = self.sum()
        operator = self.take(*COMPARISONS)
        if not operator:
            raise self.error("where needs a comparison (<, <=, >, >=) first")
        condition = _binary(COMPARISONS[operator], left, self.sum())
        values = []
        for _ in range(2):
            if not self.take(","):
                raise self.error("where needs a comparison and two values")
            values.append(self.sum())
        self.close()
        return _chosen(condition, *values)

    def rate(self) -> Evaluator:
        """Read what a derivative is taken of; it stands for a value of its own, found under its text."""
        begin, outside = self.position, self.names
        self.names, self.rates_allowed = set[str](), False
        inner = self.sum()
        text = "".join(self.tokens[begin : self.position])
        self.close()
        found = Expression(text, frozenset(self.names), inner)
        self.names, self.rates_allowed = outside, True
        key = f"der({text})"
        self.rates[key] = found
        return lambda values, _: values[key]

    def close(self) -> None:
        if not self.take(")"):
            raise self.error("a parenthesis is not closed")


def _tokens(text: str) -> list[str]:
    tokens, position = [], 0
    stripped = text.rstrip()
    while position < len(stripped):
        match = _TOKEN.match(stripped, position)
        if match is None:
            sign = stripped[position:].strip()[0]
            instead = ": write ** for a power" if sign == "^" else ""
            raise SpecError(f"{text!r} is no valid expression: {sign!r} is not allowed{instead}.")
        tokens.append(match.group(match.lastindex or 0))
        position = match.end()
    return tokens


def _unary(operation: Callable[[Any], Any], inner: Evaluator) -> Evaluator:
    return lambda values, translate: translate(operation)(inner(values, translate))


def _binary(operation: Callable[[Any, Any], Any], left: Evaluator, right: Evaluator) -> Evaluator:
    return lambda values, translate: translate(operation)(left(values, translate), right(values, translate))


def _chain(first: Evaluator, rest: Sequence[tuple[Callable[[Any, Any], Any], Evaluator]]) -> Evaluator:
    """Return operations from left to right, in a loop: a long sum is no deep one."""
    if not rest:
        return first

    def evaluated(values: Mapping[str, Any], translate: Translation) -> Any:
        found = first(values, translate)
        for operation, operand in rest:
            found = translate(operation)(found, operand(values, translate))
        return found

    return evaluated


def _chosen(condition: Evaluator, first: Evaluator, second: Evaluator) -> Evaluator:
    return lambda values, translate: translate(np.where)(
        condition(values, translate), first(values, translate), second(values, translate)
    )
