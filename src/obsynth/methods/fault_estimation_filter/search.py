"""Search for the gains of a fault-estimation filter: the least gain, a gain to ship, and small matrices for it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np

from obsynth.conditions.gamma_lower_bound import BOUND_MARGIN, proved_lower_bound
from obsynth.errors import InfeasibleError, SolverError
from obsynth.methods.fault_estimation_filter.method import FaultEstimationFilter
from obsynth.methods.fault_estimation_filter.small_gains import POLISHING_UP_TO, PrintedInequality, small_gain_design
from obsynth.numerics.central_filter import AT_THE_BOUND, LeastGain, least_level, search_by_bisection, search_least_gain
from obsynth.numerics.injection_problem import GainProblem, Injection, WeightLimit
from obsynth.numerics.outward import lower_text

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

#: A gamma between these multiples of the least gain found by the equations calls the inequality by default, up to so
#: many states: far below the least no polish helps, and far above none is needed.
BELOW_LEAST, ABOVE_LEAST = 0.95, 1.0 + 1e-4

#: Level of the certificate, relative to the same, when no disturbance reaches the fault estimate at all.
NOMINAL_GAIN = 1e-3


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
        return all(limit.norm(injection.V) <= limit.bound for injection in (self.least.injection, self.chosen))


def found_gains(
    problem: GainProblem,
    method: FaultEstimationFilter,
    engine: str,
    *,
    printed: PrintedInequality,
    progress: Callable[[str], None],
    known: LeastGain | None = None,
) -> FoundGains:
    """Search the least gain, where it is not known, and small gains for a slightly larger one."""
    size = max(problem.disturbance_size, NOMINAL_GAIN)
    progress("searching for the least gain")
    noisy = printed.plant.nw > 0
    least = _least_gain(problem, method) if known is None else known
    unfelt = problem.disturbances and least.starting_gain <= ROUNDING_GAIN * problem.disturbance_size
    if unfelt and noisy and problem.weight_limit is None:
        # Against the noise, gains may take up measurements that feel the disturbance: it stays in the problem.
        least = replace(least, starting_gain=NOMINAL_GAIN * size)
    elif unfelt:
        # What is left of the disturbance in the estimates is rounding: nothing to minimise.
        problem = replace(problem, B=problem.B[:, :0], D=problem.D[:, :0], Zd=problem.Zd[:, :0])
        least = replace(_least_gain(problem, method), gain=least.starting_gain)
    elif engine == "lmi" or (engine == "auto" and _leaves_little(method.gamma, least.gain, problem)):
        progress("refining the least gain")
        least = _polished(problem, least, printed)
    gamma = _gain_to_ship(method, problem, least, noisy=noisy)
    progress("reducing the observer gains")
    inner = gamma - min(CERTIFICATE_SHARE * (gamma - least.gain), CERTIFICATE_MARGIN * gamma)
    chosen, records = small_gain_design(problem, least, inner, printed=printed, engine=engine)
    return FoundGains(problem, least, gamma, chosen, records)


def found_within(
    problem: GainProblem,
    limited: GainProblem | None,
    method: FaultEstimationFilter,
    *,
    exactly: bool,
    printed: PrintedInequality,
    progress: Callable[[str], None],
    known: LeastGain | None = None,
) -> FoundGains:
    """Search gains; of a problem with a limit on the weight by the inequality, as Riccati equations do not cover it.

    ``known``: the least gain of the problem, not judged exactly, where it was searched before.
    """
    search = partial(found_gains, method=method, printed=printed, progress=progress)
    problem = replace(problem, judged_exactly=exactly)
    if limited is None:
        known = known if method.gamma_search == "direct" and not exactly else None
        return search(problem, engine=method.engine, known=known)
    limited = replace(limited, judged_exactly=exactly)
    if method.engine == "auto" and limited.weight_limit is not None:
        # They do where the limit costs nothing: what is found without it keeps it.
        try:
            free = search(problem, engine="auto")
        except SolverError:
            free = None
        if free is not None and free.within(limited.weight_limit):
            return free
    return search(limited, engine="lmi" if method.engine == "auto" else method.engine)


def _least_gain(problem: GainProblem, method: FaultEstimationFilter) -> LeastGain:
    if method.gamma_search == "direct":
        return search_least_gain(problem)
    return search_by_bisection(problem, tolerance=method.tolerance)


def _polished(problem: GainProblem, least: LeastGain, printed: PrintedInequality) -> LeastGain:
    """Return the filter of the inequality's least gain where its true gain is less."""
    records = list(least.records)
    if problem.measured == 0 or problem.disturbances == 0:
        return least
    if least.gain <= least_level(problem) * (1.0 + AT_THE_BOUND):
        record = {"what": "least gain", "solver": "lower bound", "status": NOTHING_TO_POLISH, "gain": least.gain}
        return replace(least, records=[*records, record])
    injection = printed.least(problem, records)
    gain = np.inf if injection is None else replace(problem, judged_exactly=True).achieved_gain(injection)
    if injection is None or not gain < least.gain:
        return replace(least, records=records)
    bracket = (min(least.bracket[0], gain), min(least.bracket[1], gain))
    return replace(least, gain=gain, injection=injection, bracket=bracket, records=records)


def _leaves_little(gamma: float | None, least: float, problem: GainProblem) -> bool:
    """Whether a gamma leaves less room above the least gain found than the inequality may still find."""
    near = gamma is not None and BELOW_LEAST * least <= gamma <= ABOVE_LEAST * least
    return near and problem.disturbances > 0 and problem.order <= POLISHING_UP_TO


def _gain_to_ship(method: FaultEstimationFilter, problem: GainProblem, least: LeastGain, *, noisy: bool) -> float:
    floor = SMALLEST_USEFUL_GAIN * least.starting_gain
    if problem.disturbances == 0:
        return NOMINAL_GAIN
    if method.gamma is None and noisy:
        # Where noise is stated, the least gain may cost any amount of it (a decoupled disturbance).  The Kalman filter
        # that takes the disturbance as unit white noise is a fair compromise, and its gain is known to be reachable.
        return max((1.0 + method.gamma_margin) * least.gain, least.starting_gain)
    if method.gamma is None:
        return max((1.0 + method.gamma_margin) * least.gain, floor)
    _require_reachable(problem, least, method.gamma, solver=method.solver)
    ceiling = LARGEST_USEFUL_GAIN * least.starting_gain
    return min(method.gamma, ceiling) if ceiling > 0.0 else method.gamma


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
        remedy = "" if problem.free_weight else ", or set weight: free"
        raise InfeasibleError(
            f"No filter reaches gamma = {gain:.6g} {choice}: a checked certificate proves gamma >= "
            f"{lower_text(bound, 6)}, and the best filter found has {best:.6g}. Ask for a larger gamma, leave it out "
            f"for the least{remedy}.",
            necessary=False,
            lower_bound=bound,
        )
    raise SolverError(
        f"gamma = {gain:.6g} was not reached (best found {best:.6g}), and the proved lower bound {bound:.6g} does not "
        f"rule it out: the result is inconclusive {choice}. Ask for a slightly larger gamma."
    )
