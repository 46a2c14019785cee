"""Central H-infinity filters: the least gain of a `GainProblem`, and filters that weigh noise at a given gain.

See `central_equation` for the equation behind them.  The true gain of the true problem decides.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import replace

import numpy as np

from obsynth.methods.fault_estimation_filter.central_equation import CentralEquation, central_injection
from obsynth.methods.fault_estimation_filter.gamma_iteration import NEXT_TO, GammaIteration
from obsynth.methods.fault_estimation_filter.injection_problem import GainProblem, Injection
from obsynth.numerics.arrays import SMALLEST
from obsynth.numerics.norms import spectral_radius

#: Artificial noise relative to the disturbance, in turn: the first is bisected, and each of the others only where it
#: reaches a level below.
NOISES = (1e-6, 1e-8, 1e-7, 1e-5, 1e-4, 1e-2)
#: Relative width of the bracket at which the search ends, for few and for many states.
FEW_STATES = 80
LEVEL_TOLERANCE = 1e-7
COARSE_LEVEL_TOLERANCE = 1e-5
COARSE_NOISES = (1e-6, 1e-4)
#: Distance below the best gain, in tolerances, at which another noise is tried.
PROBE = 10.0
#: The first level tried, relative to the start, for few and for many states: the margin near the start leads far down.
START_SHARE = 0.5
COARSE_START_SHARE = 0.99
#: Weights of the noise beside the disturbance, relative to their sizes, and levels of both together, relative to the
#: gain of the disturbance alone.
NOISE_WEIGHTS = np.logspace(-6.0, 3.0, 31)
LEVEL_FACTORS = (1.0, 1.5)
#: Above so many states the higher level, which makes gains up to a quarter smaller, would cost up to half of the time;
#: and one weight in so many is enough.
MOST_STATES_FOR_LEVELS = 200
COARSE_WEIGHTS = 4
WEIGHT_STEPS = 4
#: A disturbance that does less than this share of what it does to the starting filter is decoupled; the levels at which
#: such a filter is looked for in turn, relative to the same; a point without meaning; and the share of rows xi that
#: counts as nothing.
DECOUPLED_GAIN = 1e-7
#: Pairs of level and artificial noise: what this noise costs goes with its square, but many states need some.
DECOUPLING_ATTEMPTS = ((1e-4, 1e-6), (1e-2, 1e-6), (1e-4, 1e-8), (1e-2, 1e-8))
#: The same share where states are many: no gain that is shipped is smaller than ten times that.
COARSELY_DECOUPLED = 1e-4
GENERIC_POINT = 1.3247
#: Points so far out that a combination which waits for samples, or takes the last ones alone, is told by its growth.
FAR_POINTS, MOST_GROWTH, LEAST_DECAY = (1e2, 1e3), 3.0, 0.3
SAME_ROWS = 1e-8
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
    start_is_good: bool = False,
) -> tuple[Injection, float]:
    """Return the best central filter found, and (a bound on) its true gain.

    The least level with little noise first; other noises, cheaper or less sensitive, where they reach one below.
    """
    tolerance = LEVEL_TOLERANCE if problem.order <= FEW_STATES else COARSE_LEVEL_TOLERANCE
    best, gain = start, problem.achieved_gain(start) if gain is None else gain
    low, most_noise = least_level(problem), np.inf
    if low <= DECOUPLED_GAIN * gain and (decoupled := _decoupling_filter(problem, gain)) is not None:
        return decoupled
    for noise in NOISES if problem.order <= FEW_STATES else COARSE_NOISES:
        if gain <= low * (1.0 + 2.0 * tolerance):
            break
        if noise > most_noise:
            continue
        close = start_is_good or best is not start
        equation = CentralEquation.of(problem, noise=noise)
        descent = GammaIteration(equation, low, gain, tolerance, wary=close)
        share = START_SHARE if problem.order <= FEW_STATES else COARSE_START_SHARE
        descent.run(max(low, gain * (1.0 - PROBE * tolerance if close else share)))
        found = descent.best()
        if found is None and descent.reached and descent.reached[0].level < gain * (1.0 - NEXT_TO):
            descent = descent.judged_again(gain)
            found = descent.best()
        if found is None:
            continue
        injection, reached = found
        if descent.settled and reached <= descent.high * (1.0 + PROBE * tolerance):
            most_noise = noise  # more of it cannot cost less
        if reached < gain:
            best, gain = injection, reached
    return best, gain


def _decoupling_filter(problem: GainProblem, gain: float) -> tuple[Injection, float] | None:
    """Return a filter that no disturbance reaches, and its gain; ``None`` where there is none."""
    if not _follows_from_measurements(problem):
        return None
    # The artificial noise has a gain of its own, which in many states may be above the first level; next to a zero on
    # the unit circle only little of it leaves the equation a solution.
    best = None
    for share, noise in DECOUPLING_ATTEMPTS:
        found = central_injection(problem, share * gain, noise=noise)
        if found is None:
            continue
        reached = problem.achieved_gain(found)
        if reached <= DECOUPLED_GAIN * gain:
            return found, reached
        best = (found, reached) if best is None or reached < best[1] else best
    coarsely = best is not None and problem.order > FEW_STATES and best[1] <= COARSELY_DECOUPLED * gain
    return best if coarsely else None


def _follows_from_measurements(problem: GainProblem) -> bool:
    """Whether the rows of xi are combinations of those of state and measurements, without samples yet to come."""
    if _combined(problem, GENERIC_POINT)[1] > SAME_ROWS:
        return False
    # A sample yet to come is a factor of z, and where no weight is free past ones alone are left: a factor of 1 / z.
    near, far = (_combined(problem, point * max(1.0, spectral_radius(problem.A)))[0] for point in FAR_POINTS)
    return far <= (MOST_GROWTH if problem.weight_is_free else LEAST_DECAY) * near


def _combined(problem: GainProblem, point: float) -> tuple[float, float]:
    """Return the size of the combination at a point of the z-plane, and what it leaves, as a share of xi."""
    from scipy.linalg import lstsq

    shifted = problem.A - point * np.eye(problem.order)
    known = np.vstack([np.hstack([shifted, problem.B]), np.hstack([problem.C, problem.D])])
    wanted = np.hstack([problem.Z, problem.Zd])
    solved = lstsq(known.T, wanted.T, lapack_driver="gelsy", check_finite=False)[0]
    left = float(np.linalg.norm(known.T @ solved - wanted.T))
    return float(np.linalg.norm(solved)), left / max(float(np.linalg.norm(wanted)), SMALLEST)


def least_level(problem: GainProblem) -> float:
    """Return what a disturbance does to xi before any measurement can help: no gain is below."""
    if problem.weight_is_free:
        return 0.0
    direct = problem.Zd if np.any(problem.D) else np.hstack([problem.Zd, problem.Z @ problem.B])
    return float(np.linalg.norm(direct, 2)) if direct.size else 0.0


def least_noise_filter(problem: GainProblem) -> Injection | None:
    """Return the filter with the least variance of xi under the noise of the problem: a level without limit."""
    noise = with_least_weight(problem).noise_as_disturbance()
    if noise.order == 0 or noise.measured == 0:
        return None
    found = central_injection(noise, WITHOUT_LIMIT * max(noise.disturbance_size, 1.0), noise=NOISES[0])
    return found if found is not None and np.isfinite(problem.noise_variance(found)) else None


def noise_weighted_filters(
    problem: GainProblem, gain: float, *, reaches: Callable[[Injection], bool]
) -> Iterator[Injection]:
    """Yield central filters that promise a gain of at most ``gain``, for which the noise counts as much as it can.

    The noise, times a weight, is one more disturbance; at a level above ``gain`` the true gain finds the weight.
    """
    work = with_least_weight(problem)
    sizes = [float(np.linalg.norm(np.vstack(pair))) for pair in ((work.B, work.D), (work.Bn, work.Dn))]
    if work.order == 0 or work.measured == 0 or not min(sizes) > 0.0:
        return
    weights, last = NOISE_WEIGHTS * sizes[0] / sizes[1], 0
    weights = weights if work.order <= MOST_STATES_FOR_LEVELS else weights[::COARSE_WEIGHTS]
    for factor in LEVEL_FACTORS if work.order <= MOST_STATES_FOR_LEVELS else LEVEL_FACTORS[:1]:
        # More weight than at a lower level, and not more than can be hoped for.
        low, high = last, len(weights) if factor == 1.0 else min(last + WEIGHT_STEPS, len(weights))
        best = None
        while low < high:
            middle = (low + high) // 2
            found = central_injection(_with_noise(work, weights[middle]), factor * gain, noise=NOISES[0])
            if found is not None and (factor == 1.0 or reaches(found)):
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
