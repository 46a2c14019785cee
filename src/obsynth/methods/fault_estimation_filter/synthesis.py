"""Fault-estimation filter for discrete-time descriptor systems.

Source: Z. Wang, M. Rodrigues, D. Theilliol, Y. Shen, *Fault estimation filter design for discrete-time descriptor
systems*, IET Control Theory and Applications 9 (10), 2015: filter (23), gain structure (60), LMI (45).

Our deviations
    1. (48) has the sign of its second term wrong: L = TA Psi Upsilon^+ + P^-1 Y (I - Upsilon Upsilon^+), see (60).
    2. W = Upsilon^+ of (47), not Psi^+ as the proof says.
    3. Existence is decided before any solver, with the zero condition the paper never states.
    4. Only the part of Y that matters is a variable (Y = y V', V = null Upsilon'), or none at all (eliminated form).
    5. gamma^2 is minimised directly; Algorithm 1 never advances past one step, our bisection ends with a bracket.
    6. A second stage at a slightly larger gamma picks small gains: the bare optimum has condition numbers of 1e7.
    7. Feedthrough of inputs, faults, disturbances and noise, exactly (see `prepared_plant`).
    8. What is shipped corrects the state estimate, which the paper leaves biased by Psi.

The search for the gains of a fault-estimation filter: the least gain, the one to ship, and small gains for it.

The least gain by bisection: the paper's Algorithm 1, made to end.

The second stage: of all filters that reach a gain, one with small gains or little noise.

No number of a solver is believed: the true gain, the true variance and the spectral radius of the closed loop decide.

Small gains by the whole inequality, and what a filter must meet: true gain, variance and spectral radius decide.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property, partial
from typing import TYPE_CHECKING, Any

import numpy as np

from obsynth.analysis.existence.condition import require_all
from obsynth.analysis.existence.restricted_equivalent import PreparedPlant, prepare, with_sensor_faults_as_states
from obsynth.analysis.existence.wang2015 import examine_fault_filter
from obsynth.conditions import lazy_cvxpy as cp
from obsynth.conditions.gamma_lower_bound import BOUND_MARGIN, least_gain_certificate, proved_lower_bound
from obsynth.conditions.lmi import chosen_solver, solved
from obsynth.errors import InfeasibleError, SolverError
from obsynth.methods.fault_estimation_filter.certificate import bounded_real_certificate
from obsynth.methods.fault_estimation_filter.method import FaultEstimationFilter
from obsynth.methods.fault_estimation_filter.realisation import notes, realise_filter
from obsynth.methods.method import Synthesis
from obsynth.numerics.arrays import FloatArray, as_matrix, largest_singular_value
from obsynth.numerics.central_filter import (
    AT_THE_BOUND,
    FEW_STATES,
    MOST_STATES_FOR_LEVELS,
    LeastGain,
    least_level,
    least_noise_filter,
    noise_weighted_filters,
    noise_weighted_filters_within,
    search_by_bisection,
    search_least_gain,
)
from obsynth.numerics.injection_problem import GainProblem, Injection, WeightLimit, null_basis
from obsynth.numerics.regions import disk
from obsynth.observers.linear.derived import averaged
from obsynth.observers.linear.observer import LinearObserver
from obsynth.plants.descriptor import DescriptorSystem
from obsynth.results.design import Certificate

if TYPE_CHECKING:
    from obsynth.conditions.problem import Conditions


#: The error shall decay at least this fast (spectral radius), or half as fast as that of the starting filter: the
#: smallest gains alone would leave an observable mode at the very edge of stability.
SLOWEST_DECAY = 0.999

#: Up to so many states the whole inequality competes although nothing needs it.
MOST_STATES_FOR_WHOLE = 12

#: Noise on the states, relative to that of the plant, for filters that shall decay faster; and how much more variance
#: than the least of such filters that may cost.
STATE_NOISE = (1e-4, 1e-3, 1e-2, 1e-1)

PRICE_OF_SPEED = 1.04

#: Halvings of the step towards the filter of least noise, for few, for many, and for still more states.
LINE_STEPS = 7

COARSE_LINE_STEPS = 3

COARSEST_LINE_STEPS = 2


#: A shipped gain is never asked to be smaller than this fraction of the starting filter's.
SMALLEST_USEFUL_GAIN = 1e-3

#: Why the inequality was not asked.
NOTHING_TO_POLISH = "the lower bound is reached: the disturbance has this effect before any measurement can counter it"

#: Asking for a gain above this multiple of the starting filter's adds nothing but bad scaling.
LARGEST_USEFUL_GAIN = 1e3

#: The gains are designed for a slightly smaller gamma than claimed, so that the claim has a well-conditioned proof.
CERTIFICATE_MARGIN = 5e-3

CERTIFICATE_SHARE = 0.2

#: Gains below this, relative to the disturbance and the output it could reach, are rounding errors.
ROUNDING_GAIN = 1e-11

#: Level of the certificate, relative to the same, when no disturbance reaches the fault estimate at all.
NOMINAL_GAIN = 1e-3

#: A gamma between these multiples of the least gain found by the equations calls the inequality by default, up to so
#: many states: far below the least no polish helps, and far above none is needed.
BELOW_LEAST, ABOVE_LEAST = 0.95, 1.0 + 1e-4

MOST_STATES_TO_POLISH = 20


#: Fictitious noise on the measurements, relative to the given one, so that no direction of the gains is free of cost.
BACKGROUND_NOISE = 1e-3

#: Coordinates in which a certificate is looked for before the gain is judged again.
FIRST_TRIES = 4


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
            problem, limit = self.problem, self.problem.weight_limit
            reached = not (limit is not None and limit.norm(injection.V) > limit.bound) and (
                problem.reaches(injection, self.gain) if problem.disturbances else problem.radius(injection) < 1.0
            )
            self.judged[id(injection)] = (injection, reached)
        return self.judged[id(injection)][1]

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
    parts: _Parts
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

        found, added = self.conditions, dict[str, Any]()
        P, Y = found.variables["P"], found.variables["Y"]
        if problem.disturbances:
            added["gamma"] = found.variables["gamma_squared"] <= level**2
        if decay < 1.0:
            added["decay"] = region(found.data["A1"], P, disk(0.0, decay), Y=Y, Cy=found.data["C1"])[1]
        if problem.states_noise:
            work = with_sensor_faults_as_states(self.plant)
            entering, free = noise_paths(self.plant, found, work.Bw, work.Dw)
        else:
            # Unit noise on what no fault reaches alone: its variance is the size of the gains.
            free = self.parts.V / self.prepared.scaling.outputs[:, None]
            entering = np.zeros((len(found.data["T"]), free.shape[1]))
        _, added["variance"], Z = h2_terms(self.plant, found, entering, free)
        changed = found.changed(constraints=added, objective=cp.trace(Z))
        return self._filter("small gains", changed, problem.weight_limit, records)

    def _filter(
        self, what: str, found: Conditions, limit: WeightLimit | None, records: list[dict[str, Any]]
    ) -> Injection | None:
        if limit is not None and found.weight is not None:
            found = found.changed(constraints={"weight": cp.norm(found.weight, 2) <= limit.bound})
        try:
            records.append(solved(found.problem, what, self.solver))
            gains = found.gains()
        except SolverError as error:
            records.append({**error.record, "outcome": str(error)})
            return None
        scaling, parts = self.prepared.scaling, self.parts
        r = (gains["L"] / scaling.states[:, None] / scaling.outputs - parts.L0) @ parts.V
        if not self.free_weight:
            return Injection(r, np.zeros((len(parts.W0), parts.V.shape[1])))
        v = (gains["W"] / scaling.outputs - parts.W0) @ parts.V
        return Injection(r, v if limit is None else limit.kept(v))


def gains_by_inequality(goal: Goal, printed: PrintedInequality, records: list[dict[str, Any]]) -> list[Injection]:
    """Return what the inequality gives that meets the goal; with a decay imposed where that is too slow without."""
    found: list[Injection] = []
    for decay in (1.0, goal.slowest):
        injection = printed.small_gains(goal.problem, goal.gain, records, decay=decay)
        found += [injection] if injection is not None and goal.met(injection) else []
        if any(map(goal.is_fast, found)):
            break
    return found


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
    small = problem.order <= MOST_STATES_FOR_WHOLE
    wanted = {
        "auto": small and not candidates,
        "riccati": False,
        "lmi": problem.order <= MOST_STATES_TO_POLISH or problem.weight_limit is not None or not candidates,
    }
    if wanted[engine]:
        candidates += gains_by_inequality(goal, printed, records)
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
    size = largest_singular_value(np.vstack([problem.Bn, problem.Dn]))
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


@dataclass(frozen=True, eq=False)
class FoundGains:
    """The problem in the end, its least gain, the gain that is claimed, and the gains that are shipped."""

    problem: GainProblem
    least: LeastGain
    gamma: float
    chosen: Injection
    records: list[dict[str, Any]]

    def within(self, limit: WeightLimit) -> bool:
        """Whether the weights of both, the least gain and what is shipped, keep a limit."""
        return all(limit.norm(found.V) <= limit.bound for found in (self.least.injection, self.chosen))


def found_gains(
    problem: GainProblem,
    asked: FaultEstimationFilter,
    engine: str,
    *,
    printed: PrintedInequality,
    progress: Callable[[str], None],
) -> FoundGains:
    """Search the least gain, and small gains for a slightly larger one."""
    size = max(problem.disturbance_size, NOMINAL_GAIN)
    progress("searching for the least gain")
    noisy = printed.plant.nw > 0
    least = _least_gain(problem, asked)
    unfelt = problem.disturbances and least.starting_gain <= ROUNDING_GAIN * problem.disturbance_size
    if unfelt and noisy and problem.weight_limit is None:
        # Against the noise, gains may take up measurements that feel the disturbance: it stays in the problem.
        least = replace(least, starting_gain=NOMINAL_GAIN * size)
    elif unfelt:
        # What is left of the disturbance in the estimates is rounding: nothing to minimise.
        problem = replace(problem, B=problem.B[:, :0], D=problem.D[:, :0], Zd=problem.Zd[:, :0])
        least = replace(_least_gain(problem, asked), gain=least.starting_gain)
    elif engine == "lmi" or (engine == "auto" and _leaves_little(asked.gamma, least.gain, problem)):
        progress("refining the least gain")
        least = _polished(problem, least, printed)
    gamma = _gain_to_ship(asked, problem, least, noisy=noisy)
    progress("reducing the observer gains")
    inner = gamma - min(CERTIFICATE_SHARE * (gamma - least.gain), CERTIFICATE_MARGIN * gamma)
    chosen, records = small_gain_design(problem, least, inner, printed=printed, engine=engine)
    return FoundGains(problem, least, gamma, chosen, records)


def found_within(
    problem: GainProblem,
    limited: GainProblem | None,
    asked: FaultEstimationFilter,
    *,
    exactly: bool,
    printed: PrintedInequality,
    progress: Callable[[str], None],
) -> FoundGains:
    """Search gains; of a problem with a limit on the weight by the inequality, as Riccati equations do not cover it."""
    search = partial(found_gains, asked=asked, printed=printed, progress=progress)
    problem = replace(problem, judged_exactly=exactly)
    if limited is None:
        return search(problem, engine=asked.engine)
    limited = replace(limited, judged_exactly=exactly)
    if asked.engine == "auto" and limited.weight_limit is not None:
        # They do where the limit costs nothing: what is found without it keeps it.
        try:
            free = search(problem, engine="auto")
        except SolverError:
            free = None
        if free is not None and free.within(limited.weight_limit):
            return free
    return search(limited, engine="lmi" if asked.engine == "auto" else asked.engine)


def _least_gain(problem: GainProblem, asked: FaultEstimationFilter) -> LeastGain:
    if asked.gamma_search == "direct":
        return search_least_gain(problem)
    return search_by_bisection(problem, tolerance=asked.tolerance)


def _polished(problem: GainProblem, least: LeastGain, printed: PrintedInequality) -> LeastGain:
    """Return the filter of the inequality's least gain where its true gain is less."""
    records = list(least.records)
    if problem.measured == 0 or problem.disturbances == 0:
        return least
    if least.gain <= least_level(problem) * (1.0 + AT_THE_BOUND):
        told = {"what": "least gain", "solver": "lower bound", "status": NOTHING_TO_POLISH, "gain": least.gain}
        return replace(least, records=[*records, told])
    injection = printed.least(problem, records)
    gain = np.inf if injection is None else replace(problem, judged_exactly=True).achieved_gain(injection)
    if injection is None or not gain < least.gain:
        return replace(least, records=records)
    bracket = (min(least.bracket[0], gain), min(least.bracket[1], gain))
    return replace(least, gain=gain, injection=injection, bracket=bracket, records=records)


