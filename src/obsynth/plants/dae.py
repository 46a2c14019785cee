"""Nonlinear differential-algebraic plants with unknown parameters: equations as CasADi expressions, and their
checks.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from dataclasses import fields as fields_of
from functools import cached_property, partial
from types import MappingProxyType
from typing import Any

import numpy as np

from obsynth.errors import SpecError
from obsynth.numerics import lazy_casadi as ca
from obsynth.numerics.arguments import real_array, real_number
from obsynth.numerics.arrays import FloatArray, as_given, read_only
from obsynth.numerics.expressions import (
    DECIDING_WORDS,
    FUNCTIONS,
    FUNCTIONS_OF_TWO,
    NAMED_NUMBERS,
    Expression,
    parse_expression,
    step_function,
)
from obsynth.numerics.libraries import imported
from obsynth.plants.checking import Problems, checked_units
from obsynth.plants.signal_names import checked_names

#: Names that mean something else in the language.
RESERVED = frozenset({*NAMED_NUMBERS, *FUNCTIONS, *FUNCTIONS_OF_TWO, *DECIDING_WORDS, "der", "where"})

#: An equation that is named by the derivative that it gives.
_DERIVATIVE_NAME = re.compile(r"der\(\w+\)")

#: The sign between two sides, which is no part of a comparison.
EQUALS = re.compile("(?<![<>=])=(?!=)")

Equations = Mapping[str, str] | Callable[..., Sequence[Any]]


def checked_signals(values: Mapping[str, float] | None, what: str) -> dict[str, float]:
    """Return names with finite nominal values; raise `SpecError` naming ``what`` otherwise."""
    checked = {}
    if values is not None and not isinstance(values, Mapping):
        raise SpecError(f"{what} must be a mapping from names to values.", path=what)
    for name, value in (values or {}).items():
        if not isinstance(name, str) or not name.isidentifier() or not name.isascii() or name in RESERVED:
            raise SpecError(f"{what} names {name!r}: use letters, digits and '_', and no function's name.", path=what)
        checked[name] = real_number(value, f"{what}.{name}", "a finite number")
    if what == "states" and not checked:
        raise SpecError("states is empty: a plant needs at least one.", path=what)
    return checked


def checked_texts(texts: Mapping[str, str], what: str) -> dict[str, str]:
    """Return names with texts; raise `SpecError` naming ``what`` otherwise."""
    if not isinstance(texts, Mapping):
        raise SpecError(f"{what} must be a mapping from names to texts, or a function.", path=what)
    for name, text in texts.items():
        if not isinstance(name, str) or not name.strip() or not isinstance(text, (str, int, float)):
            raise SpecError(f"{what}.{name} must be a text, such as 'area * der(level) = inflow'.", path=what)
        if what == "definitions" and (not name.isidentifier() or name in RESERVED):
            raise SpecError(f"{what} names {name!r}: use letters, digits and '_'.", path=what)
    found = {name: str(text) for name, text in texts.items()}
    return {name: _whole_equation(name, text) for name, text in found.items()} if what == "equations" else found


def _whole_equation(name: str, text: str) -> str:
    """Return an equation; under the name ``der(x)`` a text without that and without '=' says what that is."""
    rate = "".join(name.split())
    alone = _DERIVATIVE_NAME.fullmatch(rate) and not EQUALS.search(text) and rate not in "".join(text.split())
    return f"{rate} = {text}" if alone else text


def checked_equation_names(
    names: Sequence[str] | None, texts: Mapping[str, str] | Callable[..., Any], what: str, states: int
) -> tuple[str, ...]:
    """Return the names of equations or outputs: their keys, or what was given beside a function."""
    if not callable(texts):
        if names is not None:
            raise SpecError(f"{what} belongs to functions: texts have their names already.", path=what)
        return tuple(texts)
    if what == "output_names":
        if names is None:
            raise SpecError("output_names is missing: outputs given as a function need names.", path=what)
        return checked_names(names, len(names), prefix="y", what=what)
    return checked_names(names, states, prefix="equation ", what=what)


def check_distinct(model: DAEModel) -> None:
    """Raise `SpecError` when a name stands for two things."""
    groups = (model.states, model.inputs, model.parameters, model.constants, model.definitions)
    names = [name for group in groups for name in group]
    repeated = sorted({name for name in names if names.count(name) > 1})
    if repeated:
        raise SpecError(
            f"{', '.join(map(repr, repeated))} is named in more than one of states, inputs, parameters, constants and "
            "definitions.",
            path="states",
        )


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


def symbols_of(model: DAEModel) -> DAESymbols:
    """Return the symbols of a model."""
    return _from_functions(model) if callable(model.equations) else _from_texts(model, model.equations)


def _columns(model: DAEModel) -> tuple[Any, Any, Any]:
    return tuple(
        ca.vertcat(*(ca.SX.sym(name) for name in names)) if names else ca.SX(0, 1)
        for names in (model.state_names, model.input_names, model.parameter_names)
    )


def _from_texts(model: DAEModel, equations: Mapping[str, str]) -> DAESymbols:
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
    seen = [_text_value(text, known, f"outputs.{name}") for name, text in model.outputs.items()]
    return DAESymbols(rates, x, u, theta, ca.vertcat(*rows), ca.vertcat(*stored.values()), ca.vertcat(*seen))


def _text_value(text: str, known: Mapping[str, Any], path: str) -> Any:
    return _value(_parsed(text, path), known, path)


def _parsed(text: str, path: str, *, rates: bool = False) -> Expression:
    """Parse a text, and say where it stands when it is malformed."""
    try:
        return parse_expression(text, rates=rates)
    except SpecError as error:
        raise SpecError(f"{path}: {error}", path=path) from error


def equation_of(text: str, path: str) -> Expression:
    """Parse ``left = right``, or an expression that is zero."""
    sides = EQUALS.split(text, maxsplit=1)
    for side in sides:
        _parsed(side.strip(), path, rates=True)
    whole = _parsed(f"({sides[0]}) - ({sides[1]})" if len(sides) > 1 else text, path, rates=True)
    return replace(whole, text=text)


def _value(expression: Expression, known: Mapping[str, Any], path: str) -> Any:
    unknown = sorted(expression.names - set(known))
    if unknown:
        raise SpecError(
            f"{path}: {expression.text!r} uses {', '.join(map(repr, unknown))}, which is no state, input, parameter, "
            f"constant or earlier definition; there are: {', '.join(n for n in known if 'der(' not in n)}.",
            path=path,
        )
    return symbolic_value(expression, known)


def symbolic_value(expression: Expression, known: Mapping[str, Any]) -> Any:
    """Return a parsed expression of symbols by name as a symbol."""
    return ca.SX(expression.translated(known, _translation))


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
    found = special.get(operation) or getattr(ca, operation.__name__)

    return lambda *values: found(*(ca.SX(value) for value in values))


def _from_functions(model: DAEModel) -> DAESymbols:
    x, u, theta = _columns(model)
    stored = x if model.storage is None else _called(model.storage, (x, theta), "storage")
    rates = ca.SX.sym("rates", stored.numel())
    if not callable(model.outputs) or not callable(model.equations):
        raise SpecError(
            "The equations are a function, but the outputs are texts: give both in one way.", path="outputs"
        )
    rows = _called(model.equations, (rates, x, u, theta), "equations")
    seen = _called(model.outputs, (x, theta), "outputs")
    return DAESymbols(rates, x, u, theta, rows, stored, seen)


def _called(function: Callable[..., Any], columns: Sequence[Any], path: str) -> Any:
    """Call a user's function on lists of symbols, with numpy's functions meaning CasADi's meanwhile."""
    arguments = [[column[i] for i in range(column.numel())] for column in columns]
    mode = ca.GlobalOptions.getNumpyMode()
    ca.GlobalOptions.setNumpyMode(1)
    try:
        found = function(*arguments)
        if not isinstance(found, (list, tuple, np.ndarray, ca.SX)):
            raise SpecError(f"The function {path} must return a list with one expression for each entry.", path=path)
        entries = ca.vertsplit(ca.vec(found)) if isinstance(found, ca.SX) else list(found)
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
    function = ca.Function("found", list(columns), [column], {"allow_free": True})
    constants = (
        function.instruction_constant(i)
        for i in range(function.n_instructions())
        if function.instruction_id(i) == ca.OP_CONST
    )
    return any(np.isnan(constant) for constant in constants)


