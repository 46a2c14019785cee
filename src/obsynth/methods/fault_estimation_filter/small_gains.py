"""The second stage: of all filters that reach a gain, one with small gains or little noise.

No number of a solver is believed: the true gain, the true variance and the spectral radius of the closed loop decide.

Small gains by the whole inequality, and what a filter must meet: true gain, variance and spectral radius decide.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from obsynth.errors import SolverError
from obsynth.methods.fault_estimation_filter import inequality_solutions
from obsynth.methods.fault_estimation_filter.central_filter import (
    FEW_STATES,
    MOST_STATES_FOR_LEVELS,
    least_noise_filter,
    noise_weighted_filters,
)
from obsynth.methods.fault_estimation_filter.inequality_search import LeastGain
from obsynth.methods.fault_estimation_filter.injection_problem import (
    GainProblem,
    Injection,
    NormalisedProblem,
    normalise,
)


@dataclass(frozen=True, eq=False)
class Goal:
    """What a filter must meet (true gain, spectral radius ``slowest``), and what it shall cost little of."""

    problem: GainProblem
    gain: float
    slowest: float
    judged: dict[int, tuple[Injection, bool]] = field(default_factory=dict, repr=False)

    @property
    def noisy(self) -> bool:
        """Whether noise is the cost, or the size of the gains."""
        return self.problem.states_noise

    def at(self, gain: float) -> Goal:
        """Return the goal at another level."""
        return replace(self, gain=gain, judged={})

    def met(self, injection: Injection) -> bool:
        """Return whether the true gain is within the level, and the weight within its limit."""
        # A filter is asked for more than once, and for many states each answer takes a Riccati equation.
        if id(injection) not in self.judged:
            self.judged[id(injection)] = (injection, self._reached(injection))
        return self.judged[id(injection)][1]

    def _reached(self, injection: Injection) -> bool:
        problem, limit = self.problem, self.problem.weight_limit
        if limit is not None and limit.norm(injection.V) > limit.bound:
            return False
        return problem.reaches(injection, self.gain) if problem.disturbances else problem.radius(injection) < 1.0

    def is_fast(self, injection: Injection) -> bool:
        """Return whether the filter forgets fast enough."""
        return self.problem.radius(injection) <= self.slowest

    def met_fast(self, injection: Injection) -> bool:
        """Return both."""
        return self.is_fast(injection) and self.met(injection)

    def cost(self, injection: Injection) -> float:
        """Return the variance under the noise, or the size of the gains."""
        if self.noisy:
            return self.problem.noise_variance(injection)
        return float(np.linalg.norm(np.vstack([injection.R, injection.V])))


#: Descent in steps: ratios of successive levels, tried in turn, and how many steps at most.
STEP_RATIOS = (0.6, 0.9)
MOST_STEPS = 24
#: A step counts when its level is met to this relative accuracy.
LEVEL_ACCURACY = 1e-6
#: Further solutions of the inequality at most, and the ratio of costs below which another one is worth its time.
MOST_REPETITIONS = 2
WORTH_REPEATING = 0.95


def gains_by_inequality(goal: Goal, least: LeastGain, records: list[dict[str, Any]], *, solver: str) -> list[Injection]:
    """Return what the inequality gives, in different coordinates until one is good and fast enough.

    The bounds on P mean something else in other coordinates, and those of the least gain can be extreme.
    """
    problem, gain, fresh = goal.problem, goal.gain, least.first
    candidates: list[Injection] = []
    close = normalise(problem, solver=solver, start=least.injection, gain=least.gain)
    attempts = ((close, 1.0), (fresh, 1.0), (None, 1.0), (close, goal.slowest), (fresh, goal.slowest))
    for normalised, decay in attempts:
        if normalised is None:
            injection = _small_gains_step_by_step(goal, fresh, records, solver=solver)
        else:
            injection = _small_gains_in(problem, normalised, gain, records, solver=solver, decay=decay)
        if injection is not None and goal.met(injection):
            candidates.append(injection)
            if goal.met_fast(injection):
                candidates += _again(goal, injection, records, solver=solver, decay=decay)
                break
    if not candidates and problem.disturbances:
        centre = inequality_solutions.feasible_point(close.problem, gain / close.gain, solver=solver)
        candidates = [] if centre is None else [close.restore(centre.injection)]
    return [item for item in candidates if goal.met(item)]


def _again(
    goal: Goal, injection: Injection, records: list[dict[str, Any]], *, solver: str, decay: float
) -> list[Injection]:
    """Return what the inequality gives in the coordinates of its own answer, while that costs much less each time."""
    found: list[Injection] = []
    before, cost = np.inf, goal.cost(injection)
    for _ in range(MOST_REPETITIONS):
        if found and cost > WORTH_REPEATING * before:
            break
        normalised = normalise(goal.problem, solver=solver, start=injection)
        better = _small_gains_in(goal.problem, normalised, goal.gain, records, solver=solver, decay=decay)
        if better is None or not goal.met_fast(better):
            break
        found.append(better)
        injection, before, cost = better, cost, goal.cost(better)
    return found


def _small_gains_in(
    problem: GainProblem,
    normalised: NormalisedProblem,
    gain: float,
    records: list[dict[str, Any]],
    *,
    solver: str,
    decay: float = 1.0,
) -> Injection | None:
    try:
        work, level = _with_scaled_noise(normalised), gain / normalised.gain
        found = inequality_solutions.small_gains(work, level, solver=solver, decay=decay)
    except (SolverError, np.linalg.LinAlgError) as error:
        records.append(dict(getattr(error, "record", {})) | {"outcome": str(error)})
        return None
    records.append(found.record)
    return normalised.restore(found.injection)


def _small_gains_step_by_step(
    goal: Goal, normalised: NormalisedProblem, records: list[dict[str, Any]], *, solver: str
) -> Injection | None:
    """Go from the filter of ``normalised`` down to the goal, each filter giving the next coordinates.

    Far below the starting filter's gain its coordinates are too bad for one jump.
    """
    problem = goal.problem
    reached = problem.achieved_gain(normalised.start)
    for _ in range(MOST_STEPS):
        for ratio in STEP_RATIOS:
            level = max(goal.gain, ratio * reached)
            injection = _small_gains_in(problem, normalised, level, records, solver=solver)
            if injection is not None and goal.at(level * (1.0 + LEVEL_ACCURACY)).met(injection):
                break
        else:
            return None
        if goal.met(injection):
            return injection
        reached = problem.achieved_gain(injection)
        normalised = normalise(problem, solver=solver, start=injection)
    return None


def _with_scaled_noise(normalised: NormalisedProblem) -> GainProblem:
    """Return the problem with its noise scaled so that the objective is of size one."""
    work = normalised.problem
    r = normalised.contracted(normalised.start).R
    size = float(np.linalg.norm(np.vstack([work.Bn - r @ work.Dn, work.Zn])))
    size = size if size > 0.0 else max(float(np.linalg.norm(work.Dn)), 1.0)
    return replace(work, Bn=work.Bn / size, Dn=work.Dn / size, Zn=work.Zn / size)


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
