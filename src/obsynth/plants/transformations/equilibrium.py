"""Equilibria of a nonlinear plant, or the reason why there is none; and consistent points of a trajectory."""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from obsynth.errors import PreconditionError, SpecError
from obsynth.numerics.arguments import real_number
from obsynth.numerics.arrays import FloatArray
from obsynth.numerics.ranks import JACOBIAN_RANK_TOLERANCE
from obsynth.plants.dae import DAEModel
from obsynth.plants.dae_checks import without_value
from obsynth.plants.dae_functions import local_equations
from obsynth.plants.signal_names import index_of

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
    left_vectors, values, right_vectors = np.linalg.svd(jacobian)
    rank = int((values > JACOBIAN_RANK_TOLERANCE * values.max()).sum()) if values.size else 0
    if not np.abs(residual).max(initial=0.0) <= ROOT_RESIDUAL:
        raise problem.without_root(residual, left_vectors[:, rank:])
    if rank < len(problem.names):
        raise problem.not_unique(right_vectors[rank:])
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
        residual, jacobian = self.raw(self.begin)
        if not np.isfinite(jacobian).all():
            _, undefined = without_value(self.rows, residual, jacobian, where="at the nominal values")
            raise SpecError(
                f"There is no point to begin at: {undefined}. Give other values by start or given.", path="start"
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
        bad, undefined = without_value(self.rows, residual, jacobian, where="where the search ends")
        return PreconditionError(
            f"There is no equilibrium: {undefined}. Give other values, or a start.",
            condition="no-equilibrium",
            signals=bad,
        )

    def without_root(self, residual: FloatArray, left_null: FloatArray) -> PreconditionError:
        """Return the refusal: what is left, and the combination of equations that no unknown changes."""
        fixed = left_null @ (left_null.T @ residual)
        names, combination = self._combination(fixed * self.weights)
        rest = ", ".join(
            f"{self.rows[i]}: {residual[i] / self.weights[i]:.4g}"
            for i in np.argsort(-np.abs(residual))[:4]
            if abs(residual[i]) > ROOT_RESIDUAL
        )
        unknowns = ", ".join(self.names) or "nothing"
        why = (
            f"No unknown ({unknowns}) changes the combination {combination} of the equations, which is not zero."
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
            named = [i for i in np.argsort(-np.abs(row)) if abs(row[i]) > NAMED * np.abs(row).max()]
            signals += [self.names[i] for i in named]
            directions.append("(" + ", ".join(f"{self.names[i]}: {moved[i]:.4g}" for i in named) + ")")
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
        named = [i for i in range(len(shares)) if abs(shares[i]) > NAMED]
        terms = [("" if abs(shares[i] - 1.0) < NAMED else f"{shares[i]:.6g} * ") + self.rows[i] for i in named]
        return [self.rows[i] for i in named], " + ".join(terms)


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
        left_vectors, values, _ = np.linalg.svd(E)
        rank = int((values > JACOBIAN_RANK_TOLERANCE * values.max()).sum()) if values.any() else 0
        null = left_vectors[:, rank:]
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
    for first, columns in ((True, (np.abs(E).max(axis=0) == 0.0) & movable), (False, movable)):
        if first or np.abs(constraint @ move - right).max() > ROOT_RESIDUAL * max(1.0, np.abs(right).max()):
            move = np.zeros(E.shape[1])
            move[columns] = np.linalg.lstsq(constraint[:, columns], right, rcond=JACOBIAN_RANK_TOLERANCE)[0]
    return move


def _row_weights(matrix: FloatArray) -> FloatArray:
    peaks = np.abs(matrix).max(axis=1, initial=0.0)
    return np.asarray(1.0 / np.where(peaks > 0.0, peaks, 1.0))