def check_structure(model: DAEModel, problems: Problems) -> None:
    """Note what is wrong with the equations as a whole: their number, empty ones, signals that enter nothing."""
    symbols = problems.collect(lambda: symbols_of(model))
    problems.raise_if_any()
    for check in (_square, _only_states_stored, _no_empty_equation):
        problems.collect(partial(check, model, symbols))
    _every_signal_used(model, symbols, problems)


def _square(model: DAEModel, symbols: DAESymbols) -> None:
    rows, ny = symbols.equations.numel(), symbols.outputs.numel()
    if rows != model.nx:
        few = "few" if rows < model.nx else "many"
        raise SpecError(
            f"There are {rows} equations for {model.nx} states ({', '.join(model.state_names)}): "
            f"{abs(rows - model.nx)} too {few}.",
            path="equations",
        )
    if ny != model.ny:
        raise SpecError(f"outputs returns {ny} expressions, but output_names has {model.ny} names.", path="outputs")
    if not ny:
        raise SpecError("outputs is empty: an observer needs at least one.", path="outputs")
    if _depends(symbols.outputs, symbols.u).any():
        raise SpecError(
            "An output depends on an input: add a state that equals the input, or subtract it from y.", path="outputs"
        )


def _only_states_stored(model: DAEModel, symbols: DAESymbols) -> None:
    found = _depends(symbols.stored, symbols.u)
    if found.any():
        name = model.input_names[int(np.argmax(found.any(axis=0)))]
        raise SpecError(
            f"der(...) is taken of the input {name!r}, whose derivative is not known: give the derivative as an input "
            "of its own, or write the balance with states only.",
            path="equations",
        )
    still = ~_depends(symbols.stored, symbols.x).any(axis=1)
    if still.any():
        where = [
            name
            for name, row in zip(
                model.equation_names, _depends(symbols.equations, symbols.rates)[:, still], strict=False
            )
            if row.any()
        ]
        told = f" in the equation {where[0]!r}" if where else ""
        raise SpecError(f"der(...){told} contains no state, so it is zero: differentiate a state.", path="equations")


