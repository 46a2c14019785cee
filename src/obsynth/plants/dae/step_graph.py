"""One implicit step of a DAE as CasADi functions: a Newton iteration, the whole step, and its sensitivities.

The iteration is the undamped one of `obsynth.numerics.newton`.  Where that would damp, lead the input along a homotopy,
or give up, the whole step says that it is not to be trusted, and the caller takes `ImplicitStep.solve`.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from obsynth.numerics.arrays import FloatArray
from obsynth.numerics.newton import LARGEST_RESIDUAL, LAST_STEP, MOST_ITERATIONS
from obsynth.numerics.symbolic_solve import SMALL, equilibrated, solved
from obsynth.plants.dae.functions import DAEFunctions

#: Iterations that every step takes, and further ones in blocks for those that need them.  From the last sample's state
#: three or four are the rule.
BLOCKS = (4, 4, 8, MOST_ITERATIONS - 16)


@dataclass(frozen=True, eq=False)
class StepGraph:
    """The functions of one implicit step of fixed length.

    Fields: newton: From stages, state before, input and parameters to the residual, its scale by rows, and the Newton
    step; sensitivities: From the same to F ``(nx, nx)`` of (8), G ``(nx, nq)`` of (9), the derivative with respect to
    what is added to the equations ``(nx, nx)``, and the equilibrated matrix of (7); step: From state before, input and
    parameters to stages, scaled residual, and one if the step is to be trusted; small: Whether everything is scalar
    operations.
    """

    newton: Any
    sensitivities: Any
    step: Any
    small: bool


def step_graph(functions: DAEFunctions, dt: float, largest_move: float) -> StepGraph:
    """Return the functions of one implicit step."""
    graphs, key = functions.model.graphs, (functions.method, dt, largest_move)
    if key not in graphs:
        graphs[key] = _graph(functions, dt, largest_move)
    found: StepGraph = graphs[key]
    return found


def _graph(functions: DAEFunctions, dt: float, largest_move: float) -> StepGraph:
    import casadi as ca

    model, stages = functions.model, functions.stages
    n = model.nx * stages
    sizes = np.tile(model.state_scales, stages)
    X, x = ca.MX.sym("X", n), ca.MX.sym("x", model.nx)
    u, theta = ca.MX.sym("u", model.nu), ca.MX.sym("theta", model.nq)
    point = [X, x, u, theta]
    value, J = functions.residual_function(*point, dt)
    scaled, rows = equilibrated(J, sizes)
    newton = ca.Function("newton", point, [value, rows, sizes * solved(scaled, -rows * value)])
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
        newton, local = newton.expand(), local.expand()
    return StepGraph(newton, local, _whole(newton, sizes, stages, largest_move), n <= SMALL)


def _whole(newton: Any, sizes: FloatArray, stages: int, largest_move: float) -> Any:
    """Return the step: blocks of iterations, the later ones taken only where the earlier have not ended."""
    import casadi as ca

    point = [ca.MX.sym("x", len(sizes) // stages), *(ca.MX.sym(name, newton.size1_in(i)) for i, name in ((2, "u"),
             (3, "theta")))]  # fmt: skip
    start = ca.repmat(point[0], stages, 1)
    state = [start, *newton(start, *point), ca.MX(0.0), ca.MX(0.0), ca.MX(0.0)]
    for i, count in enumerate(BLOCKS):
        block, done = _block(newton, sizes, count), state[4]
        if i:
            inputs = block.mx_in()
            kept = ca.Function("kept", inputs, inputs[: len(state)])
            block = ca.Function.if_else("further", kept, block)
            state = list(block(done, *state, *point))
        else:
            state = list(block(*state, *point))
    X, done, converged, residual = state[0], *state[4:]
    near = _all(ca.fabs(X - start) <= largest_move * ca.DM(sizes)) if np.isfinite(largest_move) else ca.MX(1.0)
    trusted = ca.logic_and(ca.logic_and(done, converged), near)
    return ca.Function("step", point, [X, residual, trusted], ["x", "u", "theta"], ["stages", "residual", "trusted"])


def _block(newton: Any, sizes: FloatArray, count: int) -> Any:
    """Return some iterations, from and to stages, residual, row scales, Newton step, and whether and how it ended."""
    import casadi as ca

    inputs = [newton.mx_in(0)] + [ca.MX.sym(name, len(sizes)) for name in ("value", "rows", "move")]
    inputs += [ca.MX.sym(name) for name in ("done", "converged", "residual")]
    point = [newton.mx_in(i) for i in (1, 2, 3)]
    X, value, rows, move, done, converged, residual = inputs
    for _ in range(count):
        # A comparison with what is not a number is false, so that it never converges.
        last = _all(ca.fabs(move) <= LAST_STEP * ca.fmax(ca.fabs(X), ca.DM(sizes)))
        after = [X + move, *newton(X + move, *point)]
        reached = ca.fabs(rows * after[1])
        smaller = _all(reached < ca.mmax(ca.fabs(rows * value)))
        solved_now = ca.logic_and(last, _all(reached <= LARGEST_RESIDUAL))
        converged = ca.if_else(done, converged, solved_now)
        residual = ca.if_else(done, residual, ca.mmax(reached))
        X, value, rows, move = (
            ca.if_else(done, old, new) for old, new in zip((X, value, rows, move), after, strict=True)
        )
        done = ca.logic_or(done, ca.logic_or(last, ca.logic_not(smaller)))
    found = ca.Function("iterations", [*inputs, *point], [X, value, rows, move, done, converged, residual])
    return found.expand() if len(sizes) <= SMALL else found


def _all(conditions: Any) -> Any:
    import casadi as ca

    return ca.sum1(conditions) >= float(conditions.numel())
