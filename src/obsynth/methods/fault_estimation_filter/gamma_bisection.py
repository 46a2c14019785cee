"""The least gain by bisection: the paper's Algorithm 1, made to end."""

from __future__ import annotations

from typing import Any

from obsynth.methods.fault_estimation_filter import inequality_solutions
from obsynth.methods.fault_estimation_filter.central_filter import central_filter_at
from obsynth.methods.fault_estimation_filter.inequality_search import LeastGain, coordinates
from obsynth.methods.fault_estimation_filter.injection_problem import GainProblem, Injection

#: The bracket ends at this share of the width asked for: the filter in hand is at its upper end.
BRACKET_SHARE = 0.1


def bisected_gain(
    problem: GainProblem, start: Injection, *, tolerance: float, solver: str, polish: bool
) -> tuple[float, float, Injection, list[dict[str, Any]]]:
    """Return ``(high, low, gains, records)``: the final bracket of a bisection on the gain, and the best filter.

    Algorithm 1 of the paper, made to end: every upper end of the bracket is the true norm of a filter in hand, and
    the lower end is a level at which none was found.
    """
    best, high, low = start, problem.achieved_gain(start), 0.0
    records = []
    while high - low > BRACKET_SHARE * tolerance * high:
        middle = 0.5 * (low + high)
        better = central_filter_at(problem, middle)
        if better is None and polish:
            found = inequality_solutions.feasible_point(problem, middle, solver=solver)
            better = None if found is None else found.injection
            records += [] if found is None else [found.record]
        if better is None:
            low = middle
        else:
            best, high = better, min(middle, problem.achieved_gain(better))
    return high, low, best, records


def search_by_bisection(problem: GainProblem, *, tolerance: float, solver: str, polish: bool = True) -> LeastGain:
    """Minimise the gain by bisection (the paper's Algorithm 1, made to end)."""
    normalised = coordinates(problem, solver=solver)
    gain = normalised.start_gain
    if problem.measured == 0 or gain == 0.0:
        return LeastGain(gain, normalised, normalised.start, gain, (gain, gain))
    start = normalised.contracted(normalised.start)
    high, low, found, records = bisected_gain(
        normalised.problem, start, tolerance=tolerance, solver=solver, polish=polish
    )
    injection = normalised.restore(found)
    return LeastGain(
        problem.achieved_gain(injection),
        normalised,
        injection,
        gain,
        (low * normalised.gain, high * normalised.gain),
        records,
    )