def _no_empty_equation(model: DAEModel, symbols: DAESymbols) -> None:
    filled = _depends(symbols.equations, ca.vertcat(symbols.x, symbols.rates)).any(axis=1)
    empty = [repr(name) for name, full in zip(model.equation_names, filled, strict=False) if not full]
    if empty:
        raise SpecError(
            f"The equation {', '.join(empty)} contains neither a state nor a derivative of one: no solution can "
            "depend on it. Remove it together with a state, or correct it.",
            path="equations",
        )
    through_rates = _depends(symbols.equations, symbols.rates) @ _depends(symbols.stored, symbols.x)
    free = ~(_depends(symbols.equations, symbols.x) | through_rates).any(axis=0)
    if free.any():
        name = model.state_names[int(np.argmax(free))]
        raise SpecError(f"The state {name!r} enters no equation: nothing determines it.", path=f"states.{name}")


def _every_signal_used(model: DAEModel, symbols: DAESymbols, problems: Problems) -> None:
    """Note the first input and parameter that enter nothing, and the first output that nothing enters."""
    # What an output must not contain is said elsewhere.
    everything = ca.vertcat(symbols.equations, symbols.stored, symbols.outputs)
    seen = _depends(symbols.outputs, ca.vertcat(symbols.x, symbols.theta)).any(axis=1)
    for path, names, used, text in (
        (
            "inputs",
            model.input_names,
            _depends(everything, symbols.u).any(axis=0),
            "The input {!r} enters no equation: remove it, or use it.",
        ),
        (
            "parameters",
            model.parameter_names,
            _depends(everything, symbols.theta).any(axis=0),
            "The parameter {!r} enters no equation and no output: remove it, or use it.",
        ),
        (
            "outputs",
            model.output_names,
            seen,
            "The output {!r} contains neither a state nor a parameter: remove it.",
        ),
    ):
        idle = [name for name, enters in zip(names, used, strict=False) if not enters]
        if idle:
            problems.note(text.format(idle[0]), f"{path}.{idle[0]}")


