"""The second stage: of all filters that reach a gain, one with small gains or little noise.

No number of a solver is believed: the true gain, the true variance and the spectral radius of the closed loop decide.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from obsynth.errors import SolverError
from obsynth.methods.fault_estimation_filter.central_filter import (
    FEW_STATES,
    MOST_STATES_FOR_LEVELS,
    least_noise_filter,
    noise_weighted_filters,
)
from obsynth.methods.fault_estimation_filter.inequality_search import LeastGain
from obsynth.methods.fault_estimation_filter.injection_problem import GainProblem, Injection
from obsynth.methods.fault_estimation_filter.small_gains_by_inequality import Goal, gains_by_inequality

#: The error shall be forgotten at least this fast (spectral radius), or half as fast as the starting filter does: the
#: smallest gains alone would leave an observable mode at the very edge of stability.
SLOWEST_DECAY = 0.999
#: Up to so many states the whole inequality competes although nothing needs it.
MOST_STATES_FOR_WHOLE = 12
#: Noise on the states, relative to that of the plant, for filters that shall forget faster; and how much more variance
#: than the least of such filters that may cost.
STATE_NOISE = (1e-4, 1e-3, 1e-2, 1e-1)
PRICE_OF_SPEED = 1.04
#: Halvings of the step towards the filter of least noise, for few, for many, and for still more states.
LINE_STEPS = 7
COARSE_LINE_STEPS = 3
COARSEST_LINE_STEPS = 2


def small_gain_design(
    problem: GainProblem, least: LeastGain, gain: float, *, solver: str, engine: str
) -> tuple[Injection, list[dict[str, Any]]]:
    """Return gains of least size or noise whose true norm is at most ``gain``, and records of what was tried.

    Central filters that weigh the noise compete with the inequality; where both fail, the search's filter is left.
    """
    records: list[dict[str, Any]] = []
    if problem.measured == 0:
        return least.injection, records
    nothing = Injection(np.zeros_like(least.injection.R), np.zeros_like(least.injection.V))
    fresh = least.first
    goal = Goal(problem, gain, max(SLOWEST_DECAY, 0.5 + 0.5 * problem.radius(fresh.start)))
    if not goal.noisy and goal.met_fast(nothing):
        # Without a noise model the objective is the size of the gains themselves, and zero is least.
        return nothing, records
    candidates: list[Injection] = []
    target = least_noise_filter(problem) if goal.noisy else nothing
    central = [item for item in noise_weighted_filters(problem, gain, reaches=goal.met) if goal.met(item)]
    if fresh.start_gain <= gain and goal.met(fresh.start):
        central.append(fresh.start)
    fast = [] if not goal.noisy or any(map(goal.is_fast, central)) else _fast_filters(goal)
    quick = None
    if fast:
        # The filter of least noise may forget slowly again: what was bought is not given back.
        quick = _towards(goal, fast[0], target, slowest=problem.radius(fast[0]))
        candidates.append(quick)
        central += fast
    else:
        central = [item for item in central if goal.is_fast(item)] or central
        candidates += [_towards(goal, min(central, key=goal.cost), target)] if central else []
    records.append({"what": "small gains", "solver": "central filter", "status": f"{len(central)} filters"})
    small = problem.order <= MOST_STATES_FOR_WHOLE
    wanted = {
        "auto": small and not candidates,
        "riccati": False,
        "lmi": small or problem.weight_limit is not None or not candidates,
    }
    if wanted[engine]:
        # The eliminated inequality has no gains to make small: this takes the whole one.
        candidates += gains_by_inequality(goal, least, records, solver=solver)
    if (wanted[engine] or not candidates) and goal.met(least.injection):
        candidates.append(least.injection)
    if not candidates:
        raise SolverError(f"No filter with gain {gain:.6g} was found: the result is inconclusive.", record=records[-1])
    # An inaccurate solution may be far from the least noise: the true cost decides, not the solver.
    fast = [item for item in candidates if goal.met_fast(item)]
    found = min(fast or candidates, key=goal.cost)
    if quick is not None and goal.cost(quick) <= PRICE_OF_SPEED * goal.cost(found):
        found = quick
    # Among many states what was moved towards the target once is not moved again: each judgement is an equation.
    moved = problem.order > MOST_STATES_FOR_LEVELS and len(candidates) == 1
    return (_towards(goal, found, target) if goal.noisy and quick is None and not moved else found), records


def _fast_filters(goal: Goal) -> list[Injection]:
    """Return fast filters that meet the goal, the fastest first, where those that weigh the noise alone are slow.

    Noise on every state makes a filter trust its measurements more; little more noise than the least may be paid.
    """
    problem = goal.problem
    size = float(np.linalg.norm(np.vstack([problem.Bn, problem.Dn]), 2))
    found: list[Injection] = []
    for share in STATE_NOISE:
        noisier = problem.with_state_noise(share * size)
        found += [item for item in noise_weighted_filters(noisier, goal.gain, reaches=goal.met) if goal.met_fast(item)]
    least = min(map(goal.cost, found), default=0.0)
    return sorted((item for item in found if goal.cost(item) <= PRICE_OF_SPEED * least), key=problem.radius)


def _towards(goal: Goal, injection: Injection, target: Injection | None, *, slowest: float | None = None) -> Injection:
    """Go towards a cheaper filter as far as the true gain allows: one P for gain and noise leaves room."""
    if target is None:
        return injection
    goal = goal if slowest is None else replace(goal, slowest=slowest)
    best, least, share, step = injection, goal.cost(injection), 0.0, 1.0
    judge = goal.met_fast if goal.met_fast(injection) else goal.met
    few = goal.problem.order <= FEW_STATES
    if not goal.noisy:
        step = 0.5  # without noise the target is no filter of this gain
    many = COARSE_LINE_STEPS if goal.problem.order <= MOST_STATES_FOR_LEVELS else COARSEST_LINE_STEPS
    for _ in range(LINE_STEPS - (not goal.noisy) if few else many):
        tried = share + step
        mixed = Injection(*((1.0 - tried) * a + tried * b for a, b in zip(injection.parts, target.parts, strict=True)))
        if tried <= 1.0 and judge(mixed) and (cost := goal.cost(mixed)) <= least:
            best, least, share = mixed, cost, tried
        step *= 0.5
    return best
