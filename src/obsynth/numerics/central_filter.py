"""Central H-infinity filters: the least gain of a `GainProblem`, and filters that weigh noise at a given gain.

See `central_equation` for the equation behind them.  The true gain of the true problem decides.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any, NamedTuple, TypeVar

import numpy as np

from obsynth.numerics.arrays import SMALLEST, largest_singular_value
from obsynth.numerics.central_equation import CentralEquation, central_injection
from obsynth.numerics.injection_problem import GainProblem, Injection, NormalisedProblem, normalise
from obsynth.numerics.lapack import least_squares
from obsynth.numerics.least_level import NEXT_TO, GammaIteration
from obsynth.numerics.modal_response import Modes
from obsynth.numerics.norms import spectral_radius
from obsynth.numerics.pencil_points import GENERIC_POINTS

#: Artificial noise relative to the disturbance, in turn: the first is bisected, and each of the others only where it
#: reaches a level below.
NOISES = (1e-6, 1e-8, 1e-10, 1e-7, 1e-5, 1e-4, 1e-2)

#: Relative width of the bracket at which the search ends, for few and for many states.
FEW_STATES = 80

LEVEL_TOLERANCE = 1e-7

COARSE_LEVEL_TOLERANCE = 1e-5

COARSE_NOISES = (1e-6, 1e-4)

#: Distance below the best gain, in tolerances, at which another noise is tried.
PROBE = 10.0

#: The first level tried, relative to the start, for few and for many states: the margin near the start leads far down.
FIRST_LEVEL = 0.5

COARSE_START_SHARE = 0.99

#: Weights of the noise beside the disturbance, relative to their sizes, and levels of both together, relative to the
#: gain of the disturbance alone.
NOISE_WEIGHTS = np.logspace(-6.0, 3.0, 31)

LEVEL_FACTORS = (1.0, 1.5)

#: Above so many states the higher level, which makes gains up to a quarter smaller, would cost up to half of the time;
#: and one weight in so many is enough.
HIGHER_LEVEL_UP_TO = 200

COARSE_WEIGHTS = 4

WEIGHT_STEPS = 4

#: The weight that is tried first: the largest that keeps the level was within two of it in 161 of 180 random plants of
#: 6 to 32 states, and eight below it, or four above, in two power networks.
USUAL_WEIGHT = 16

#: A disturbance that does less than this share of what it does to the starting filter is decoupled; the levels at which
#: such a filter is looked for in turn, relative to the same; a point without meaning; and the share of rows xi that
#: counts as nothing.
DECOUPLED_GAIN = 1e-7

#: Pairs of level and artificial noise: what this noise costs goes with its square, but many states need some.
DECOUPLING_ATTEMPTS = ((1e-4, 1e-6), (1e-2, 1e-6), (1e-4, 1e-8), (1e-2, 1e-8))

#: One more where rounding spoiled them all, and the share of the gain below which a filter of few states is worth other
#: coordinates, in which the attempts are repeated: a descent of the level would take a hundred equations.
COARSE_ATTEMPT, WORTH_COORDINATES = (1e-1, 1e-4), 0.05

#: The same share where states are many: no gain that is shipped is smaller than ten times that.
COARSELY_DECOUPLED = 1e-4

#: Points so far out that a combination which waits for samples, or takes only the last ones, shows by its growth.
FAR_POINTS, MOST_FAR_GROWTH, LEAST_FAR_DECAY = (1e2, 1e3), 3.0, 0.3

SAME_ROWS = 1e-8

#: A level this far above anything a disturbance could do is no limit.
WITHOUT_LIMIT = 1e4

Found = TypeVar("Found")

#: A gain this close to one that no filter is below is the least.
AT_THE_BOUND = 1e-6

#: Coordinates in which the Riccati equations are solved, at most.
MOST_PASSES = 8

#: Riccati equations need no other coordinates when the gain is at least this fraction of that behind those they had.
GOOD_COORDINATES = 0.1

#: Gains below this fraction of the starting filter's are treated as zero: the disturbance is decoupled.
NEGLIGIBLE_GAIN = 1e-6

#: The bracket of a bisection ends at this share of the width asked for: the filter in hand is at its upper end.
BRACKET_SHARE = 0.1


def central_filter_at(problem: GainProblem, level: float) -> Injection | None:
    """Return a filter whose true gain is below ``level``, from the first noise that gives one, or ``None``."""
    if problem.order == 0 or problem.measured == 0:
        return None
    work = with_least_weight(problem)
    for noise in NOISES:
        injection = central_injection(work, level, noise=noise)
        if injection is not None and problem.reaches(injection, level):
            return injection
    return None


def with_least_weight(problem: GainProblem) -> GainProblem:
    """Return the problem with V = 0 where the weight has a limit: the least weight there is meets every limit."""
    return problem if problem.weight_limit is None else replace(problem, free_weight=False, weight_limit=None)


def search_central_filter(
    problem: GainProblem,
    start: Injection,
    gain: float | None = None,
    *,
    start_is_good: bool = False,
    hastens: bool = False,
) -> tuple[Injection, float]:
    """Return the best central filter found, and (a bound on) its true gain.

    The least level with little noise first; other noises, cheaper or less sensitive, where they reach one below.
    ``hastens``: a filter that no disturbance hardly reaches is returned at once, as a start in other coordinates.
    """
    tolerance = LEVEL_TOLERANCE if problem.order <= FEW_STATES else COARSE_LEVEL_TOLERANCE
    best, gain = start, problem.achieved_gain(start) if gain is None else gain
    low, least_noise, most_noise = least_level(problem), 0.0, np.inf
    if low <= DECOUPLED_GAIN * gain and (decoupled := _decoupling_filter(problem, gain, hastens)) is not None:
        return decoupled
    for noise in NOISES if problem.order <= FEW_STATES else COARSE_NOISES:
        if gain <= low * (1.0 + 2.0 * tolerance):
            break
        if not least_noise <= noise <= most_noise:
            continue
        close = start_is_good or best is not start
        equation = CentralEquation.of(problem, noise=noise)
        descent = GammaIteration(equation, low, gain, tolerance, expects_rounding=close)
        share = FIRST_LEVEL if problem.order <= FEW_STATES else COARSE_START_SHARE
        descent.run(max(low, gain * (1.0 - PROBE * tolerance if close else share)))
        candidate = descent.best()
        if candidate is None and descent.reached and descent.reached[0].level < gain * (1.0 - NEXT_TO):
            descent = descent.judged_again(gain)
            candidate = descent.best()
        # The level that is reached last may be made up by rounding, or noise may raise it: of all that were judged.
        candidates = [candidate, *(item for item in descent.evaluated if math.isfinite(item[1]))]
        candidate = min(filter(None, candidates), key=lambda item: item[1], default=None)
        if noise < most_noise < np.inf and (candidate is None or candidate[1] >= gain):
            least_noise = noise  # nor is less of it worth a try
        if candidate is None:
            continue
        injection, reached = candidate
        if descent.settled and reached <= descent.high * (1.0 + PROBE * tolerance):
            most_noise = noise  # more of it cannot cost less
        if reached < gain:
            best, gain = injection, reached
    return best, gain


def _decoupling_filter(problem: GainProblem, gain: float, hastens: bool) -> tuple[Injection, float] | None:
    """Return a filter that no disturbance reaches, or hardly any, and its gain; ``None`` where there is none."""
    if not _follows_from_measurements(problem):
        return None
    # The artificial noise has a gain of its own, which in many states may be above the first level; next to a zero on
    # the unit circle only little of it leaves the equation a solution.
    best = None
    for share, noise in (*DECOUPLING_ATTEMPTS, COARSE_ATTEMPT):
        if (share, noise) == COARSE_ATTEMPT and (not hastens or (best is not None and best[1] < gain)):
            break
        injection = central_injection(problem, share * gain, noise=noise)
        if injection is None:
            continue
        reached = problem.achieved_gain(injection)
        if reached <= DECOUPLED_GAIN * gain:
            return injection, reached
        best = (injection, reached) if best is None or reached < best[1] else best
    enough = WORTH_COORDINATES if hastens else COARSELY_DECOUPLED if problem.order > FEW_STATES else 0.0
    return best if best is not None and best[1] <= enough * gain else None


def _follows_from_measurements(problem: GainProblem) -> bool:
    """Whether the rows of xi are combinations of those of state and measurements, without samples yet to come."""
    if _combined(problem, -GENERIC_POINTS[1])[1] > SAME_ROWS:
        return False
    # A sample yet to come is a factor of z, and where no weight is free past ones alone are left: a factor of 1 / z.
    size = max(1.0, spectral_radius(problem.A))
    near, far = (_combined(problem, point * size)[0] for point in FAR_POINTS)
    return far <= (MOST_FAR_GROWTH if problem.weight_is_free else LEAST_FAR_DECAY) * near


def _combined(problem: GainProblem, point: float) -> tuple[float, float]:
    """Return the size of the combination at a point of the z-plane, and what it leaves, as a share of xi."""
    shifted = problem.A - point * np.eye(problem.order)
    known = np.vstack([np.hstack([shifted, problem.B]), np.hstack([problem.C, problem.D])])
    target = np.hstack([problem.Z, problem.Zd])
    solved = least_squares(known.T, target.T)
    residual = float(np.linalg.norm(known.T @ solved - target.T))
    return float(np.linalg.norm(solved)), residual / max(float(np.linalg.norm(target)), SMALLEST)


def least_level(problem: GainProblem) -> float:
    """Return what a disturbance does to xi before any measurement can help: no gain is below."""
    if problem.weight_is_free:
        return 0.0
    direct = problem.Zd if np.any(problem.D) else np.hstack([problem.Zd, problem.Z @ problem.B])
    return largest_singular_value(direct)


def least_noise_filter(problem: GainProblem) -> Injection | None:
    """Return the filter with the least variance of xi under the noise of the problem: a level without limit."""
    noise = with_least_weight(problem).noise_as_disturbance()
    if noise.order == 0 or noise.measured == 0:
        return None
    injection = central_injection(noise, WITHOUT_LIMIT * max(noise.disturbance_size, 1.0), noise=NOISES[0])
    return injection if injection is not None and np.isfinite(problem.noise_variance(injection)) else None


def noise_weighted_filters(
    problem: GainProblem, gain: float, *, reaches: Callable[[Injection], bool], artificial: float = NOISES[0]
) -> Iterator[Injection]:
    """Yield central filters with a gain of at most ``gain`` on paper, for which the noise counts as much as it can.

    The noise, times a weight, is one more disturbance; at a level above ``gain`` the true gain finds the weight.
    """
    for _, injection in placed_filters(problem, gain, reaches=reaches, artificial=artificial):
        yield injection


def placed_filters(
    problem: GainProblem,
    gain: float,
    *,
    reaches: Callable[[Injection], bool],
    artificial: float = NOISES[0],
    near: int | None = None,
) -> Iterator[tuple[int, Injection]]:
    """Yield `noise_weighted_filters` with their places among the weights; the search begins ``near`` one of these."""
    work = with_least_weight(problem)
    sizes = [float(np.linalg.norm(np.vstack(pair))) for pair in ((work.B, work.D), (work.Bn, work.Dn))]
    if work.order == 0 or work.measured == 0 or not min(sizes) > 0.0:
        return
    coarse = 1 if work.order <= HIGHER_LEVEL_UP_TO else COARSE_WEIGHTS
    weights, last = (NOISE_WEIGHTS * sizes[0] / sizes[1])[::coarse], 0
    begin = USUAL_WEIGHT // coarse if near is None else near

    def tried(place: int, factor: float) -> Injection | None:
        injection = central_injection(_with_noise(work, weights[place]), factor * gain, noise=artificial)
        return injection if injection is not None and (factor == 1.0 or reaches(injection)) else None

    for factor in LEVEL_FACTORS if coarse == 1 else LEVEL_FACTORS[:1]:
        # More weight than at a lower level, and not more than can be hoped for.
        places = range(last, len(weights) if factor == 1.0 else min(last + WEIGHT_STEPS, len(weights)))
        heaviest = last_found(partial(tried, factor=factor), places, begin)
        if heaviest is not None:
            begin = last = heaviest[0]
            yield heaviest


def last_found(tried: Callable[[int], Found | None], places: range, begin: int) -> tuple[int, Found] | None:
    """Return the last place at which something is found, and what, by bisection that begins in small steps."""
    low, high, step = places.start, places.stop, 1
    best: tuple[int, Found] | None = None
    place = min(max(begin, low), high - 1)
    while low < high:
        result = tried(place)
        if result is None:
            high = place
        else:
            best, low = (place, result), place + 1
        if best is not None and high < places.stop:
            place = (low + high) // 2
        else:
            place, step = min(place + step, high - 1) if best is not None else max(place - step, low), 2 * step
    return best


def noise_weighted_filters_within(
    normalised: NormalisedProblem, gain: float, *, reaches: Callable[[Injection], bool]
) -> Iterator[Injection]:
    """Yield `noise_weighted_filters` of the problem before normalisation, found in its coordinates.

    Far below the gain of the starting filter the artificial noise would in others be all that counts."""

    def reached(injection: Injection) -> bool:
        return reaches(normalised.restore(injection))

    level = gain / normalised.gain
    for central in noise_weighted_filters(normalised.problem, level, reaches=reached, artificial=min(NOISES)):
        yield normalised.restore(central)


def _with_noise(problem: GainProblem, weight: float) -> GainProblem:
    """Return the problem with its noise, times a weight, as further disturbances."""
    return replace(
        problem,
        B=np.concatenate([problem.B, weight * problem.Bn], axis=1),
        D=np.concatenate([problem.D, weight * problem.Dn], axis=1),
        Zd=np.concatenate([problem.Zd, weight * problem.Zn], axis=1),
    )


@dataclass(frozen=True, eq=False)
class LeastGain:
    """The outcome of the search: the true norm of the best filter (0 without d), and its gains.

    ``first``: coordinates of the starting (Kalman) filter; ``starting_gain``: its norm; ``bracket``: of a bisection.
    """

    gain: float
    first: NormalisedProblem
    injection: Injection
    starting_gain: float
    bracket: tuple[float, float]
    records: list[dict[str, Any]] = field(default_factory=list)


def search_least_gain(problem: GainProblem) -> LeastGain:
    """Minimise the gain directly, improving the coordinates between passes."""
    first = normalise(problem)
    starting = first.start_gain
    if problem.measured == 0 or starting == 0.0:
        return LeastGain(starting, first, first.start, starting, (starting, starting))
    found = _passed(problem, first, hastens=problem.order <= FEW_STATES)
    if found.hastened and found.gain > NEGLIGIBLE_GAIN * starting:
        # The disturbance is not decoupled: its least gain is searched from the first coordinates on.
        found = min(found, _passed(problem, first, hastens=False), key=lambda one: one.gain)
    exact = replace(problem, judged_exactly=True)
    if found.modes is not None:
        exact.knows(found.injection, found.modes)
    gain = exact.achieved_gain(found.injection)
    return LeastGain(gain, first, found.injection, starting, (gain, gain), found.records)


class _Passed(NamedTuple):
    """The best filter of some passes, and whether one of them ended at a filter that was near enough."""

    injection: Injection
    gain: float
    hastened: bool
    modes: Modes | None
    records: list[dict[str, Any]]


def _passed(problem: GainProblem, first: NormalisedProblem, *, hastens: bool) -> _Passed:
    """Search the least gain in coordinates that each pass makes better for the next one."""
    normalised, best, gain = first, first.start, first.start_gain
    records: list[dict[str, Any]] = []
    modes, hastened = None, False
    for number in range(MOST_PASSES):
        if problem.order == 0 or gain <= least_level(problem) * (1.0 + AT_THE_BOUND):
            break  # nothing is below
        before = gain
        if best is not normalised.start:
            normalised = normalise(problem, start=best, gain=gain)
        # In coordinates in which the artificial noise is of a natural size.
        work, start = with_least_weight(normalised.problem), normalised.contracted(best)
        known: float | None = gain / normalised.gain
        if not work.weight_is_free and np.any(start.V):
            start, known = Injection(start.R, np.zeros_like(start.V)), None
        injection, level = search_central_filter(work, start, known, start_is_good=number > 0, hastens=hastens)
        hastened |= hastens and level < WORTH_COORDINATES
        records.append({"what": "least gain", "solver": "central filter", "status": "optimal", "gain": level})
        if level * normalised.gain < gain:
            best, gain = normalised.restore(injection), level * normalised.gain
            # Found once, in one of the two coordinates, among many states.
            modes = normalised.restored_modes(work.modes(injection)) if problem.order > HIGHER_LEVEL_UP_TO else None
        if gain >= GOOD_COORDINATES * before or gain <= NEGLIGIBLE_GAIN * first.start_gain:
            break
    return _Passed(best, gain, hastened, modes, records)


def search_by_bisection(problem: GainProblem, *, tolerance: float) -> LeastGain:
    """Minimise the gain by bisection: the paper's Algorithm 1, made to end.

    Every upper end of the bracket is the true norm of a filter in hand, the lower end a level at which none was found.
    """
    problem = replace(problem, judged_exactly=True)
    normalised = normalise(problem)
    gain = normalised.start_gain
    if problem.measured == 0 or gain == 0.0:
        return LeastGain(gain, normalised, normalised.start, gain, (gain, gain))
    work, best = normalised.problem, normalised.contracted(normalised.start)
    high, low = work.achieved_gain(best), 0.0
    while high - low > BRACKET_SHARE * tolerance * high:
        middle = 0.5 * (low + high)
        better = central_filter_at(work, middle)
        if better is None:
            low = middle
        else:
            best, high = better, min(middle, work.achieved_gain(better))
    injection, bracket = normalised.restore(best), (low * normalised.gain, high * normalised.gain)
    return LeastGain(problem.achieved_gain(injection), normalised, injection, gain, bracket)
