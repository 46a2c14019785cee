"""The second stage of synthesis: small gains or little noise among all filters that reach a gain.

No number of a solver is believed: the true gain, the true variance and the spectral radius of the closed loop decide.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any

import numpy as np

from obsynth.analysis.existence.restricted_equivalent import PreparedPlant, with_sensor_faults_as_states
from obsynth.conditions import lazy_cvxpy as cp
from obsynth.conditions.lmi import solved
from obsynth.conditions.problem import Conditions
from obsynth.errors import SolverError
from obsynth.methods.fault_estimation_filter.convex_problem import GainParts
from obsynth.numerics.arrays import largest_singular_value
from obsynth.numerics.central_filter import (
    FEW_STATES,
    HIGHER_LEVEL_UP_TO,
    LeastGain,
    least_noise_filter,
    noise_weighted_filters,
    noise_weighted_filters_within,
    placed_filters,
)
from obsynth.numerics.injection_problem import GainProblem, Injection, WeightLimit
from obsynth.numerics.regions import disk
from obsynth.plants.descriptor import DescriptorSystem

#: The error shall decay at least this fast (spectral radius), or half as fast as that of the starting filter: the
#: smallest gains alone would leave an observable mode at the very edge of stability.
SLOWEST_DECAY = 0.999

#: Up to so many states the whole inequality competes although nothing needs it.
WHOLE_INEQUALITY_UP_TO = 12

#: Noise on the states, relative to that of the plant, for filters that shall decay faster; and how much more variance
#: than the least of such filters that may cost.
STATE_NOISE = (1e-4, 1e-3, 1e-2, 1e-1)

PRICE_OF_SPEED = 1.04

#: Halvings of the step towards the filter of least noise, for few, for many, and for still more states.
LINE_STEPS = 7

COARSE_LINE_STEPS = 3

COARSEST_LINE_STEPS = 2

POLISHING_UP_TO = 20


@dataclass(frozen=True, eq=False)
class Goal:
    """What a filter must meet (true gain, spectral radius ``slowest``), and what it shall cost little of."""

    problem: GainProblem
    gain: float
    slowest: float
    judged: dict[int, tuple[Injection, bool]] = field(default_factory=dict, repr=False)
    mixtures: dict[tuple[bytes, ...], Injection] = field(default_factory=dict, repr=False)

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
            problem, limit = self.problem, self.problem.weight_limit
            reached = not (limit is not None and limit.norm(injection.V) > limit.bound) and (
                problem.reaches(injection, self.gain) if problem.disturbances else problem.radius(injection) < 1.0
            )
            self.judged[id(injection)] = (injection, reached)
        return self.judged[id(injection)][1]

    def mixture(self, one: Injection, other: Injection, share: float) -> Injection:
        """Return the filter between two, the same object for the same gains, so that it is judged once."""
        gains = [(1.0 - share) * a + share * b for a, b in zip(one.parts, other.parts, strict=True)]
        return self.mixtures.setdefault(tuple(part.tobytes() for part in gains), Injection(*gains))

    def is_fast(self, injection: Injection) -> bool:
        """Return whether the filter decays fast enough."""
        return self.problem.radius(injection) <= self.slowest

    def met_fast(self, injection: Injection) -> bool:
        """Return both."""
        return self.is_fast(injection) and self.met(injection)

    def cost(self, injection: Injection) -> float:
        """Return the variance under the noise, or the size of the gains."""
        if self.noisy:
            return self.problem.noise_variance(injection)
        return float(np.linalg.norm(np.vstack([injection.R, injection.V])))


@dataclass(frozen=True, eq=False)
class PrintedInequality:
    """The paper's inequality (45) for a prepared plant, from `obsynth.conditions`, and its gains in balanced units."""

    plant: DescriptorSystem
    prepared: PreparedPlant
    parts: GainParts
    free_weight: bool
    solver: str

    @cached_property
    def conditions(self) -> Conditions:
        """The inequality, written in the coordinates of a Riccati filter."""
        from obsynth.conditions.wang import wang2015

        scaling = self.prepared.scaling
        states = scaling.states[:, None]
        return wang2015(
            self.plant,
            T=states * self.prepared.T * scaling.equations,
            N=states * self.prepared.N * scaling.outputs,
            W="free" if self.free_weight else self.parts.W0 * scaling.outputs,
            coordinates="balanced",
        )

    def least(self, problem: GainProblem, records: list[dict[str, Any]]) -> Injection | None:
        """Return the filter of the least gain of the inequality; ``None`` where the solver gives none."""
        return self._filter("least gain", self.conditions, problem.weight_limit, records)

    def small_gains(
        self, problem: GainProblem, level: float, records: list[dict[str, Any]], *, decay: float = 1.0
    ) -> Injection | None:
        """Return a filter of small gains, or of little noise, at a level; ``None`` where the solver gives none."""
        from obsynth.conditions.atoms import region
        from obsynth.conditions.wang import h2_terms, noise_paths

        inequality, added = self.conditions, dict[str, Any]()
        P, Y = inequality.variables["P"], inequality.variables["Y"]
        if problem.disturbances:
            added["gamma"] = inequality.variables["gamma_squared"] <= level**2
        if decay < 1.0:
            added["decay"] = region(inequality.data["A1"], P, disk(0.0, decay), Y=Y, Cy=inequality.data["C1"])[1]
        if self.plant.nw:
            work = with_sensor_faults_as_states(self.plant)
            driving, free = noise_paths(self.plant, inequality, work.Bw, work.Dw)
        else:
            # Unit noise on what no fault reaches alone: its variance is the size of the gains.
            free = self.parts.V / self.prepared.scaling.outputs[:, None]
            driving = np.zeros((len(inequality.data["T"]), free.shape[1]))
        _, added["variance"], Z = h2_terms(self.plant, inequality, driving, free)
        changed = inequality.changed(constraints=added, objective=cp.trace(Z))
        return self._filter("small gains", changed, problem.weight_limit, records)

    def _filter(
        self, purpose: str, inequality: Conditions, limit: WeightLimit | None, records: list[dict[str, Any]]
    ) -> Injection | None:
        if limit is not None and inequality.weight is not None:
            inequality = inequality.changed(constraints={"weight": cp.norm(inequality.weight, 2) <= limit.bound})
        try:
            records.append(solved(inequality.problem, purpose, self.solver))
            gains = inequality.gains()
        except SolverError as error:
            records.append({**error.record, "outcome": str(error)})
            return None
        scaling, parts = self.prepared.scaling, self.parts
        r = (gains["L"] / scaling.states[:, None] / scaling.outputs - parts.L0) @ parts.V
        if not self.free_weight:
            return Injection(r, np.zeros((len(parts.W0), parts.V.shape[1])))
        v = (gains["W"] / scaling.outputs - parts.W0) @ parts.V
        return Injection(r, v if limit is None else limit.within_bound(v))


