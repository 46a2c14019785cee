"""The greatest likelihood of constants and variances: several starts, SLSQP in scaled variables, and a polish."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from obsynth.monitoring.calibration.likelihood import IMPOSSIBLE, Likelihood
from obsynth.monitoring.calibration.logs import refused
from obsynth.monitoring.calibration.problem import CalibrationProblem
from obsynth.monitoring.calibration.simulation_error import BoolArray, Fit, without_solution
from obsynth.numerics.arrays import FloatArray

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

    def __init__(self, problem: CalibrationProblem, fit: Fit) -> None:
        p, g = problem, problem.graphs
        self.problem = p
        self.likelihood = Likelihood(p)
        self.nt, nq = g.nt, len(p.noisy)
        first_q = _process_noise(problem, fit)
        first_r = np.log(np.maximum(fit.deviations**2, 2.0 * p.floors))
        stated = np.concatenate([p.known_Q, p.known_R])
        self.variances = np.where(np.isnan(stated), np.concatenate([first_q, first_r]), np.log(stated))
        self.free = np.concatenate([np.ones(g.nt, dtype=bool), np.isnan(stated)])
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
        variables = np.concatenate([t / self.problem.widths, self.variances])
        return np.asarray(np.clip(variables[self.free], self.low, self.high))

    def free_of(self, v: FloatArray) -> FloatArray:
        """Return free variables from ``[t, log q, log r]``."""
        scaled = np.concatenate([v[: self.nt] / self.problem.widths, v[self.nt :]])
        return np.asarray(np.clip(scaled[self.free], self.low, self.high))

    def full(self, z: FloatArray) -> FloatArray:
        """Return ``[t, log q, log r]``."""
        variables = np.concatenate([np.zeros(self.nt), self.variances])
        variables[self.free] = z
        variables[: self.nt] *= self.problem.widths
        return variables

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


def _process_noise(problem: CalibrationProblem, fit: Fit) -> FloatArray:
    """Return logarithms of first guesses, from what a unit added to an equation does to the states in a sample."""
    g, p = problem.graphs, problem
    stages = g.solve(p.x0, p.u[0], fit.t)[0]
    way = np.array(g.local(p.x0, p.u[0], fit.t, fit.t, g.sensitivities(p.x0, p.u[0], fit.t, stages))[3])
    moved = (np.abs(way) / p.plant.state_scales[:, None]).max(axis=0)[p.noisy_equations]
    moved = np.where(np.isfinite(moved) & (moved > 0.0), moved, 1.0)
    return np.asarray(2.0 * np.log(FIRST_PROCESS_NOISE / moved))


def descent(
    objective: Callable[[FloatArray], tuple[float, FloatArray]],
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
        value, gradient = objective(at(w))
        return value, gradient * scale

    with np.errstate(all="ignore"):
        result = minimize(
            scaled,
            np.zeros(len(start)),
            jac=True,
            method="SLSQP",
            options={"maxiter": most, "ftol": tolerance},
            bounds=np.column_stack([(low - start) / scale, (high - start) / scale]),
        )
    return float(result.fun), at(result.x)


def greatest_likelihood(
    objective: Objective, fits: Sequence[Fit], note: Callable[[str], object], known: FloatArray | None = None
) -> Maximum:
    """Return the best of several searches, polished; of one, where it is ``known`` about where the maximum is, as
    ``[t, log q, log r]``."""
    count, best, value = 0, None, np.inf
    if known is not None:
        note("likelihood, from what is known")
        value, best = objective.descent(objective.free_of(known))
        fits = fits if value >= IMPOSSIBLE else []
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
            "The filter has no finite likelihood from any start."
            f"{without_solution(objective.problem)} Check units, bounds and the initial covariance.",
            signals=list(objective.problem.unknown),
        )
    for _ in range(MOST_WIDENINGS):
        if not objective.widened(best):
            break
        value, best = objective.descent(best)
    # What drives coloured noise moves a sensor from row to row by the same whatever its correlation: the search begins
    # again from others, where this one ended.
    problem = objective.problem
    for i in range(len(problem.names), objective.nt) if fits else ():
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
            trial_value, slope = objective(trial)
            if trial_value < value:
                z, value, gradient = trial, trial_value, slope
                break
        if before - value < tolerance:
            break
        curvature = hessian(objective, z, curvature)
    # What is left across steep walls tilts the bottom of a bent valley, and with it what the valley leaves open.
    for _ in range(ACROSS_STEPS):
        trial = _newton_step(objective, z, gradient, curvature, 0.0, fixed, least=STEEP)
        trial_value, slope = objective(trial)
        if not trial_value < value + VALUE_ROUNDING * abs(value):
            break
        z, value, gradient = trial, trial_value, slope
    return value, z, _hessian_of_minimum(objective, z, curvature) if fixed is None else curvature


def _hessian_of_minimum(objective: Objective, z: FloatArray, near: FloatArray) -> FloatArray:
    """Return the Hessian, in longer steps where short ones see a kink of the model and no minimum."""
    free = np.flatnonzero(~at_bounds(z, objective.low, objective.high))
    second = hessian(objective, z, near)
    for step in LONGER_DIFFERENCES:
        values = np.linalg.eigvalsh(second[np.ix_(free, free)]) if free.size else np.zeros(1)
        if values[0] >= -max(DOWNWARDS, DOWNWARDS_SHARE * values[-1]):
            break
        objective.bent = True
        second = hessian(objective, z, steps=np.where(objective.is_q | objective.is_r, 1.0, CONSTANT_STEP) * step)
    return second


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
    is_collapsed = np.zeros(objective.size, dtype=bool)
    for i in np.flatnonzero(objective.is_q | objective.is_r):
        z = maximum.z.copy()
        z[i] = max(z[i] - COLLAPSE, objective.low[i])
        is_collapsed[i] = objective(z)[0] - maximum.value < COLLAPSE_NATS
    return is_collapsed


def without_collapse(
    objective: Objective, maximum: Maximum, note: Callable[[str], object], known: FloatArray | None = None
) -> Maximum:
    """Return the maximum with variances kept away from zero where the log cannot tell them from it. The weight sqrt(q)
    of a boundary-avoiding prior (Chung et al. 2013) is given to those variances alone: a variance that a short log
    makes zero by chance would make every box too small. The search begins where such a variance is ``known`` to be,
    as `avoided_variances` of another fit has it, or else at several places."""
    for _ in range(len(objective.problem.noisy) + 1):
        new = collapsed(objective, maximum) & (objective.avoided == 0.0)
        if not new.any():
            break
        note("variances that the log cannot distinguish from zero")
        objective.avoided[new] = 1.0
        best, value = maximum.z, np.inf
        places = [objective.first[new] + raised for raised in RAISED]
        if known is not None and np.isfinite(known[objective.free][new]).all():
            places = [known[objective.free][new]]
        for place in places:
            start = maximum.z.copy()
            start[new] = np.clip(place, objective.low[new], objective.high[new])
            reached, z = objective.descent(start)
            if reached < value:
                best, value = z, reached
        value, best, curvature = polished(objective, best)
        maximum = Maximum(best, value, curvature, maximum.likeliest)
    return maximum


def avoided_variances(objective: Objective, z: FloatArray) -> FloatArray:
    """Return ``[t, log q, log r]`` of the variances that are kept away from zero, NaN for all others."""
    variables = np.full(len(objective.free), np.nan)
    variables[objective.free] = np.where(objective.avoided > 0.0, z, np.nan)
    return variables


def hessian(
    objective: Objective, z: FloatArray, near: FloatArray | None = None, *, steps: FloatArray | None = None
) -> FloatArray:
    """Return second derivatives by central differences of the exact gradient, in steps that suit those nearby."""
    if steps is None:
        steps = np.full(len(z), GRADIENT_DIFFERENCE)
    if near is not None:
        steeper = np.sqrt(np.maximum(np.diag(near), 1.0))
        steps = np.clip(DIFFERENCE_SHARE / steeper, LEAST_DIFFERENCE, GRADIENT_DIFFERENCE)
    second = np.array(
        [
            (objective(z + step)[1] - objective(z - step)[1]) / (2.0 * size)
            for size, step in zip(steps, np.diag(steps), strict=True)
        ]
    )
    return np.asarray(0.5 * (second + second.T))


def at_bounds(z: FloatArray, low: FloatArray, high: FloatArray) -> BoolArray:
    """Return which variables are at a bound, as truth values."""
    room = NEAR_BOUND * (1.0 + np.abs(z))
    return (z - low <= room) | (high - z <= room)
