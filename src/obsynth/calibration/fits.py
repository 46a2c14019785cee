"""The likelihood's maximum with everything that is read off it: boxes, directions, limits of variances, timing.

What a log says of each constant: information, directions it does not determine, and boxes by profile likelihood.

The greatest likelihood of constants and variances: several starts, SLSQP in scaled variables, and a polish.

The start of a calibration: constants and initial state whose simulation follows the log, by sensitivities.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from obsynth.calibration.logs import refused, roughness
from obsynth.calibration.problem import IMPOSSIBLE, LARGEST_STEP_RESIDUAL, Likelihood, PlantWithNoise, Problem
from obsynth.numerics import lazy_casadi as ca
from obsynth.numerics.arguments import SMALLEST, FloatArray
from obsynth.numerics.ranks import LEAST_INFORMATION
from obsynth.plants.dae import Compiled
from obsynth.plants.noise_model import DEFAULT_WHITE_SHARE, offset_state

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

    def __init__(self, problem: Problem) -> None:
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
        x, found = fit.x0, [fit.x0]
        for u in p.u[1:]:
            x = np.array(g.solve(x, u, fit.t)[0])[-g.nx :, 0]
            found.append(x)
        return np.array(found)

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
            found = least_squares(
                self.residuals,
                v,
                jac=self.jacobian,
                bounds=(low, high),
                args=(weights,),
                x_scale="jac",
                loss="soft_l1" if i == 0 else "linear",
                max_nfev=MOST_FIT_EVALUATIONS,
            )
            v = np.asarray(found.x)
            left = self.simulated(v)[0] - p.y
            if not np.isfinite(left[np.isfinite(p.y)]).all():
                return None
            weights = np.sqrt(np.maximum(np.nanmean(left**2, axis=0), p.floors))
        J = self.jacobian(v, weights)
        cost = float(0.5 * found.fun @ found.fun + np.log(weights).sum() * len(p.y))
        return Fit(v[: self.nt] * p.widths, v[self.nt :] * self.spread, weights, cost, J.T @ J)


def simulation_fits(
    problem: Problem, starts: int, seed: int, note: Callable[[str], object], *, start: FloatArray | None = None
) -> list[Fit]:
    """Return fits from given or nominal constants and random ones within their bounds, the best first."""
    error, rng = SimulationError(problem), np.random.default_rng(seed)
    fits = []
    for i in range(starts):
        note(f"simulation error, start {i + 1} of {starts}")
        drawn = problem.low + problem.widths * rng.uniform(DRAWN, 1.0 - DRAWN, len(problem.low))
        found = error.fit(drawn if i else problem.nominal if start is None else start)
        if found is not None:
            fits.append(found)
    if not fits:
        raise refused(
            "cannot-simulate",
            "No start gives a trajectory: the model has no solution along the log's inputs. Check "
            "units, the sample time and the initial state, and narrow the bounds.",
            signals=list(problem.unknown),
        )
    fits.sort(key=lambda fit: fit.cost)
    simulated = error.simulated(np.concatenate([fits[0].t, fits[0].x0]) / error.scale)[0]
    judged = _judged(problem, simulated)
    _require_explained(problem, fits[0].deviations, judged)
    _require_levels(problem, fits[0], simulated, judged)
    return fits


def with_seen_start(problem: Problem, fit: Fit, *, first: FloatArray | None = None) -> Problem:
    """Return the problem with a wider covariance of the initial state, where the log begins elsewhere. A start that
    nobody stated would else look like a fault in the first rows. It is seen in the fit, or in the ``first`` whitened
    innovations ``(rows, ny)``: then a fit that hardly knows it says where it is."""
    deviations, limit = np.sqrt(np.diag(problem.P0)), START_LIMIT
    if first is not None:
        if not np.abs(np.nan_to_num(first)).max() > FIRST_LIMIT:
            return problem
        found = SimulationError(problem.with_start(UNKNOWN_START**2 * problem.P0)).fit(fit.t)
        fit, limit = fit if found is None else found, 1.0
    away = np.abs(fit.x0 - problem.x0)
    far = away > limit * deviations
    if not far.any():
        return problem
    told = ", ".join(
        f"{name} {fit.x0[i]:.4g} for {problem.x0[i]:.4g}" for i, name in enumerate(problem.plant.state_names) if far[i]
    )
    note = f"The log does not begin at the nominal state ({told}): what is known of the start is widened."
    return problem.with_start(np.diag(np.where(far, away, deviations) ** 2), note)


def unexplained(problem: Problem, left: FloatArray) -> list[str]:
    """Return sensors that move, and of whose motion the best fit leaves nearly all ``left (ny,)``."""
    share, moves = _shares(problem, left)
    return [name for name, bad in zip(problem.output_names, moves & (share > UNEXPLAINED), strict=True) if bad]


def _shares(problem: Problem, left: FloatArray) -> tuple[FloatArray, BoolArray]:
    """Return what a fit leaves of each sensor, as a share of its deviation, and whether it moves."""
    deviations = np.nanstd(problem.y, axis=0)
    moves = deviations > MOVING_SIGNAL * np.maximum(roughness(problem.y), np.sqrt(problem.floors))
    return left / np.maximum(deviations, SMALLEST), moves


def _judged(problem: Problem, simulated: FloatArray) -> BoolArray:
    """Return of which sensors a simulation without noise must say something ``(ny,)``: those that inputs move, and only
    where no input is unknown."""
    if problem.plant.unknown_inputs:
        return np.zeros(len(problem.output_names), dtype=bool)
    moved = np.std(simulated, axis=0) > UNMOVED_OUTPUT * np.nanstd(problem.y, axis=0)
    return np.asarray(moved | problem.plant.has_levels)


def _require_explained(problem: Problem, left: FloatArray, judged: BoolArray) -> None:
    """Refuse a model whose best fit leaves as much as there was: its units, scales or sample time are wrong."""
    deviations = np.nanstd(problem.y, axis=0)
    share, moves = _shares(problem, left)
    bad = judged & np.where(moves, share > UNEXPLAINED, share > UNEXPLAINED_AT_REST)
    moves = moves & judged
    if bad.any() and (bad[moves].all() if moves.any() else True) and not _moved_by_noise(problem, deviations):
        names = [name for name, wrong in zip(problem.output_names, bad, strict=True) if wrong]
        told = ", ".join(f"{name}: {100 * part:.3g} %" for name, part in zip(problem.output_names, share, strict=True))
        raise refused(
            "explains-nothing",
            f"The model cannot follow the log: the residual of the best fit is as large as the signals "
            f"({told} of their deviations). Check units and scales (a factor of 1000?), the sample time, and the "
            "bounds.",
            signals=names,
        )


def _require_levels(problem: Problem, fit: Fit, simulated: FloatArray, judged: BoolArray) -> None:
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
        told = ", ".join(f"{names[i]}: {1.0 / levels[i]:.3g} times that of the model" for i in np.flatnonzero(far))
        raise refused(
            "explains-nothing",
            f"The model cannot follow the log: {told}. Check units and scales (a factor of 1000?).",
            signals=[names[i] for i in np.flatnonzero(far)],
        )


def _moved_by_noise(problem: Problem, deviations: FloatArray) -> bool:
    """Whether no input moves, and outputs move by no more than the plant's size: noise may be all that moves it."""
    if np.std(problem.log.u, axis=0).any():
        return False
    H = np.array(problem.graphs.outputs(problem.x0, problem.u[0], problem.nominal)[1])
    sizes = np.abs(H) @ np.maximum(problem.plant.state_scales, problem.plant.state_deviations)
    return bool((deviations <= OUTSIZED * sizes).all())