def _leaves_little(gamma: float | None, least: float, problem: GainProblem) -> bool:
    """Whether a gamma leaves less room above the least gain found than the inequality may still find."""
    near = gamma is not None and BELOW_LEAST * least <= gamma <= ABOVE_LEAST * least
    return near and problem.disturbances > 0 and problem.order <= MOST_STATES_TO_POLISH


def _gain_to_ship(asked: FaultEstimationFilter, problem: GainProblem, least: LeastGain, *, noisy: bool) -> float:
    floor = SMALLEST_USEFUL_GAIN * least.starting_gain
    if problem.disturbances == 0:
        return NOMINAL_GAIN
    if asked.gamma is None and noisy:
        # Where noise is stated, the least gain may cost any amount of it (a decoupled disturbance).  The Kalman filter
        # that takes the disturbance as unit white noise is a fair compromise, and its gain is known to be reachable.
        return max((1.0 + asked.gamma_margin) * least.gain, least.starting_gain)
    if asked.gamma is None:
        return max((1.0 + asked.gamma_margin) * least.gain, floor)
    _require_reachable(problem, least, asked.gamma, solver=asked.solver)
    ceiling = LARGEST_USEFUL_GAIN * least.starting_gain
    return min(asked.gamma, ceiling) if ceiling > 0.0 else asked.gamma