def step_length(dt: Any) -> float:
    """Return the seconds between samples; raise `SpecError` unless they are a positive number."""
    return real_number(dt, "dt", "the seconds between samples, a positive number", above=0.0)


def checked_inputs(model: DAEModel, u: Any, samples: int | None = None) -> FloatArray:
    """Return known inputs ``(samples, nu)``; raise `SpecError` naming the signal and k where one is not finite."""
    if u is None and (model.nu or samples is None):
        raise SpecError(f"u is missing: the model has {model.nu} input(s), {', '.join(model.input_names)}.", path="u")
    raw = np.zeros((samples or 0, 0)) if u is None else as_given(u, "u", "u has rows of different lengths.")
    if raw.ndim == 1 and model.nu == 1:
        raw = raw[:, None]
    if raw.dtype.kind in "OUSbc" or raw.ndim != 2 or raw.shape[1] != model.nu:
        what = "no numbers" if raw.dtype.kind in "OUSbc" else f"of shape {raw.shape}"
        raise SpecError(f"u is {what}, but (samples, {model.nu}) numbers are needed.", path="u")
    array = raw.astype(np.float64)
    if not np.isfinite(array).all():
        k, i = np.argwhere(~np.isfinite(array))[0]
        raise SpecError(
            f"The input {model.input_names[i]!r} is {array[k, i]} at k = {k}: inputs must be known. Fill the gap, or "
            "make the signal a state with a sensor.",
            path="u",
        )
    if samples is not None and len(array) != samples:
        raise SpecError(f"u has {len(array)} samples and y has {samples}: give the same number.", path="u")
    return array


def finite_vector(value: Any, names: Sequence[str], default: FloatArray, what: str) -> FloatArray:
    """Return ``(len(names),)`` finite numbers, the default for ``None``; raise `SpecError` naming what is wrong."""
    if value is None:
        return np.array(default)
    try:
        vector = np.atleast_1d(real_array(value, what))
    except SpecError:
        raise SpecError(f"{what} must be {len(names)} finite number(s).", path=what) from None
    if vector.shape != (len(names),):
        raise SpecError(f"{what} must be {len(names)} finite number(s): {', '.join(names)}.", path=what)
    for name, entry in zip(names, vector, strict=True):
        if not np.isfinite(entry):
            raise SpecError(f"{what}.{name} is {entry}: give a finite number.", path=f"{what}.{name}")
    return vector


def _depends(expressions: Any, symbols: Any) -> Any:
    """Return which expression ``(rows)`` contains which symbol ``(columns)``."""
    pattern = ca.jacobian_sparsity(expressions, symbols)
    return np.array(ca.DM(pattern, 1.0).full() != 0.0).reshape(expressions.numel(), symbols.numel())


