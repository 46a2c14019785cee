r"""From equations to matrices: exact linear models of nonlinear plants at rest, or at a point of a motion.

Where such a plant rests, or the exact reason why it rests nowhere, comes first; then entries as expressions in the
constants of the plant. The model is taken at one point for all values of the constants, where the equations hold for
the nominal ones alone: what is left of them there for others is how the equilibrium moves, and acts like an input that
is one in every row.

A nonlinear plant as its sampled linear model with a bound on what that leaves out, over a region.

The equations are evaluated in affine arithmetic over the region: what is not linear is bounded, with all rounding.
Between samples it may do anything within its bound:

.. math::
    \xi_{k+1} = A \xi_k + B u_k + B_f f_k + \rho_k, \qquad
    |\rho| \le \int_0^h |e^{A s}| \, ds \; r .
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from obsynth.analysis.transformations.linear_plants import discretise
from obsynth.analysis.transformations.uncertain_plant import reduced_matrices
from obsynth.errors import PreconditionError, SpecError
from obsynth.numerics import lazy_casadi as ca
from obsynth.numerics.arguments import FloatArray, arguments_checked, is_finite_number, real_number
from obsynth.numerics.expressions import parse_expression
from obsynth.numerics.ranks import JACOBIAN_RANK_TOLERANCE
from obsynth.plants.constants import Constant, ConstantsBox, Entry, Uncertainty, constants_box, matrices_of
from obsynth.plants.dae import DAEModel, LocalEquations, equation_of, local_equations, symbolic_equations, symbols_of
from obsynth.plants.descriptor import DescriptorSystem, index_of
from obsynth.plants.uncertain_system import filled_plant, stated_box
from obsynth.proofs.affine import (
    AffineMatrix,
    AffineNumber,
    affine_block,
    affine_exponential,
    affine_translation,
    affine_zero_order_hold,
)
from obsynth.proofs.balls import UNIT_ROUNDOFF, gamma, rounded_up

#: Largest scaled residual of what counts as a root.
ROOT_RESIDUAL = 1e-9
#: Entries of a direction, and of a combination of equations, below this share of the largest are not named.
NAMED = 1e-6
#: Newton steps after the least squares; they square the error, so that a few reach rounding.
POLISH = 8
#: Derivatives satisfy the equations where the weighted residual is below this.
CONSISTENT = 1e-3 * ROOT_RESIDUAL
#: Stands in a search for a residual that is not finite.
HUGE = 1e10
MOST_ROOT_EVALUATIONS = 400


@dataclass(frozen=True, eq=False)
class Point:
    """States ``(nx,)``, inputs ``(nu,)``, parameters ``(nq,)`` and the states' derivatives ``(nx,)`` at one moment."""

    x: FloatArray
    u: FloatArray
    theta: FloatArray
    rates: FloatArray


def nominal_point(model: DAEModel, given: Mapping[str, float], free: Sequence[str] = ()) -> Point:
    """Return the nominal point with what is given by name in place; outputs are left to the caller."""
    x, u, theta = (np.array(v) for v in (model.nominal_state, model.nominal_input, model.nominal_parameters))
    places = ((model.state_names, x), (model.input_names, u), (model.parameter_names, theta))
    known = [*model.state_names, *model.input_names, *model.parameter_names, *model.output_names]
    for name, value in given.items():
        index_of(name, known, what="given")
        real_number(value, f"given.{name}", "a finite number")
        if name in free:
            raise SpecError(f"{name!r} is both given and free: choose one.", path=f"given.{name}")
        for names, vector in places:
            if name in names:
                vector[names.index(name)] = float(value)
    for name in free:
        index_of(name, [*model.input_names, *model.parameter_names], what="free")
    return Point(x, u, theta, np.zeros(model.nx))


def equilibrium(
    model: DAEModel, given: Mapping[str, float], free: Sequence[str], start: Mapping[str, float] | None = None
) -> Point:
    """Return the point where nothing moves, what is given holds, what is free is as it must be, or why none is."""
    problem = _Problem(model, given, free, start or {})
    z = problem.solved()
    residual, jacobian = problem.scaled(z)
    if not (np.isfinite(residual).all() and np.isfinite(jacobian).all()):
        raise problem.undefined(residual, jacobian)
    left, values, right = np.linalg.svd(jacobian)
    rank = int((values > JACOBIAN_RANK_TOLERANCE * values.max()).sum()) if values.size else 0
    if not np.abs(residual).max(initial=0.0) <= ROOT_RESIDUAL:
        raise problem.without_root(residual, left[:, rank:])
    if rank < len(problem.names):
        raise problem.not_unique(right[rank:])
    return problem.point(z)


