"""Equations of a nonlinear differential-algebraic plant as CasADi expressions, from texts or from functions."""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from obsynth.errors import SpecError
from obsynth.numerics import lazy_casadi as ca
from obsynth.numerics.expressions import Expression, parse_expression, step_function
from obsynth.numerics.suggestions import there_are
from obsynth.plants.dae_fields import DAEFields

#: The sign between two sides, which is no part of a comparison.
EQUALS = re.compile("(?<![<>=])=(?!=)")

#: How the time is called elsewhere, and how Leibniz writes a derivative.
_TIMES, _LEIBNIZ = ("t", "time", "Time"), re.compile(r"\bd\w+\s*/\s*dt\b")


@dataclass(frozen=True, eq=False)
class DAESymbols:
    """``F(q', x, u, theta) = 0``, ``y = h(x, theta)``, q ``stored``, as columns of CasADi's SX; ``rates`` is q'."""

    rates: Any
    x: Any
    u: Any
    theta: Any
    equations: Any
    stored: Any
    outputs: Any


def symbols_of(model: DAEFields) -> DAESymbols:
    """Return the symbols of a model."""
    return _from_functions(model) if callable(model.equations) else _from_texts(model, model.equations)


def equation_of(text: str, path: str) -> Expression:
    """Parse ``left = right``, or an expression that is zero."""
    sides = EQUALS.split(text, maxsplit=1)
    for side in sides:
        _parsed(side.strip(), path, rates=True)
    whole = _parsed(f"({sides[0]}) - ({sides[1]})" if len(sides) > 1 else text, path, rates=True)
    return replace(whole, text=text)


def symbolic_value(expression: Expression, known: Mapping[str, Any]) -> Any:
    """Return a parsed expression of symbols by name as a symbol."""
    return ca.SX(expression.translated(known, _translation))


def _from_texts(model: DAEFields, equations: Mapping[str, str]) -> DAESymbols:
    x, u, theta = _columns(model)
    known: dict[str, Any] = dict(model.constants)
    for names, column in ((model.state_names, x), (model.input_names, u), (model.parameter_names, theta)):
        known |= {name: column[i] for i, name in enumerate(names)}
    for name, text in model.definitions.items():
        known[name] = _text_value(text, known, f"definitions.{name}")
    parsed = {name: equation_of(text, f"equations.{name}") for name, text in equations.items()}
    stored: dict[str, Any] = {}
    for name, expression in parsed.items():
        for key, inner in expression.rates.items():
            stored.setdefault(key, _value(inner, known, f"equations.{name}"))
    rates = ca.SX.sym("rates", len(stored))
    with_rates = known | {key: rates[i] for i, key in enumerate(stored)}
    rows = [_value(expression, with_rates, f"equations.{name}") for name, expression in parsed.items()]
    if callable(model.outputs):
        raise SpecError(
            "The equations are texts, but the outputs are a function: give both in one way.", path="outputs"
        )
    outputs = [_text_value(text, known, f"outputs.{name}") for name, text in model.outputs.items()]
    return DAESymbols(rates, x, u, theta, ca.vertcat(*rows), ca.vertcat(*stored.values()), ca.vertcat(*outputs))


def _from_functions(model: DAEFields) -> DAESymbols:
    x, u, theta = _columns(model)
    stored = x if model.storage is None else _called(model.storage, (x, theta), "storage")
    rates = ca.SX.sym("rates", stored.numel())
    if not callable(model.outputs) or not callable(model.equations):
        raise SpecError(
            "The equations are a function, but the outputs are texts: give both in one way.", path="outputs"
        )
    rows = _called(model.equations, (rates, x, u, theta), "equations")
    outputs = _called(model.outputs, (x, theta), "outputs")
    return DAESymbols(rates, x, u, theta, rows, stored, outputs)


def _columns(model: DAEFields) -> tuple[Any, Any, Any]:
    return tuple(
        ca.vertcat(*(ca.SX.sym(name) for name in names)) if names else ca.SX(0, 1)
        for names in (model.state_names, model.input_names, model.parameter_names)
    )


def _text_value(text: str, known: Mapping[str, Any], path: str) -> Any:
    return _value(_parsed(text, path), known, path)


def _parsed(text: str, path: str, *, rates: bool = False) -> Expression:
    """Parse a text, and say where it stands when it is malformed."""
    try:
        return parse_expression(text, rates=rates)
    except SpecError as error:
        raise SpecError(f"{path}: {error}", path=path) from error


