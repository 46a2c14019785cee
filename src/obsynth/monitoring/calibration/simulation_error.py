"""The start of a calibration: constants and initial state whose simulation follows the log, by sensitivities."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from obsynth.monitoring.calibration.likelihood import LARGEST_STEP_RESIDUAL
from obsynth.monitoring.calibration.logs import refused, roughness
from obsynth.monitoring.calibration.problem import CalibrationProblem
from obsynth.numerics import lazy_casadi as ca
from obsynth.numerics.arrays import SMALLEST, FloatArray
from obsynth.plants.dae_functions import Compiled
from obsynth.plants.noise import offset_state
from obsynth.results.number_texts import point_in_time

BoolArray = NDArray[np.bool_]

#: Rounds in which the sensors' weights are estimated again; the first is robust against single wrong values.
WEIGHT_ROUNDS = 3

MOST_FIT_EVALUATIONS = 60

#: Share of a signal's deviation that stands for its noise before anything is fitted.
FIRST_NOISE = 0.05

#: Further starts keep this share of the bounds' width away from them; every start keeps the second.
DRAWN, INSIDE = 0.05, 1e-9

#: Residuals are cut here, so that a trajectory that runs away does not overflow.
LARGEST_MISFIT = 1e6

#: A moving signal of whose deviation more than this share is left is not explained; and one that rests.
UNEXPLAINED = 0.9

UNEXPLAINED_AT_REST = 5.0

#: A signal moves if its deviation is this many times its roughness from sample to sample.
MOVING_SIGNAL = 3.0

#: A simulated output that moves by less than this share of what its sensor does is moved by no input.
UNMOVED_OUTPUT = 1e-9

#: A simulation is off by what runs away if no more than this share of it is left beside a polynomial of so many degrees
#: (what is integrated twice, with what drag makes of it), in at least so many rows.
DRIFT_REST, DRIFT_DEGREE, LEAST_DRIFT_ROWS = 0.1, 3, 20

#: Without inputs, outputs that move by more than this multiple of what the states' sizes make are of other units.
OUTSIZED = 10.0

#: A sensor that the best fit does not explain, and whose level is so many times another, is in other units.
OTHER_LEVEL = 30.0

#: Deviations by which a fitted initial state may differ from the nominal one where its covariance is not stated.
START_LIMIT = 3.0

#: Whitened innovations of the first rows beyond this do not fit the start; by how much wider it is then sought.
FIRST_ROWS, FIRST_LIMIT, UNKNOWN_START = 2, 4.0, 10.0


@dataclass(frozen=True, eq=False)
class Fit:
    """A simulation that follows the log: ``t (nt,)``, ``x0 (nx,)``, deviations of the sensors ``(ny,)``, cost."""

    t: FloatArray
    x0: FloatArray
    deviations: FloatArray
    cost: float
    information: FloatArray


class SimulationError:
    """Weighted differences between simulation and log, prior terms included, as a function of ``[t, x0]`` scaled."""

    def __init__(self, problem: CalibrationProblem) -> None:
        self.problem, graphs = problem, problem.graphs
        self.spread = np.sqrt(np.maximum(np.diag(problem.P0), SMALLEST))
        self.scale = np.concatenate([problem.widths, self.spread])
        self.run = Compiled(_simulated(problem))
        self.nt, self.ny, self.size = graphs.nt, graphs.ny, graphs.nt + graphs.nx
        self.mask = np.isfinite(problem.y).ravel()
        self._last: tuple[bytes, FloatArray, FloatArray] | None = None

    def simulated(self, v: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return outputs ``(n, ny)`` and their derivatives by the scaled variables ``(n * ny, nt + nx)``."""
        key = v.tobytes()
        if self._last is None or self._last[0] != key:
            rows = self.run(v * self.scale)[0].T
            y = rows[:, : self.ny].copy()
            y[np.abs(rows[:, -1]) > LARGEST_STEP_RESIDUAL] = np.nan
            S = rows[:, self.ny : -1].reshape(len(rows), self.size, self.ny).transpose(0, 2, 1)
            self._last = key, y, S.reshape(-1, self.size) * self.scale
        return self._last[1], self._last[2]

    def states(self, fit: Fit) -> FloatArray:
        """Return the states of a fit ``(n, nx)``."""
        p, g = self.problem, self.problem.graphs
        x, states = fit.x0, [fit.x0]
        for u in p.u[1:]:
            x = np.array(g.solve(x, u, fit.t)[0])[-g.nx :, 0]
            states.append(x)
        return np.array(states)

    def residuals(self, v: FloatArray, weights: FloatArray) -> FloatArray:
        """Return differences in units of the sensors' deviations, then those from the priors."""
        p, (y, _) = self.problem, self.simulated(v)
        e = ((y - p.y) / weights).ravel()[self.mask]
        e = np.clip(np.nan_to_num(e, nan=LARGEST_MISFIT), -LARGEST_MISFIT, LARGEST_MISFIT)
        constants = np.sqrt(p.prior_weights) * (v[: self.nt] * p.widths - p.prior_means)
        return np.concatenate([e, v[self.nt :] - p.x0 / self.spread, constants])

    def jacobian(self, v: FloatArray, weights: FloatArray) -> FloatArray:
        """Return the derivatives of `residuals`."""
        p, (_, S) = self.problem, self.simulated(v)
        rows = (S / np.tile(weights, len(p.y))[:, None])[self.mask]
        rows = np.nan_to_num(rows, nan=0.0, posinf=0.0, neginf=0.0)
        nx = self.size - self.nt
        states = np.hstack([np.zeros((nx, self.nt)), np.eye(nx)])
        priors = np.hstack([np.diag(np.sqrt(p.prior_weights) * p.widths), np.zeros((self.nt, nx))])
        return np.vstack([rows, states, priors])

    def fit(self, start: FloatArray) -> Fit | None:
        """Return the fit that is reached from constants ``(nt,)``, or nothing where the model cannot be simulated."""
        from scipy.optimize import least_squares

        p = self.problem
        low = np.concatenate([p.low / p.widths, np.full(len(p.x0), -np.inf)])
        high = np.concatenate([p.high / p.widths, np.full(len(p.x0), np.inf)])
        inside = np.clip(start / p.widths, low[: self.nt] + INSIDE, high[: self.nt] - INSIDE)
        v = np.concatenate([inside, p.x0 / self.spread])
        weights = FIRST_NOISE * np.nanstd(p.y, axis=0) + np.sqrt(p.floors)
        for i in range(WEIGHT_ROUNDS):
            solution = least_squares(
                self.residuals,
                v,
                jac=self.jacobian,
                bounds=(low, high),
                args=(weights,),
                x_scale="jac",
                loss="soft_l1" if i == 0 else "linear",
                max_nfev=MOST_FIT_EVALUATIONS,
            )
            v = np.asarray(solution.x)
            errors = self.simulated(v)[0] - p.y
            if not np.isfinite(errors[np.isfinite(p.y)]).all():
                return None
            weights = np.sqrt(np.maximum(np.nanmean(errors**2, axis=0), p.floors))
        J = self.jacobian(v, weights)
        cost = float(0.5 * solution.fun @ solution.fun + np.log(weights).sum() * len(p.y))
        return Fit(v[: self.nt] * p.widths, v[self.nt :] * self.spread, weights, cost, J.T @ J)