class _Problem:
    """Equations of rest with scaled unknowns: states that are not given, then what is free."""

    def __init__(
        self, model: DAEModel, given: Mapping[str, float], free: Sequence[str], start: Mapping[str, float]
    ) -> None:
        self.model, self.base = model, nominal_point(model, given, free)
        for name, value in start.items():
            if name not in given:
                self.base.x[index_of(name, model.state_names, what="start")] = real_number(value, f"start.{name}")
        self.states = [i for i, name in enumerate(model.state_names) if name not in given]
        self.inputs, self.parameters = (
            [names.index(name) for name in free if name in names]
            for names in (model.input_names, model.parameter_names)
        )
        others = (*model.state_names, *model.input_names, *model.parameter_names)
        self.seen = [i for i, name in enumerate(model.output_names) if name in given and name not in others]
        self.wanted = np.array([given[model.output_names[i]] for i in self.seen])
        groups = (
            (model.state_names, self.states),
            (model.input_names, self.inputs),
            (model.parameter_names, self.parameters),
        )
        self.names = [names[i] for names, places in groups for i in places]
        self.rows = [*model.equation_names, *(f"given {model.output_names[i]}" for i in self.seen)]
        begin = np.concatenate([self.base.x[self.states], self.base.u[self.inputs], self.base.theta[self.parameters]])
        freed = np.abs(begin[len(self.states) :])
        self.sizes = np.concatenate([model.state_scales[self.states], np.where(freed > 0.0, freed, 1.0)])
        self.begin: FloatArray = np.asarray(begin / self.sizes)
        jacobian = self.raw(self.begin)[1]
        if not np.isfinite(jacobian).all():
            raise SpecError(
                "The model is not defined at its nominal values: give other ones by start or given.", path="start"
            )
        self.weights = _row_weights(jacobian)

    def point(self, z: FloatArray) -> Point:
        """Return the whole point of scaled unknowns."""
        x, u, theta = np.array(self.base.x), np.array(self.base.u), np.array(self.base.theta)
        x[self.states], u[self.inputs], theta[self.parameters] = np.split(
            z * self.sizes, [len(self.states), len(self.states) + len(self.inputs)]
        )
        return Point(x, u, theta, np.zeros(self.model.nx))

    def raw(self, z: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return what is left of each row, and its derivatives with respect to the scaled unknowns."""
        p = self.point(z)
        local = local_equations(self.model, p.rates, p.x, p.u, p.theta)
        top = np.hstack(
            [local.by_state[:, self.states], local.by_input[:, self.inputs], local.by_parameter[:, self.parameters]]
        )
        bottom = np.hstack(
            [
                local.C[:, self.states],
                np.zeros((self.model.ny, len(self.inputs))),
                local.outputs_by_parameter[:, self.parameters],
            ]
        )[self.seen]
        return np.concatenate([local.value, local.y[self.seen] - self.wanted]), np.vstack([top, bottom]) * self.sizes

    def scaled(self, z: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return `raw` with rows scaled by their size at the start."""
        residual, jacobian = self.raw(z)
        return np.asarray(self.weights * residual), np.asarray(self.weights[:, None] * jacobian)

    def solved(self) -> FloatArray:
        """Return the scaled unknowns that satisfy the rows best."""
        from scipy.optimize import least_squares

        if not self.names:
            return self.begin

        def finite(part: int) -> Callable[[FloatArray], FloatArray]:
            # Outside the region where the model is defined a large number turns the search back.
            return lambda z: np.nan_to_num(self.scaled(z)[part], nan=HUGE, posinf=HUGE, neginf=-HUGE)

        # As far as rounding allows.
        exact = np.finfo(np.float64).eps * 4.0
        z = np.asarray(
            least_squares(
                finite(0),
                self.begin,
                jac=finite(1),
                xtol=exact,
                ftol=exact,
                gtol=exact,
                max_nfev=MOST_ROOT_EVALUATIONS,
                method="lm" if len(self.rows) >= len(self.names) else "trf",
            ).x
        )
        for _ in range(POLISH):
            residual, jacobian = self.scaled(z)
            if not (np.isfinite(residual).all() and np.isfinite(jacobian).all()):
                break
            after = z - np.linalg.lstsq(jacobian, residual, rcond=JACOBIAN_RANK_TOLERANCE)[0]
            if not np.abs(self.scaled(after)[0]).max() < np.abs(residual).max():
                break
            z = after
        return z

    def undefined(self, residual: FloatArray, jacobian: FloatArray) -> PreconditionError:
        """Return the refusal of a place where equations have no value."""
        bad = [
            name
            for name, value, row in zip(self.rows, residual, jacobian, strict=True)
            if not (np.isfinite(value) and np.isfinite(row).all())
        ]
        return PreconditionError(
            f"There is no equilibrium: the equations {', '.join(map(repr, bad))} are not defined where the search ends "
            "(a root or a logarithm of a negative number, a division by zero?). Give other values, or a start.",
            condition="no-equilibrium",
            signals=bad,
        )

    def without_root(self, residual: FloatArray, left: FloatArray) -> PreconditionError:
        """Return the refusal: what is left, and the combination of equations that no unknown changes."""
        fixed = left @ (left.T @ residual)
        names, told = self._combination(fixed * self.weights)
        rest = ", ".join(
            f"{self.rows[i]}: {residual[i] / self.weights[i]:.4g}"
            for i in np.argsort(-np.abs(residual))[:4]
            if abs(residual[i]) > ROOT_RESIDUAL
        )
        unknowns = ", ".join(self.names) or "nothing"
        why = (
            f"No unknown ({unknowns}) changes the combination {told} of the equations, which is not zero."
            if names
            else f"The search over {unknowns} ends where its equations have a residual."
        )
        return PreconditionError(
            f"There is no equilibrium: F(0, x, u, theta) = 0 has no root ({rest}). {why} Free an input or a parameter "
            "that enters it, give other values, or linearise at a point with drift=True.",
            condition="no-equilibrium",
            signals=names or [self.rows[int(np.argmax(np.abs(residual)))]],
        )

    def not_unique(self, null: FloatArray) -> PreconditionError:
        """Return the refusal: the directions that nothing determines."""
        directions, signals = [], []
        for row in null:
            moved = row * self.sizes
            kept = [i for i in np.argsort(-np.abs(row)) if abs(row[i]) > NAMED * np.abs(row).max()]
            signals += [self.names[i] for i in kept]
            directions.append("(" + ", ".join(f"{self.names[i]}: {moved[i]:.4g}" for i in kept) + ")")
        return PreconditionError(
            f"The equilibrium is not unique: {len(self.names)} unknowns and {len(self.names) - len(null)} conditions. "
            f"Nothing determines the direction {', '.join(directions)}: give the value of one of these.",
            condition="equilibrium-not-unique",
            signals=list(dict.fromkeys(signals)),
        )

    def _combination(self, weights: FloatArray) -> tuple[list[str], str]:
        largest = np.abs(weights).max(initial=0.0)
        if not largest > 0.0:
            return [], ""
        shares = weights / weights[int(np.argmax(np.abs(weights)))]
        kept = [i for i in range(len(shares)) if abs(shares[i]) > NAMED]
        terms = [("" if abs(shares[i] - 1.0) < NAMED else f"{shares[i]:.6g} * ") + self.rows[i] for i in kept]
        return [self.rows[i] for i in kept], " + ".join(terms)


def consistent_point(model: DAEModel, point: Point, fixed: Collection[str] = ()) -> Point:
    """Return a near point with derivatives that satisfy the equations; ``fixed`` states stay, differentiated may."""
    x, rates, sizes = np.array(point.x), np.zeros(model.nx), model.state_scales
    movable = np.array([name not in fixed for name in model.state_names])
    for _ in range(MOST_ROOT_EVALUATIONS):
        local = local_equations(model, rates, x, point.u, point.theta)
        if not local.is_defined:
            break
        weights = _row_weights(np.hstack([local.E * sizes, local.by_state * sizes]))
        E = weights[:, None] * (local.E * sizes)
        left, values, _ = np.linalg.svd(E)
        rank = int((values > JACOBIAN_RANK_TOLERANCE * values.max()).sum()) if values.any() else 0
        null = left[:, rank:]
        x = x + sizes * _algebraic_step(
            null.T @ (weights[:, None] * local.by_state * sizes), -null.T @ (weights * local.value), E, movable
        )
        local = local_equations(model, rates, x, point.u, point.theta)
        if not local.is_defined:
            break
        rates = rates - sizes * np.linalg.lstsq(E, weights * local.value, rcond=JACOBIAN_RANK_TOLERANCE)[0]
        local = local_equations(model, rates, x, point.u, point.theta)
        if local.is_defined and np.abs(weights * local.value).max() < CONSISTENT:
            return Point(x, point.u, point.theta, rates)
    raise PreconditionError(
        "No derivatives satisfy the equations at that point: the values that are given contradict the constraints, or "
        "the index is above one. Give fewer states.",
        condition="no-consistent-point",
        signals=list(model.equation_names),
    )


def _algebraic_step(constraint: FloatArray, right: FloatArray, E: FloatArray, movable: NDArray[np.bool_]) -> FloatArray:
    """Return the least move onto the constraints, of what is not differentiated if that is enough."""
    move = np.zeros(E.shape[1])
    if not constraint.size:
        return move
    for first, kept in ((True, (np.abs(E).max(axis=0) == 0.0) & movable), (False, movable)):
        if first or np.abs(constraint @ move - right).max() > ROOT_RESIDUAL * max(1.0, np.abs(right).max()):
            move = np.zeros(E.shape[1])
            move[kept] = np.linalg.lstsq(constraint[:, kept], right, rcond=JACOBIAN_RANK_TOLERANCE)[0]
    return move


def _row_weights(matrix: FloatArray) -> FloatArray:
    peaks = np.abs(matrix).max(axis=1, initial=0.0)
    return np.asarray(1.0 / np.where(peaks > 0.0, peaks, 1.0))


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
            f"{unknown[0]!r} is no constant and no parameter of the model; there are {', '.join(known) or 'none'}.",
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
    kept, changed = (
        {name: box.constants[name].nominal if name in box.constants else value for name, value in given.items()}
        for given in (model.constants, model.parameters)
    )
    same = kept == dict(model.constants) and changed == dict(model.parameters)
    return promoted(model if same else model.replace(constants=kept, parameters=changed), box.names)


def entries_in_constants(
    model: DAEModel, point: Point, box: ConstantsBox, columns: Mapping[str, Sequence[int]], *, moving: bool
) -> tuple[dict[str, list[Entry]], list[Entry], list[Entry]]:
    """Return entries of the matrices that depend on the box, and of the equilibrium's shift in equations and outputs.
    ``columns``: inputs, known (``B``) and not (``Bd``), and parameters that are faults (``Bf``); ``moving``: the
    motion of the point is an input after the known ones."""
    symbols = {name: ca.SX.sym(name) for name in box.names}
    theta = [symbols.get(name, float(value)) for name, value in zip(model.parameter_names, point.theta, strict=True)]
    local = symbolic_equations(model)(point.rates, point.x, point.u, ca.vertcat(*theta) if theta else ca.SX(0, 1))
    value, e, by_state, by_input, by_parameter, y, c, seen = local
    known, unknown, faults = ([int(i) for i in columns[name]] for name in ("B", "Bd", "Bf"))
    b = -by_input[:, known]
    found = {
        "E": e,
        "A": -by_state,
        "B": ca.horzcat(b, e @ ca.DM(point.rates)) if moving else b,
        "C": c,
        "Bf": -by_parameter[:, faults],
        "Df": seen[:, faults],
        "Bd": -by_input[:, unknown],
    }
    writer = _Writer(symbols)
    entries = {name: texts for name, matrix in found.items() if (texts := writer.entries(matrix, name))}
    nominal = {name: box.constants[name].nominal for name in box.names}
    return entries, writer.changes(value, -1.0, nominal), writer.changes(y, 1.0, nominal)


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
        found = []
        for i, _, text in self.entries(column, "the equilibrium's shift"):
            middle = float(parse_expression(text)(nominal))
            rest = f"{text} - {_number(middle)[0]}" if middle else text
            found.append((i, 0, rest if sign > 0.0 else f"-({rest})"))
        return found

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
            sign, left, right = self.operators[operation]
            return f"{self._in(inner[0], left)} {sign} {self._in(inner[1], right)}", min(left, _POWER)
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
        left, right = (self._written(condition.dep(i))[0] for i in range(2))
        return f"where({left} {sign} {right}, {first}, {second})"


def _number(value: float) -> tuple[str, int]:
    if not np.isfinite(value):
        raise KeyError(value)
    text = repr(abs(value))
    return (f"-{text}", _SIGN) if np.signbit(value) and value else (text, _ATOM)


#: What E x' may be, in sizes of its row, where a point counts as resting.
LARGEST_MOTION = 1e-9
#: Input of a linear model at a moving point: it is one, always.
DRIFT = "drift"
#: Input of a linear model whose equilibrium depends on constants with tolerances: it is one, always.
SHIFT_INPUT = "shift"


@arguments_checked
def linearise(
    model: DAEModel,
    *,
    at: Literal["equilibrium", "point"] = "equilibrium",
    given: Mapping[str, float] | None = None,
    free: Sequence[str] | Mapping[str, tuple[float, float]] = (),
    faults: Sequence[str] | None = None,
    disturbances: Sequence[str] = (),
    start: Mapping[str, float] | None = None,
    drift: bool = False,
    constants: Mapping[str, Any] | ConstantsBox | None = None,
    sensor_noise: Mapping[str, float] | None = None,
    process_noise: Mapping[str, float] | None = None,
) -> DescriptorSystem:
    r"""Linearise a nonlinear plant: exact Jacobians, names, units and operating point.

    With ``F(d/dt q(x, theta), x, u, theta) = 0`` and ``G(x', x, u, theta) = F(q_x x', x, u, theta)``

    .. math::
        E = G_{x'}, \quad A = -G_x, \quad B = -G_u, \quad B_f = -G_\theta, \quad C = h_x, \quad D_f = h_\theta .

    Parameters
    ----------
    model : DAEModel
        ``nx`` states, ``nu`` inputs, ``ny`` outputs, ``nq`` parameters.
    at : {"equilibrium", "point"}, optional
        Where nothing moves, found from what is given; or the point that is given, nominal where nothing is said, with
        the algebraic states solved for.
    given : mapping, optional
        Values of states, inputs, parameters and (at an equilibrium) outputs, in their units.  Inputs and parameters
        that are not given have their nominal values; states are unknown.
    free : list of str, or mapping of str to (low, high), optional
        Inputs and parameters that are solved for at an equilibrium, with the bounds they must keep.
    faults : list of str, optional
        Parameters that become faults ``Bf (nx, nf)``, ``Df (ny, nf)``: deviations from their values at the point; all
        by default.  Where a derivative is taken of something that contains one, the columns hold while its deviation
        is constant.
    disturbances : list of str, optional
        Inputs that are not known: they become ``Bd (nx, nd)``.
    start : mapping, optional
        Where the search for an equilibrium begins: states by name; nominal values by default.
    drift : bool, optional
        Whether a point that moves is taken: its motion becomes an input ``drift``, which is 1 in every row.
    constants : mapping, ConstantsBox or CalibratedBox, optional
        Tolerances of constants and parameters of the model, as `obsynth.uncertain_system` takes them; parameters among
        them are no faults.  Entries of the linear model are then expressions in them (CasADi's derivatives, at the one
        point), and the equilibrium that others have acts as an input ``shift``, which is 1 in every row and zero for
        the nominal ones.  What is not linear in the plant is not covered.
    sensor_noise : mapping, optional
        Standard deviation of white noise by output, in its unit: columns of ``Dw (ny, nw)``.
    process_noise : mapping, optional
        Intensity of white noise by equation, in the unit of the equation times the root of a second: columns of
        ``Bw (nx, nw)``, which come before those of the sensors.

    Returns
    -------
    DescriptorSystem
        Continuous in time, in deviations from ``operating_point``.  A state whose name an output has, with another
        value, is called ``"... (state)"``.  With ``constants`` it knows its tolerances; those that stand in no entry
        are left out.

    Raises
    ------
    SpecError
        A name is unknown, a value is no finite number, or an output is given for a point.
    PreconditionError
        ``no-equilibrium``: nothing satisfies the equations at rest; the combination of equations that no unknown
        changes is named.  ``equilibrium-not-unique``: the direction that nothing determines is named.
        ``outside-bounds``: what is free would leave its bounds.  ``no-consistent-point``: no derivatives satisfy the
        equations at the point.

    Examples
    --------
    >>> tank = DAEModel(
    ...     {"balance": "2.0 * der(level) = inflow - c * sqrt(level)"}, {"seen": "level"}, states={"level": 1.0},
    ...     inputs={"inflow": 0.5}, parameters={"c": 0.5},
    ...     units={"level": "m", "inflow": "m3/s", "c": "m2.5/s", "seen": "m"},
    ... )
    >>> linear = linearise(tank, given={"level": 4.0}, free=["inflow"])
    >>> float(linear.operating_point["inflow"]), linear.A.tolist()
    (1.0, [[-0.125]])

    References
    ----------
    .. [CampbellLinearisation1995] S. L. Campbell, "Linearization of DAEs along trajectories", ZAMP 46, 1995; at a
       moving point we keep E x' as an input, which is exact to first order.
    """
    values, freed = dict(given or {}), _names(free, "free")
    for name, bounds in free.items() if isinstance(free, Mapping) else ():
        if np.shape(bounds) != (2,) or not float(bounds[0]) <= float(bounds[1]):
            raise SpecError(f"free.{name} must be [low, high].", path=f"free.{name}")
    box = None
    if constants is not None:
        box = box_of_model(model, constants, values)
        both = [name for name in box.names if name in freed or name in (faults or ())]
        if both:
            raise SpecError(
                f"{both[0]!r} has a tolerance, and is {'free' if both[0] in freed else 'a fault'}: choose one.",
                path=f"constants.{both[0]}",
            )
        model = at_nominal(model, box)
    if at == "equilibrium":
        point = equilibrium(model, values, freed, start)
        _require_bounds(model, point, free)
    else:
        if freed or start:
            raise SpecError("free and start belong to an equilibrium: at a point, give every value.", path="free")
        others = (*model.state_names, *model.input_names, *model.parameter_names)
        wrong = [name for name in values if name in model.output_names and name not in others]
        if wrong:
            raise SpecError(
                f"The output {wrong[0]!r} cannot be given at a point: give states.", path=f"given.{wrong[0]}"
            )
        point = consistent_point(model, nominal_point(model, values), values)
    found = linear_model(model, point, faults=faults, disturbances=disturbances, drift=drift, box=box)
    return _with_noise(found, model.equation_names, process_noise, sensor_noise)


def _with_noise(
    linear: DescriptorSystem,
    equations: Sequence[str],
    process_noise: Mapping[str, float] | None,
    sensor_noise: Mapping[str, float] | None,
) -> DescriptorSystem:
    """Return a linear model with the noise of its equations and sensors, if any is stated."""
    if process_noise:
        columns = np.zeros((linear.nx, len(process_noise)))
        for column, (name, value) in enumerate(process_noise.items()):
            row = index_of(name, equations, what="process_noise")
            real_number(value, f"process_noise.{name}", "an intensity above 0", above=0.0)
            columns[row, column] = value
        linear = linear.replace(Bw=columns, Dw=np.zeros((linear.ny, len(process_noise))))
    return linear.replace(sensor_noise=sensor_noise) if sensor_noise else linear


def linear_model(
    model: DAEModel,
    point: Point,
    *,
    faults: Sequence[str] | None,
    disturbances: Sequence[str],
    drift: bool,
    box: ConstantsBox | None = None,
) -> DescriptorSystem:
    """Return the linear model at a point that satisfies the equations, over the box of its constants if it has one."""
    local = local_equations(model, point.rates, point.x, point.u, point.theta)
    if not local.is_defined:
        raise PreconditionError(
            "The derivatives of the model are not finite at the point: move it.",
            condition="not-differentiable",
            signals=list(model.equation_names),
        )
    motion = _motion(model, point, local, drift=drift)
    uncertain = () if box is None else box.names
    every = [name for name in model.parameter_names if name not in uncertain]
    chosen = every if faults is None else _names(faults, "faults")
    fault_columns = [index_of(name, model.parameter_names, what="faults") for name in chosen]
    unknown = [index_of(name, model.input_names, what="disturbances") for name in _names(disturbances, "disturbances")]
    known = [i for i in range(model.nu) if i not in unknown]
    inputs, B = [model.input_names[i] for i in known], -local.by_input[:, known]
    if motion is not None:
        inputs, B = [*inputs, DRIFT], np.column_stack([B, motion])
    # A state must not have the name of an output with another value.
    shown = dict(zip(model.output_names, local.y, strict=True))
    names = [
        name if shown.get(name, x) == x else f"{name} (state)"
        for name, x in zip(model.state_names, point.x, strict=True)
    ]
    values = dict(
        zip(
            (*model.parameter_names, *model.input_names, *names, *model.output_names),
            map(float, (*point.theta, *point.u, *point.x, *local.y)),
            strict=True,
        )
    )
    values |= {} if motion is None else {DRIFT: 0.0}
    signals = {*names, *inputs, *model.output_names, *chosen, *disturbances}
    units = {name: unit for name, unit in model.units.items() if name in signals}
    units |= {
        name: model.units[given] for name, given in zip(names, model.state_names, strict=True) if given in model.units
    }
    linear = DescriptorSystem(
        local.E,
        -local.by_state,
        B if inputs else None,
        local.C,
        dt=0.0,
        Bf=-local.by_parameter[:, fault_columns] if fault_columns else None,
        Df=local.outputs_by_parameter[:, fault_columns] if fault_columns else None,
        Bd=-local.by_input[:, unknown] if unknown else None,
        state_names=names,
        input_names=inputs or None,
        output_names=list(model.output_names),
        fault_names=list(chosen) or None,
        disturbance_names=list(disturbances) or None,
        units=units,
        operating_point={name: value for name, value in values.items() if name in signals},
    )
    if box is None or not box.names:
        return linear
    columns = {"B": known, "Bd": unknown, "Bf": fault_columns}
    return _over_box(linear, model, point, box, columns, moving=motion is not None)


def _motion(model: DAEModel, point: Point, local: LocalEquations, *, drift: bool) -> FloatArray | None:
    """Return ``E x'`` of a point that moves, refused unless ``drift`` makes an input of it; ``None`` at rest."""
    motion = local.E @ point.rates
    moves = np.abs(motion) > LARGEST_MOTION * np.maximum(
        np.abs(local.by_state) @ model.state_scales, np.abs(motion).min()
    )
    if not moves.any():
        return None
    if not drift:
        moved = {name: value for name, value, moving in zip(model.equation_names, motion, moves, strict=True) if moving}
        raise PreconditionError(
            f"The point moves: E x' = ({', '.join(f'{name}: {value:.4g}' for name, value in moved.items())}), so that "
            f"it is no equilibrium. With drift=True this motion becomes an input {DRIFT!r}, which is 1 in every row.",
            condition="no-equilibrium",
            signals=list(moved),
        )
    return np.asarray(motion)


def _over_box(
    linear: DescriptorSystem,
    model: DAEModel,
    point: Point,
    box: ConstantsBox,
    columns: Mapping[str, Sequence[int]],
    *,
    moving: bool,
) -> DescriptorSystem:
    """Return a linear model that knows the tolerances of its constants."""
    entries, moved, shown = entries_in_constants(model, point, box, columns, moving=moving)
    shift = ""
    if moved or shown:
        taken = {
            *linear.state_names,
            *linear.input_names,
            *linear.output_names,
            *linear.fault_names,
            *linear.disturbance_names,
        }
        shift = SHIFT_INPUT if SHIFT_INPUT not in taken else f"equilibrium {SHIFT_INPUT}"
        nu = linear.nu
        for name, found in (("B", moved), ("D", shown)):
            if found:
                entries[name] = [*entries.get(name, []), *((i, nu, text) for i, _, text in found)]
        linear = linear.replace(
            B=np.column_stack([linear.B, np.zeros(linear.nx)]),
            D=np.column_stack([linear.D, np.zeros(linear.ny)]),
            input_names=[*linear.input_names, shift],
            operating_point={**linear.operating_point, shift: 0.0},
            units={**linear.units, shift: "1"} if linear.units else linear.units,
        )
    uncertainty = Uncertainty(box, {name: tuple(found) for name, found in entries.items()}, shift=shift)
    kept = {name: item for name, item in box.constants.items() if name in uncertainty.used}
    return filled_plant(linear, uncertainty.with_box(replace(box, constants=kept)), set(kept))


def _names(value: Sequence[str] | Mapping[str, tuple[float, float]], what: str) -> list[str]:
    if isinstance(value, str):
        raise SpecError(f"{what} is the text {value!r}: give a list of names.", path=what)
    return list(value)


def _require_bounds(model: DAEModel, point: Point, free: Sequence[str] | Mapping[str, tuple[float, float]]) -> None:
    if not isinstance(free, Mapping):
        return
    values = dict(zip((*model.input_names, *model.parameter_names), (*point.u, *point.theta), strict=True))
    outside = {
        name: f"{name} = {values[name]:.6g} is outside [{float(low):g}, {float(high):g}]"
        for name, (low, high) in free.items()
        if not float(low) <= values[name] <= float(high)
    }
    if outside:
        raise PreconditionError(
            f"The equilibrium is not admissible: {'; '.join(outside.values())}. Give other values, or free something "
            "else.",
            condition="outside-bounds",
            signals=list(outside),
        )


#: Parts of a sample over which what moves within it is bounded.
PARTS_OF_SAMPLE = 32
#: Roundings of the coefficients of derivatives, which CasADi computes.
COEFFICIENT_ROUNDINGS = 16.0


def bounded_model(
    model: DAEModel,
    region: Mapping[str, Sequence[float]],
    sample_time: float,
    *,
    faults: Sequence[str],
    disturbances: Sequence[str],
    given: Mapping[str, float] | None = None,
    shipped: DescriptorSystem | None = None,
) -> tuple[DescriptorSystem, Mapping[str, float]]:
    """Return the sampled linear model at an equilibrium, whose last disturbances stand for what it leaves out, and the
    bounds of these by name; ``shipped``: bound what this one leaves out, instead of a new one.

    ``region``: ``[low, high]`` of every state, input and fault; others have their nominal values.
    """
    if not model.is_data or callable(model.outputs):
        raise SpecError("The model is given as functions: its remainder needs equations as texts.", path="plant")
    require_linear_rates(model)
    linear = linearise(model, given=given, faults=list(faults), disturbances=list(disturbances))
    signals = (*model.state_names, *linear.input_names, *linear.fault_names, *linear.disturbance_names)
    middles, halves = _region(model, linear, signals, region)
    several = np.sum(linear.E != 0.0, axis=1) > 1
    if np.any(linear.E[several] != np.round(linear.E[several])):
        raise PreconditionError(
            "An equation has several derivatives whose coefficients are no whole numbers: their rounding has no bound "
            "here. Write one derivative in each equation.",
            condition="remainder",
        )
    equations, outputs = _remainders(model, linear, signals, middles, halves, given or {})
    found = discretise(linear, sample_time).plant
    if any(name.startswith("xi ") for name in found.state_names):
        raise PreconditionError(
            "The equations hold derivatives of algebraic states, so that the dynamic states are combinations of "
            "states: write the equations with derivatives of the dynamic states alone.",
            condition="remainder",
        )
    at = np.maximum(np.abs(middles - halves), np.abs(middles + halves))
    own = found if shipped is None else shipped
    bounds = _sampled(linear, own, sample_time, (equations, outputs), dict(zip(signals, at.tolist(), strict=True)))
    if shipped is not None:
        return shipped, bounds
    nx, ny = found.nx, found.ny
    with_remainders = found.replace(
        Bd=np.hstack([found.Bd, np.eye(nx), np.zeros((nx, ny))]),
        Dd=np.hstack([found.Dd, np.zeros((ny, nx)), np.eye(ny)]),
        disturbance_names=[*found.disturbance_names, *remainder_names(found)],
    )
    return with_remainders, bounds


def remainder_names(plant: DescriptorSystem) -> list[str]:
    """Return what stands for the remainder in each state and each output."""
    into = [f"remainder of {name}" for name in plant.state_names]
    return [*into, *(f"remainder in {name}" for name in plant.output_names)]


def require_linear_rates(model: DAEModel) -> None:
    """Raise `PreconditionError` where derivatives enter with other coefficients than constants."""
    s = symbols_of(model)
    into, stored = ca.jacobian(s.equations, s.rates), ca.jacobian(s.stored, s.x)
    moved = ca.depends_on(s.stored, ca.vertcat(s.theta, s.u)) if s.stored.numel() else False
    if not (into.is_constant() and stored.is_constant()) or moved:
        raise PreconditionError(
            "A derivative is taken of a nonlinear expression, or multiplied by a signal: its remainder has no bound "
            "here. Write the equations with derivatives of states times constants.",
            condition="remainder",
        )


def _region(
    model: DAEModel, linear: DescriptorSystem, signals: Sequence[str], region: Mapping[str, Sequence[float]]
) -> tuple[FloatArray, FloatArray]:
    """Return middles and half widths of the region, as deviations from the point of the linear model."""
    lacking = [name for name in signals if name not in region]
    unknown = [name for name in region if name not in signals]
    if lacking or unknown:
        told = f"it lacks {', '.join(lacking)}" if lacking else f"{', '.join(unknown)} is none of them"
        raise SpecError(
            f"region must give [low, high] of each of {', '.join(signals)}, in their units: {told}.",
            path="method.options.region",
        )
    point = dict(zip(signals, _point(model, linear, signals), strict=True))
    low, high = [], []
    for name in signals:
        ends = region[name]
        good = len(ends) == 2 and all(map(is_finite_number, ends)) and ends[0] <= ends[1]
        if not good or not ends[0] <= point[name] <= ends[1]:
            raise SpecError(
                f"region of {name} is {list(ends)!r}: give two finite numbers, low first, around "
                f"{point[name]:.6g}, where the model is linearised.",
                path="method.options.region",
            )
        low.append(float(ends[0]) - point[name])
        high.append(float(ends[1]) - point[name])
    middles = 0.5 * (np.array(low) + np.array(high))
    widths = np.maximum(np.array(high) - middles, middles - np.array(low))
    return middles, rounded_up(
        widths + 4.0 * UNIT_ROUNDOFF * (np.abs(middles) + np.abs(np.array(list(point.values())))), 4
    )


def _point(model: DAEModel, linear: DescriptorSystem, signals: Sequence[str]) -> list[float]:
    """Return the values of signals at the point of the linear model."""
    at = linear.operating_point
    named = dict(zip(model.state_names, linear.state_names, strict=True))
    return [float(at[named.get(name, name)]) for name in signals]


def _remainders(
    model: DAEModel,
    linear: DescriptorSystem,
    signals: Sequence[str],
    middles: FloatArray,
    halves: FloatArray,
    given: Mapping[str, float],
) -> tuple[FloatArray, FloatArray]:
    """Return bounds of what each equation and each output leaves out ``(nx,)``, ``(ny,)``."""
    count = len(signals)
    translation, zero = affine_translation(count), AffineNumber(0.0, np.zeros(count), 0.0)
    known: dict[str, Any] = {name: zero.lifted(value) for name, value in model.constants.items()}
    known |= {name: zero.lifted(given.get(name, value)) for name, value in model.parameters.items()}
    for i, (name, value) in enumerate(zip(signals, _point(model, linear, signals), strict=True)):
        known[name] = AffineNumber(value + middles[i], halves[i] * np.eye(count)[i], 0.0)
    for name, text in model.definitions.items():
        known[name] = zero.lifted(equation_of(text, f"definitions.{name}").translated(known, translation))
    texts: Any = model.equations
    parsed = [equation_of(text, f"equations.{name}") for name, text in texts.items()]
    still = {key: zero for expression in parsed for key in expression.rates}
    left = [zero.lifted(expression.translated({**known, **still}, translation)) for expression in parsed]
    seen_texts: Any = model.outputs
    seen = [
        zero.lifted(equation_of(text, f"outputs.{name}").translated(known, translation))
        for name, text in seen_texts.items()
    ]
    # E x' = -F(0, x, u, theta), of which the linear model has A, B, Bf and Bd.
    into = np.hstack([linear.A, linear.B, linear.Bf, linear.Bd])
    out = np.hstack([linear.C, linear.D, linear.Df, linear.Dd])
    shown = np.array([linear.operating_point.get(name, 0.0) for name in linear.output_names])
    equations = [_missed(-value, row, 0.0, middles, halves) for value, row in zip(left, into, strict=True)]
    rates = [COEFFICIENT_ROUNDINGS * UNIT_ROUNDOFF * value.magnitude for value in left]
    outputs = [_missed(value, row, y, middles, halves) for value, row, y in zip(seen, out, shown, strict=True)]
    return np.array(equations) + np.array(rates), np.array(outputs)


def _missed(value: AffineNumber, row: FloatArray, offset: float, middles: FloatArray, halves: FloatArray) -> float:
    """Return how far a number is from ``offset + row (middles + halves q)`` at most."""
    constant, parts = value.center - offset - row @ middles, value.parts - row * halves
    size = abs(value.center) + abs(offset) + np.abs(row) @ (np.abs(middles) + halves) + np.abs(value.parts).sum()
    total = abs(constant) + np.abs(parts).sum() + value.radius + gamma(len(row) + 8) * size
    return float(rounded_up(np.array(total), len(row) + 8))


def _sampled(
    linear: DescriptorSystem,
    shipped: DescriptorSystem,
    step: float,
    left_out: tuple[FloatArray, FloatArray],
    sizes: Mapping[str, float],
) -> dict[str, float]:
    """Return the bounds of what a shipped sampled model leaves out, by name; ``sizes``: of all deviations."""
    equations, outputs = left_out
    nx, nu, nf, nd = linear.nx, linear.nu, linear.nf, linear.nd
    written = {**matrices_of(linear)}
    written["Bd"] = np.hstack([linear.Bd, np.eye(nx)])
    written["Dd"] = np.hstack([linear.Dd, np.zeros((linear.ny, nx))])
    reduced = reduced_matrices(written, {name: AffineMatrix.exact(part, 0) for name, part in written.items()}, None)
    inputs = affine_block([[reduced["B"], reduced["Bf"], reduced["Bd"][:, :nd]]])
    a, held = affine_zero_order_hold(reduced["A"], inputs, step)
    states = np.array([sizes[name.removesuffix(" (state)")] for name in shipped.state_names])
    known = np.array([sizes[name] for name in (*linear.input_names, *linear.fault_names, *linear.disturbance_names)])
    own = np.hstack([shipped.B, shipped.Bf, shipped.Bd[:, :nd]])
    inside = _away(a, shipped.A) @ states + _away(held, own) @ known
    inside = inside + _moving(reduced["A"], reduced["Bd"][:, nd:].magnitude @ equations, step)
    through = affine_block([[reduced["D"], reduced["Df"], reduced["Dd"][:, :nd]]])
    direct = np.hstack([shipped.D, shipped.Df, shipped.Dd[:, :nd]])
    seen = _away(reduced["C"], shipped.C) @ states + _away(through, direct) @ known
    seen = seen + reduced["Dd"][:, nd:].magnitude @ equations + outputs
    terms = 4 * (nx + nu + nf + nd + 4)
    found = np.concatenate([rounded_up(inside, terms), rounded_up(seen, terms)])
    return dict(zip(remainder_names(shipped), found.tolist(), strict=True))


def _away(found: AffineMatrix, shipped: FloatArray) -> FloatArray:
    """Return how far a proved matrix is from a shipped one at most."""
    return rounded_up(np.abs(found.center - shipped) + found.radius + UNIT_ROUNDOFF * np.abs(shipped), 4)


def _moving(a: AffineMatrix, sizes: FloatArray, step: float) -> FloatArray:
    """Return what disturbances of these sizes, which do anything within a sample, do to the states at its end."""
    piece = step / PARTS_OF_SAMPLE
    # Within a piece e^(A s) is away from its begin by e^(|A| s) - 1 times that.
    spread = affine_exponential(AffineMatrix.exact(a.magnitude * (piece * (1.0 + 4.0 * UNIT_ROUNDOFF)), 0)).magnitude
    over = affine_exponential(a.scaled(piece))
    here, total = AffineMatrix.exact(np.eye(len(sizes)), 0), np.zeros(len(sizes))
    for _ in range(PARTS_OF_SAMPLE):
        total = total + here.magnitude @ (spread @ sizes)
        here = here @ over
    return rounded_up(total * piece, PARTS_OF_SAMPLE * (2 * len(sizes) + 4) + 8)