def _value(expression: Expression, known: Mapping[str, Any], path: str) -> Any:
    unknown = sorted(expression.names - set(known))
    if unknown:
        raise SpecError(
            f"{path}: {expression.text!r} uses {', '.join(map(repr, unknown))}, which is no state, input, parameter, "
            f"constant or earlier definition; {there_are(unknown[0], (n for n in known if 'der(' not in n))}"
            f"{_advice(expression.text, unknown)}",
            path=path,
        )
    return symbolic_value(expression, known)


def _advice(text: str, unknown: Sequence[str]) -> str:
    """Return what to write for a derivative or for the time, as a sentence, where a text seems to mean one."""
    if any(name in _TIMES for name in unknown):
        return " What depends on time by itself is an input: a column of the log."
    return " A derivative in an equation is written der(x)." if _LEIBNIZ.search(text) else ""


def _translation(operation: Callable[..., Any]) -> Callable[..., Any]:
    """Return CasADi's operation for one of numpy's: the names agree but for a few."""
    special: dict[Callable[..., Any], Callable[..., Any]] = {
        np.add: ca.plus,
        np.subtract: ca.minus,
        np.multiply: ca.times,
        np.divide: ca.rdivide,
        np.power: ca.power,
        np.negative: lambda a: -a,
        np.arcsin: ca.asin,
        np.arccos: ca.acos,
        np.arctan: ca.atan,
        np.abs: ca.fabs,
        np.minimum: ca.fmin,
        np.maximum: ca.fmax,
        step_function: lambda a: ca.if_else(a >= 0.0, 1.0, 0.0),
        np.where: ca.if_else,
        np.less: ca.lt,
        np.less_equal: ca.le,
        np.greater: ca.gt,
        np.greater_equal: ca.ge,
    }
    casadi_operation = special.get(operation) or getattr(ca, operation.__name__)

    return lambda *values: casadi_operation(*(ca.SX(value) for value in values))


def _called(function: Callable[..., Any], columns: Sequence[Any], path: str) -> Any:
    """Call a user's function on lists of symbols, with numpy's functions meaning CasADi's meanwhile."""
    arguments = [[column[i] for i in range(column.numel())] for column in columns]
    mode = ca.GlobalOptions.getNumpyMode()
    ca.GlobalOptions.setNumpyMode(1)
    try:
        returned = function(*arguments)
        if not isinstance(returned, (list, tuple, np.ndarray, ca.SX)):
            raise SpecError(f"The function {path} must return a list with one expression for each entry.", path=path)
        entries = ca.vertsplit(ca.vec(returned)) if isinstance(returned, ca.SX) else list(returned)
        column = ca.vertcat(*(ca.SX(entry) for entry in entries)) if entries else ca.SX(0, 1)
    except (ArithmeticError, AttributeError, LookupError, RuntimeError, TypeError, ValueError) as error:
        if "truth value" in str(error):
            raise SpecError(
                f"The function {path} decides with `if` (or `and`, `or`, `min`, `max`) on a state, which has no value "
                "yet: use numpy.where(condition, a, b), numpy.logical_and, numpy.minimum or numpy.maximum.",
                path=path,
            ) from error
        raise _not_symbolic(path, len(columns), f"{type(error).__name__}: {str(error).splitlines()[0]}") from error
    finally:
        ca.GlobalOptions.setNumpyMode(mode)
    if _holds_nan(column, columns):
        # A symbol made into a number, such as by the functions of `math`.
        raise _not_symbolic(path, len(columns), "an expression is not a number")
    return column


def _not_symbolic(path: str, count: int, reason: str) -> SpecError:
    taken = {4: "rates, x, u, theta", 2: "x, theta"}[count]
    return SpecError(
        f"The function {path} cannot be called on symbols: {reason}. It takes lists ({taken}), in the order of the "
        "names, and returns a list; use numpy's functions (sqrt, where, minimum, ...) in place of those of math, and "
        "no numbers that are made of a state, such as int(x) or range(x).",
        path=path,
    )


def _holds_nan(column: Any, columns: Sequence[Any]) -> bool:
    function = ca.Function("called", list(columns), [column], {"allow_free": True})
    constants = (
        function.instruction_constant(i)
        for i in range(function.n_instructions())
        if function.instruction_id(i) == ca.OP_CONST
    )
    return any(np.isnan(constant) for constant in constants)
