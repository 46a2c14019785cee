"""Checking what a DAE is made of."""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import Any

import numpy as np

from obsynth.errors import SpecError
from obsynth.numerics import lazy_casadi as ca
from obsynth.numerics.arguments import is_finite_number, real_array
from obsynth.numerics.arrays import FloatArray
from obsynth.numerics.expressions import DECIDING_WORDS, FUNCTIONS, FUNCTIONS_OF_TWO, NAMED_NUMBERS
from obsynth.plants.dae.symbols import EQUALS, DAEFields, DAESymbols, symbols_of
from obsynth.plants.validation import Problems, checked_names

#: Names that mean something else in the language.
RESERVED = frozenset({*NAMED_NUMBERS, *FUNCTIONS, *FUNCTIONS_OF_TWO, *DECIDING_WORDS, "der", "where"})
#: An equation that is named by the derivative that it gives.
_DERIVATIVE_NAME = re.compile(r"der\(\w+\)")


def checked_signals(values: Mapping[str, float] | None, what: str) -> dict[str, float]:
    """Return names with finite nominal values; raise `SpecError` naming ``what`` otherwise."""
    checked = {}
    if values is not None and not isinstance(values, Mapping):
        raise SpecError(f"{what} must be a mapping from names to values.", path=what)
    for name, value in (values or {}).items():
        if not isinstance(name, str) or not name.isidentifier() or not name.isascii() or name in RESERVED:
            raise SpecError(f"{what} names {name!r}: use letters, digits and '_', and no function's name.", path=what)
        if not is_finite_number(value):
            raise SpecError(f"{what}.{name} is {value!r}: give a finite number.", path=f"{what}.{name}")
        checked[name] = float(value)
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


def check_distinct(model: DAEFields) -> None:
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


def check_structure(model: DAEFields, problems: Problems) -> None:
    """Note what is wrong with the equations as a whole: their number, empty ones, signals that enter nothing."""
    symbols = problems.collect(lambda: symbols_of(model))
    problems.raise_if_any()
    for check in (_square, _only_states_stored, _no_empty_equation):
        problems.collect(partial(check, model, symbols))
    _every_signal_used(model, symbols, problems)


def _square(model: DAEFields, symbols: DAESymbols) -> None:
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


def _only_states_stored(model: DAEFields, symbols: DAESymbols) -> None:
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
        raise SpecError(
            f"der(...){told} is taken of what contains no state, and is zero: take it of a state.", path="equations"
        )


def _no_empty_equation(model: DAEFields, symbols: DAESymbols) -> None:
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


def _every_signal_used(model: DAEFields, symbols: DAESymbols, problems: Problems) -> None:
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
    if not is_finite_number(dt) or not dt > 0.0:
        raise SpecError(f"dt is {dt!r}: give the seconds between samples, a positive number.", path="dt")
    return float(dt)


def checked_inputs(model: DAEFields, u: Any, samples: int | None = None) -> FloatArray:
    """Return known inputs ``(samples, nu)``; raise `SpecError` naming the signal and k where one is not finite."""
    if u is None and (model.nu or samples is None):
        raise SpecError(f"u is missing: the model has {model.nu} input(s), {', '.join(model.input_names)}.", path="u")
    raw = np.zeros((samples or 0, 0)) if u is None else np.asarray(u)
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
