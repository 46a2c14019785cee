"""The innovations likelihood of a log and its exact gradient, and the outputs of a simulation with sensitivities.

``nll = 1/2 sum(e' S^-1 e + log det 2 pi S)``, x(0) ~ N(x0, P0) integrated out; Q on named equations and R as logarithms
of variances.  CasADi differentiates one sample; two accumulations take the gradient back through the filter.

One sample of a nonlinear plant as CasADi functions of state, input and unknown constants, with derivatives.

Newton's iterations are not differentiated: the solved stages and their first derivatives enter as numbers, and the
implicit function theorem does the rest.  Machine code where a C compiler is there and the work is long enough.
"""

from __future__ import annotations

import math
import subprocess
import tempfile
from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np

from obsynth.calibration.plants import CalibrationPlant
from obsynth.calibration.problem import Problem
from obsynth.numerics import lazy_casadi as ca
from obsynth.numerics.arrays import SMALLEST, FloatArray
from obsynth.numerics.newton import largest_entries
from obsynth.observers.dae.c_code import compiler
from obsynth.plants.dae.functions import Compiled

#: Optimisation costs more than it gains on straight code of thousands of lines.
STRAIGHT_CODE_FLAGS = ("-std=c99", "-O1", "-ffp-contract=off", "-shared", "-fPIC")


def compiled(functions: Sequence[Any]) -> list[Any]:
    """Return the same functions as machine code; as they are where there is no compiler or it fails."""
    command = compiler()
    if command is None:
        return list(functions)
    generator = ca.CodeGenerator("calibration.c")
    for function in functions:
        generator.add(function)
    try:
        return list(
            _loaded(
                generator.dump(), tuple(function.name() for function in functions), (*command, *STRAIGHT_CODE_FLAGS)
            )
        )
    except subprocess.CalledProcessError:
        return list(functions)


@lru_cache(maxsize=16)
def _loaded(code: str, names: tuple[str, ...], command: tuple[str, ...]) -> tuple[Any, ...]:
    """Return functions of C code; the same code is compiled once."""
    with tempfile.TemporaryDirectory(prefix="obsynth-", ignore_cleanup_errors=True) as folder:
        source, library = Path(folder) / "calibration.c", Path(folder) / "calibration.so"
        source.write_text(code, encoding="utf-8", newline="\n")
        subprocess.run([*command, str(source), "-o", str(library), "-lm"], capture_output=True, check=True)
        # What is loaded stays when the file is gone; Windows keeps the file.
        return tuple(ca.external(name, str(library)) for name in names)


#: Newton iterations of every step, from the last sample's state, and further ones where the residual is above
#: `SOLVED_STEP`.
ITERATIONS, FURTHER_ITERATIONS = 3, 8
SOLVED_STEP = 1e-11
#: Operations in one evaluation above which functions are compiled: a second or so, before a thousand evaluations.
COMPILED_OPERATIONS = 200_000


@dataclass(frozen=True, eq=False)
class SampleGraphs:
    """The functions of one sample; ``u (nu,)`` are the signals, ``t (nt,)`` the unknown constants."""

    solve: Any  # from x, u, t to the stages of all substeps and the scaled residual that is left
    sensitivities: Any  # from x, u, t, stages to what `local` takes as numbers: stages and their derivatives
    local: Any  # from x, u, t, t and those numbers to the state after, F, G by t, and the noise's way
    outputs: Any  # from x, u, t to y, H and L by t
    fast: Any  # `local`, to be evaluated and not to be differentiated
    nx: int
    nu: int
    ny: int
    nt: int
    numbers: int
    in_c: bool  # whether functions are machine code
    made: dict[Any, Any] = field(default_factory=dict, repr=False)


