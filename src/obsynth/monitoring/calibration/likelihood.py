"""The innovations likelihood of a log and its exact gradient, and the outputs of a simulation with sensitivities.

``nll = 1/2 sum(e' S^-1 e + log det 2 pi S)``, x(0) ~ N(x0, P0) integrated out; Q on named equations and R as logarithms
of variances.  CasADi differentiates one sample; two accumulations take the gradient back through the filter.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np

from obsynth.monitoring.calibration.problem import CalibrationProblem
from obsynth.monitoring.calibration.step_graphs import SampleGraphs, compiled
from obsynth.numerics import lazy_casadi as ca
from obsynth.numerics.arrays import FloatArray
from obsynth.plants.dae_functions import Compiled

#: A scaled Newton residual above this is no solution of a step.
LARGEST_STEP_RESIDUAL = 1e-7

#: Stands for the likelihood where there is none.
IMPOSSIBLE = 1e12


class Likelihood:
    """Negative log likelihood of a problem's record, or of other outputs ``y (n, ny)`` with NaN for what is missing, as
    a function of ``v = [t, log q, log r]``."""

    def __init__(self, problem: CalibrationProblem, y: FloatArray | None = None) -> None:
        graphs, noisy = problem.graphs, problem.noisy_equations
        self.ny, self.size = graphs.ny, graphs.nt + len(noisy) + graphs.ny
        y, self._nx = problem.y if y is None else y, graphs.nx
        self._both, self._missing = (
            Compiled(_likelihood_function(graphs, problem.u, y, noisy, problem.x0, problem.P0)),
            np.isnan(y),
        )

    def __call__(self, v: FloatArray) -> tuple[float, FloatArray]:
        """Return the value and its gradient ``(nt + len(noisy) + ny,)``."""
        total, gradient, rows, _ = self._both(v)
        step_residuals = rows[-1]
        good = (
            np.isfinite(total).all()
            and np.isfinite(gradient).all()
            and np.abs(step_residuals).max() <= LARGEST_STEP_RESIDUAL
        )
        return (float(total[0, 0]), gradient[:, 0]) if good else (IMPOSSIBLE, np.zeros(self.size))

    def at_end(self, v: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return the state after the last row ``(nx,)``, and its covariance."""
        packed = self._both(v)[3][:, 0]
        return packed[: self._nx], packed[self._nx :].reshape(self._nx, self._nx)

    def innovations(self, v: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return whitened innovations, innovations and their variances, each ``(n, ny)``; no innovation (NaN) where y
        is missing."""
        whitened, e, variances = (part.T for part in np.split(self._both(v)[2][1 : 1 + 3 * self.ny], 3))
        return np.where(self._missing, np.nan, whitened), np.where(self._missing, np.nan, e), variances


def _likelihood_function(
    graphs: SampleGraphs, u: FloatArray, y: FloatArray, noisy: Sequence[int], x0: FloatArray, P0: FloatArray
) -> Any:
    """Return the function from v to value, gradient, rows, and the state and covariance after them, packed."""
    nx, nt, n = graphs.nx, graphs.nt, len(y)
    first = _first(graphs, noisy)
    measured = np.isfinite(y)
    data = np.hstack([u, np.where(measured, y, 0.0), measured]).T
    v = ca.MX.sym("v", nt + len(noisy) + graphs.ny)
    begin = ca.DM(np.concatenate([x0, P0.ravel()]))
    state, row = first(begin, data[:, 0], v)
    rows, total = row, row[0]
    gradient = ca.MX.zeros(v.shape[0])
    size = nx + nx * nx
    back_first = first.reverse(1)
    if n > 1:
        forward, backward = _accumulated(graphs, noisy, size)
        states, later_rows, numbers = forward.mapaccum(n - 1)(state, data[:, 1:], ca.repmat(v, 1, n - 1))
        before = ca.horzcat(state, states[:, :-1])
        rows, total = ca.horzcat(row, later_rows), row[0] + ca.sum2(later_rows[0, :])
        flip = list(range(n - 2, -1, -1))
        costates = backward.mapaccum(n - 1)(
            ca.MX.zeros(size + v.shape[0]),
            before[:, flip],
            numbers[:, flip],
            ca.DM(data[:, 1:])[:, flip],
            ca.repmat(v, 1, n - 1),
        )
        end = costates[:, -1]
        costate, gradient, last = end[:size], end[size:], states[:, -1]
    else:
        costate, last = ca.MX.zeros(size), state
    seed = ca.MX.zeros(row.shape[0])
    seed[0] = 1.0
    gradient = gradient + back_first(begin, data[:, 0], v, state, row, costate, seed)[2]
    return ca.Function("likelihood", [v], [total, ca.densify(gradient), ca.densify(rows), ca.densify(last)])


def _update(graphs: SampleGraphs, x: Any, P: Any, u: Any, t: Any, log_r: Any, y: Any, measured: Any) -> tuple[Any, Any]:
    """Return the state and covariance after a measurement, packed; and its row: value, whitened, e, variances."""
    predicted, H, _ = graphs.outputs(x, u, t)
    H = ca.densify(H) * ca.repmat(measured, 1, graphs.nx)
    e = measured * (y - predicted)
    S = H @ P @ H.T + ca.diag(measured * ca.exp(log_r) + (1.0 - measured))
    root = ca.chol(ca.densify(S)).T
    whitened = ca.solve(root, ca.horzcat(e, H @ P))
    w, V = whitened[:, 0], whitened[:, 1:]
    after = P - V.T @ V
    value = 0.5 * ca.sumsqr(w) + ca.sum1(ca.log(ca.diag(root))) + 0.5 * math.log(2.0 * math.pi) * ca.sum1(measured)
    return ca.vertcat(x + V.T @ w, ca.vec(0.5 * (after + after.T))), ca.vertcat(value, w, e, ca.diag(S))


def _symbols(graphs: SampleGraphs, noisy: Sequence[int]) -> tuple[Any, ...]:
    nx, ny = graphs.nx, graphs.ny
    packed = ca.SX.sym("packed", nx + nx * nx)
    data = ca.SX.sym("data", graphs.nu + 2 * ny)
    v = ca.SX.sym("v", graphs.nt + len(noisy) + ny)
    u, y, measured = ca.vertsplit(data, [0, graphs.nu, graphs.nu + ny, graphs.nu + 2 * ny])
    t, log_q, log_r = ca.vertsplit(v, [0, graphs.nt, graphs.nt + len(noisy), v.numel()])
    return packed, data, v, u, y, measured, t, log_q, log_r


def _first(graphs: SampleGraphs, noisy: Sequence[int]) -> Any:
    packed, data, v, u, y, measured, t, _, log_r = _symbols(graphs, noisy)
    nx = graphs.nx
    x, P = packed[:nx], ca.reshape(packed[nx:], nx, nx)
    after, row = _update(graphs, x, P, u, t, log_r, y, measured)
    return ca.Function("first", [packed, data, v], [ca.densify(after), ca.densify(ca.vertcat(row, 0.0))])


def _later(graphs: SampleGraphs, noisy: Sequence[int]) -> Any:
    """Return one sample, with what was solved as numbers: from packed, data, v, tc, numbers to packed and row."""
    packed, data, v, u, y, measured, t, log_q, log_r = _symbols(graphs, noisy)
    nx = graphs.nx
    tc, numbers = ca.SX.sym("tc", graphs.nt), ca.SX.sym("numbers", graphs.numbers)
    P = ca.reshape(packed[nx:], nx, nx)
    x, F, _, way = graphs.local(packed[:nx], u, t, tc, numbers)
    added = way[:, list(noisy)]
    P = F @ P @ F.T + added @ ca.diag(ca.exp(log_q)) @ added.T if noisy else F @ P @ F.T
    after, row = _update(graphs, x, P, u, t, log_r, y, measured)
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
    functions: list[Any] = graphs.made[key]
    return functions


def _forward(graphs: SampleGraphs, later: Any) -> Any:
    packed, data, v = (ca.MX.sym(name, later.size1_in(i)) for i, name in enumerate(("packed", "data", "v")))
    x, u, t = packed[: graphs.nx], data[: graphs.nu], v[: graphs.nt]
    stages, step_residual = graphs.solve(x, u, t)
    numbers = graphs.sensitivities(x, u, t, stages)
    after, row = later(packed, data, v, t, numbers)
    return ca.Function("forward", [packed, data, v], [after, ca.vertcat(row, step_residual), numbers])


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
    derivatives = reverse(packed, data, v, v[: graphs.nt], numbers, *outputs, costate[:size], seed)
    after = ca.vertcat(derivatives[0], costate[size:] + derivatives[2])
    return ca.Function("backward", [costate, packed, numbers, data, v], [after])
