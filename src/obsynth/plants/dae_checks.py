"""Checks of a nonlinear plant as a whole: number of equations, empty equations, signals without effect."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from typing import Any

import numpy as np

from obsynth.errors import SpecError, counted
from obsynth.numerics import lazy_casadi as ca
from obsynth.numerics.arrays import FloatArray
from obsynth.plants.checking import Problems
from obsynth.plants.dae_equations import DAESymbols, symbols_of
from obsynth.plants.dae_fields import DAEFields

#: Where an expression has no value, and where it has one but no finite derivative.
_NO_VALUE = "a root of a negative number, a logarithm of zero or less, asin or acos beyond 1, a division by zero?"
_NO_DERIVATIVE = "a root at zero, asin or acos at 1 or -1?"


def without_value(
    names: Sequence[str], residual: FloatArray, jacobian: FloatArray, *, where: str
) -> tuple[list[str], str]:
    """Return the equations without a value, where all have one those without finite derivatives, and that in words.

    ``names``: of the rows of ``residual (n,)`` and ``jacobian (n, m)``; ``where`` they were asked, such as "at the
    nominal values".  Nothing where all is finite.
    """
    has_value, is_smooth = np.isfinite(residual), np.isfinite(jacobian).all(axis=1)
    what, reasons = ("no finite derivative", _NO_DERIVATIVE) if has_value.all() else ("no value", _NO_VALUE)
    rows: list[bool] = np.logical_not(is_smooth if has_value.all() else has_value).tolist()
    bad = list(dict.fromkeys(name for name, is_bad in zip(names, rows, strict=True) if is_bad))
    if not bad:
        return [], ""
    subject = f"the equation {bad[0]!r} has" if len(bad) == 1 else f"the equations {', '.join(map(repr, bad))} have"
    return bad, f"{subject} {what} {where} ({reasons})"


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
            f"There {'is' if rows == 1 else 'are'} {counted(rows, 'equation')} for {counted(model.nx, 'state')} "
            f"({', '.join(model.state_names)}): "
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
    by_input = _depends(symbols.stored, symbols.u)
    if by_input.any():
        name = model.input_names[int(np.argmax(by_input.any(axis=0)))]
        raise SpecError(
            f"der(...) is taken of the input {name!r}, whose derivative is not known: give the derivative as an input "
            "of its own, or write the balance with states only.",
            path="equations",
        )
    still = ~_depends(symbols.stored, symbols.x).any(axis=1)
    if still.any():
        equations = [
            name
            for name, row in zip(
                model.equation_names, _depends(symbols.equations, symbols.rates)[:, still], strict=False
            )
            if row.any()
        ]
        place = f" in the equation {equations[0]!r}" if equations else ""
        raise SpecError(f"der(...){place} contains no state, so it is zero: differentiate a state.", path="equations")


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
    determined = _depends(symbols.outputs, ca.vertcat(symbols.x, symbols.theta)).any(axis=1)
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
            determined,
            "The output {!r} contains neither a state nor a parameter: remove it.",
        ),
    ):
        idle = [name for name, enters in zip(names, used, strict=False) if not enters]
        if idle:
            problems.note(text.format(idle[0]), f"{path}.{idle[0]}")


def _depends(expressions: Any, symbols: Any) -> Any:
    """Return which expression ``(rows)`` contains which symbol ``(columns)``."""
    pattern = ca.jacobian_sparsity(expressions, symbols)
    return np.array(ca.DM(pattern, 1.0).full() != 0.0).reshape(expressions.numel(), symbols.numel())