def sample_graphs(
    plant: CalibrationPlant, unknown: Sequence[str], dt: float, *, integration: str, substeps: int, samples: int = 1
) -> SampleGraphs:
    """Return the functions of one sample of ``dt`` seconds, in C where there are many."""
    base = _Substep(plant, unknown, dt / substeps, integration)
    nx, nu, nt, n = len(plant.state_scales), len(plant.nominal_signals), len(unknown), base.size
    x, u, t = ca.MX.sym("x", nx), ca.MX.sym("u", nu), ca.MX.sym("t", nt)
    stages: list[Any] = []
    state, left = x, ca.MX(0.0)
    for _ in range(substeps):
        X, rest = base.solve(ca.repmat(state, base.stages, 1), state, u, t)
        stages, state, left = [*stages, X], X[n - nx :], ca.fmax(left, rest)
    solve = ca.Function("solve", [x, u, t], [ca.vertcat(*stages), left])

    Z, numbers, state = ca.MX.sym("Z", n * substeps), [x], x
    for i in range(substeps):
        X = Z[n * i : n * (i + 1)]
        numbers += [X, *(ca.vec(part) for part in base.derivatives(X, state, u, t))]
        state = X[n - nx :]
    packed = ca.vertcat(*numbers)
    sensitivities = ca.Function("sensitivities", [x, u, t, Z], [packed])
    outputs = plant.outputs(unknown)
    local = _local(base, substeps, nx, nu, nt)
    fast, in_c = local, 8 * samples * local.n_instructions() > COMPILED_OPERATIONS
    if in_c:
        solve, sensitivities, fast = compiled([solve, sensitivities, local])
    return SampleGraphs(
        solve, sensitivities, local, outputs, fast, nx, nu, outputs.size1_out(0), nt, packed.shape[0], in_c
    )


def _local(base: _Substep, substeps: int, nx: int, nu: int, nt: int) -> Any:
    """Return the differentiable part: values from the numbers, derivatives from the equations at them."""
    n = base.size
    x, u, t, tc = (ca.SX.sym(name, size) for name, size in (("x", nx), ("u", nu), ("t", nt), ("tc", nt)))
    length = nx + substeps * n * (1 + nx + nt)
    packed = ca.SX.sym("numbers", length)
    before, state, place = packed[:nx], x, nx
    F, G, noise = ca.SX.eye(nx), ca.SX.zeros(nx, nt), ca.SX.zeros(nx, nx)
    for _ in range(substeps):
        X = packed[place : place + n]
        by_x = ca.reshape(packed[place + n : place + n * (1 + nx)], n, nx)
        by_t = ca.reshape(packed[place + n * (1 + nx) : place + n * (1 + nx + nt)], n, nt)
        moved = X + by_x @ (state - before) + by_t @ (t - tc)
        by_x, by_t, way = base.symbolic(moved, state, u, t)
        # What is added to the equations is added during the whole sample, in every substep.
        noise = by_x[n - nx :, :] @ noise + way
        F, G = by_x[n - nx :, :] @ F, by_x[n - nx :, :] @ G + by_t[n - nx :, :]
        state, before, place = moved[n - nx :], X[n - nx :], place + n * (1 + nx + nt)
    return ca.Function("local", [x, u, t, tc, packed], [state, ca.densify(F), ca.densify(G), ca.densify(noise)])


