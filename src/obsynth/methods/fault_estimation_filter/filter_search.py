"""The search for the gains of a fault-estimation filter: the least gain, the one to ship, and small gains for it.

The least gain by bisection: the paper's Algorithm 1, made to end.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

from obsynth.errors import InfeasibleError, SolverError
from obsynth.methods.fault_estimation_filter import inequality_solutions
from obsynth.methods.fault_estimation_filter.central_filter import central_filter_at
from obsynth.methods.fault_estimation_filter.gamma_lower_bound import BOUND_MARGIN, proved_lower_bound
from obsynth.methods.fault_estimation_filter.inequality_search import SMALLEST_USEFUL_GAIN, LeastGain, search_least_gain
from obsynth.methods.fault_estimation_filter.injection_problem import GainProblem, Injection, WeightLimit, normalise
from obsynth.methods.fault_estimation_filter.method import FaultEstimationFilter
from obsynth.methods.fault_estimation_filter.small_gains import small_gain_design

#: The bracket ends at this share of the width asked for: the filter in hand is at its upper end.
BRACKET_SHARE = 0.1


def search_by_bisection(problem: GainProblem, *, tolerance: float, solver: str, polish: bool = True) -> LeastGain:
    """Minimise the gain by bisection: the paper's Algorithm 1, made to end.

    Every upper end of the bracket is the true norm of a filter in hand, the lower end a level at which none was found.
    """
    problem = replace(problem, judged_exactly=True)
    normalised = normalise(problem, solver=solver)
    gain = normalised.start_gain
    if problem.measured == 0 or gain == 0.0:
        return LeastGain(gain, normalised, normalised.start, gain, (gain, gain))
    work, best = normalised.problem, normalised.contracted(normalised.start)
    high, low, records = work.achieved_gain(best), 0.0, list[dict[str, Any]]()
    while high - low > BRACKET_SHARE * tolerance * high:
        middle = 0.5 * (low + high)
        better = central_filter_at(work, middle)
        if better is None and polish:
            found = inequality_solutions.feasible_point(work, middle, solver=solver)
            better = None if found is None else found.injection
            records += [] if found is None else [found.record]
        if better is None:
            low = middle
        else:
            best, high = better, min(middle, work.achieved_gain(better))
    injection, bracket = normalised.restore(best), (low * normalised.gain, high * normalised.gain)
    return LeastGain(problem.achieved_gain(injection), normalised, injection, gain, bracket, records)


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
MOST_STATES_TO_POLISH = 64


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
    problem: GainProblem, asked: FaultEstimationFilter, engine: str, *, noisy: bool, progress: Callable[[str], None]
) -> FoundGains:
    """Search the least gain, and small gains for a slightly larger one."""
    size = max(problem.disturbance_size, NOMINAL_GAIN)
    progress("searching the least gain")
    least = _least_gain(problem, asked, engine)
    unfelt = problem.disturbances and least.starting_gain <= ROUNDING_GAIN * problem.disturbance_size
    if unfelt and noisy and problem.weight_limit is None:
        # Against the noise, gains may take up measurements that feel the disturbance: it stays in the problem.
        least = replace(least, starting_gain=NOMINAL_GAIN * size)
    elif unfelt:
        # What is left of the disturbance in the estimates is rounding: nothing to minimise.
        problem = problem.without_disturbance()
        least = replace(_least_gain(problem, asked, engine), gain=least.starting_gain)
    elif engine == "auto" and asked.gamma is not None and _leaves_little(asked.gamma, least.gain, problem):
        progress("polishing the least gain")
        polished = _least_gain(problem, asked, "lmi")
        records = [*least.records, *polished.records]
        least = replace(min(least, polished, key=lambda found: found.gain), records=records)
    gamma = _gain_to_ship(asked, problem, least, noisy=noisy)
    progress("choosing small gains")
    inner = gamma - min(CERTIFICATE_SHARE * (gamma - least.gain), CERTIFICATE_MARGIN * gamma)
    chosen, records = small_gain_design(problem, least, inner, solver=asked.solver, engine=engine)
    return FoundGains(problem, least, gamma, chosen, records)


def found_within(
    problem: GainProblem,
    limited: GainProblem,
    asked: FaultEstimationFilter,
    *,
    noisy: bool,
    progress: Callable[[str], None],
) -> FoundGains:
    """Search gains with a limit on the weight, which Riccati equations do not cover."""
    if asked.engine == "auto" and limited.weight_limit is not None:
        # They do where the limit costs nothing: what is found without it keeps it.
        try:
            free = found_gains(problem, asked, "auto", noisy=noisy, progress=progress)
        except SolverError:
            free = None
        if free is not None and free.within(limited.weight_limit):
            return free
    engine = "lmi" if asked.engine == "auto" else asked.engine
    return found_gains(limited, asked, engine, noisy=noisy, progress=progress)


def _least_gain(problem: GainProblem, asked: FaultEstimationFilter, engine: str) -> LeastGain:
    polish = engine == "lmi"
    if asked.gamma_search == "direct":
        return search_least_gain(problem, solver=asked.solver, polish=polish)
    return search_by_bisection(problem, tolerance=asked.tolerance, solver=asked.solver, polish=polish)


def _leaves_little(gamma: float, least: float, problem: GainProblem) -> bool:
    """Whether a gamma leaves less room above the least gain found than the inequality may still find."""
    near = BELOW_LEAST * least <= gamma <= ABOVE_LEAST * least
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
