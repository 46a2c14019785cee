"""A small language of arithmetic expressions: Python parses them, and only known operations are allowed.

Numbers, names, ``+ - * / **``, parentheses, a fixed list of functions, and ``where(a > b, c, d)``, which is c where
a > b and d elsewhere; in equations of a DAE also ``der(...)``, the derivative with respect to time of any expression.
"""

from __future__ import annotations

import ast
import re
import warnings
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

#: How other languages write things, and what to write here.
_OTHER_SPELLINGS: Sequence[tuple[re.Pattern[str], str]] = (
    (re.compile(r"\^|\bpow(?:er)?\("), "A power is written **."),
    (re.compile("=="), "An equation has a single =."),
    (
        re.compile(r"\b(?:d|dt|ddt|dot|diff|deriv|derivative|Der|D)\(|'\s*(?:$|[-+*/=])"),
        "A derivative in an equation is written der(x).",
    ),
    (
        re.compile(r"(?:(?<![\w.])[\d.]+(?:[eE][+-]?\d+)?(?![eE][+-]?\d)|\))\s*(?!(?:if|else|and|or)\b)[A-Za-z_(]"),
        "A product is written with *, as 2 * x.",
    ),
    (re.compile(r"\bln\("), "The natural logarithm is log(x)."),
    (re.compile(r"\barc(?:sin|cos|tan)\("), "Inverse functions are asin, acos and atan."),
    (re.compile(r"\batan2\("), "The angle of (x, y) is 2 * atan(y / (sqrt(x**2 + y**2) + x))."),
    (re.compile(r"\bfabs\("), "The absolute value is abs(x)."),
    (re.compile(r"\b(?:heaviside|Heaviside)\("), "step(x) is 1 from zero on and 0 before."),
    (re.compile(r"\b(?:clip|sat|saturate|saturation)\("), "A limited value is min(max(x, low), high)."),
    (re.compile(r"\b(?:interp|interp1|interp1d|lookup|table)\("), "A table is a sum of pieces: a + b * max(x - c, 0)."),
    (
        re.compile(r"\b(?:if|else|and|or|not)\b|\bPiecewise\(|[<>]"),
        "To decide, write where(a > b, c, d): c where a > b, d elsewhere.",
    ),
)

#: Names have a prefix where Python's grammar reads them, so that its own words may be names as well.
_NAME_IN_TEXT = re.compile(r"(?<![\w.])[A-Za-z_]\w*", re.ASCII)

_NUMBER_IN_TEXT = re.compile(r"(?:\d+\.?\d*|\.\d+)(?:[eE][+-]?\d+)?", re.ASCII)

_NAME_PREFIX = "name_"

_PREFIX_IN_TEXT = re.compile(rf"\b{_NAME_PREFIX}", re.ASCII)

_LEADING_ZEROS = re.compile(r"(?<![\w.])0+(?=\d)", re.ASCII)

_TOO_DEEP = f"it is nested more than {MAXIMUM_DEPTH} times"

#: Functions of two arguments.
FUNCTIONS_OF_TWO: Mapping[str, Callable[[Any, Any], Any]] = {"min": np.minimum, "max": np.maximum}

NAMED_NUMBERS: Mapping[str, float] = {"pi": float(np.pi)}

#: What may stand in the first place of ``where``.
COMPARISONS: Mapping[type[ast.cmpop], Callable[[Any, Any], Any]] = {
    ast.Lt: np.less,
    ast.LtE: np.less_equal,
    ast.Gt: np.greater,
    ast.GtE: np.greater_equal,
}

ARITHMETIC: Mapping[type[ast.operator], Callable[[Any, Any], Any]] = {
    ast.Add: np.add,
    ast.Sub: np.subtract,
    ast.Mult: np.multiply,
    ast.Div: np.divide,
    ast.Pow: np.power,
}

#: Words that other languages decide with; names of these would be read as mistakes.
DECIDING_WORDS = frozenset({"if", "else", "and", "or", "not"})


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
            return self._evaluator(values, lambda operation: operation)

    def translated(self, values: Mapping[str, Any], translation: Translation) -> Any:
        """Return the value on other things than numbers."""
        return self._evaluator(values, translation)


def _parsed(text: str, rates: bool) -> Expression:
    return parse_expression(text, rates=rates)


def parse_expression(text: str, *, rates: bool = False) -> Expression:
    """Parse a text into an expression."""
    if len(text) > MAXIMUM_LENGTH:
        raise SpecError(f"An expression has {len(text)} characters: at most {MAXIMUM_LENGTH} are read.")
    reader = _Reader(text, rates=rates)
    try:
        with warnings.catch_warnings(action="ignore"):
            tree = ast.parse(reader.prefixed, mode="eval")
    except SyntaxError as error:
        raise reader.misread(error) from None
    except (RecursionError, MemoryError):  # Python's own limit of nesting
        raise reader.error(_TOO_DEEP) from None
    evaluator = reader.read(tree.body, 1)
    return Expression(text, frozenset(reader.names), evaluator, dict(reader.rates))


