"""One implicit step of a DAE: Newton's method, a homotopy in the input where it fails, and the step's sensitivities.

The compiled step runs the undamped iteration of `obsynth.numerics.newton` as one CasADi function.  Where damping or a
homotopy is needed it returns a step that is not trusted.  `ImplicitStep.solve_carefully` then solves the step, with the
same function for the Newton direction.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np

from obsynth.errors import SolverError
from obsynth.numerics import lazy_casadi as ca
from obsynth.numerics.arrays import FloatArray
from obsynth.numerics.graph_equations import SMALL, equilibrated, solved
from obsynth.numerics.newton import LARGEST_RESIDUAL, LAST_STEP, MOST_ITERATIONS, NewtonResult, ScaledMatrix, newton
from obsynth.plants.dae import DAEModel
from obsynth.plants.dae_functions import Compiled, DAEFunctions

#: Numbers of iterations in blocks: every step runs the first block, and a further one only if it has not converged.
#: Three or four iterations from the state of the last sample are usual.
BLOCKS = (4, 4, 8, MOST_ITERATIONS - 16)

#: First step of a homotopy, as a share of the change of the input; doubled after a success, halved after a failure.
FIRST_FRACTION = 0.125

#: A homotopy fails when it needs a smaller step than this.
LEAST_FRACTION = 2.0**-20

#: A homotopy fails when it needs more solutions by Newton's method than this.
MOST_SUBSOLVES = 10_000

#: A state is projected onto the algebraic equations by a step of backward Euler over this share of dt, in which the
#: dynamic states hardly move.
PROJECTION_SHARE = 1e-6

#: A smaller move in that step, relative to the sizes of the states, is motion and not a projection.
PROJECTION_NOTICE = 1e-5


@dataclass(frozen=True, eq=False)
class StepGraph:
    """The CasADi functions of one implicit step of fixed length.

    Parameters
    ----------
    newton : casadi.Function
        ``(stages, state before, input, parameters)`` to residual, row scales and Newton step.
    sensitivities : casadi.Function
        The same arguments to F of (8), G of (9), the derivative by what is added to the equations, and the
        equilibrated matrix of (7).
    step : casadi.Function
        ``(state before, input, parameters)`` to stages, residual, and 1 if the step is trusted.
    small : bool
        Whether the functions are expanded into scalar operations.
    """

    newton: Any
    sensitivities: Any
    step: Any
    small: bool


def step_graph(functions: DAEFunctions, dt: float, largest_move: float) -> StepGraph:
    """Return the functions of one implicit step, cached with the model."""
    graphs, key = functions.model.graphs, (functions.method, dt, largest_move)
    if key not in graphs:
        graphs[key] = _graph(functions, dt, largest_move)
    graph: StepGraph = graphs[key]
    return graph


def newton_graph(functions: DAEFunctions, dt: float) -> Any:
    """Return the function from stages, state before, input and parameters to residual, row scales and Newton step."""
    graphs, key = functions.model.graphs, (functions.method, dt, "newton")
    if key not in graphs:
        sizes = np.tile(functions.model.state_scales, functions.stages)
        point = _point(functions)
        value, J = functions.residual_function(*point, dt)
        scaled, rows = equilibrated(J, sizes)
        newton = ca.Function("newton", point, [value, rows, sizes * solved(scaled, -rows * value)])
        graphs[key] = newton.expand() if len(sizes) <= SMALL else newton
    return graphs[key]


def _point(functions: DAEFunctions) -> list[Any]:
    """Return symbols of stages, state before, input and parameters."""
    model = functions.model
    sizes = (("X", model.nx * functions.stages), ("x", model.nx), ("u", model.nu), ("theta", model.nq))
    return [ca.MX.sym(name, size) for name, size in sizes]


def _graph(functions: DAEFunctions, dt: float, largest_move: float) -> StepGraph:
    model, stages = functions.model, functions.stages
    n = model.nx * stages
    sizes = np.tile(model.state_scales, stages)
    newton, point = newton_graph(functions, dt), _point(functions)
    J, start, parameters = functions.derivative_function(*point, dt)
    scaled, rows = equilibrated(J, sizes)
    right = ca.horzcat(-start, -parameters, ca.repmat(ca.DM.eye(model.nx), stages, 1))
    width = right.shape[1]
    moved = ca.repmat(ca.DM(sizes), 1, width) * solved(scaled, ca.repmat(rows, 1, width) * right)
    nx, last, noise = model.nx, slice(n - model.nx, n), slice(model.nx + model.nq, width)
    local = ca.Function(
        "sensitivities", point, [moved[last, :nx], moved[last, nx : noise.start], moved[last, noise], scaled]
    )
    if n <= SMALL:
        local = local.expand()
    return StepGraph(newton, local, _whole(newton, sizes, stages, largest_move), n <= SMALL)


def input_effect(functions: DAEFunctions, dt: float) -> Any:
    """Return a function of stages, state before, input and parameters: the derivative ``(nx, nu)`` of the step by the
    input."""
    model, stages = functions.model, functions.stages
    n = model.nx * stages
    sizes = np.tile(model.state_scales, stages)
    point = _point(functions)
    value, J = functions.residual_function(*point, dt)
    scaled, rows = equilibrated(J, sizes)
    right = -ca.densify(ca.jacobian(value, point[2]))
    moved = ca.repmat(ca.DM(sizes), 1, model.nu) * solved(scaled, ca.repmat(rows, 1, model.nu) * right)
    effect = ca.Function("input_effect", point, [moved[n - model.nx :, :]])
    return effect.expand() if n <= SMALL else effect


def _whole(newton: Any, sizes: FloatArray, stages: int, largest_move: float) -> Any:
    """Return the whole step as one function: blocks of iterations, each run only if the one before has not ended."""
    point = [ca.MX.sym("x", len(sizes) // stages), *(ca.MX.sym(name, newton.size1_in(i)) for i, name in ((2, "u"),
             (3, "theta")))]  # fmt: skip
    start = ca.repmat(point[0], stages, 1)
    state = [start, *newton(start, *point), ca.MX(0.0), ca.MX(0.0), ca.MX(0.0)]
    iteration = _iteration(newton, sizes)
    for i, count in enumerate(BLOCKS):
        block, done = _block(iteration, count), state[4]
        if i:
            inputs = block.mx_in()
            unchanged = ca.Function("unchanged", inputs, inputs[: len(state)])
            block = ca.Function.if_else("further", unchanged, block)
            state = list(block(done, *state, *point))
        else:
            state = list(block(*state, *point))
    X, done, converged, residual = state[0], *state[4:]
    near = _all(ca.fabs(X - start) <= largest_move * ca.DM(sizes)) if np.isfinite(largest_move) else ca.MX(1.0)
    trusted = ca.logic_and(ca.logic_and(done, converged), near)
    return ca.Function("step", point, [X, residual, trusted], ["x", "u", "theta"], ["stages", "residual", "trusted"])


def _iteration(newton: Any, sizes: FloatArray) -> Any:
    """Return one iteration as a function, which does nothing once it has ended.

    It maps stages, residual, row scales, Newton step, and the flags ``done``, ``converged`` and largest residual to
    their new values.
    """
    inputs = [newton.mx_in(0)] + [ca.MX.sym(name, len(sizes)) for name in ("value", "rows", "move")]
    inputs += [ca.MX.sym(name) for name in ("done", "converged", "residual")]
    point = [newton.mx_in(i) for i in (1, 2, 3)]
    X, value, rows, move, done, converged, residual = inputs
    # Comparisons with NaN are false, so that an iteration with NaN never converges.
    last = _all(ca.fabs(move) <= LAST_STEP * ca.fmax(ca.fabs(X), ca.DM(sizes)))
    after = [X + move, *newton(X + move, *point)]
    reached = ca.fabs(rows * after[1])
    smaller = _all(reached < ca.mmax(ca.fabs(rows * value)))
    solved_now = ca.logic_and(last, _all(reached <= LARGEST_RESIDUAL))
    converged = ca.if_else(done, converged, solved_now)
    residual = ca.if_else(done, residual, ca.mmax(reached))
    X, value, rows, move = (ca.if_else(done, old, new) for old, new in zip((X, value, rows, move), after, strict=True))
    done = ca.logic_or(done, ca.logic_or(last, ca.logic_not(smaller)))
    iteration = ca.Function("iteration", [*inputs, *point], [X, value, rows, move, done, converged, residual])
    return iteration.expand() if len(sizes) <= SMALL else iteration


def _block(iteration: Any, count: int) -> Any:
    """Return ``count`` iterations as one function."""
    inputs = iteration.mx_in()
    state, point = inputs[: iteration.n_out()], inputs[iteration.n_out() :]
    for _ in range(count):
        state = iteration(*state, *point)
    iterations = ca.Function("iterations", inputs, state)
    return iterations.expand() if iteration.is_a("SXFunction") else iterations


def _all(conditions: Any) -> Any:
    return ca.sum1(conditions) >= float(conditions.numel())


@dataclass(frozen=True, eq=False)
class Solution:
    """The state ``x (nx,)`` after a step, its stages, its residual in sizes of the states, and the number of solves."""

    x: FloatArray
    stages: FloatArray
    residual: float
    subsolves: int


class ImplicitStep:
    """Implicit steps of dt s.

    A step that moves a state by more than ``largest_move`` follows a homotopy in the input, so that it ends at the
    root that is connected with the last state.
    """

    def __init__(self, functions: DAEFunctions, dt: float, *, largest_move: float | None = None) -> None:
        self.functions, self.dt = functions, dt
        self.largest_move = np.inf if largest_move is None else largest_move
        self.sizes = np.tile(functions.model.state_scales, functions.stages)

    @cached_property
    def graph(self) -> StepGraph:
        """The step as CasADi functions."""
        return step_graph(self.functions, self.dt, self.largest_move)

    @cached_property
    def _fast(self) -> Compiled:
        return Compiled(self.graph.step)

    @cached_property
    def _local(self) -> Compiled:
        return Compiled(self.graph.sensitivities)

    def solve(
        self, x: FloatArray, u: FloatArray, theta: FloatArray, *, before: FloatArray | None = None, k: int = 0
    ) -> Solution:
        """Return the state after one step from ``x (nx,)`` with ``u (nu,)``, ``theta (nq,)``; ``before``: last u."""
        stages, residual, trusted = self._fast(x, u, theta)
        if trusted[0, 0] == 1.0:
            return Solution(stages[-self.functions.model.nx :, 0], stages[:, 0], float(residual[0, 0]), 1)
        return self.solve_carefully(x, u, theta, before=before, k=k)

    def solve_carefully(
        self, x: FloatArray, u: FloatArray, theta: FloatArray, *, before: FloatArray | None = None, k: int = 0
    ) -> Solution:
        """Return the state after one step, by damped Newton and by a homotopy where that is needed."""
        start = np.tile(x, self.functions.stages)
        whole_step = self._newton(start, x, u, theta)
        if whole_step.converged and self._move(whole_step.x, start) <= self.largest_move:
            return self._solution(whole_step, 1)
        if before is None or np.array_equal(before, u):
            if whole_step.converged:
                return self._solution(whole_step, 1)
            raise self._error(whole_step, x, u, theta, k, "")
        return self._homotopy(start, x, before, u, theta, k)

    def sensitivities(
        self, solution: Solution, x: FloatArray, u: FloatArray, theta: FloatArray
    ) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return the derivatives of a solved step by state (F of (8)), parameters (G of (9)) and equation noise."""
        F, G, noise, _ = self._local(solution.stages, x, u, theta)
        if not (np.isfinite(F).all() and np.isfinite(G).all() and np.isfinite(noise).all()):
            raise SolverError("The matrix of (7), dF/dx' / dt + dF/dx, is singular: the step has no unique solution.")
        return F, G, noise

    def _move(self, stages: FloatArray, start: FloatArray) -> float:
        return float(np.abs((stages - start) / self.sizes).max())

    @cached_property
    def _evaluated(self) -> Compiled:
        return Compiled(newton_graph(self.functions, self.dt))

    def _newton(self, start: FloatArray, x: FloatArray, u: FloatArray, theta: FloatArray) -> NewtonResult:
        """Solve from a start with the function that the C code contains, so that both round alike."""

        def evaluate(stages: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
            value, rows, step = self._evaluated(stages, x, u, theta)
            return value[:, 0], rows[:, 0], step[:, 0]

        return newton(evaluate, start, self.sizes)

    def _homotopy(
        self, start: FloatArray, x: FloatArray, before: FloatArray, u: FloatArray, theta: FloatArray, k: int
    ) -> Solution:
        """Lead the input from its last value to the new one, as fast as Newton follows."""
        last = self._newton(start, x, before, theta)
        if not last.converged:
            raise self._error(last, x, before, theta, k, " (with the input of the step before)")
        reached, fraction, subsolves = 0.0, FIRST_FRACTION, 1
        while reached < 1.0:
            target = min(1.0, reached + fraction)
            between = before + target * (u - before)
            tried = self._newton(last.x, x, between, theta)
            subsolves += 1
            if tried.converged and self._move(tried.x, last.x) <= self.largest_move:
                last, reached, fraction = tried, target, 2.0 * fraction
            else:
                fraction *= 0.5
            if fraction < LEAST_FRACTION or subsolves > MOST_SUBSOLVES:
                share = f" (homotopy: {100 * reached:.3g} % of the change of the input)"
                raise self._error(tried, x, between, theta, k, share)
        return self._solution(last, subsolves)

    def _solution(self, found: NewtonResult, subsolves: int) -> Solution:
        return Solution(found.x[-self.functions.model.nx :], found.x, found.residual, subsolves)

    def _error(
        self, found: NewtonResult, x: FloatArray, u: FloatArray, theta: FloatArray, k: int, where: str
    ) -> SolverError:
        model = self.functions.model
        value, jacobian = self.functions.residual(found.x, x, u, theta, np.array([self.dt]))
        is_defined = np.isfinite(value[:, 0]) & np.isfinite(jacobian).all(axis=1)
        if not is_defined.all():
            found = replace(found, residuals=np.where(is_defined, 0.0, np.inf))
        elif not np.isfinite(found.residuals).all():
            # Defined, but singular: the function of a step has no row scales there.
            found = replace(found, residuals=ScaledMatrix.of(jacobian, self.sizes).rows * value[:, 0])
        name = model.equation_names[found.worst % model.nx]
        worst = (
            f"residual {found.residual:.3g} in sizes of the states"
            if is_defined.all()
            else "which is not defined there"
        )
        return SolverError(
            f"No solution at k = {k}{where}: Newton stopped after iteration {found.iterations}, and the worst equation "
            f"is {name!r} ({worst}). Check that input and state at this k are possible, or take smaller steps.",
            record={"k": k, "iteration": found.iterations, "equation": name, "residual": found.residual},
        )


def onto_constraint(model: DAEModel, x: FloatArray, u: FloatArray, theta: FloatArray, dt: float) -> FloatArray:
    """Return the state ``x (nx,)`` projected onto the algebraic equations; ``x`` itself where it satisfies them."""
    projected = ImplicitStep(DAEFunctions(model), PROJECTION_SHARE * dt).solve_carefully(x, u, theta).x
    return projected if np.abs((projected - x) / model.state_scales).max() > PROJECTION_NOTICE else x
