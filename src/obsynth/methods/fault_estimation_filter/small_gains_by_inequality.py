"""Small gains by the whole inequality, and what a filter must meet: true gain, variance and spectral radius decide."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from obsynth.errors import SolverError
from obsynth.methods.fault_estimation_filter import inequality_solutions
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
