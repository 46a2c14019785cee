"""Central H-infinity filters: the least gain of a `GainProblem`, and filters that weigh noise at a given gain.

See `obsynth.synthesis.central_equation` for the equation behind them.  The true gain of the true problem decides.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from obsynth.synthesis.central_equation import CentralEquation, central_injection
from obsynth.synthesis.gain_problem import GainProblem, Injection

#: Artificial noise relative to the disturbance, in turn: the first is bisected, and each of the others only where it
#: reaches a level below.
NOISES = (1e-6, 1e-8, 1e-7, 1e-5, 1e-4, 1e-2)
#: Relative width of the bracket at which the search ends, for few and for many states.
FEW_STATES = 80
LEVEL_TOLERANCE = 1e-7
COARSE_LEVEL_TOLERANCE = 1e-4
COARSE_NOISES = (1e-6, 1e-4)
MOST_LEVELS = 60
#: Distance below the best gain, in tolerances, at which another noise is tried, and from which a failure ends that.
PROBE = 10.0
NEXT_TO = 1e-3
#: A filter whose true gain is above its level by this relative amount shows that the equation was not solved.
BROKEN_PROMISE = 2e-3
#: Share of the distance between a level that was reached and where the next should fail, by which it stays above that.
SAFETY = 0.01
#: The first level tried, relative to the start.
START_SHARE = 0.5
#: Weights of the noise beside the disturbance, relative to their sizes, and levels of both together, relative to the
#: gain of the disturbance alone.
NOISE_WEIGHTS = np.logspace(-6.0, 3.0, 31)
LEVEL_FACTORS = (1.0, 1.5)
WEIGHT_STEPS = 4
#: The same for many states, where each filter counts.
COARSE_NOISE_WEIGHTS = np.logspace(-6.0, 3.0, 15)
COARSE_LEVEL_FACTORS = (1.0,)
#: A level this far above anything a disturbance could do is no limit.
WITHOUT_LIMIT = 1e4


def central_filter_at(problem: GainProblem, level: float) -> Injection | None:
    """Return a filter whose true gain is below ``level``, from the first noise that gives one, or ``None``."""
    if problem.order == 0 or problem.measured == 0:
        return None
    work = with_least_weight(problem)
    for noise in NOISES:
        found = central_injection(work, level, noise=noise)
        if found is not None and problem.reaches(found, level):
            return found
    return None


def with_least_weight(problem: GainProblem) -> GainProblem:
    """Return the problem with V = 0 where the weight has a limit: the least weight there is meets every limit."""
    return problem if problem.weight_limit is None else replace(problem, free_weight=False, weight_limit=None)


def search_central_filter(
    problem: GainProblem,
    start: Injection,
    gain: float | None = None,
    *,
    tolerance: float | None = None,
    start_is_good: bool = False,
) -> tuple[Injection, float]:
    """Return the best central filter found, and (a bound on) its true gain.

    The least level of the equation with little noise is bisected.  Less of it may cost less, and with more of it the
    equation is less sensitive to rounding: a level just below is tried, and if that is reached, bisected in turn.

    Parameters
    ----------
    problem : GainProblem
        With measurements and a disturbance.
    start : Injection
        A stable filter: what is returned is at least as good.
    gain : float, optional
        Its true gain, where that is known.
    tolerance : float, optional
        Relative width of the bracket at which to stop.
    start_is_good : bool, optional
        Look just below the start first, and stop where nothing is found.
    """
    if tolerance is None:
        tolerance = LEVEL_TOLERANCE if problem.order <= FEW_STATES else COARSE_LEVEL_TOLERANCE
    best, gain = start, problem.achieved_gain(start) if gain is None else gain
    low = least_level(problem)
    for noise in NOISES if problem.order <= FEW_STATES else COARSE_NOISES:
        if gain <= low * (1.0 + 2.0 * tolerance):
            break
        equation = CentralEquation.of(problem, noise=noise)
        close = start_is_good or best is not start
        first = max(low, gain * (1.0 - PROBE * tolerance if close else START_SHARE))
        found, level = _descended(equation, low, gain, first=first, tolerance=tolerance)
        reached = np.inf if found is None else problem.achieved_gain(found)
        if found is not None and reached > level * (1.0 + BROKEN_PROMISE):
            # The equation promises more than its filter keeps: each filter is judged by itself.
            found, level = _descended(equation, low, gain, first=first, tolerance=tolerance, judged=True)
            reached = np.inf if found is None else problem.achieved_gain(found)
        if found is not None and reached < gain:
            best, gain = found, reached
    return best, gain


def least_level(problem: GainProblem) -> float:
    """Return what a disturbance does to xi before any measurement can help: no gain is below."""
    if problem.weight_is_free:
        return 0.0
    direct = problem.Zd if np.any(problem.D) else np.hstack([problem.Zd, problem.Z @ problem.B])
    return float(np.linalg.norm(direct, 2)) if direct.size else 0.0


def _descended(
    equation: CentralEquation, low: float, high: float, *, first: float, tolerance: float, judged: bool = False
) -> tuple[Injection | None, float]:
    """Return the central filter of the least level found between ``low`` and ``high``, and that level.

    Parameters
    ----------
    equation : CentralEquation
        For all levels.
    low, high : float
        No gain is below ``low``; nothing at or above ``high`` is of use.
    first : float
        Level to begin with: where it is not reached and close to ``high``, there is nothing below.
    tolerance : float
        Relative width of the bracket at which to stop.
    judged : bool, optional
        Whether a filter counts only when its true gain is as low as its level.
    """
    best, level = None, first * (1.0 + tolerance)
    known: list[tuple[float, float]] = []
    for _ in range(MOST_LEVELS):
        if level >= high * (1.0 - 0.5 * tolerance):
            break
        found, margin = equation.filter_and_margin(level)
        if found is not None and (not judged or equation.problem.achieved_gain(found) <= level * (1.0 + tolerance)):
            best, high = found, level
            known = [*known[-1:], (level, margin)]
            level = _next_level(known, low, tolerance)
        else:
            if best is None and level >= high * (1.0 - NEXT_TO):
                break
            low = level
            level = 0.5 * (low + high)
    return best, high


def _next_level(known: list[tuple[float, float]], low: float, tolerance: float) -> float:
    """Return the level to try after those that were reached, with their margins: close to where the margin vanishes."""
    high, margin = known[-1]
    zero = high * (1.0 - 0.5 * margin)
    if len(known) == 2 and known[0][1] > margin:
        zero = max(zero, high - margin * (known[0][0] - high) / (known[0][1] - margin))
    if high - zero <= tolerance * high:
        return high * (1.0 - tolerance)  # there should be none
    level = zero + SAFETY * (high - zero)
    return level if level > low else 0.5 * (low + high)


def least_noise_filter(problem: GainProblem) -> Injection | None:
    """Return the filter with the least variance of xi under the noise of the problem: a level without limit."""
    noise = replace(with_least_weight(problem), B=problem.Bn, D=problem.Dn, Zd=problem.Zn)
    if noise.order == 0 or noise.measured == 0:
        return None
    found = central_injection(noise, WITHOUT_LIMIT * max(noise.disturbance_size, 1.0), noise=NOISES[0])
    return found if found is not None and np.isfinite(problem.noise_variance(found)) else None


def noise_weighted_filters(problem: GainProblem, gain: float) -> Iterator[Injection]:
    """Yield central filters that promise a gain of at most ``gain``, for which the noise counts as much as it can.

    The noise of the problem, times a weight, is one more disturbance.  At the level ``gain`` for both together the gain
    of the true disturbance alone is lower; at a higher level the weight may be larger, and must then be searched with
    the true gain.

    Parameters
    ----------
    problem : GainProblem
        With measurements; without a noise model its noise is a unit one on the free measurements, so that little
        noise means small gains.
    gain : float
        Bound on the true gain of the disturbance.
    """
    work = with_least_weight(problem)
    sizes = [float(np.linalg.norm(np.vstack(pair))) for pair in ((work.B, work.D), (work.Bn, work.Dn))]
    if work.order == 0 or work.measured == 0 or not min(sizes) > 0.0:
        return
    few = work.order <= FEW_STATES
    weights, last = (NOISE_WEIGHTS if few else COARSE_NOISE_WEIGHTS) * sizes[0] / sizes[1], 0
    for factor in LEVEL_FACTORS if few else COARSE_LEVEL_FACTORS:
        # More weight than at a lower level, and not more than can be hoped for.
        low, high = last, len(weights) if factor == 1.0 else min(last + WEIGHT_STEPS, len(weights))
        best = None
        while low < high:
            middle = (low + high) // 2
            equation = CentralEquation.of(_with_noise(work, weights[middle]), noise=NOISES[0])
            found = equation.filter_at(factor * gain)
            if found is not None and (factor == 1.0 or problem.reaches(found, gain)):
                best, low = found, middle + 1
            else:
                high = middle
        if best is not None:
            yield best
            last = low - 1


def _with_noise(problem: GainProblem, weight: float) -> GainProblem:
    """Return the problem with its noise, times a weight, as further disturbances."""
    return replace(
        problem,
        B=np.hstack([problem.B, weight * problem.Bn]),
        D=np.hstack([problem.D, weight * problem.Dn]),
        Zd=np.hstack([problem.Zd, weight * problem.Zn]),
    )