def _require_reachable(problem: GainProblem, least: LeastGain, gain: float, *, solver: str) -> None:
    """Raise unless ``gain`` is within reach of the best filter found."""
    best = least.gain
    if problem.disturbances == 0 or best <= gain:
        return
    # Without free measurements there is one filter, and its norm is attained at a frequency.
    bound = best * (1.0 - BOUND_MARGIN)
    if problem.measured:
        bound = proved_lower_bound(problem, solver=solver, best=least.injection, enough=gain)
    choice = "for this T and N" if problem.free_weight else "for this T, N and W"
    if bound > gain:
        remedy = "" if problem.free_weight else ", or set free_residual_weight: true"
        raise InfeasibleError(
            f"No filter reaches gamma = {gain:.6g} {choice}: a checked certificate proves gamma >= {bound:.6g}, and "
            f"the best filter found has {best:.6g}. Ask for a larger gamma, leave it out for the least{remedy}.",
            necessary=False,
            lower_bound=bound,
        )
    raise SolverError(
        f"gamma = {gain:.6g} was not reached (best found {best:.6g}), and the proved lower bound {bound:.6g} does not "
        f"rule it out: the result is inconclusive {choice}. Ask for a slightly larger gamma."
    )


def synthesise(plant: DescriptorSystem, asked: FaultEstimationFilter, *, progress: Callable[[str], None]) -> Synthesis:
    """Design the filter; see `obsynth.fault_estimation_filter` for the options, results and errors."""
    solver = chosen_solver(asked.solver, asked.solver_options)
    if asked.own_inequality:
        from obsynth.methods.engines.own_terms import filter_by_inequality

        return filter_by_inequality(plant, asked, progress=progress)
    asked = replace(asked, solver=solver)
    progress("checking the existence conditions")
    held, prepared = examine_fault_filter(plant)
    require_all(held)
    s = None if asked.S is None else as_matrix(asked.S, "S")
    prepared = prepare(plant, s) if prepared is None or s is not None else prepared
    limit = asked.residual_weight_limit
    free = asked.free_residual_weight if asked.free_residual_weight is not None else plant.nw > 0 or limit is not None
    problem, parts = gain_problem(prepared, free_weight=free)
    # Where nothing disturbs the estimates, a small share of what disturbances could do is proved.
    nominal = NOMINAL_GAIN * max(problem.disturbance_size, NOMINAL_GAIN)
    if s is not None or limit is not None:
        # With the paper's S the weight is its W = Upsilon^+ too, which is that of the outputs as given.
        problem, parts = centred(problem, prepared, parts)
    limited = None if limit is None else with_weight_limit(problem, prepared, parts, limit)
    printed = PrintedInequality(plant, prepared, parts, free, asked.solver)
    search = partial(found_within, problem, limited, asked, printed=printed, progress=progress)
    found = search(exactly=False)
    progress("building the realisation and its certificate")
    level = found.gamma if found.problem.disturbances else nominal
    gains, realised, factor, proved = _shipped(plant, prepared, parts, found, level, tries=FIRST_TRIES)
    if not proved:
        if not replace(found.problem, judged_exactly=True).reaches(found.chosen, level):
            found = search(exactly=True)  # a peak was missed
            level = found.gamma if found.problem.disturbances else nominal
        gains, realised, factor, _ = _shipped(plant, prepared, parts, found, level, tries=None)
    observer, tracking, lag = realised
    claims, witnesses = {"state_lag": float(lag)}, {"P_factor": factor, "tracking": tracking}
    if plant.nd:
        progress("proving that no filter has a smaller gain")
        least, proof = _least(found, prepared, asked, gains, factor, level=level, free_weight=free)
        claims = {"gamma": level, "gamma_min": least["gamma_min"]} | claims | least
        witnesses |= proof
    records = [*found.least.records, *found.records]
    resolved = asked.as_plain() | {"free_residual_weight": free, "S": None if s is None else s.tolist()}
    if asked.mean > 1:
        # Registers hold estimates, which see no state: nothing of the plant is tracked there.
        zeros = np.zeros(((asked.mean - 1) * plant.nf, tracking.shape[1]))
        witnesses["tracking"] = np.vstack([tracking, zeros])
        observer = averaged(observer, asked.mean)
    told = []
    if plant.nd and asked.gamma is not None and level < asked.gamma:
        told.append(
            f"gamma = {asked.gamma:.6g} was asked for, and {level:.6g} is proved: a larger gamma would only make the "
            "gains worse conditioned."
        )
    return Synthesis(
        resolved,
        gains,
        observer,
        Certificate(witnesses, claims),
        {"engine": "lmi" if any("settings" in record for record in records) else "riccati", "runs": records},
        (*told, *notes(plant, prepared.detectability, observer, largest_zero=held[-1].value)),
    )


