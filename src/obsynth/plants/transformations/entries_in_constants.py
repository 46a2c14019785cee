"""Entries of a linear model as expressions in the constants of the nonlinear plant it was made from.

The model is taken at one point for all values of the constants, where the equations hold for the nominal ones alone:
what is left of them there for others is how the equilibrium moves, and acts like an input that is one in every row.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from obsynth.errors import PreconditionError, SpecError
from obsynth.numerics import lazy_casadi as ca
from obsynth.numerics.expressions import parse_expression
from obsynth.numerics.suggestions import there_are
from obsynth.plants.constants import Constant, ConstantsBox, constants_box
from obsynth.plants.dae import DAEModel
from obsynth.plants.dae_functions import symbolic_equations
from obsynth.plants.transformations.equilibrium import Point
from obsynth.plants.uncertain_system import stated_box
from obsynth.plants.uncertainty import Entry

#: How tightly an operation binds its operands, as the language reads it.
_SUM, _PRODUCT, _SIGN, _POWER, _ATOM = range(1, 6)


def promoted(model: DAEModel, names: Sequence[str]) -> DAEModel:
    """Return a model whose named constants are parameters, before those it has."""
    new = [name for name in names if name in model.constants]
    if not new:
        return model
    if not model.is_data:
        raise SpecError(
            f"{new[0]!r} is a constant of Python functions, and only equations given as texts can replace a constant: "
            "make it a parameter.",
            path=f"unknown.{new[0]}",
        )
    return model.replace(
        constants={name: value for name, value in model.constants.items() if name not in new},
        parameters={**{name: model.constants[name] for name in new}, **model.parameters},
        units={**dict.fromkeys(new, "1"), **model.units},
    )


def box_of_model(model: DAEModel, constants: Any, given: Mapping[str, float], **options: Any) -> ConstantsBox:
    """Return the box of constants and parameters of a model; nominal values that are left out are those it has."""
    known = {**model.constants, **model.parameters, **{name: given[name] for name in given if name in model.parameters}}
    constants = stated_box(constants, options.get("variation"))
    names = constants.constants if isinstance(constants, ConstantsBox) else constants
    unknown = [name for name in names if name not in known] if isinstance(names, Mapping) else []
    if unknown:
        raise SpecError(
            f"{unknown[0]!r} is no constant and no parameter of the model; {there_are(unknown[0], known)}",
            path=f"constants.{unknown[0]}",
        )
    nominal = {name: Constant(name, value, value, value) for name, value in known.items() if name in names}
    box = constants_box(constants, known=nominal, **options)
    for name, item in box.constants.items():
        if name in given and item.nominal != given[name]:
            raise SpecError(
                f"{name!r} is given as {given[name]:g}, and its nominal value as {item.nominal:g}.",
                path=f"given.{name}",
            )
    return replace(box, constants={item.name: item for item in box.uncertain})


def at_nominal(model: DAEModel, box: ConstantsBox) -> DAEModel:
    """Return the model with the nominal values of a box, whose constants are parameters then."""
    constants, parameters = (
        {name: box.constants[name].nominal if name in box.constants else value for name, value in values.items()}
        for values in (model.constants, model.parameters)
    )
    same = constants == dict(model.constants) and parameters == dict(model.parameters)
    return promoted(model if same else model.replace(constants=constants, parameters=parameters), box.names)


def entries_in_constants(
    model: DAEModel, point: Point, box: ConstantsBox, columns: Mapping[str, Sequence[int]], *, moving: bool
) -> tuple[dict[str, list[Entry]], list[Entry], list[Entry]]:
    """Return entries of the matrices that depend on the box, and of the equilibrium's shift in equations and outputs.
    ``columns``: inputs, known (``B``) and not (``Bd``), and parameters that are faults (``Bf``); ``moving``: the
    motion of the point is an input after the known ones."""
    return entries_in(model, point, {name: box.constants[name].nominal for name in box.names}, columns, moving=moving)


def entries_in(
    model: DAEModel, point: Point, nominal: Mapping[str, float], columns: Mapping[str, Sequence[int]], *, moving: bool
) -> tuple[dict[str, list[Entry]], list[Entry], list[Entry]]:
    """Return the same for parameters and inputs by their nominal values."""
    symbols = {name: ca.SX.sym(name) for name in nominal}
    u, theta = (
        ca.vertcat(ca.SX(0, 1), *(symbols.get(name, float(value)) for name, value in zip(names, values, strict=True)))
        for names, values in ((model.input_names, point.u), (model.parameter_names, point.theta))
    )
    local = symbolic_equations(model)(point.rates, point.x, u, theta)
    value, e, by_state, by_input, by_parameter, y, c, outputs_by_parameter = local
    known, unknown, faults = ([int(i) for i in columns[name]] for name in ("B", "Bd", "Bf"))
    b = -by_input[:, known]
    matrices = {
        "E": e,
        "A": -by_state,
        "B": ca.horzcat(b, e @ ca.DM(point.rates)) if moving else b,
        "C": c,
        "Bf": -by_parameter[:, faults],
        "Df": outputs_by_parameter[:, faults],
        "Bd": -by_input[:, unknown],
    }
    writer = _Writer(symbols)
    entries = {name: texts for name, matrix in matrices.items() if (texts := writer.entries(matrix, name))}
    return entries, writer.changes(value, -1.0, nominal), writer.changes(y, 1.0, nominal)


def require_linear_beside(model: DAEModel, scheduled: Sequence[str], faults: Sequence[str]) -> None:
    """Raise `PreconditionError` for an entry of the linear model that depends on a signal that is not scheduled."""
    kinds = (model.state_names, model.state_names, model.input_names, model.parameter_names)
    rates, x, u, theta = ([ca.SX.sym(name) for name in names] for names in kinds)
    moving = [*rates, *x, *(s for s in u if s.name() not in scheduled), *(s for s in theta if s.name() in faults)]
    local = symbolic_equations(model)(*(ca.vertcat(ca.SX(0, 1), *each) for each in (rates, x, u, theta)))
    _, e, by_state, by_input, by_parameter, _, c, outputs_by_parameter = local
    chosen = [i for i, name in enumerate(model.parameter_names) if name in faults]
    others = [i for i, name in enumerate(model.input_names) if name not in scheduled]
    equations = ca.horzcat(e, by_state, by_input[:, others], by_parameter[:, chosen])
    for matrix, names in (
        (equations, model.equation_names),
        (ca.horzcat(c, outputs_by_parameter[:, chosen]), model.output_names),
    ):
        for row, place in enumerate(names):
            causes = [each.name() for each in moving if ca.depends_on(matrix[row, :].T, each)]
            if causes:
                raise PreconditionError(
                    f"{place!r} is not linear in the signals that are not scheduled: its derivatives depend on "
                    f"{', '.join(map(repr, causes))}. A model over a region has no remainder. Take the nonlinear "
                    "equations (obsynth.region_observer); or, where what multiplies there is a measured input, a "
                    "parameter or a constant, schedule by it.",
                    condition="linear beside the scheduling",
                    signals=tuple(causes),
                )


class _Writer:
    """Writes CasADi's expressions in the language of the entries."""

    def __init__(self, symbols: Mapping[str, Any]) -> None:
        self.ca, self.symbols = ca, ca.vertcat(*symbols.values())
        self.operators = {
            ca.OP_ADD: ("+", _SUM, _SUM),
            ca.OP_SUB: ("-", _SUM, _PRODUCT),
            ca.OP_MUL: ("*", _PRODUCT, _PRODUCT),
            ca.OP_DIV: ("/", _PRODUCT, _SIGN),
            ca.OP_POW: ("**", _ATOM, _SIGN),
            ca.OP_CONSTPOW: ("**", _ATOM, _SIGN),
        }
        self.functions = {
            ca.OP_SQRT: "sqrt",
            ca.OP_EXP: "exp",
            ca.OP_LOG: "log",
            ca.OP_SIN: "sin",
            ca.OP_COS: "cos",
            ca.OP_TAN: "tan",
            ca.OP_ASIN: "asin",
            ca.OP_ACOS: "acos",
            ca.OP_ATAN: "atan",
            ca.OP_SINH: "sinh",
            ca.OP_COSH: "cosh",
            ca.OP_TANH: "tanh",
            ca.OP_FABS: "abs",
            ca.OP_SIGN: "sign",
            ca.OP_FLOOR: "floor",
            ca.OP_CEIL: "ceil",
            ca.OP_FMIN: "min",
            ca.OP_FMAX: "max",
        }
        self.forms = {
            ca.OP_NEG: ("-{}", _SIGN, _SIGN),
            ca.OP_SQ: ("{}**2", _ATOM, _POWER),
            ca.OP_INV: ("1 / {}", _SIGN, _PRODUCT),
            ca.OP_TWICE: ("2 * {}", _SIGN, _PRODUCT),
            ca.OP_LOG1P: ("log(1 + {})", _SUM, _ATOM),
            ca.OP_EXPM1: ("exp({}) - 1", _SUM, _SUM),
        }
        self.comparisons = {ca.OP_LT: "<", ca.OP_LE: "<="}

    def entries(self, matrix: Any, name: str) -> list[Entry]:
        """Return row, column and text of the entries that depend on the constants."""
        return [
            (i, j, self.whole(matrix[i, j], f"{name}, row {i + 1}, column {j + 1}"))
            for i in range(matrix.shape[0])
            for j in range(matrix.shape[1])
            if self._depends(matrix[i, j])
        ]

    def changes(self, column: Any, sign: float, nominal: Mapping[str, float]) -> list[Entry]:
        """Return texts of ``sign`` times how a column changes from its nominal value."""
        changes = []
        for i, _, text in self.entries(column, "the equilibrium's shift"):
            middle = float(parse_expression(text)(nominal))
            rest = f"{text} - {_number(middle)[0]}" if middle else text
            changes.append((i, 0, rest if sign > 0.0 else f"-({rest})"))
        return changes

    def whole(self, node: Any, place: str) -> str:
        """Return the text of one entry; `PreconditionError` where the language has none for it."""
        try:
            text = self._written(node)[0]
            parse_expression(text)
        except (KeyError, SpecError) as error:
            raise PreconditionError(
                f"{place} of the linear model depends on the constants through what cannot be written as an "
                "expression, or is too long for one: give them no tolerance, or write the equations in fewer steps.",
                condition="expressions",
            ) from error
        return text

    def _depends(self, node: Any) -> bool:
        return bool(self.ca.depends_on(node, self.symbols))

    def _written(self, node: Any) -> tuple[str, int]:
        ca = self.ca
        if node.is_constant():
            return _number(float(node))
        if node.is_symbolic():
            return str(node.name()), _ATOM
        operation, inner = node.op(), [node.dep(i) for i in range(node.n_dep())]
        if operation in self.operators:
            sign, left_level, right_level = self.operators[operation]
            return f"{self._in(inner[0], left_level)} {sign} {self._in(inner[1], right_level)}", min(left_level, _POWER)
        if operation in self.functions:
            return f"{self.functions[operation]}({', '.join(self._written(item)[0] for item in inner)})", _ATOM
        if operation in (*self.comparisons, ca.OP_NOT):
            return self._chosen(node, "1", "0"), _ATOM
        if operation == ca.OP_IF_ELSE_ZERO:
            return self._chosen(inner[0], self._written(inner[1])[0], "0"), _ATOM
        form, least, level = self.forms[operation]
        return form.format(self._in(inner[0], least)), level

    def _in(self, node: Any, least: int) -> str:
        """Return a text that stands where an operation binds, in parentheses where it binds less."""
        text, level = self._written(node)
        return text if level >= least else f"({text})"

    def _chosen(self, condition: Any, first: str, second: str) -> str:
        if condition.op() == self.ca.OP_NOT:
            return self._chosen(condition.dep(0), second, first)
        sign = self.comparisons[condition.op()]
        left_side, right_side = (self._written(condition.dep(i))[0] for i in range(2))
        return f"where({left_side} {sign} {right_side}, {first}, {second})"


def _number(value: float) -> tuple[str, int]:
    if not np.isfinite(value):
        raise KeyError(value)
    text = repr(abs(value))
    return (f"-{text}", _SIGN) if np.signbit(value) and value else (text, _ATOM)
