"""Information of a log on the constants: directions that it does not determine, and boxes by profile likelihood."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from obsynth.monitoring.calibration.maximum import Maximum, Objective, at_bounds, descent, polished
from obsynth.numerics.arrays import SMALLEST, FloatArray
from obsynth.numerics.ranks import LEAST_INFORMATION

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

#: The share of that step at which an end is reported.
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
    matrix = hessian[:nt, :nt]
    if nuisance:
        values, vectors = np.linalg.eigh(hessian[np.ix_(nuisance, nuisance)])
        determined = values > LEAST_INFORMATION * max(float(values.max()), SMALLEST)
        across = hessian[:nt, nuisance] @ vectors[:, determined]
        matrix = matrix - (across / values[determined]) @ across.T
    return covariance_of(matrix, widths, names)


def covariance_of(matrix: FloatArray, widths: FloatArray, names: tuple[str, ...]) -> Information:
    """Return covariance and undetermined directions of information in widths of the bounds."""
    values, vectors = np.linalg.eigh(0.5 * (matrix + matrix.T))
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

    probability = 1.0 - (1.0 - level) / (2.0 * max(constants, 1))
    if not variances:
        return float(norm.ppf(probability))
    return float(t.ppf(probability, max(samples - constants - 2, 3))) * (
        1.0 + (SHORT_WIDENING - 1.0) * min(1.0, SHORT_LOG / samples)
    )


@dataclass(frozen=True, eq=False)
class Side:
    """One end of a box: its value, and whether the log bounds it there."""

    value: float
    is_open: bool


def profile_box(
    objective: Objective,
    maximum: Maximum,
    root: float,
    knowledge: Information,
    of_fewer_rows: Sequence[tuple[Side, Side]] | None = None,
) -> list[tuple[Side, Side]]:
    """Return both ends of each constant's box, in its own units. Where boxes ``of_fewer_rows`` are given, constants
    that a log hardly determines keep these: all rows say no less."""
    box, problem = [], objective.problem
    for i, (name, width) in enumerate(zip(problem.names, problem.widths, strict=False)):
        weak = objective.bent or any(name in direction for direction in knowledge.undetermined)
        if weak and of_fewer_rows is not None:
            box.append(of_fewer_rows[i])
            continue
        side = _side_along_valley if weak else _side
        sides = [side(objective, maximum, i, sign, root) for sign in (-1.0, 1.0)]
        # An open side is the bound that was given, not what a division and a product leave of it.
        bounds = (float(problem.low[i]), float(problem.high[i]))
        low, high = (
            Side(bound if item.is_open else item.value * width, item.is_open)
            for item, bound in zip(sides, bounds, strict=True)
        )
        box.append((low, high))
    return box


def quadratic_box(
    objective: Objective, maximum: Maximum, root: float, knowledge: Information
) -> list[tuple[Side, Side]]:
    """Return both ends of each constant's box by its deviation, open at a bound: many rows make the likelihood a
    parabola, and what they do not determine counts as the whole width."""
    problem, nominal = objective.problem, objective.constants(maximum.z)
    reach = root * np.sqrt(np.diag(knowledge.covariance))
    bounds = zip(problem.low.tolist(), problem.high.tolist(), strict=True)
    return [
        (Side(max(value - far, low), value - far <= low), Side(min(value + far, high), value + far >= high))
        for value, far, (low, high) in zip(nominal.tolist(), reach.tolist(), bounds, strict=False)
    ]


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
    place, others_at = float(maximum.z[i]), maximum.z[others].copy()

    def root(value: float) -> float:
        nonlocal place, others_at

        def both(w: FloatArray) -> tuple[float, FloatArray]:
            z = np.empty(len(others) + 1)
            z[others], z[i] = w, value
            value_at, gradient = objective(z)
            return value_at, gradient[others]

        if others:
            guess = np.clip(others_at + slope * (value - place), low, high)
            least, others_at = descent(
                both, guess, low, high, scale, tolerance=PROFILE_SEARCH_TOLERANCE, most=MOST_PROFILE_SEARCHES
            )
        else:
            least = both(others_at)[0]
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
        middle_root = root(middle)
        if middle_root >= target:
            outer, reached = middle, middle_root
        else:
            inner, reached_inner = middle, middle_root
        if target - reached_inner < PROFILE_TOLERANCE * target:
            # The outer end would do as well; between them the interpolation is better than either.
            share = (target - reached_inner) / max(reached - reached_inner, SAME_ROOT)
            return Side(inner + share * (outer - inner), False)
    return Side(outer, False)


def _side_along_valley(objective: Objective, maximum: Maximum, i: int, sign: float, target: float) -> Side:
    """Return the end of a constant that the log hardly determines: along a valley that bends, in short steps. The
    others are led on from the last two places, and set right by Newton's steps at each."""
    others = [j for j in range(len(maximum.z)) if j != i]
    place, others_at = float(maximum.z[i]), maximum.z[others].copy()
    end = float(objective.low[i] if sign < 0 else objective.high[i])
    inner = maximum.hessian[np.ix_(others, others)]
    slope = -np.linalg.lstsq(inner, maximum.hessian[others, i], rcond=LEAST_INFORMATION)[0]
    step, reached, curvature = VALLEY_STEP, 0.0, maximum.hessian
    while abs(end - place) > AT_BOUND:
        new = place + sign * min(step, abs(end - place))
        z = np.empty(len(maximum.z))
        z[others], z[i] = others_at + slope * (new - place), new
        z = np.clip(z, objective.low, objective.high)
        least, z, after = polished(
            objective, z, fixed=i, most=VALLEY_NEWTON_STEPS, tolerance=VALLEY_TOLERANCE, near=curvature
        )
        new_root = math.sqrt(max(2.0 * (least - maximum.value), 0.0))
        if new_root >= target:
            if step <= LEAST_VALLEY_STEP * VALLEY_STEP:
                share = (target - reached) / max(new_root - reached, SAME_ROOT)
                return Side(place + share * (new - place), False)
            step *= 0.25
            continue
        slope, place, others_at, reached = (z[others] - others_at) / (new - place), new, z[others].copy(), new_root
        curvature = after
    return Side(end, True)