def _least(
    found: FoundGains,
    prepared: PreparedPlant,
    asked: FaultEstimationFilter,
    gains: Mapping[str, FloatArray],
    factor: FloatArray,
    *,
    level: float,
    free_weight: bool,
) -> tuple[dict[str, float], dict[str, FloatArray]]:
    """Return what is claimed of the least gain of any filter, and the witnesses."""
    least = found.least
    proof, proved = least_gain_certificate(
        found.problem,
        prepared.plant,
        gains,
        factor,
        gain=least.gain,
        free_weight=free_weight,
        solver=asked.solver,
        thorough=asked.prove_least,
    )
    # The search may end below what is proved, by its tolerance: no filter is there.
    claims = {"gamma_min": min(max(least.gain, proved), level)}
    if asked.gamma_search == "bisection":
        low, high = least.bracket
        claims |= {"gamma_bracket_low": low, "gamma_bracket_high": max(high, claims["gamma_min"])}
    return claims, proof


def _shipped(
    plant: DescriptorSystem,
    prepared: PreparedPlant,
    parts: _Parts,
    found: FoundGains,
    level: float,
    *,
    tries: int | None,
) -> tuple[dict[str, FloatArray], tuple[LinearObserver, FloatArray, int], FloatArray, bool]:
    """Return gains, their realisation, the certificate of the level that is claimed, and whether it proves that."""
    gains = _gains(prepared, parts, found.chosen)
    observer, tracking, lag = realise_filter(plant, prepared.plant, gains, prepared.detectability)
    proof = bounded_real_certificate(plant, observer, tracking, level, core=prepared.plant.nx, lag=lag, tries=tries)
    return gains, (observer, tracking, lag), *proof


