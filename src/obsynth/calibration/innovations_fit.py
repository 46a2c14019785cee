"""The likelihood's maximum with everything that is read off it: boxes, directions, limits of variances, timing.

What a log says of each constant: information, directions it does not determine, and boxes by profile likelihood.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from obsynth.calibration.likelihood import IMPOSSIBLE
from obsynth.calibration.maximum import (
    Maximum,
    Objective,
    at_bounds,
    collapsed,
    descent,
    greatest_likelihood,
    polished,
    without_collapse,
)
from obsynth.calibration.plants import PlantWithNoise
from obsynth.calibration.problem import Problem
from obsynth.calibration.simulation_error import UNKNOWN_START, Fit, simulation_fits
from obsynth.numerics.arrays import SMALLEST, FloatArray
from obsynth.numerics.ranks import LEAST_INFORMATION
from obsynth.plants.noise_model import DEFAULT_WHITE_SHARE

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
    names = problem.names
    for i, width in enumerate(problem.widths[: len(names)]):
        weak = objective.bent or any(names[i] in direction for direction in said.undetermined)
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


class Profile:
    """The least value of the objective as a function of one variable, the others led along."""

    def __init__(self, objective: Objective, maximum: Maximum, i: int) -> None:
        self.objective, self.maximum, self.i = objective, maximum, i
        self.others = [j for j in range(len(maximum.z)) if j != i]
        values, vectors = np.linalg.eigh(maximum.hessian)
        values = np.maximum(values, LEAST_CURVATURE_SHARE * max(float(values.max()), SMALLEST))
        self.covariance = (vectors / values) @ vectors.T
        inner = maximum.hessian[np.ix_(self.others, self.others)]
        values, vectors = np.linalg.eigh(inner)
        values = np.maximum(values, LEAST_CURVATURE_SHARE * max(float(values.max(initial=0.0)), SMALLEST))
        spread = np.sqrt(np.diag((vectors / values) @ vectors.T))
        # Variables that the log does not determine move by no more than their search does.
        self.scale = np.minimum(spread, np.where(np.arange(len(maximum.z))[self.others] < objective.nt, 1.0, 3.0))
        self.place, self.rest = float(maximum.z[i]), maximum.z[self.others].copy()

    def root(self, value: float) -> float:
        """Return the root of the deviance at a value of the variable."""
        o, i, others = self.objective, self.i, self.others
        slope = self.covariance[others, i] / self.covariance[i, i]
        low, high = o.low[others], o.high[others]
        guess = np.clip(self.rest + slope * (value - self.place), low, high)

        def both(w: FloatArray) -> tuple[float, FloatArray]:
            z = np.empty(len(others) + 1)
            z[others], z[i] = w, value
            found, gradient = o(z)
            return found, gradient[others]

        if others:
            least, self.rest = descent(
                both, guess, low, high, self.scale, tolerance=PROFILE_SEARCH_TOLERANCE, most=MOST_PROFILE_SEARCHES
            )
        else:
            least = both(self.rest)[0]
        self.place = value
        return math.sqrt(max(2.0 * (least - self.maximum.value), 0.0))


def _side(objective: Objective, maximum: Maximum, i: int, sign: float, target: float) -> Side:
    """Return where the root of the profile's deviance reaches a target; open where a bound comes first."""
    profile, begin = Profile(objective, maximum, i), float(maximum.z[i])
    end = float(objective.low[i] if sign < 0 else objective.high[i])
    if abs(end - begin) < AT_BOUND:
        return Side(end, True)
    deviation = math.sqrt(max(profile.covariance[i, i], LEAST_DEVIATION**2))
    inner, reached_inner = begin, 0.0
    outer, reached = begin + sign * min(target * deviation, abs(end - begin)), 0.0
    for _ in range(MOST_PROFILE_STEPS):
        reached = profile.root(outer)
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
        found = profile.root(middle)
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


BoolArray = NDArray[np.bool_]
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
    """Constants ``(nt,)``, their information and box, variances by equation and sensor, and what the filter said."""

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
    R = np.where(coloured, np.maximum(R, DEFAULT_WHITE_SHARE**2 * np.mean(e**2, axis=0)), R)
    bounds = at_bounds(maximum.z, objective.low, objective.high)[: objective.nt]
    return InnovationsFit(
        objective.constants(maximum.z),
        objective.plain(maximum.z),
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
    ), moved


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