class _Substep:
    """One implicit step: its Newton iteration and its derivatives, by elimination in an order that is fixed."""

    def __init__(self, plant: CalibrationPlant, unknown: Sequence[str], dt: float, integration: str) -> None:
        self.nx, self.dt = len(plant.state_scales), dt
        self.stages, self.function = plant.step(unknown, integration)
        self.size = self.stages * self.nx
        X, x = ca.SX.sym("X", self.size), ca.SX.sym("x", self.nx)
        u, t = ca.SX.sym("u", len(plant.nominal_signals)), ca.SX.sym("t", len(unknown))
        sizes = ca.DM(np.tile(plant.state_scales, self.stages))
        equations = self.function(X, x, u, t, self.dt)
        J = ca.jacobian(equations, X)
        values = np.array([plant.values[name] for name in unknown])
        self.order = _pivots(ca.Function("J", [X, x, u, t], [ca.densify(J)]), plant, self.stages, values)
        step = eliminated(J, -equations, self.order)
        weights = 1.0 / ca.fmax(largest_entries(ca.densify(J) @ ca.diag(sizes)), SMALLEST)
        left = ca.mmax(ca.fabs(weights * equations)) if self.size > 1 else ca.fabs(weights * equations)
        # The residual is that before the iteration, so that the last one is better than it says.
        self.newton = ca.Function("newton", [X, x, u, t], [X + step, left])
        self.solve = self._solve()
        found = [ca.densify(part) for part in self.symbolic(X, x, u, t)[:2]]
        self.derivatives = ca.Function("derivatives", [X, x, u, t], found)

    def _solve(self) -> Any:
        """Return the solution of the stages from a start, in as many iterations as it takes."""
        start = [ca.MX.sym(name, self.newton.size1_in(i)) for i, name in enumerate(("X", "x", "u", "t"))]
        X, before = start[0], start[1:]
        for _ in range(ITERATIONS):
            X, left = self.newton(X, *before)
        X, left = self.newton(X, *before)
        more, rest = start[0], ca.MX(0.0)
        for _ in range(FURTHER_ITERATIONS):
            more, rest = self.newton(more, *before)
        further = ca.Function("iterate", start, [more, rest])
        done = ca.Function("done", start, [start[0], ca.MX(0.0)])
        choice = ca.Function.if_else("choice", further, done)
        unsolved = ca.logic_not(left <= SOLVED_STEP)
        after, rest = choice(unsolved, X, *before)
        return ca.Function("solution", start, [after, ca.if_else(unsolved, rest, left)])

    def symbolic(self, X: Any, x: Any, u: Any, t: Any) -> tuple[Any, Any, Any]:
        """Return the derivatives of the stages by x and by t, and of the state after by what is added."""
        Xs, xs, us, ts = (ca.SX.sym(name, part.numel()) for name, part in zip("Xxut", (X, x, u, t), strict=True))
        equations, nx, nt = self.function(Xs, xs, us, ts, self.dt), self.nx, ts.numel()
        right = ca.horzcat(
            -ca.jacobian(equations, xs), -ca.jacobian(equations, ts), ca.repmat(ca.SX.eye(nx), self.stages, 1)
        )
        found = eliminated(ca.jacobian(equations, Xs), right, self.order)
        found = ca.Function("found", [Xs, xs, us, ts], [found])(X, x, u, t)
        return found[:, :nx], found[:, nx : nx + nt], found[self.size - nx :, nx + nt :]


def _pivots(jacobian: Any, plant: CalibrationPlant, stages: int, values: FloatArray) -> list[int]:
    """Return the order of rows in which elimination goes at the nominal point."""
    from scipy.linalg import lu_factor

    x = plant.nominal_state
    J = np.array(jacobian(np.tile(x, stages), x, plant.nominal_signals, values))
    J = np.nan_to_num(J * np.tile(plant.state_scales, stages))
    peaks = np.abs(J).max(axis=1)
    _, exchanges = lu_factor(J / np.where(peaks > 0.0, peaks, 1.0)[:, None], check_finite=False)
    order = list(range(len(J)))
    for i, j in enumerate(exchanges):
        order[i], order[j] = order[j], order[i]
    return order


def eliminated(matrix: Any, right: Any, order: Sequence[int]) -> Any:
    """Return ``matrix^-1 right`` by scalar operations, rows in a given order; structural zeros cost nothing."""
    n, m = matrix.shape[0], right.shape[1]
    rows = [[matrix[i, j] for j in range(n)] + [right[i, j] for j in range(m)] for i in order]
    for j in range(n):
        for i in range(j + 1, n):
            if rows[i][j].is_zero():
                continue
            factor = rows[i][j] / rows[j][j]
            for c in range(j + 1, n + m):
                if not rows[j][c].is_zero():
                    rows[i][c] = rows[i][c] - factor * rows[j][c]
    found: list[list[Any]] = [[]] * n
    for j in reversed(range(n)):
        solution = []
        for c in range(m):
            rest = rows[j][n + c]
            for i in range(j + 1, n):
                if not (rows[j][i].is_zero() or found[i][c].is_zero()):
                    rest = rest - rows[j][i] * found[i][c]
            solution.append(rest if rest.is_zero() else rest / rows[j][j])
        found[j] = solution
    return ca.vertcat(*(ca.horzcat(*row) for row in found))


#: A scaled Newton residual above this is no solution of a step.
LARGEST_STEP_RESIDUAL = 1e-7
#: Stands for the likelihood where there is none.
IMPOSSIBLE = 1e12