@dataclass(frozen=True, eq=False)
class _Parts:
    """Fixed parts of the gains in balanced coordinates: L = L0 + R V', W = W0 + Vw V'."""

    L0: FloatArray
    W0: FloatArray
    V: FloatArray


def gain_problem(prepared: PreparedPlant, *, free_weight: bool) -> tuple[GainProblem, _Parts]:
    """Return the convex problem behind Theorem 2, with (32) solved exactly, and the fixed parts of the gains."""
    detectability = prepared.detectability
    upsilon = detectability.Upsilon
    w0, v = _left_inverse(upsilon), null_basis(upsilon.T)
    l0 = prepared.TA @ detectability.Psi @ w0
    measure, na = v.T, prepared.TA.shape[0]
    if prepared.Bw.shape[1]:
        size = BACKGROUND_NOISE * max(
            float(np.linalg.norm(measure @ prepared.Dw)),
            # In units of the outputs: W may be large.
            float(np.linalg.norm(w0 @ prepared.Dw) / np.linalg.norm(w0)),
        )
        background = size if size > 0.0 else BACKGROUND_NOISE
        bn = np.hstack([prepared.Bw - l0 @ prepared.Dw, np.zeros((na, v.shape[1]))])
        dn = np.hstack([measure @ prepared.Dw, -background * np.eye(v.shape[1])])
        zn = np.hstack([w0 @ prepared.Dw, np.zeros((w0.shape[0], v.shape[1]))])
    else:
        # Unit noise on the free measurements: the variance is then the size of R (and V) itself.
        bn, dn, zn = np.zeros((na, v.shape[1])), -np.eye(v.shape[1]), np.zeros((w0.shape[0], v.shape[1]))
    problem = GainProblem(
        A=prepared.TA - l0 @ prepared.C,
        C=measure @ prepared.C,
        Z=w0 @ prepared.C,
        B=prepared.Bd - l0 @ prepared.Dd,
        D=measure @ prepared.Dd,
        Zd=w0 @ prepared.Dd,
        Bn=bn,
        Dn=dn,
        Zn=zn,
        free_weight=free_weight,
    )
    return problem, _Parts(l0, w0, v)