def simulation_fits(
    problem: CalibrationProblem,
    starts: int,
    seed: int,
    note: Callable[[str], object],
    *,
    start: FloatArray | None = None,
) -> list[Fit]:
    """Return fits from given or nominal constants and random ones within their bounds, the best first."""
    error, rng = SimulationError(problem), np.random.default_rng(seed)
    fits = []
    for i in range(starts):
        note(f"simulation error, start {i + 1} of {starts}")
        drawn = problem.low + problem.widths * rng.uniform(DRAWN, 1.0 - DRAWN, len(problem.low))
        fit_of_start = error.fit(drawn if i else problem.nominal if start is None else start)
        if fit_of_start is not None:
            fits.append(fit_of_start)
    if not fits:
        raise refused(
            "cannot-simulate",
            "No start gives a trajectory: the model has no solution along the log's inputs."
            f"{without_solution(problem)} Check units, the sample time and the initial state, and narrow the bounds.",
            signals=list(problem.unknown),
        )
    fits.sort(key=lambda fit: fit.cost)
    simulated = error.simulated(np.concatenate([fits[0].t, fits[0].x0]) / error.scale)[0]
    judged = _required_sensors(problem, simulated)
    _require_explained(problem, fits[0].deviations, judged, simulated)
    _require_levels(problem, fits[0], simulated, judged)
    return fits


def without_solution(problem: CalibrationProblem) -> str:
    """Return in words, after a blank, at which row the step of a simulation with the nominal constants has no solution,
    and what may have one; empty where all steps have."""
    error = SimulationError(problem)
    start = np.concatenate([problem.nominal / problem.widths, problem.x0 / error.spread])
    lost = np.flatnonzero(~np.isfinite(error.simulated(start)[0]).all(axis=1))
    if not len(lost):
        return ""
    row, log = int(lost[0]), problem.log
    stamp = point_in_time(float(log.time[row]))
    shorter = "integration: radau or substeps: 10" if problem.integration != "radau" else "substeps: 10"
    values = ", ".join(f"{name} = {value:.4g}" for name, value in zip(problem.unknown, problem.nominal, strict=True))
    return (
        f" With {values} the step of {log.dt:.4g} s to row {log.rows[0] + row} (at {stamp}) has none, as "
        f"where a reaction ignites within a step: {shorter} may have one."
    )


