"""What is asked of a calibration, checked: a model with unknown constants, a log, priors and what is known of noise.

The innovations likelihood of a log and its exact gradient, and the outputs of a simulation with sensitivities.

``nll = 1/2 sum(e' S^-1 e + log det 2 pi S)``, x(0) ~ N(x0, P0) integrated out; Q on named equations and R as logarithms
of variances.  CasADi differentiates one sample; two accumulations take the gradient back through the filter.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from obsynth.calibration.logs import EVEN, Log, bad_log, quantum, refused, repeats
from obsynth.calibration.plants import CalibrationPlant, SampleGraphs, compiled, sample_graphs
from obsynth.errors import SpecError
from obsynth.numerics import lazy_casadi as ca
from obsynth.numerics.arguments import FloatArray, is_number, real_number, require_mapping, require_shape, whole_number
from obsynth.numerics.ranks import covariance_factor
from obsynth.observers.records import named_covariance, named_vector
from obsynth.plants.dae import Compiled
from obsynth.plants.descriptor import index_of

#: Measured values for each unknown constant and variance that are needed at least.
VALUES_PER_UNKNOWN = 5
#: Least deviation of a sensor, as a share of its largest value: rounding.
LEAST_NOISE = 1e-9


@dataclass(frozen=True, eq=False)
class Problem:
    """A plant with its log; arrays by unknown ``(nt,)``, by sensor ``(ny,)``, by noisy equation. ``u (n, ns)``: the
    signals that the plant takes of each row."""

    plant: CalibrationPlant
    log: Log
    u: FloatArray
    unknown: tuple[str, ...]
    nominal: FloatArray
    low: FloatArray
    high: FloatArray
    prior_means: FloatArray
    prior_weights: FloatArray
    noisy: tuple[str, ...]
    known_Q: FloatArray
    known_R: FloatArray
    x0: FloatArray
    P0: FloatArray
    quanta: FloatArray
    floors: FloatArray
    graphs: SampleGraphs
    integration: str
    substeps: int
    notes: tuple[str, ...] = ()

    @property
    def y(self) -> FloatArray:
        """Outputs ``(n, ny)``, NaN where missing."""
        return self.log.y

    @property
    def names(self) -> tuple[str, ...]:
        """The constants that were asked for; what is sought beside them stands last."""
        return self.unknown[: len(self.unknown) - len(self.plant.bounds)]

    @property
    def widths(self) -> FloatArray:
        """Width of the bounds of each unknown ``(nt,)``."""
        return self.high - self.low

    @property
    def output_names(self) -> tuple[str, ...]:
        """The sensors."""
        return self.log.output_names

    @property
    def noisy_equations(self) -> list[int]:
        """Numbers of the noisy equations."""
        return [self.plant.equation_names.index(name) for name in self.noisy]

    def integrated(self, integration: str, substeps: int) -> Problem:
        """Return the same problem with other steps."""
        graphs = sample_graphs(
            self.plant, self.unknown, self.log.dt, integration=integration, substeps=substeps, samples=self.log.samples
        )
        return Problem(**{**vars(self), "graphs": graphs, "integration": integration, "substeps": substeps})

    def with_start(self, P0: FloatArray, *notes: str) -> Problem:
        """Return the same problem with another covariance of the initial state, and what is said of that."""
        return Problem(**{**vars(self), "P0": P0, "notes": notes})

    def with_notes(self, *notes: str) -> Problem:
        """Return the same problem with more that is said of it."""
        return Problem(**{**vars(self), "notes": (*self.notes, *notes)})

    def with_log(self, log: Log) -> Problem:
        """Return the same problem with another log of the same signals."""
        return Problem(**{**vars(self), "log": log, "u": self.plant.signals(log)})


def calibration_problem(
    plant: CalibrationPlant,
    log: Log,
    *,
    unknown: Mapping[str, Sequence[float]],
    priors: Mapping[str, Sequence[float]] | None,
    noisy: Sequence[str] | None,
    Q: Mapping[str, float | None] | None,
    R: Mapping[str, float | None] | None,
    initial_state: Any,
    initial_covariance: Any,
    integration: str,
    substeps: int,
) -> Problem:
    """Return the problem, or say what is wrong with what is asked."""
    substeps = whole_number(substeps, "substeps")
    if not log.samples > 1:
        raise bad_log("too-short", f"The log has {log.samples} row(s): a calibration needs more.")
    if not isinstance(unknown, Mapping):
        raise SpecError("unknown must be a mapping from names to [low, high], such as {k: [0.5, 2]}.", path="unknown")
    unknown = {**unknown, **plant.bounds}
    names = tuple(unknown)
    for name in names:
        index_of(name, list(plant.values), what="unknown")
    values = _started(unknown, plant)
    low, high = _bounds(unknown, values)
    equations = tuple(plant.equation_names if noisy is None else noisy)
    for name in equations:
        index_of(name, plant.equation_names, what="noisy (the equations that Q names)")
    means, weights = _priors(priors, names, values)
    known_Q = _variances(Q, equations, "Q")
    known_R = _variances(R, log.output_names, "R")
    quanta = np.array([quantum(column) for column in log.y.T])
    _require_enough(log, len(names), int(np.isnan(known_Q).sum() + np.isnan(known_R).sum()))
    x0 = named_vector(initial_state, plant.state_names, plant.nominal_state, "initial_state")
    graphs = sample_graphs(plant, names, log.dt, integration=integration, substeps=substeps, samples=log.samples)
    return Problem(
        plant,
        log,
        plant.signals(log),
        names,
        np.array([values[name] for name in names]),
        low,
        high,
        means,
        weights,
        equations,
        known_Q,
        known_R,
        x0,
        _covariance(plant, initial_covariance),
        quanta,
        _floors(log.y, quanta),
        graphs,
        integration,
        substeps,
    )


def _floors(y: FloatArray, quanta: FloatArray) -> FloatArray:
    """Return the least variance of each sensor ``(ny,)``: of its quantisation, where values repeat, or of rounding."""
    held = np.array([repeats(column) for column in y.T])
    largest = np.nanmax(np.abs(y), axis=0)
    return np.maximum(np.where(held, quanta**2 / EVEN, 0.0), (LEAST_NOISE * np.where(largest > 0.0, largest, 1.0)) ** 2)


def _require_enough(log: Log, constants: int, variances: int) -> None:
    """Refuse a question without unknowns, or with more of them than the log can determine."""
    if not constants and not variances:
        raise SpecError(
            "unknown is empty, and Q and R are known: there is nothing to estimate. Name constants with their "
            "bounds, or leave variances out.",
            path="unknown",
        )
    needed, seen = VALUES_PER_UNKNOWN * (constants + variances), int(np.isfinite(log.y).sum())
    if seen < needed:
        raise bad_log(
            "too-short",
            f"The log is too short: {seen} measured values for {constants} constants and "
            f"{variances} variances; at least {needed} are needed. Take more rows, fewer unknowns, or state "
            "Q and R.",
        )


def _started(unknown: Mapping[str, Sequence[float]], plant: CalibrationPlant) -> dict[str, float]:
    """Return nominal values; the middle of its bounds for what has none within them and none that is stated."""
    values = dict(plant.values)
    for name in plant.unstated.intersection(unknown):
        pair = unknown[name]
        if _is_pair(pair) and not pair[0] <= values[name] <= pair[1]:
            values[name] = 0.5 * (float(pair[0]) + float(pair[1]))
    return values


def _is_pair(pair: Any) -> bool:
    """Whether a value is two finite numbers."""
    return np.shape(pair) == (2,) and all(is_number(entry) and np.isfinite(entry) for entry in pair)


def _bounds(unknown: Mapping[str, Sequence[float]], values: Mapping[str, float]) -> tuple[FloatArray, FloatArray]:
    rows = []
    for name, pair in unknown.items():
        if not _is_pair(pair) or not pair[0] < pair[1]:
            raise SpecError(
                f"unknown.{name} is {pair!r}: give [low, high], finite, the lower one first.", path=f"unknown.{name}"
            )
        if not pair[0] <= values[name] <= pair[1]:
            raise SpecError(
                f"The nominal value of {name!r}, {values[name]:g}, is outside its bounds [{pair[0]:g}, "
                f"{pair[1]:g}]: move one of them.",
                path=f"unknown.{name}",
            )
        rows.append([float(pair[0]), float(pair[1])])
    low, high = np.array(rows).reshape(len(rows), 2).T
    return low, high


def _priors(
    priors: Mapping[str, Sequence[float]] | None, names: Sequence[str], values: Mapping[str, float]
) -> tuple[FloatArray, FloatArray]:
    means, weights = np.array([values[name] for name in names]), np.zeros(len(names))
    for name, pair in (priors or {}).items():
        i = index_of(name, names, what="priors")
        if not _is_pair(pair) or not pair[1] > 0.0:
            raise SpecError(f"priors.{name} is {pair!r}: give [mean, standard deviation].", path=f"priors.{name}")
        means[i], weights[i] = float(pair[0]), float(pair[1]) ** -2
    return means, weights


def _variances(given: Mapping[str, float | None] | None, names: Sequence[str], what: str) -> FloatArray:
    """Return known variances, NaN for those that are to be found."""
    require_mapping(given, what)
    found = np.full(len(names), np.nan)
    for name, value in (given or {}).items():
        i = index_of(name, names, what=what)
        if value is None:
            continue
        found[i] = real_number(
            value, f"{what}.{name}", "a positive variance, or leave it out to have it found", above=0.0
        )
    return found


def _covariance(plant: CalibrationPlant, value: Any) -> FloatArray:
    default, nx = plant.state_deviations**2, len(plant.state_names)
    matrix = named_covariance(value, plant.state_names, "initial_covariance", default, others=default)
    require_shape(matrix.shape, (nx, nx), "initial_covariance")
    covariance_factor(matrix, "initial_covariance")
    return matrix


def require_variation(problem: Problem) -> None:
    """Refuse a log in which nothing moves and nothing is put in: it determines no constant."""
    if not np.nanstd(problem.y, axis=0).any() and not np.std(problem.u, axis=0).any():
        raise refused(
            "not-exciting",
            "Every signal is constant in these rows: they hold no information on the dynamics.",
            signals=list(problem.unknown),
        )


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
        y, self._nx = problem.y if y is None else y, graphs.nx
        self._both, self._missing = Compiled(_whole(graphs, problem.u, y, noisy, problem.x0, problem.P0)), np.isnan(y)

    def __call__(self, v: FloatArray) -> tuple[float, FloatArray]:
        """Return the value and its gradient ``(nt + len(noisy) + ny,)``."""
        total, gradient, rows, _ = self._both(v)
        left = rows[-1]
        good = np.isfinite(total).all() and np.isfinite(gradient).all() and np.abs(left).max() <= LARGEST_STEP_RESIDUAL
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


def _whole(
    graphs: SampleGraphs, u: FloatArray, y: FloatArray, noisy: Sequence[int], x0: FloatArray, P0: FloatArray
) -> Any:
    """Return the function from v to value, gradient, rows, and the state and covariance after them, packed."""
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
        costate, gradient, last = end[:size], end[size:], states[:, -1]
    else:
        costate, last = ca.MX.zeros(size), state
    seed = ca.MX.zeros(row.shape[0])
    seed[0] = 1.0
    gradient = gradient + back_first(begin, data[:, 0], v, state, row, costate, seed)[2]
    return ca.Function("likelihood", [v], [total, ca.densify(gradient), ca.densify(rows), ca.densify(last)])


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
