"""Nonlinear differential-algebraic plants with unknown parameters."""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from dataclasses import fields as fields_of
from functools import cached_property, partial
from types import MappingProxyType
from typing import Any

import numpy as np

from obsynth.errors import SpecError
from obsynth.numerics.arguments import real_number
from obsynth.numerics.arrays import FloatArray, read_only
from obsynth.numerics.expressions import DECIDING_WORDS, FUNCTIONS, FUNCTIONS_OF_TWO, NAMED_NUMBERS
from obsynth.numerics.libraries import imported
from obsynth.plants.checking import Problems, checked_units
from obsynth.plants.dae_checks import check_distinct, check_structure
from obsynth.plants.dae_equations import EQUALS
from obsynth.plants.dae_feedthrough import with_inputs_as_states
from obsynth.plants.dae_fields import DAEFields, Equations
from obsynth.plants.other_names import plant_keywords_suggested
from obsynth.plants.signal_names import checked_names

#: Names that mean something else in the language.
RESERVED = frozenset({*NAMED_NUMBERS, *FUNCTIONS, *FUNCTIONS_OF_TWO, *DECIDING_WORDS, "der", "where"})

#: An equation that is named by the derivative that it gives.
_DERIVATIVE_NAME = re.compile(r"der\(\w+\)")


@dataclass(frozen=True, eq=False, init=False)
class DAEModel(DAEFields):
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
        Name -> expression of states and parameters; or a function ``h(x, theta)`` that returns a list.  Each input that
        texts read becomes a state ``NAME_now`` that equals it (its equation has no noise, unless Q names it).
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

    @plant_keywords_suggested
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
        signals = {"states": states, "inputs": inputs, "parameters": parameters, "constants": constants}
        for field, values in signals.items():
            fields[field] = problems.collect(partial(_checked_signals, values, field))
        for field, texts in (("equations", equations), ("outputs", outputs)):
            fields[field] = texts if callable(texts) else problems.collect(partial(_checked_texts, texts, field))
        expressions = {} if definitions is None else definitions
        fields["definitions"] = problems.collect(partial(_checked_texts, expressions, "definitions"))
        problems.raise_if_any()
        if not callable(equations) and not callable(outputs):
            fields = with_inputs_as_states(fields)
        for field, names, what in (
            ("equation_names", equation_names, "equations"),
            ("output_names", output_names, "outputs"),
        ):
            fields[field] = problems.collect(partial(_checked_equation_names, names, fields[what], field, len(states)))
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
        arguments = {field.name: getattr(self, field.name) for field in fields_of(self)}
        if self.is_data:
            del arguments["equation_names"], arguments["output_names"]
        return arguments

    def __reduce__(self) -> tuple[Any, ...]:
        """Return what makes it again in another process: read-only mappings do not travel, functions by their names."""
        arguments: dict[str, Any] = {
            name: dict(value) if isinstance(value, Mapping) else value for name, value in self._given().items()
        }
        return partial(DAEModel, **arguments), ()

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


def _checked_signals(values: Mapping[str, float] | None, what: str) -> dict[str, float]:
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


def _checked_texts(texts: Mapping[str, str], what: str) -> dict[str, str]:
    """Return names with texts; raise `SpecError` naming ``what`` otherwise."""
    if not isinstance(texts, Mapping):
        raise SpecError(f"{what} must be a mapping from names to texts, or a function.", path=what)
    for name, text in texts.items():
        if not isinstance(name, str) or not name.strip() or not isinstance(text, (str, int, float)):
            raise SpecError(f"{what}.{name} must be a text, such as 'area * der(level) = inflow'.", path=what)
        if what == "definitions" and (not name.isidentifier() or name in RESERVED):
            raise SpecError(f"{what} names {name!r}: use letters, digits and '_'.", path=what)
    checked = {name: str(text) for name, text in texts.items()}
    return {name: _whole_equation(name, text) for name, text in checked.items()} if what == "equations" else checked


def _whole_equation(name: str, text: str) -> str:
    """Return an equation; under the name ``der(x)`` a text without that and without '=' says what that is."""
    rate = "".join(name.split())
    alone = _DERIVATIVE_NAME.fullmatch(rate) and not EQUALS.search(text) and rate not in "".join(text.split())
    return f"{rate} = {text}" if alone else text


def _checked_equation_names(
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