@dataclass(frozen=True, eq=False, init=False)
class DAEModel:
    r"""A nonlinear descriptor plant with constant or slowly changing parameters.

    .. math::
        F\left(\tfrac{d}{dt} q(x, \theta),\; x,\; u,\; \theta\right) = 0, \qquad y = h(x, \theta)

    As texts, ``der(...)`` may be taken of any expression of states: ``der(v * p / (R * T))`` is a balance in
    conservative form, whose discretisation neither makes nor loses mass.  As functions, ``q`` is ``storage`` (x
    itself by default).

    Parameters
    ----------
    equations : mapping of str to str, or callable
        Name -> ``"left = right"`` (or an expression that is zero; under the name ``der(x)``: what that is), as many as
        states; or a function ``F(rates, x, u, theta)`` of lists that returns a list, written with numpy's functions
        (``where`` instead of ``if``).
    outputs : mapping of str to str, or callable
        Name -> expression of states and parameters; or a function ``h(x, theta)`` that returns a list.
    states : mapping of str to float
        Name -> nominal value, which also scales it (one where the value is zero).
    inputs : mapping of str to float, optional
        Known inputs: name -> nominal value.
    parameters : mapping of str to float, optional
        Name -> nominal value.
    units : mapping of str to str, optional
        Unit of states, inputs, parameters, outputs and constants (``"1"`` for what has none).
    constants : mapping of str to float, optional
        Names that texts may use.
    definitions : mapping of str to str, optional
        Names for expressions, each of which may use those before it.
    storage : callable, optional
        ``q(x, theta)`` for equations given as a function.
    equation_names, output_names : list of str, optional
        For functions: names; ``equation 1, ...`` and ``y1, ...`` by default.

    Raises
    ------
    SpecError
        A text does not belong to the language or uses an unknown name; there are more or fewer equations than states;
        an equation contains neither states nor their derivatives; an input enters no equation, a parameter no equation
        and no output; a unit is missing; a derivative is taken of an input; a function decides with ``if`` on a state.

    Examples
    --------
    >>> tank = DAEModel(
    ...     {"balance": "area * der(level) = inflow - outflow", "valve": "outflow = c * sqrt(level)"},
    ...     {"flow": "outflow"}, states={"level": 1.0, "outflow": 0.5}, inputs={"inflow": 0.5}, parameters={"c": 0.5},
    ...     constants={"area": 2.0},
    ...     units={"level": "m", "outflow": "m3/s", "inflow": "m3/s", "c": "m2.5/s", "flow": "m3/s"},
    ... )
    >>> tank.nx, tank.nu, tank.ny, tank.nq
    (2, 1, 1, 1)

    References
    ----------
    .. [MoussaAliDAE2013] Adaptive observer based fault diagnosis applied to differential-algebraic systems, IFAC SSSC
       2013, (3)-(4).  There h does not depend on theta only in the derivation; (21) needs it, and we allow it.
    """

    equations: Equations
    outputs: Equations
    states: Mapping[str, float]
    inputs: Mapping[str, float]
    parameters: Mapping[str, float]
    constants: Mapping[str, float]
    definitions: Mapping[str, str]
    units: Mapping[str, str]
    storage: Callable[..., Sequence[Any]] | None
    equation_names: tuple[str, ...]
    output_names: tuple[str, ...]

    def __init__(
        self,
        equations: Equations,
        outputs: Equations,
        *,
        states: Mapping[str, float],
        units: Mapping[str, str] | None = None,
        inputs: Mapping[str, float] | None = None,
        parameters: Mapping[str, float] | None = None,
        constants: Mapping[str, float] | None = None,
        definitions: Mapping[str, str] | None = None,
        storage: Callable[..., Sequence[Any]] | None = None,
        equation_names: Sequence[str] | None = None,
        output_names: Sequence[str] | None = None,
    ) -> None:
        imported("casadi", extra="nonlinear", what="A nonlinear plant")
        problems = Problems()
        fields: dict[str, Any] = {"storage": storage}
        given = {"states": states, "inputs": inputs, "parameters": parameters, "constants": constants}
        for field, values in given.items():
            fields[field] = problems.collect(partial(checked_signals, values, field))
        for field, texts in (("equations", equations), ("outputs", outputs)):
            fields[field] = texts if callable(texts) else problems.collect(partial(checked_texts, texts, field))
        expressions = {} if definitions is None else definitions
        fields["definitions"] = problems.collect(partial(checked_texts, expressions, "definitions"))
        problems.raise_if_any()
        for field, names, what in (
            ("equation_names", equation_names, "equations"),
            ("output_names", output_names, "outputs"),
        ):
            fields[field] = problems.collect(partial(checked_equation_names, names, fields[what], field, len(states)))
        problems.raise_if_any()
        for field, value in fields.items():
            object.__setattr__(self, field, MappingProxyType(value) if isinstance(value, dict) else value)
        problems.collect(lambda: check_distinct(self))
        problems.raise_if_any()
        check_structure(self, problems)
        required = [*self.state_names, *self.input_names, *self.parameter_names, *self.output_names]
        known = {*required, *self.constants, *self.definitions}
        object.__setattr__(self, "units", problems.collect(lambda: checked_units(units, known)))
        problems.raise_if_any()

    @property
    def state_names(self) -> tuple[str, ...]:
        """Names of the states, in order."""
        return tuple(self.states)

    @property
    def input_names(self) -> tuple[str, ...]:
        """Names of the known inputs, in order."""
        return tuple(self.inputs)

    @property
    def parameter_names(self) -> tuple[str, ...]:
        """Names of the parameters, in order."""
        return tuple(self.parameters)

    @property
    def nx(self) -> int:
        """Number of states, and of equations."""
        return len(self.states)

    @property
    def nu(self) -> int:
        """Number of known inputs."""
        return len(self.inputs)

    @property
    def ny(self) -> int:
        """Number of outputs."""
        return len(self.output_names)

    @property
    def nq(self) -> int:
        """Number of parameters."""
        return len(self.parameters)

    @property
    def nominal_state(self) -> FloatArray:
        """Nominal values of the states ``(nx,)``."""
        return read_only(np.array(list(self.states.values()), dtype=np.float64))

    @property
    def nominal_input(self) -> FloatArray:
        """Nominal values of the inputs ``(nu,)``."""
        return read_only(np.array(list(self.inputs.values()), dtype=np.float64))

    @property
    def nominal_parameters(self) -> FloatArray:
        """Nominal values of the parameters ``(nq,)``."""
        return read_only(np.array(list(self.parameters.values()), dtype=np.float64))

    @property
    def state_scales(self) -> FloatArray:
        """Size of each state ``(nx,)``: its nominal value, or one where that is zero."""
        sizes = np.abs(self.nominal_state)
        return read_only(np.where(sizes > 0.0, sizes, 1.0))

    @property
    def is_data(self) -> bool:
        """Whether the model is given as texts, so that it can be saved."""
        return not callable(self.equations)

    @cached_property
    def graphs(self) -> dict[tuple[Any, ...], Any]:
        """CasADi functions that were made of the model, by what they were made for, so that each is made once."""
        return {}

    def as_dict(self) -> dict[str, Any]:
        """Return every field as data, as the constructor takes it.

        Raises
        ------
        SpecError
            The model is given as Python functions.
        """
        if callable(self.equations) or callable(self.outputs):
            raise SpecError(
                "The model is given as Python functions, which cannot be saved as data: write its equations as texts.",
                path="equations",
            )
        return {name: dict(value) for name, value in self._given().items() if name != "storage"}

    def _given(self) -> dict[str, Any]:
        """Return the arguments of the constructor."""
        given = {field.name: getattr(self, field.name) for field in fields_of(self)}
        if self.is_data:
            del given["equation_names"], given["output_names"]
        return given

    def __reduce__(self) -> tuple[Any, ...]:
        """Return what makes it again in another process: read-only mappings do not travel, functions by their names."""
        given: dict[str, Any] = {
            name: dict(value) if isinstance(value, Mapping) else value for name, value in self._given().items()
        }
        return partial(DAEModel, **given), ()

    def replace(self, **changes: Any) -> DAEModel:
        """Return a model with some fields changed, checked again as a whole.

        Parameters
        ----------
        **changes
            Any argument of the constructor.
        """
        return DAEModel(**{**self._given(), **changes})

    def __repr__(self) -> str:
        return f"DAEModel(nx={self.nx}, nu={self.nu}, ny={self.ny}, nq={self.nq}, states={list(self.states)})"