def _simulated(problem: Problem) -> Any:
    """Return the function from ``[t, x0]`` to rows: outputs, their derivatives by t and x0, and the residual."""
    g, n = problem.graphs, len(problem.y)
    nx, ny, nt, size = g.nx, g.ny, g.nt, g.nt + g.nx
    packed, u, t = ca.MX.sym("packed", nx + nx * size), ca.MX.sym("u", g.nu), ca.MX.sym("t", nt)

    def row(x: Any, S: Any, u: Any, t: Any, left: Any) -> Any:
        y, H, L = g.outputs(x, u, t)
        return ca.vertcat(y, ca.vec(H @ S + ca.horzcat(L, ca.MX.zeros(ny, nx))), left)

    x, S = packed[:nx], ca.reshape(packed[nx:], nx, size)
    stages, left = g.solve(x, u, t)
    after, F, G, _ = g.fast(x, u, t, t, g.sensitivities(x, u, t, stages))
    S = F @ S + ca.horzcat(G, ca.MX.zeros(nx, nx))
    one = ca.Function("one", [packed, u, t], [ca.vertcat(after, ca.vec(S)), row(after, S, u, t, left)])
    v = ca.MX.sym("v", size)
    first = ca.DM(np.hstack([np.zeros((nx, nt)), np.eye(nx)]))
    rows = row(v[nt:], ca.MX(first), ca.DM(problem.u[0]), v[:nt], ca.MX(0.0))
    if n > 1:
        begin = ca.vertcat(v[nt:], ca.vec(first))
        _, later = one.mapaccum(n - 1)(begin, ca.DM(problem.u[1:].T), ca.repmat(v[:nt], 1, n - 1))
        rows = ca.horzcat(rows, later)
    return ca.Function("simulated", [v], [ca.densify(rows)])


#: Where the search for the variances begins: process noise and sensor noise as logarithms of factors of a first guess.
#: With one start alone the result was 3.6 nats above the best on the measured tanks.
NOISE_STARTS = ((0.0, 0.0), (3.0, -2.0), (-5.0, 0.0), (0.0, -4.0))
#: Logarithms by which variances may leave their first guess.
LOWEST_VARIANCE, HIGHEST_VARIANCE = -16.0, 12.0
#: How often these are widened, where a variance stops there and the likelihood would have it go on.
MOST_WIDENINGS = 4
#: First guess of the process noise: what it moves a state by in a sample, in sizes of the states.
FIRST_PROCESS_NOISE = 1e-3
#: Correlations of coloured noise, in samples, from which the search begins again: with the first one alone it ended
#: 26 nats below the best on a motor, at a correlation as long as the log.
CORRELATIONS = (3.0, 10.0, 30.0)
#: Scales of the search: constants in widths of their bounds, logarithms of variances.
CONSTANT_SCALE, VARIANCE_SCALE = 0.01, 1.0
#: Fits of the simulation whose costs differ by less than this share are the same minimum.
SAME_MINIMUM = 1e-3
SEARCH_TOLERANCE = 1e-6
MOST_LIKELIHOOD_STEPS = 150
#: Newton steps at the end: how many, what is added to curvatures until one helps, how far one goes (in widths
#: of the bounds, and as a logarithm of a variance), the least curvature that is seen, the gain in nats that ends them.
MOST_FINAL_STEPS, NEWTON_DAMPINGS = 12, (0.0, 1e1, 1e3, 1e5, 1e7)
FINAL_STEP_REACH, LEAST_CURVATURE, NEWTON_TOLERANCE = (0.1, 2.0), 0.1, 1e-6
#: Steps along directions of high curvature alone, and what a value is rounded by.
ACROSS_STEPS, STEEP, VALUE_ROUNDING = 4, 1e3, 1e-13
#: Differences of the gradient: the longest, as a share of a deviation, and the shortest.
GRADIENT_DIFFERENCE, DIFFERENCE_SHARE, LEAST_DIFFERENCE = 1e-4, 0.03, 1e-6
#: Longer ones, where a kink of the model bends the likelihood the wrong way: of logarithms of variances, and what share
#: of them of constants; curvatures below zero that are rounding, and as a share of the largest.
LONGER_DIFFERENCES, CONSTANT_STEP, DOWNWARDS, DOWNWARDS_SHARE = (1e-3, 1e-2, 1e-1), 0.1, 1e-2, 1e-6
#: A variance counts as indistinguishable from zero if making it smaller by this logarithm costs fewer nats than this.
COLLAPSE, COLLAPSE_NATS = 3.0, 0.05
#: Where variances that must not collapse begin, as logarithms of factors of their first guess.
RAISED = (0.0, 3.0, -3.0)
#: Nearer to a bound than this, relative to its size, a variable counts as on it.
NEAR_BOUND = 1e-6