def with_observed_start(
    problem: CalibrationProblem, fit: Fit, *, first: FloatArray | None = None
) -> CalibrationProblem:
    """Return the problem with a wider covariance of the initial state, where the log begins elsewhere. A start that
    nobody stated would else look like a fault in the first rows. It is seen in the fit, or in the ``first`` whitened
    innovations ``(rows, ny)``: then a fit that hardly knows it says where it is."""
    deviations, limit = np.sqrt(np.diag(problem.P0)), START_LIMIT
    if first is not None:
        if not np.abs(np.nan_to_num(first)).max() > FIRST_LIMIT:
            return problem
        refit = SimulationError(problem.with_start(UNKNOWN_START**2 * problem.P0)).fit(fit.t)
        fit, limit = fit if refit is None else refit, 1.0
    away = np.abs(fit.x0 - problem.x0)
    far = away > limit * deviations
    if not far.any():
        return problem
    listed = ", ".join(
        f"{name} {fit.x0[i]:.4g} for {problem.x0[i]:.4g}" for i, name in enumerate(problem.plant.state_names) if far[i]
    )
    note = f"The log does not begin at the nominal state ({listed}): what is known of the start is widened."
    return problem.with_start(np.diag(np.where(far, away, deviations) ** 2), note)


def unexplained(problem: CalibrationProblem, residual: FloatArray) -> list[str]:
    """Return sensors that move, and of whose motion the best fit leaves nearly all ``left (ny,)``."""
    share, moves = _shares(problem, residual)
    return [name for name, bad in zip(problem.output_names, moves & (share > UNEXPLAINED), strict=True) if bad]


def _shares(problem: CalibrationProblem, residual: FloatArray) -> tuple[FloatArray, BoolArray]:
    """Return what a fit leaves of each sensor, as a share of its deviation, and whether it moves."""
    deviations = np.nanstd(problem.y, axis=0)
    moves = deviations > MOVING_SIGNAL * np.maximum(roughness(problem.y), np.sqrt(problem.floors))
    return residual / np.maximum(deviations, SMALLEST), moves


def _required_sensors(problem: CalibrationProblem, simulated: FloatArray) -> BoolArray:
    """Return of which sensors a simulation without noise must say something ``(ny,)``: those that inputs move, and only
    where no input is unknown."""
    if problem.plant.unknown_inputs:
        return np.zeros(len(problem.output_names), dtype=bool)
    moved = np.std(simulated, axis=0) > UNMOVED_OUTPUT * np.nanstd(problem.y, axis=0)
    return np.asarray(moved | problem.plant.has_levels)


def _require_explained(
    problem: CalibrationProblem, residual: FloatArray, judged: BoolArray, simulated: FloatArray
) -> None:
    """Refuse a model whose best fit leaves as much as there was: its units, scales or sample time are wrong."""
    deviations = np.nanstd(problem.y, axis=0)
    share, moves = _shares(problem, residual)
    bad = judged & np.where(moves, share > UNEXPLAINED, share > UNEXPLAINED_AT_REST)
    moves = moves & judged
    if bad.any() and (bad[moves].all() if moves.any() else True) and not _moved_by_noise(problem, deviations):
        names = [name for name, wrong in zip(problem.output_names, bad, strict=True) if wrong]
        listed = ", ".join(
            f"{name}: {100 * part:.3g} %" for name, part in zip(problem.output_names, share, strict=True)
        )
        raise refused(
            "explains-nothing",
            f"The model cannot follow the log: the residual of the best fit is as large as the signals "
            f"({listed} of their deviations). {_remedy(problem, simulated, bad)}, the sample time, and the bounds.",
            signals=names,
        )


def _require_levels(problem: CalibrationProblem, fit: Fit, simulated: FloatArray, judged: BoolArray) -> None:
    """Refuse a single sensor in other units: the best fit leaves nearly all of it, on another level altogether."""
    names = problem.output_names
    # Deviations from an operating point have no level, but a size; a free offset stands for any level.
    level = np.array([problem.plant.has_levels and offset_state(n) not in problem.plant.state_names for n in names])
    y = problem.y - np.where(level, 0.0, np.nanmean(problem.y, axis=0))
    simulated = simulated - np.where(level, 0.0, simulated.mean(axis=0))
    levels = np.sqrt(np.nanmean(simulated**2, axis=0)) / np.maximum(np.sqrt(np.nanmean(y**2, axis=0)), SMALLEST)
    far = (levels > OTHER_LEVEL) | (levels < 1.0 / OTHER_LEVEL)
    far &= fit.deviations > UNEXPLAINED * np.nanstd(y, axis=0)
    far &= judged & (level | _shares(problem, fit.deviations)[1])
    if far.any():
        listed = ", ".join(f"{names[i]}: {1.0 / levels[i]:.3g} times that of the model" for i in np.flatnonzero(far))
        raise refused(
            "explains-nothing",
            f"The model cannot follow the log: {listed}. {_remedy(problem, simulated, far)}.",
            signals=[names[i] for i in np.flatnonzero(far)],
        )


