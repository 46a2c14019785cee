r"""Central H-infinity filters: the gain of a `GainProblem` by Riccati equations, without matrix inequalities.

For a level g the filtering equation, with :math:`h = [C; Z]`, :math:`k = [D; Z_d]`,

.. math::
    Y = A Y A^T - (A Y h^T + B k^T)(k k^T - \mathrm{diag}(0, g^2 I) + h Y h^T)^{-1}(\cdot)^T + B B^T,

has a stabilising solution with the right signs exactly when a filter of gain below g exists, and then gives one.  A
little artificial noise on states and measurements makes the equation regular; it can only raise the gain, and the true
gain of the true problem decides whether a level counts as reached.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from obsynth.numerics.arrays import FloatArray
from obsynth.synthesis.gain_problem import MOST_STATES_FOR_NORMS, GainProblem, Injection
from obsynth.synthesis.riccati import doubled_riccati_solution

#: Artificial noise relative to the disturbance, in turn: the more of it, the better the equation is conditioned.
NOISE_LADDER = (1e-1, 1e-2, 1e-3, 1e-4, 1e-5, 1e-6)
#: Relative width of the bracket at which the bisection of one rung ends.
LEVEL_TOLERANCE = 1e-8
MOST_LEVELS = 60
#: How much longer each stride downwards is than the one before.
STRIDE_GROWTH = 8.0
#: Weights of the noise beside the disturbance, relative to their sizes, and levels of both together, relative to the
#: gain of the disturbance alone.
NOISE_WEIGHTS = np.logspace(-6.0, 3.0, 55)
LEVEL_FACTORS = (1.0, 1.2, 1.5, 2.5, 5.0)
#: A level this far above anything a disturbance could do is no limit.
WITHOUT_LIMIT = 1e4
#: A level counts as reached when the true gain is below it up to the tolerance of the norm.
NORM_ALLOWANCE = 1e-8


def central_injection(problem: GainProblem, level: float, *, noise: float) -> Injection | None:
    """Return the gains of the central filter at ``level``, or ``None`` when the equation gives none.

    Parameters
    ----------
    problem : GainProblem
        With measurements; a limit on the weight is not looked at.
    level : float
        Gain level, positive.
    noise : float
        Artificial noise relative to the disturbance.
    """
    n, m, q = problem.order, problem.measured, problem.Z.shape[0]
    size = float(np.linalg.norm(problem.B, 2))
    through = max(float(np.linalg.norm(problem.D, 2)), float(np.linalg.norm(problem.C, 2)) * size)
    h, k = np.vstack([problem.C, problem.Z]), np.vstack([problem.D, problem.Zd])
    process = problem.B @ problem.B.T + (noise * size) ** 2 * np.eye(n)
    weight = k @ k.T + np.diag([(noise * through) ** 2] * m + [-(level**2)] * q)
    cross = problem.B @ k.T
    try:
        y = doubled_riccati_solution(problem.A, h, process, weight, cross)
        if y is None:
            return None
        found = _gains(problem, weight + h @ y @ h.T, problem.A @ y @ h.T + cross)
    except np.linalg.LinAlgError:
        return None
    return found if np.all(np.isfinite(found.R)) and np.all(np.isfinite(found.V)) else None


def _gains(problem: GainProblem, total: FloatArray, through: FloatArray) -> Injection:
    m, q = problem.measured, problem.Z.shape[0]
    if problem.weight_is_free:
        # The estimate may use the measurement of the same sample.
        solved = np.linalg.solve(total[:m, :m], np.vstack([through[:, :m], total[m:, :m]]).T).T
        return Injection(np.asarray(solved[: problem.order]), np.asarray(-solved[problem.order :]))
    change = np.linalg.solve(total[m:, m:], total[m:, :m])
    reduced = total[:m, :m] - total[:m, m:] @ change
    gain = np.linalg.solve(reduced.T, (through[:, :m] - through[:, m:] @ change).T).T
    return Injection(np.asarray(gain), np.zeros((q, m)))


def central_filter_at(problem: GainProblem, level: float) -> Injection | None:
    """Return a filter whose true gain is below ``level``, from the first rung of noise that gives one, or ``None``."""
    if problem.order == 0 or problem.measured == 0:
        return None
    work = with_least_weight(problem)
    for noise in NOISE_LADDER:
        found = central_injection(work, level, noise=noise)
        if found is not None and problem.reaches(found, level):
            return found
    return None


def with_least_weight(problem: GainProblem) -> GainProblem:
    """Return the problem with V = 0 where the weight has a limit: the least weight there is meets every limit."""
    return problem if problem.weight_limit is None else replace(problem, free_weight=False, weight_limit=None)


def search_central_filter(problem: GainProblem, start: Injection) -> tuple[Injection, float]:
    """Return the best central filter found, one rung of noise after the other, and (a bound on) its true gain.

    Each rung starts from the best gain so far, steps down from it in strides that grow, and bisects the last stride.

    Parameters
    ----------
    problem : GainProblem
        With measurements and a disturbance.
    start : Injection
        A stable filter: what is returned is at least as good.
    """
    best, gain = start, problem.achieved_gain(start)
    for noise in NOISE_LADDER:
        low, high, stride = 0.0, gain, LEVEL_TOLERANCE
        for _ in range(MOST_LEVELS):
            if high - low <= LEVEL_TOLERANCE * high:
                break
            level = max(0.5 * (low + high), high * (1.0 - stride))
            found = central_injection(problem, level, noise=noise)
            reached = np.inf if found is None else _gain_of(problem, found, level)
            if found is not None and reached < gain:
                best, gain = found, reached
            if reached <= level * (1.0 + NORM_ALLOWANCE):
                high, stride = min(level, reached), min(STRIDE_GROWTH * stride, 1.0)
            else:
                low = level
            high = min(high, gain) if gain > low else high
    return best, gain


def _gain_of(problem: GainProblem, found: Injection, level: float) -> float:
    """Return the true gain, or for many states just the level when it is reached."""
    if problem.order <= MOST_STATES_FOR_NORMS:
        return problem.achieved_gain(found)
    return level if problem.reaches(found, level * (1.0 + NORM_ALLOWANCE)) else np.inf


def least_noise_filter(problem: GainProblem) -> Injection | None:
    """Return the filter with the least variance of xi under the noise of the problem: a level without limit."""
    noise = replace(with_least_weight(problem), B=problem.Bn, D=problem.Dn, Zd=problem.Zn)
    if noise.order == 0 or noise.measured == 0:
        return None
    found = central_injection(noise, WITHOUT_LIMIT * max(noise.disturbance_size, 1.0), noise=NOISE_LADDER[-1])
    return found if found is not None and np.isfinite(problem.noise_variance(found)) else None


def noise_weighted_filters(problem: GainProblem, gain: float) -> Iterator[Injection]:
    """Yield central filters of true gain at most ``gain`` for which the noise counts as much as it can.

    The noise of the problem, times a weight, is one more disturbance.  For some levels of both together the largest
    weight is searched with which the gain from the true disturbance alone stays within ``gain``.

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
    for factor in LEVEL_FACTORS:
        low, high = 0, len(NOISE_WEIGHTS)
        best = None
        while low < high:
            middle = (low + high) // 2
            both = _with_noise(work, NOISE_WEIGHTS[middle] * sizes[0] / sizes[1])
            found = central_injection(both, factor * gain, noise=NOISE_LADDER[-1])
            if found is not None and problem.reaches(found, gain):
                best, low = found, middle + 1
            else:
                high = middle
        if best is not None:
            yield best


def _with_noise(problem: GainProblem, weight: float) -> GainProblem:
    """Return the problem with its noise, times a weight, as further disturbances."""
    return replace(
        problem,
        B=np.hstack([problem.B, weight * problem.Bn]),
        D=np.hstack([problem.D, weight * problem.Dn]),
        Zd=np.hstack([problem.Zd, weight * problem.Zn]),
    )