class Objective:
    """Negative log of likelihood and prior, and its gradient, of free variables ``z``. ``z`` holds the constants in
    widths of their bounds, then the logarithms of the variances that are not known."""

    def __init__(self, problem: Problem, fit: Fit) -> None:
        p, g = problem, problem.graphs
        self.problem = p
        self.likelihood = Likelihood(p)
        self.nt, nq = g.nt, len(p.noisy)
        first_q = _process_noise(problem, fit)
        first_r = np.log(np.maximum(fit.deviations**2, 2.0 * p.floors))
        known = np.concatenate([p.known_Q, p.known_R])
        self.variances = np.where(np.isnan(known), np.concatenate([first_q, first_r]), np.log(known))
        self.free = np.concatenate([np.ones(g.nt, dtype=bool), np.isnan(known)])
        guess = np.concatenate([first_q + LOWEST_VARIANCE, np.log(p.floors)])
        self.low = np.concatenate([p.low / p.widths, guess])[self.free]
        high = self.variances + HIGHEST_VARIANCE
        self.high = np.concatenate([p.high / p.widths, high])[self.free]
        self.is_q = np.concatenate([np.zeros(g.nt, bool), np.ones(nq, bool), np.zeros(g.ny, bool)])[self.free]
        self.is_r = np.concatenate([np.zeros(g.nt + nq, bool), np.ones(g.ny, bool)])[self.free]
        self.scale = np.where(self.is_q | self.is_r, VARIANCE_SCALE, CONSTANT_SCALE)
        self.first = np.concatenate([np.zeros(g.nt), self.variances])[self.free]
        self.avoided = np.zeros(self.size)
        # Whether its slope jumps where it is least, as it does at a kink of the model.
        self.bent = False

    @property
    def size(self) -> int:
        """Number of free variables."""
        return int(self.free.sum())

    def start(self, t: FloatArray) -> FloatArray:
        """Return free variables from constants, variances at their first guess."""
        whole = np.concatenate([t / self.problem.widths, self.variances])
        return np.asarray(np.clip(whole[self.free], self.low, self.high))

    def full(self, z: FloatArray) -> FloatArray:
        """Return ``[t, log q, log r]``."""
        whole = np.concatenate([np.zeros(self.nt), self.variances])
        whole[self.free] = z
        whole[: self.nt] *= self.problem.widths
        return whole

    def __call__(self, z: FloatArray) -> tuple[float, FloatArray]:
        """Return value and gradient."""
        p = self.problem
        value, gradient = self.likelihood(self.full(z))
        if value >= IMPOSSIBLE:
            return value, np.zeros(self.size)
        away = z[: self.nt] * p.widths - p.prior_means
        gradient = gradient.copy()
        gradient[: self.nt] += p.prior_weights * away
        gradient[: self.nt] *= p.widths
        value += 0.5 * float(p.prior_weights @ away**2) - 0.5 * float(self.avoided @ z)
        return value, gradient[self.free] - 0.5 * self.avoided

    def widened(self, z: FloatArray) -> bool:
        """Widen the search of variances that stop at a bound of it and would go on; whether there are any."""
        slope, room = self(z)[1], NEAR_BOUND * (1.0 + np.abs(z))
        # A sensor's variance ends at its floor, which is what its resolution says.
        down = self.is_q & (z - self.low <= room) & (slope > COLLAPSE_NATS)
        up = (self.is_q | self.is_r) & (self.high - z <= room) & (slope < -COLLAPSE_NATS)
        self.low = np.where(down, self.low + LOWEST_VARIANCE, self.low)
        self.high = np.where(up, self.high + HIGHEST_VARIANCE, self.high)
        return bool((down | up).any())

    def descent(self, start: FloatArray) -> tuple[float, FloatArray]:
        """Return a minimum within the bounds near a start, and where it is."""
        return descent(self, np.clip(start, self.low, self.high), self.low, self.high, self.scale)

    def constants(self, z: FloatArray) -> FloatArray:
        """Return the unknown constants ``(nt,)``."""
        return np.asarray(z[: self.nt] * self.problem.widths)

    def noise(self, z: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return variances of equations and of sensors."""
        values = np.exp(self.full(z)[self.nt :])
        return values[: len(self.problem.noisy)], values[len(self.problem.noisy) :]


@dataclass(frozen=True, eq=False)
class Maximum:
    """Where the likelihood is greatest: free variables, value, Hessian.
    ``likeliest`` are the free variables before any variance was kept from zero."""

    z: FloatArray
    value: float
    hessian: FloatArray
    likeliest: FloatArray


def _process_noise(problem: Problem, fit: Fit) -> FloatArray:
    """Return logarithms of first guesses, from what a unit added to an equation does to the states in a sample."""
    g, p = problem.graphs, problem
    stages = g.solve(p.x0, p.u[0], fit.t)[0]
    way = np.array(g.local(p.x0, p.u[0], fit.t, fit.t, g.sensitivities(p.x0, p.u[0], fit.t, stages))[3])
    moved = (np.abs(way) / p.plant.state_scales[:, None]).max(axis=0)[p.noisy_equations]
    moved = np.where(np.isfinite(moved) & (moved > 0.0), moved, 1.0)
    return np.asarray(2.0 * np.log(FIRST_PROCESS_NOISE / moved))


def descent(
    both: Callable[[FloatArray], tuple[float, FloatArray]],
    start: FloatArray,
    low: FloatArray,
    high: FloatArray,
    scale: FloatArray,
    *,
    tolerance: float = SEARCH_TOLERANCE,
    most: int = MOST_LIKELIHOOD_STEPS,
) -> tuple[float, FloatArray]:
    """Return a bounded minimum near a start, in variables scaled by what they may differ by."""
    from scipy.optimize import minimize

    def at(w: FloatArray) -> FloatArray:
        return np.asarray(np.clip(start + w * scale, low, high))

    def scaled(w: FloatArray) -> tuple[float, FloatArray]:
        value, gradient = both(at(w))
        return value, gradient * scale

    with np.errstate(all="ignore"):
        found = minimize(
            scaled,
            np.zeros(len(start)),
            jac=True,
            method="SLSQP",
            options={"maxiter": most, "ftol": tolerance},
            bounds=np.column_stack([(low - start) / scale, (high - start) / scale]),
        )
    return float(found.fun), at(found.x)


def greatest_likelihood(objective: Objective, fits: Sequence[Fit], note: Callable[[str], object]) -> Maximum:
    """Return the best of several searches, polished."""
    count, best, value = 0, None, np.inf
    for i, fit in enumerate(fits):
        if i and fit.cost - fits[0].cost < SAME_MINIMUM * abs(fits[0].cost):
            continue
        for process, sensor in NOISE_STARTS if i == 0 else NOISE_STARTS[:1]:
            count += 1
            note(f"likelihood, start {count}")
            start = objective.start(fit.t) + process * objective.is_q + sensor * objective.is_r
            reached, z = objective.descent(start)
            if reached < value:
                best, value = z, reached
    if best is None or value >= IMPOSSIBLE:
        raise refused(
            "cannot-simulate",
            "The filter has no finite likelihood from any start: check units, bounds and the initial covariance.",
            signals=list(objective.problem.unknown),
        )
    for _ in range(MOST_WIDENINGS):
        if not objective.widened(best):
            break
        value, best = objective.descent(best)
    # What drives coloured noise moves a sensor from row to row by the same whatever its correlation: the search begins
    # again from others, where this one ended.
    problem = objective.problem
    for i in range(len(problem.names), objective.nt):
        for samples in CORRELATIONS:
            note(f"{problem.unknown[i]}, start {samples:g} samples")
            start = best.copy()
            start[i] = np.log(samples * problem.log.dt) / problem.widths[i]
            reached, z = objective.descent(start)
            if reached < value:
                value, best = reached, z
    value, best, curvature = polished(objective, best)
    return Maximum(best, value, curvature, best)


def polished(
    objective: Objective,
    z: FloatArray,
    *,
    fixed: int | None = None,
    most: int = MOST_FINAL_STEPS,
    tolerance: float = NEWTON_TOLERANCE,
    near: FloatArray | None = None,
) -> tuple[float, FloatArray, FloatArray]:
    """Return value, place and Hessian after Newton steps: a quiet log makes valleys that other searches end beside. One
    variable may be fixed; the Hessian is then that of a place nearby. ``near`` is a Hessian to begin with."""
    value, gradient = objective(z)
    curvature = hessian(objective, z) if near is None else near
    for _ in range(most):
        before = value
        for damping in NEWTON_DAMPINGS:
            trial = _newton_step(objective, z, gradient, curvature, damping, fixed)
            found, slope = objective(trial)
            if found < value:
                z, value, gradient = trial, found, slope
                break
        if before - value < tolerance:
            break
        curvature = hessian(objective, z, curvature)
    # What is left across steep walls tilts the bottom of a bent valley, and with it what the valley leaves open.
    for _ in range(ACROSS_STEPS):
        trial = _newton_step(objective, z, gradient, curvature, 0.0, fixed, least=STEEP)
        found, slope = objective(trial)
        if not found < value + VALUE_ROUNDING * abs(value):
            break
        z, value, gradient = trial, found, slope
    return value, z, _hessian_of_minimum(objective, z, curvature) if fixed is None else curvature


def _hessian_of_minimum(objective: Objective, z: FloatArray, near: FloatArray) -> FloatArray:
    """Return the Hessian, in longer steps where short ones see a kink of the model and no minimum."""
    free = np.flatnonzero(~at_bounds(z, objective.low, objective.high))
    found = hessian(objective, z, near)
    for step in LONGER_DIFFERENCES:
        values = np.linalg.eigvalsh(found[np.ix_(free, free)]) if free.size else np.zeros(1)
        if values[0] >= -max(DOWNWARDS, DOWNWARDS_SHARE * values[-1]):
            break
        objective.bent = True
        found = hessian(objective, z, steps=np.where(objective.is_q | objective.is_r, 1.0, CONSTANT_STEP) * step)
    return found


def _newton_step(
    objective: Objective,
    z: FloatArray,
    gradient: FloatArray,
    curvature: FloatArray,
    damping: float,
    fixed: int | None,
    *,
    least: float = 0.0,
) -> FloatArray:
    """Return where a damped step leads within the bounds, along directions of more than the least curvature."""
    room = NEAR_BOUND * (1.0 + np.abs(z))
    held = ((z - objective.low <= room) & (gradient > 0.0)) | ((objective.high - z <= room) & (gradient < 0.0))
    if fixed is not None:
        held[fixed] = True
    free = np.flatnonzero(~held)
    if not free.size:
        return z
    reach = np.where(objective.is_q | objective.is_r, FINAL_STEP_REACH[1], FINAL_STEP_REACH[0])[free]
    values, vectors = np.linalg.eigh(curvature[np.ix_(free, free)])
    lengths = -(vectors.T @ gradient[free]) / (np.maximum(np.abs(values), LEAST_CURVATURE) + damping)
    longest = 1.0 / np.abs(vectors / reach[:, None]).max(axis=0)
    step = np.zeros(len(z))
    step[free] = vectors @ np.where(np.abs(values) > least, np.clip(lengths, -longest, longest), 0.0)
    return np.asarray(np.clip(z + step, objective.low, objective.high))


def collapsed(objective: Objective, maximum: Maximum) -> BoolArray:
    """Return which variances the log cannot distinguish from zero where they are, as truth values."""
    found = np.zeros(objective.size, dtype=bool)
    for i in np.flatnonzero(objective.is_q | objective.is_r):
        z = maximum.z.copy()
        z[i] = max(z[i] - COLLAPSE, objective.low[i])
        found[i] = objective(z)[0] - maximum.value < COLLAPSE_NATS
    return found


def without_collapse(objective: Objective, maximum: Maximum, note: Callable[[str], object]) -> Maximum:
    """Return the maximum with variances kept away from zero where the log cannot tell them from it. The weight sqrt(q)
    of a boundary-avoiding prior (Chung et al. 2013) is given to those variances alone: a variance that a short log
    makes zero by chance would make every box too small."""
    for _ in range(len(objective.problem.noisy) + 1):
        new = collapsed(objective, maximum) & (objective.avoided == 0.0)
        if not new.any():
            break
        note("variances that the log cannot distinguish from zero")
        objective.avoided[new] = 1.0
        best, value = maximum.z, np.inf
        for raised in RAISED:
            start = maximum.z.copy()
            start[new] = np.clip(objective.first[new] + raised, objective.low[new], objective.high[new])
            reached, z = objective.descent(start)
            if reached < value:
                best, value = z, reached
        value, best, curvature = polished(objective, best)
        maximum = Maximum(best, value, curvature, maximum.likeliest)
    return maximum


def hessian(
    both: Objective, z: FloatArray, near: FloatArray | None = None, *, steps: FloatArray | None = None
) -> FloatArray:
    """Return second derivatives by central differences of the exact gradient, in steps that suit those nearby."""
    if steps is None:
        steps = np.full(len(z), GRADIENT_DIFFERENCE)
    if near is not None:
        steeper = np.sqrt(np.maximum(np.diag(near), 1.0))
        steps = np.clip(DIFFERENCE_SHARE / steeper, LEAST_DIFFERENCE, GRADIENT_DIFFERENCE)
    found = np.array(
        [
            (both(z + step)[1] - both(z - step)[1]) / (2.0 * size)
            for size, step in zip(steps, np.diag(steps), strict=True)
        ]
    )
    return np.asarray(0.5 * (found + found.T))


def at_bounds(z: FloatArray, low: FloatArray, high: FloatArray) -> BoolArray:
    """Return which variables are at a bound, as truth values."""
    room = NEAR_BOUND * (1.0 + np.abs(z))
    return (z - low <= room) | (high - z <= room)


#: A direction whose deviation exceeds this share of the bounds' width is not determined by the log.
UNDETERMINED = 1.0 / 6.0
#: Entries of a direction that are named.
LISTED_ENTRY_SHARE = 0.05
#: Variances that are found from n rows are themselves uncertain, which a quantile of Student's distribution covers in
#: part; what it leaves was measured (benchmarks/campaigns/calibration_coverage.md): boxes of `SHORT_LOG` rows need
#: this.
SHORT_LOG, SHORT_WIDENING = 56.0, 1.05
#: Root of the deviance at a one-sided limit of 95 %.
LIMIT_ROOT = 1.645
#: A profile ends when its root is within this share of what is sought.
PROFILE_TOLERANCE = 0.02
MOST_PROFILE_STEPS = 12
#: Curvatures below this share of the largest count as this much: rounding of the Hessian.
LEAST_CURVATURE_SHARE = 1e-8
#: Of the search for the others along a profile: the gain in nats that ends it, and its steps.
PROFILE_SEARCH_TOLERANCE, MOST_PROFILE_SEARCHES = 1e-4, 60
#: In widths of the bounds: a place this near to a bound is at it; the least deviation a profile begins with.
AT_BOUND, LEAST_DEVIATION = 1e-9, 1e-9
#: A root below this says nothing of how far to go; two roots nearer than the second are one.
LEAST_ROOT, SAME_ROOT = 1e-9, 1e-12
#: Outwards a profile goes this much further than proportion says, and grows by a factor between these.
PROFILE_FURTHER, LEAST_GROWTH, MOST_PROFILE_GROWTH = 1.1, 1.2, 4.0
#: Inwards an interval is cut at a share of it no nearer to its ends than this, until it is this share of the way.
LEAST_CUT, SHORT_INTERVAL = 0.1, 1e-3
#: Along a valley: longest step in widths of the bounds, Newton's steps at each, and the gain in nats that ends them.
VALLEY_STEP, VALLEY_NEWTON_STEPS, VALLEY_TOLERANCE = 0.0625, 8, 1e-3
#: The share of that step at which an end is told.
LEAST_VALLEY_STEP = 0.0625


@dataclass(frozen=True, eq=False)
class Information:
    """Covariance of the constants ``(nt, nt)``, and directions of bounds' widths that the log does not determine."""

    covariance: FloatArray
    undetermined: tuple[dict[str, float], ...]


def information(
    hessian: FloatArray, objective: Objective, z: FloatArray, *, apart: NDArray[np.bool_] | None = None
) -> Information:
    """Return what the log says of the constants, the variances integrated out but for those that are held ``apart``."""
    names = objective.problem.names
    nt, widths = len(names), objective.problem.widths[: len(names)]
    held = at_bounds(z, objective.low, objective.high)
    held = held if apart is None else held | apart
    nuisance = [i for i in range(nt, len(z)) if not held[i]]
    found = hessian[:nt, :nt]
    if nuisance:
        values, vectors = np.linalg.eigh(hessian[np.ix_(nuisance, nuisance)])
        kept = values > LEAST_INFORMATION * max(float(values.max()), SMALLEST)
        across = hessian[:nt, nuisance] @ vectors[:, kept]
        found = found - (across / values[kept]) @ across.T
    return covariance_of(found, widths, names)


def covariance_of(found: FloatArray, widths: FloatArray, names: tuple[str, ...]) -> Information:
    """Return covariance and undetermined directions of information in widths of the bounds."""
    values, vectors = np.linalg.eigh(0.5 * (found + found.T))
    # What is not determined counts as the whole width: rounding times more would spoil every other constant.
    deviations = 1.0 / np.sqrt(np.maximum(values, 1.0))
    directions = []
    for i in np.argsort(-deviations):
        if deviations[i] > UNDETERMINED:
            shares = vectors[:, i] / vectors[int(np.argmax(np.abs(vectors[:, i]))), i]
            directions.append(
                {
                    name: float(share)
                    for name, share in zip(names, shares, strict=True)
                    if abs(share) > LISTED_ENTRY_SHARE
                }
            )
    covariance = (vectors * deviations**2) @ vectors.T * np.outer(widths, widths)
    return Information(covariance, tuple(directions))


def quantile(level: float, constants: int, samples: int, variances: int) -> float:
    """Return the root of the deviance that bounds every constant at once with probability ``level``. Bonferroni's share
    of the level each; Student's distribution for variances that are found; widened for short logs."""
    from scipy.stats import norm, t

    each = 1.0 - (1.0 - level) / (2.0 * max(constants, 1))
    if not variances:
        return float(norm.ppf(each))
    return float(t.ppf(each, max(samples - constants - 2, 3))) * (
        1.0 + (SHORT_WIDENING - 1.0) * min(1.0, SHORT_LOG / samples)
    )


@dataclass(frozen=True, eq=False)
class Side:
    """One end of a box: its value, and whether the log bounds it there."""

    value: float
    is_open: bool


def profile_box(objective: Objective, maximum: Maximum, root: float, said: Information) -> list[tuple[Side, Side]]:
    """Return both ends of each constant's box, in its own units."""
    found, problem = [], objective.problem
    for i, (name, width) in enumerate(zip(problem.names, problem.widths, strict=False)):
        weak = objective.bent or any(name in direction for direction in said.undetermined)
        side = _side_along_valley if weak else _side
        sides = [side(objective, maximum, i, sign, root) for sign in (-1.0, 1.0)]
        # An open side is the bound that was given, not what a division and a product leave of it.
        given = (float(problem.low[i]), float(problem.high[i]))
        low, high = (
            Side(bound if item.is_open else item.value * width, item.is_open)
            for item, bound in zip(sides, given, strict=True)
        )
        found.append((low, high))
    return found


def upper_limit(objective: Objective, maximum: Maximum, i: int) -> float:
    """Return the one-sided limit of a logarithm of a variance that the log cannot distinguish from zero."""
    avoided = objective.avoided.copy()
    objective.avoided[:] = 0.0
    lowest = maximum.z.copy()
    lowest[i] = objective.low[i]
    value = min(objective(maximum.z)[0], objective(lowest)[0])
    side = _side(objective, replace(maximum, value=value), i, 1.0, LIMIT_ROOT)
    objective.avoided[:] = avoided
    return side.value


def profile_root(objective: Objective, maximum: Maximum, i: int) -> tuple[Callable[[float], float], float]:
    """Return the root of the deviance at a value of one variable, the others led along, and the variable's deviation:
    deviance is twice what the least value of the objective is above its minimum."""
    others = [j for j in range(len(maximum.z)) if j != i]
    values, vectors = np.linalg.eigh(maximum.hessian)
    values = np.maximum(values, LEAST_CURVATURE_SHARE * max(float(values.max()), SMALLEST))
    covariance = (vectors / values) @ vectors.T
    slope = covariance[others, i] / covariance[i, i]
    values, vectors = np.linalg.eigh(maximum.hessian[np.ix_(others, others)])
    values = np.maximum(values, LEAST_CURVATURE_SHARE * max(float(values.max(initial=0.0)), SMALLEST))
    spread = np.sqrt(np.diag((vectors / values) @ vectors.T))
    # Variables that the log does not determine move by no more than their search does.
    scale = np.minimum(spread, np.where(np.arange(len(maximum.z))[others] < objective.nt, 1.0, 3.0))
    low, high = objective.low[others], objective.high[others]
    place, rest = float(maximum.z[i]), maximum.z[others].copy()

    def root(value: float) -> float:
        nonlocal place, rest

        def both(w: FloatArray) -> tuple[float, FloatArray]:
            z = np.empty(len(others) + 1)
            z[others], z[i] = w, value
            found, gradient = objective(z)
            return found, gradient[others]

        if others:
            guess = np.clip(rest + slope * (value - place), low, high)
            least, rest = descent(
                both, guess, low, high, scale, tolerance=PROFILE_SEARCH_TOLERANCE, most=MOST_PROFILE_SEARCHES
            )
        else:
            least = both(rest)[0]
        place = value
        return math.sqrt(max(2.0 * (least - maximum.value), 0.0))

    return root, math.sqrt(max(covariance[i, i], LEAST_DEVIATION**2))


def _side(objective: Objective, maximum: Maximum, i: int, sign: float, target: float) -> Side:
    """Return where the root of the profile's deviance reaches a target; open where a bound comes first."""
    (root, deviation), begin = profile_root(objective, maximum, i), float(maximum.z[i])
    end = float(objective.low[i] if sign < 0 else objective.high[i])
    if abs(end - begin) < AT_BOUND:
        return Side(end, True)
    inner, reached_inner = begin, 0.0
    outer, reached = begin + sign * min(target * deviation, abs(end - begin)), 0.0
    for _ in range(MOST_PROFILE_STEPS):
        reached = root(outer)
        if reached >= target or outer == end:
            break
        inner, reached_inner = outer, reached
        longer = abs(outer - begin) * min(
            max(PROFILE_FURTHER * target / max(reached, LEAST_ROOT), LEAST_GROWTH), MOST_PROFILE_GROWTH
        )
        outer = begin + sign * min(longer, abs(end - begin))
    if reached < target:
        return Side(end, True)
    for _ in range(MOST_PROFILE_STEPS):
        if reached - target < PROFILE_TOLERANCE * target or abs(outer - inner) < SHORT_INTERVAL * abs(outer - begin):
            break
        share = min(max((target - reached_inner) / (reached - reached_inner), LEAST_CUT), 1.0 - LEAST_CUT)
        middle = inner + share * (outer - inner)
        found = root(middle)
        if found >= target:
            outer, reached = middle, found
        else:
            inner, reached_inner = middle, found
        if target - reached_inner < PROFILE_TOLERANCE * target:
            # The outer end would do as well; between them the interpolation is better than either.
            share = (target - reached_inner) / max(reached - reached_inner, SAME_ROOT)
            return Side(inner + share * (outer - inner), False)
    return Side(outer, False)


def _side_along_valley(objective: Objective, maximum: Maximum, i: int, sign: float, target: float) -> Side:
    """Return the end of a constant that the log hardly determines: along a valley that bends, in short steps. The
    others are led on from the last two places, and set right by Newton's steps at each."""
    others = [j for j in range(len(maximum.z)) if j != i]
    place, rest = float(maximum.z[i]), maximum.z[others].copy()
    end = float(objective.low[i] if sign < 0 else objective.high[i])
    inner = maximum.hessian[np.ix_(others, others)]
    slope = -np.linalg.lstsq(inner, maximum.hessian[others, i], rcond=LEAST_INFORMATION)[0]
    step, reached, curvature = VALLEY_STEP, 0.0, maximum.hessian
    while abs(end - place) > AT_BOUND:
        new = place + sign * min(step, abs(end - place))
        z = np.empty(len(maximum.z))
        z[others], z[i] = rest + slope * (new - place), new
        z = np.clip(z, objective.low, objective.high)
        least, z, after = polished(
            objective, z, fixed=i, most=VALLEY_NEWTON_STEPS, tolerance=VALLEY_TOLERANCE, near=curvature
        )
        found = math.sqrt(max(2.0 * (least - maximum.value), 0.0))
        if found >= target:
            if step <= LEAST_VALLEY_STEP * VALLEY_STEP:
                share = (target - reached) / max(found - reached, SAME_ROOT)
                return Side(place + share * (new - place), False)
            step *= 0.25
            continue
        slope, place, rest, reached = (z[others] - rest) / (new - place), new, z[others].copy(), found
        curvature = after
    return Side(end, True)


#: Nats by which another timing of the inputs must be better to be taken: a likelihood ratio of about 150.
TIMING_NATS = 5.0
#: The same for another row of delay beyond the first: what a slow actuator does looks like some rows of delay too.
FURTHER_NATS = 25.0
#: A likeliest variance below this share of its upper limit counts as zero.
ZERO_SHARE = 0.01
#: Rows by which the inputs are tried later, of which only positive ones are ever taken; more are tried while the last
#: one is the best, up to so many.
TRIED_DELAYS, MOST_DELAY = (-1, 1, 2, 3), 50
#: Share of its deviation by which a constant may move if the steps were exact.
TOLERATED_MOVE = 0.5
#: A logarithm of a variance with less curvature is known to no more than a factor of three or so.
WEAK_CURVATURE = 1.0


@dataclass(frozen=True, eq=False)
class InnovationsFit:
    """Constants ``(nt,)``, their information and box, variances by equation and sensor, and what the filter said: no
    innovation (NaN) where nothing was measured."""

    t: FloatArray
    value: float
    information: Information
    sides: list[tuple[Side, Side]]
    Q: FloatArray
    R: FloatArray
    limited_Q: BoolArray
    limited_R: BoolArray
    at_bounds: BoolArray
    whitened: FloatArray
    innovations: FloatArray
    variances: FloatArray
    #: The state after the last row, and its deviations, to which those of the constants are added; `None` where no
    #: offset of a sensor is asked of it, or there is no filter.
    at_end: tuple[FloatArray, FloatArray] | None = None

    @property
    def v(self) -> FloatArray:
        """What the likelihood takes: ``[t, log q, log r]``."""
        return np.concatenate([self.t, np.log(np.concatenate([self.Q, self.R]))])


def chosen_timing(
    problem: Problem, fits: list[Fit], seed: int, note: Callable[[str], object], *, any_start: bool = False
) -> tuple[Problem, list[Fit], Mapping[int, float]]:
    """Return the problem with the inputs as the likelihood wants them, and what each delay loses in nats; a start that
    nobody stated must not decide."""
    compared = problem.with_start(UNKNOWN_START**2 * problem.P0) if any_start else problem
    objective = Objective(compared, fits[0])
    value, z = objective.descent(objective.start(fits[0].t))
    values, waiting, start = {0: value}, [*TRIED_DELAYS], z
    while waiting:
        delay = waiting.pop(0)
        if delay >= problem.log.samples:
            break
        note(f"inputs {delay:+d} row{'s' if abs(delay) > 1 else ''}")
        moved = Objective(compared.with_log(problem.log.shifted(delay)), fits[0])
        found, at = moved.descent(z if abs(delay) == 1 else start)
        if found < min(values.values()):
            # What a timing that is far off makes of the constants is a bad start for the next one.
            start = at
            waiting += [delay + 1] if not waiting and delay < MOST_DELAY else []
        values[delay] = found
    best = min(values.values())
    # The least delay that none beats clearly; a log whose inputs would act before they are sent is only told.
    nats = {rows: FURTHER_NATS if rows else TIMING_NATS for rows in values if rows >= 0}
    delay = min((rows for rows, clear in nats.items() if values[rows] - best <= clear), default=0)
    if values[delay] > values.get(-1, np.inf):
        delay = 0
    losses = {rows: found - best for rows, found in sorted(values.items())}
    if delay:
        problem = problem.with_log(problem.log.shifted(delay))
        fits = simulation_fits(problem, 1, seed, note, start=fits[0].t)
    return problem, fits, losses


def _said(objective: Objective, maximum: Maximum) -> Information:
    """Return what the log says of the constants; a variance with hardly a curvature leaves none of them open."""
    found = information(maximum.hessian, objective, maximum.z)
    weak = (objective.is_q | objective.is_r) & (np.diag(maximum.hessian) < WEAK_CURVATURE)
    if found.undetermined and weak.any():
        others = information(maximum.hessian, objective, maximum.z, apart=weak)
        return others if len(others.undetermined) < len(found.undetermined) else found
    return found


def guarded_maximum(
    objective: Objective, fits: list[Fit], note: Callable[[str], object]
) -> tuple[Maximum, Information]:
    """Return the greatest likelihood, with variances that the log cannot distinguish from zero kept away from it."""
    maximum = greatest_likelihood(objective, fits, note)
    found = _said(objective, maximum)
    if not found.undetermined:
        # Along a direction that the log leaves open the weight of a variance would only lead the constants away.
        maximum = without_collapse(objective, maximum, note)
        found = _said(objective, maximum)
    return maximum, found


def moved_by(exact: Problem, start: Fit, maximum: Maximum, avoided: FloatArray, said: Information) -> float:
    """Return by how much constants move with exact steps: the most, in their deviations."""
    objective = Objective(exact, start)
    objective.avoided[:] = avoided
    value, z = objective.descent(maximum.z)
    if value >= IMPOSSIBLE:
        return 0.0
    moves = np.abs(objective.constants(z) - objective.constants(maximum.z))[: len(exact.names)]
    return float(np.max(moves / np.sqrt(np.diag(said.covariance)), initial=0.0))


def innovations_fit(
    problem: Problem, fits: list[Fit], level: float, note: Callable[[str], object], *, exact: Problem | None = None
) -> tuple[InnovationsFit | None, float]:
    """Return the fit of the innovations, from fits of the simulation. With an ``exact`` problem also by how much its
    constants would move; there is no fit where that matters."""
    objective = Objective(problem, fits[0])
    maximum, found = guarded_maximum(objective, fits, note)
    moved = 0.0 if exact is None else moved_by(exact, fits[0], maximum, objective.avoided, found)
    if moved > TOLERATED_MOVE:
        return None, moved
    variances = int((objective.is_q | objective.is_r).sum())
    root = quantile(level, len(problem.names), problem.log.samples, variances)
    note("boxes by profile likelihood")
    sides = profile_box(objective, maximum, root, found)
    # Variances are kept from zero for the sake of the boxes; where the log tells them from it, it says them itself.
    Q, R = objective.noise(maximum.likeliest)
    limited, limits = _limits(objective, maximum)
    Q, R = np.where(limited[: len(Q)], limits[: len(Q)], Q), np.where(limited[len(Q) :], limits[len(Q) :], R)
    whitened, e, spread = objective.likelihood.innovations(objective.full(maximum.z))
    coloured = [len(Q) + j in _beside(problem) for j in range(len(R))]
    R = np.where(coloured, np.maximum(R, DEFAULT_WHITE_SHARE**2 * np.nanmean(e**2, axis=0)), R)
    bounds = at_bounds(maximum.z, objective.low, objective.high)[: objective.nt]
    has_offsets = isinstance(problem.plant, PlantWithNoise) and bool(problem.plant.states.offsets)
    return InnovationsFit(
        objective.constants(maximum.z),
        objective.likelihood(objective.full(maximum.z))[0],
        found,
        sides,
        Q,
        R,
        limited[: len(Q)],
        limited[len(Q) :],
        bounds,
        whitened,
        e,
        spread,
        _at_end(objective, maximum, found) if has_offsets else None,
    ), moved


def _at_end(objective: Objective, maximum: Maximum, said: Information) -> tuple[FloatArray, FloatArray]:
    """Return the state after the last row, and its deviations: of the filter, and by those of the constants."""
    v, deviations = objective.full(maximum.z), np.sqrt(np.diag(said.covariance))
    x, P = objective.likelihood.at_end(v)
    moved = np.zeros((len(x), len(deviations)))
    for i, deviation in enumerate(deviations.tolist()):
        near = v.copy()
        near[i] += deviation
        found = objective.likelihood.at_end(near)[0] - x
        # Where the plant has no solution a constant is not so far off.
        moved[:, i] = found / deviation if np.isfinite(found).all() else 0.0
    return x, np.sqrt(np.diag(P) + np.einsum("ij,jk,ik->i", moved, said.covariance, moved))


def _beside(problem: Problem) -> list[int]:
    """Return places of variances, of equations and then of sensors, that stand beside a plant's own."""
    if not isinstance(problem.plant, PlantWithNoise):
        return []
    equations = [i for i, name in enumerate(problem.noisy) if name in problem.plant.added]
    coloured = problem.plant.states.correlations
    return equations + [len(problem.noisy) + j for j, name in enumerate(problem.output_names) if name in coloured]


def _limits(objective: Objective, maximum: Maximum) -> tuple[BoolArray, FloatArray]:
    """Return which variances, of equations and then of sensors, are told by an upper limit, and the limits."""
    free = np.flatnonzero(objective.is_q | objective.is_r)
    places = np.flatnonzero(objective.free[objective.nt :])
    limited = np.zeros(len(objective.free) - objective.nt, dtype=bool)
    limits = np.zeros(len(limited))
    weak = (objective.avoided > 0.0) | collapsed(objective, maximum)
    # Where coloured noise and walks are of no size there are none, and white noise beside coloured noise needs none.
    beside = _beside(objective.problem)
    for i, place in zip(free, places, strict=True):
        if weak[i] and place not in beside:
            limit = upper_limit(objective, maximum, int(i))
            limited[place] = maximum.likeliest[i] - limit < np.log(ZERO_SHARE)
            limits[place] = np.exp(limit)
    return limited, limits