class _Reader:
    """Reads what the language knows of the tree that Python makes of a text."""

    def __init__(self, text: str, *, rates: bool) -> None:
        self.text, self.names = text, set[str]()
        self.rates, self.rates_allowed = dict[str, Expression](), rates
        # Python would take what follows a # for a comment, and a number that begins with 0 for a mistake.
        if foreign := re.search(r"[^\x01-\x7f]|#", text):
            raise self.error(f"{foreign[0]!r} is not allowed")
        plain = _LEADING_ZEROS.sub("", " ".join(text.split()))
        self.prefixed = _NAME_IN_TEXT.sub(rf"{_NAME_PREFIX}\g<0>", plain)

    def error(self, reason: str) -> SpecError:
        advice = "".join(f" {sentence}" for spelling, sentence in _OTHER_SPELLINGS if spelling.search(self.text))
        return SpecError(
            f"{self.text!r} is not a valid expression: {reason}. Allowed are numbers, names, + - * / **, parentheses "
            f"and the functions {', '.join([*FUNCTIONS, *FUNCTIONS_OF_TWO, 'where'])}.{advice}"
        )

    def misread(self, error: SyntaxError) -> SpecError:
        """Return the error of a text that Python cannot read, with what stands at the place."""
        if not self.prefixed or self.prefixed[-1] in "+-*/,":
            return self.error("it ends too early")
        rest = _PREFIX_IN_TEXT.sub("", self.prefixed[(error.offset or 1) - 1 :])
        return self.error(f"{error.msg}, at {rest!r}")

    def written(self, node: ast.expr) -> str:
        """Return a part of the text, without spaces."""
        return _PREFIX_IN_TEXT.sub("", self.prefixed[node.col_offset : node.end_col_offset]).replace(" ", "")

    def read(self, node: ast.expr, depth: int) -> Evaluator:
        """Return what evaluates a part of the tree."""
        text = self.written(node)
        if depth > MAXIMUM_DEPTH:
            raise self.error(_TOO_DEEP)
        match node:
            case ast.BinOp():
                return self.chain(node, depth + 1)
            case ast.UnaryOp(op=ast.UAdd()):
                return self.read(node.operand, depth + 1)
            case ast.UnaryOp(op=ast.USub()):
                return _operation(np.negative, self.read(node.operand, depth + 1))
            case ast.Call(func=ast.Name(), keywords=[]):
                return self.function(self.written(node.func), node.args, depth + 1)
            case ast.Constant() if _NUMBER_IN_TEXT.fullmatch(text):
                number = np.float64(text)
                return lambda values, _: number
            case ast.Name() if text in NAMED_NUMBERS:
                return lambda values, _: NAMED_NUMBERS[text]
            case ast.Name() if text not in DECIDING_WORDS:
                self.names.add(text)
                return lambda values, _: values[text]
        raise self.error(f"{text!r} is not allowed")

    def chain(self, node: ast.expr, depth: int) -> Evaluator:
        """Return what evaluates operations from left to right, in a loop: a long sum is no deep one."""
        operations: list[tuple[Callable[[Any, Any], Any], Evaluator]] = []
        while isinstance(node, ast.BinOp) and type(node.op) in ARITHMETIC:
            operations.insert(0, (ARITHMETIC[type(node.op)], self.read(node.right, depth)))
            node = node.left
        if isinstance(node, ast.BinOp):
            raise self.error(f"{self.written(node)!r} is not allowed")
        first = self.read(node, depth)

        def evaluated(values: Mapping[str, Any], translate: Translation) -> Any:
            value = first(values, translate)
            for operation, operand in operations:
                value = translate(operation)(value, operand(values, translate))
            return value

        return evaluated

    def function(self, name: str, arguments: Sequence[ast.expr], depth: int) -> Evaluator:
        """Return what evaluates a function; of values that ``where`` does not choose none is wanted: they need not
        exist."""
        if name == "der" and self.rates_allowed and len(arguments) == 1:
            return self.rate(arguments[0], depth)
        operation, operands = FUNCTIONS.get(name) or FUNCTIONS_OF_TWO.get(name), list[Evaluator]()
        count = 1 if name in FUNCTIONS else 2
        if name == "where":
            match arguments:
                case [ast.Compare(ops=[operator], comparators=[right]) as first, _, _] if type(operator) in COMPARISONS:
                    pair = self.read(first.left, depth), self.read(right, depth)
                    operands.append(_operation(COMPARISONS[type(operator)], *pair))
                case _:
                    raise self.error("where needs a comparison (<, <=, >, >=) and two values")
            operation, arguments = np.where, arguments[1:]
        if operation is None:
            raise self.error(f"there is no function {name!r}")
        if len(arguments) != count:
            raise self.error(f"{name} needs {'two arguments' if count == 2 else 'one argument'}")
        return _operation(operation, *operands, *(self.read(argument, depth) for argument in arguments))

    def rate(self, inner: ast.expr, depth: int) -> Evaluator:
        """Read what a derivative is taken of; it stands for a value of its own, found under its text."""
        outside, self.names, self.rates_allowed = self.names, set[str](), False
        text, evaluator = self.written(inner), self.read(inner, depth)
        expression = Expression(text, frozenset(self.names), evaluator)
        self.names, self.rates_allowed = outside, True
        key = f"der({text})"
        self.rates[key] = expression
        return lambda values, _: values[key]


def _operation(operation: Callable[..., Any], *operands: Evaluator) -> Evaluator:
    return lambda values, translate: translate(operation)(*(operand(values, translate) for operand in operands))