def _left_inverse(upsilon: FloatArray) -> FloatArray:
    """Return the left inverse of least norm of a matrix of full column rank, whatever the units of the faults."""
    units = np.exp2(np.round(np.log2(np.linalg.norm(upsilon, axis=0))))
    return np.asarray(np.linalg.pinv(upsilon / units) / units[:, None])


def _gains(prepared: PreparedPlant, parts: _Parts, chosen: Injection) -> dict[str, FloatArray]:
    """Return the gains in the user's coordinates; the factors are powers of two, so this is exact."""
    states, equations, outputs = (
        prepared.scaling.states[:, None],
        prepared.scaling.equations,
        prepared.scaling.outputs,
    )
    free = chosen.R @ parts.V.T
    return {
        "T": states * prepared.T * equations,
        "N": states * prepared.N * outputs,
        "L": states * (parts.L0 + free) * outputs,
        "W": (parts.W0 + chosen.V @ parts.V.T) * outputs,
        "Psi": states * prepared.detectability.Psi,
        "Upsilon": prepared.detectability.Upsilon / outputs[:, None],
        "R": states * free * outputs,
    }


def centred(problem: GainProblem, prepared: PreparedPlant, parts: _Parts) -> tuple[GainProblem, _Parts]:
    """Return the problem written so that V = 0 is the W of least norm in the user's output units, not balanced ones."""
    outputs = prepared.scaling.outputs
    w0 = _left_inverse(prepared.detectability.Upsilon / outputs[:, None]) / outputs
    v = (w0 - parts.W0) @ parts.V
    moved = replace(problem, Z=problem.Z + v @ problem.C, Zd=problem.Zd + v @ problem.D, Zn=problem.Zn + v @ problem.Dn)
    return moved, replace(parts, W0=w0)


def with_weight_limit(problem: GainProblem, prepared: PreparedPlant, parts: _Parts, bound: float) -> GainProblem:
    """Return the problem with the norm of W bounded, in the user's output units."""
    outputs = prepared.scaling.outputs
    smallest = 1.0 / float(np.linalg.svd(prepared.detectability.Upsilon / outputs[:, None], compute_uv=False)[-1])
    if smallest >= bound:
        raise InfeasibleError(
            f"No residual weight W with W Upsilon = I has a norm of {bound:.6g} or less: the least is {smallest:.6g}. "
            "Raise residual_weight_limit.",
            necessary=True,
            lower_bound=smallest,
        )
    return replace(problem, weight_limit=WeightLimit(parts.W0 * outputs, parts.V.T * outputs, bound))