def gains_by_inequality(goal: Goal, printed: PrintedInequality, records: list[dict[str, Any]]) -> list[Injection]:
    """Return what the inequality gives that meets the goal; with a decay imposed where that is too slow without."""
    injections: list[Injection] = []
    for decay in (1.0, goal.slowest):
        injection = printed.small_gains(goal.problem, goal.gain, records, decay=decay)
        injections += [injection] if injection is not None and goal.met(injection) else []
        if any(map(goal.is_fast, injections)):
            break
    return injections


def small_gain_design(
    problem: GainProblem, least: LeastGain, gain: float, *, printed: PrintedInequality, engine: str
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
        # The filter of least noise may decay slowly again: the rate that was gained is kept.
        quick = _towards(goal, fast[0], target, slowest=problem.radius(fast[0]))
        candidates.append(quick)
        central += fast
    else:
        if goal.noisy and not any(map(goal.is_fast, central)):
            central += [item for item in noise_weighted_filters_within(fresh, gain, reaches=goal.met) if goal.met(item)]
        central = [item for item in central if goal.is_fast(item)] or central
        candidates += [_towards(goal, min(central, key=goal.cost), target)] if central else []
    records.append({"what": "small gains", "solver": "central filter", "status": f"{len(central)} filters"})
    small = problem.order <= WHOLE_INEQUALITY_UP_TO
    takes_inequality = {
        "auto": small and not candidates,
        "riccati": False,
        "lmi": problem.order <= POLISHING_UP_TO or problem.weight_limit is not None or not candidates,
    }
    if takes_inequality[engine]:
        candidates += gains_by_inequality(goal, printed, records)
    if (takes_inequality[engine] or not candidates) and goal.met(least.injection):
        candidates.append(least.injection)
    if not candidates:
        raise SolverError(f"No filter with gain {gain:.6g} was found: the result is inconclusive.", record=records[-1])
    # An inaccurate solution may be far from the least noise: the true cost decides, not the solver.
    fast = [item for item in candidates if goal.met_fast(item)]
    cheapest = min(fast or candidates, key=goal.cost)
    if quick is not None and goal.cost(quick) <= PRICE_OF_SPEED * goal.cost(cheapest):
        cheapest = quick
    # Among many states what was moved towards the target once is not moved again: each judgement is an equation.
    moved = problem.order > HIGHER_LEVEL_UP_TO and len(candidates) == 1
    return (_towards(goal, cheapest, target) if goal.noisy and quick is None and not moved else cheapest), records


def _fast_filters(goal: Goal) -> list[Injection]:
    """Return fast filters that meet the goal, the fastest first, where those that weigh the noise alone are slow.

    Noise on every state makes a filter trust its measurements more; little more noise than the least may be paid.
    """
    problem = goal.problem
    size = largest_singular_value(np.vstack([problem.Bn, problem.Dn]))
    filters: list[Injection] = []
    near: int | None = None
    for share in STATE_NOISE:
        noisier = problem.with_state_noise(share * size)
        placed = [*placed_filters(noisier, goal.gain, reaches=goal.met, near=near)]
        filters += [item for _, item in placed if goal.met_fast(item)]
        # Among many states each weight is an equation: the next share's are found near those of this one.
        near = placed[0][0] if placed and problem.order > FEW_STATES else None
    least = min(map(goal.cost, filters), default=0.0)
    return sorted((item for item in filters if goal.cost(item) <= PRICE_OF_SPEED * least), key=problem.radius)


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
    many = COARSE_LINE_STEPS if goal.problem.order <= HIGHER_LEVEL_UP_TO else COARSEST_LINE_STEPS
    for _ in range(LINE_STEPS - (not goal.noisy) if few else many):
        tried = share + step
        mixed = goal.mixture(injection, target, tried)
        if tried <= 1.0 and judge(mixed) and (cost := goal.cost(mixed)) <= least:
            best, least, share = mixed, cost, tried
        step *= 0.5
    return best