class Likelihood:
    """Negative log likelihood of a problem's record, or of other outputs ``y (n, ny)`` with NaN for what is missing, as
    a function of ``v = [t, log q, log r]``."""

    def __init__(self, problem: Problem, y: FloatArray | None = None) -> None:
        graphs, noisy = problem.graphs, problem.noisy_equations
        self.ny, self.size = graphs.ny, graphs.nt + len(noisy) + graphs.ny
        self._both = Compiled(_whole(graphs, problem.u, problem.y if y is None else y, noisy, problem.x0, problem.P0))

    def __call__(self, v: FloatArray) -> tuple[float, FloatArray]:
        """Return the value and its gradient ``(nt + len(noisy) + ny,)``."""
        total, gradient, rows = self._both(v)
        left = rows[-1]
        good = np.isfinite(total).all() and np.isfinite(gradient).all() and np.abs(left).max() <= LARGEST_STEP_RESIDUAL
        return (float(total[0, 0]), gradient[:, 0]) if good else (IMPOSSIBLE, np.zeros(self.size))

    def innovations(self, v: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return whitened innovations, innovations and their variances, each ``(n, ny)``; zero where y is missing."""
        rows, ny = self._both(v)[2], self.ny
        return rows[1 : 1 + ny].T, rows[1 + ny : 1 + 2 * ny].T, rows[1 + 2 * ny : 1 + 3 * ny].T


def _whole(
    graphs: SampleGraphs, u: FloatArray, y: FloatArray, noisy: Sequence[int], x0: FloatArray, P0: FloatArray
) -> Any:
    """Return the function from v to value, gradient and rows."""
    nx, nt, n = graphs.nx, graphs.nt, len(y)
    first = _first(graphs, noisy)
    seen = np.isfinite(y)
    data = np.hstack([u, np.where(seen, y, 0.0), seen]).T
    v = ca.MX.sym("v", nt + len(noisy) + graphs.ny)
    begin = ca.DM(np.concatenate([x0, P0.ravel()]))
    state, row = first(begin, data[:, 0], v)
    rows, total = row, row[0]
    gradient = ca.MX.zeros(v.shape[0])
    size = nx + nx * nx
    back_first = first.reverse(1)
    if n > 1:
        forward, backward = _accumulated(graphs, noisy, size)
        states, said, numbers = forward.mapaccum(n - 1)(state, data[:, 1:], ca.repmat(v, 1, n - 1))
        before = ca.horzcat(state, states[:, :-1])
        rows, total = ca.horzcat(row, said), row[0] + ca.sum2(said[0, :])
        flip = list(range(n - 2, -1, -1))
        costates = backward.mapaccum(n - 1)(
            ca.MX.zeros(size + v.shape[0]),
            before[:, flip],
            numbers[:, flip],
            ca.DM(data[:, 1:])[:, flip],
            ca.repmat(v, 1, n - 1),
        )
        end = costates[:, -1]
        costate, gradient = end[:size], end[size:]
    else:
        costate = ca.MX.zeros(size)
    seed = ca.MX.zeros(row.shape[0])
    seed[0] = 1.0
    gradient = gradient + back_first(begin, data[:, 0], v, state, row, costate, seed)[2]
    return ca.Function("likelihood", [v], [total, ca.densify(gradient), ca.densify(rows)])


def _update(graphs: SampleGraphs, x: Any, P: Any, u: Any, t: Any, log_r: Any, y: Any, seen: Any) -> tuple[Any, Any]:
    """Return the state and covariance after a measurement, packed; and its row: value, whitened, e, variances."""
    predicted, H, _ = graphs.outputs(x, u, t)
    H = ca.densify(H) * ca.repmat(seen, 1, graphs.nx)
    e = seen * (y - predicted)
    S = H @ P @ H.T + ca.diag(seen * ca.exp(log_r) + (1.0 - seen))
    root = ca.chol(ca.densify(S)).T
    whitened = ca.solve(root, ca.horzcat(e, H @ P))
    w, V = whitened[:, 0], whitened[:, 1:]
    after = P - V.T @ V
    value = 0.5 * ca.sumsqr(w) + ca.sum1(ca.log(ca.diag(root))) + 0.5 * math.log(2.0 * math.pi) * ca.sum1(seen)
    return ca.vertcat(x + V.T @ w, ca.vec(0.5 * (after + after.T))), ca.vertcat(value, w, e, ca.diag(S))


def _symbols(graphs: SampleGraphs, noisy: Sequence[int]) -> tuple[Any, ...]:
    nx, ny = graphs.nx, graphs.ny
    packed = ca.SX.sym("packed", nx + nx * nx)
    data = ca.SX.sym("data", graphs.nu + 2 * ny)
    v = ca.SX.sym("v", graphs.nt + len(noisy) + ny)
    u, y, seen = ca.vertsplit(data, [0, graphs.nu, graphs.nu + ny, graphs.nu + 2 * ny])
    t, log_q, log_r = ca.vertsplit(v, [0, graphs.nt, graphs.nt + len(noisy), v.numel()])
    return packed, data, v, u, y, seen, t, log_q, log_r


def _first(graphs: SampleGraphs, noisy: Sequence[int]) -> Any:
    packed, data, v, u, y, seen, t, _, log_r = _symbols(graphs, noisy)
    nx = graphs.nx
    x, P = packed[:nx], ca.reshape(packed[nx:], nx, nx)
    after, row = _update(graphs, x, P, u, t, log_r, y, seen)
    return ca.Function("first", [packed, data, v], [ca.densify(after), ca.densify(ca.vertcat(row, 0.0))])


def _later(graphs: SampleGraphs, noisy: Sequence[int]) -> Any:
    """Return one sample, with what was solved as numbers: from packed, data, v, tc, numbers to packed and row."""
    packed, data, v, u, y, seen, t, log_q, log_r = _symbols(graphs, noisy)
    nx = graphs.nx
    tc, numbers = ca.SX.sym("tc", graphs.nt), ca.SX.sym("numbers", graphs.numbers)
    P = ca.reshape(packed[nx:], nx, nx)
    x, F, _, way = graphs.local(packed[:nx], u, t, tc, numbers)
    added = way[:, list(noisy)]
    P = F @ P @ F.T + added @ ca.diag(ca.exp(log_q)) @ added.T if noisy else F @ P @ F.T
    after, row = _update(graphs, x, P, u, t, log_r, y, seen)
    return ca.Function("later", [packed, data, v, tc, numbers], [ca.densify(after), ca.densify(row)])


def _accumulated(graphs: SampleGraphs, noisy: Sequence[int], size: int) -> list[Any]:
    """Return what goes forward and back over samples, made once for all logs of a problem."""
    key = tuple(noisy)
    if key not in graphs.made:
        later = _later(graphs, noisy)
        backward = _backward(graphs, later, size)
        if graphs.in_c:
            later, backward = compiled([later, backward])
        graphs.made[key] = [_forward(graphs, later), backward]
    found: list[Any] = graphs.made[key]
    return found


def _forward(graphs: SampleGraphs, later: Any) -> Any:
    packed, data, v = (ca.MX.sym(name, later.size1_in(i)) for i, name in enumerate(("packed", "data", "v")))
    x, u, t = packed[: graphs.nx], data[: graphs.nu], v[: graphs.nt]
    stages, left = graphs.solve(x, u, t)
    numbers = graphs.sensitivities(x, u, t, stages)
    after, row = later(packed, data, v, t, numbers)
    return ca.Function("forward", [packed, data, v], [after, ca.vertcat(row, left), numbers])


def _backward(graphs: SampleGraphs, later: Any, size: int) -> Any:
    """Return the accumulation of costate and gradient over samples that go back."""
    names = ("packed", "data", "v")
    packed, data, v = (ca.MX.sym(name, later.size1_in(i)) for i, name in enumerate(names))
    numbers, costate = ca.MX.sym("numbers", graphs.numbers), ca.MX.sym("costate", size + v.shape[0])
    reverse = later.reverse(1)
    seed = ca.MX.zeros(later.size1_out(1))
    seed[0] = 1.0
    nothing = [ca.MX(later.size1_out(i), 1) for i in range(2)]
    # The derivative of scalar operations takes its function's results as arguments without using them.
    unused = all(reverse.nnz_in(i) == 0 for i in (5, 6))
    outputs = nothing if unused else list(later(packed, data, v, v[: graphs.nt], numbers))
    found = reverse(packed, data, v, v[: graphs.nt], numbers, *outputs, costate[:size], seed)
    after = ca.vertcat(found[0], costate[size:] + found[2])
    return ca.Function("backward", [costate, packed, numbers, data, v], [after])