def _remedy(problem: CalibrationProblem, simulated: FloatArray, bad: BoolArray) -> str:
    """Return what to look at where a simulation does not follow some sensors: what runs away as a constant that is
    integrated does is no other unit."""
    away = [i for i in np.flatnonzero(bad) if _runs_away(problem.log.time, simulated[:, i], problem.y[:, i])]
    if not away:
        return "Check units and scales (a factor of 1000?)"
    names = ", ".join(problem.output_names[i] for i in away)
    able = problem.plant.walking
    walks = f" (walks: {', '.join(able)})" if able else ", for which the model needs an unknown input or a parameter"
    return (
        f"The simulation runs away from {names} as a constant that is integrated does: a force, a flow or an offset of "
        f"an input that the model lacks. Take one as a random walk{walks}, state what the input is off by, or check "
        "units and scales"
    )


def _runs_away(time: FloatArray, simulated: FloatArray, y: FloatArray) -> bool:
    """Whether a simulation is off a sensor by a polynomial of time, which the sensor itself does not follow."""
    seen = np.isfinite(y) & np.isfinite(simulated)
    if seen.sum() <= LEAST_DRIFT_ROWS:
        return False
    scaled = np.interp(time[seen], (time[seen].min(), time[seen].max()), (-1.0, 1.0))
    powers = np.vander(scaled, DRIFT_DEGREE + 1)
    rest = [
        float(np.std(part - powers @ np.linalg.lstsq(powers, part, rcond=None)[0])) / max(float(np.std(part)), SMALLEST)
        for part in (simulated[seen] - y[seen], y[seen])
    ]
    return bool(rest[0] < DRIFT_REST < rest[1])


def _moved_by_noise(problem: CalibrationProblem, deviations: FloatArray) -> bool:
    """Whether no input moves, and outputs move by no more than the plant's size: noise may be all that moves it."""
    if np.std(problem.log.u, axis=0).any():
        return False
    H = np.array(problem.graphs.outputs(problem.x0, problem.u[0], problem.nominal)[1])
    sizes = np.abs(H) @ np.maximum(problem.plant.state_scales, problem.plant.state_deviations)
    return bool((deviations <= OUTSIZED * sizes).all())


def _simulated(problem: CalibrationProblem) -> Any:
    """Return the function from ``[t, x0]`` to rows: outputs, their derivatives by t and x0, and the residual."""
    g, n = problem.graphs, len(problem.y)
    nx, ny, nt, size = g.nx, g.ny, g.nt, g.nt + g.nx
    packed, u, t = ca.MX.sym("packed", nx + nx * size), ca.MX.sym("u", g.nu), ca.MX.sym("t", nt)

    def row(x: Any, S: Any, u: Any, t: Any, residual: Any) -> Any:
        y, H, L = g.outputs(x, u, t)
        return ca.vertcat(y, ca.vec(H @ S + ca.horzcat(L, ca.MX.zeros(ny, nx))), residual)

    x, S = packed[:nx], ca.reshape(packed[nx:], nx, size)
    stages, residual = g.solve(x, u, t)
    after, F, G, _ = g.fast(x, u, t, t, g.sensitivities(x, u, t, stages))
    S = F @ S + ca.horzcat(G, ca.MX.zeros(nx, nx))
    sample = ca.Function("one", [packed, u, t], [ca.vertcat(after, ca.vec(S)), row(after, S, u, t, residual)])
    v = ca.MX.sym("v", size)
    first = ca.DM(np.hstack([np.zeros((nx, nt)), np.eye(nx)]))
    rows = row(v[nt:], ca.MX(first), ca.DM(problem.u[0]), v[:nt], ca.MX(0.0))
    if n > 1:
        begin = ca.vertcat(v[nt:], ca.vec(first))
        _, later = sample.mapaccum(n - 1)(begin, ca.DM(problem.u[1:].T), ca.repmat(v[:nt], 1, n - 1))
        rows = ca.horzcat(rows, later)
    return ca.Function("simulated", [v], [ca.densify(rows)])
