"""Strategy around the convex core: find the least gain, then gains of least size at a given gain.

No number of a solver is believed: a gain counts as reached only when the true H-infinity norm of the closed loop
says so.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from obsynth.errors import SolverError
from obsynth.methods.fault_estimation_filter import inequality_solutions
from obsynth.methods.fault_estimation_filter.central_filter import (
    least_level,
    search_central_filter,
    with_least_weight,
)
from obsynth.methods.fault_estimation_filter.injection_problem import (
    GainProblem,
    Injection,
    NormalisedProblem,
    normalise,
)

#: The search stops when another pass in better coordinates improves the gain by less than this.
PASS_IMPROVEMENT = 1e-6
MOST_PASSES = 8
#: Riccati equations need no other coordinates when the gain is at least this fraction of that behind those they had.
GOOD_COORDINATES = 0.1
#: Bounds on P in normalised coordinates, tried in turn: a tight one is easier, and the next pass moves on from it.
CEILINGS = (1e4, 1e2, 1e1)
#: Gains below this fraction of the starting filter's are treated as zero: the disturbance is decoupled.
NEGLIGIBLE_GAIN = 1e-6
#: A shipped gain is never asked to be smaller than this fraction of the starting filter's.
SMALLEST_USEFUL_GAIN = 1e-3
#: Why the inequality was not asked, or not again.
NOTHING_TO_POLISH = "reached: the disturbance does as much before any measurement can help; nothing to polish"


@dataclass(frozen=True, eq=False)
class LeastGain:
    """The outcome of the search: the true norm of the best filter (0 without d), and its gains.

    ``first``: coordinates of the starting (Kalman) filter; ``starting_gain``: its norm; ``bracket``: of a bisection.
    """

    gain: float
    first: NormalisedProblem
    injection: Injection
    starting_gain: float
    bracket: tuple[float, float]
    records: list[dict[str, Any]] = field(default_factory=list)


def search_least_gain(problem: GainProblem, *, solver: str, polish: bool = True) -> LeastGain:
    """Minimise the gain directly, improving the coordinates between passes."""
    first = normalised = normalise(problem, solver=solver)
    best, gain = first.start, first.start_gain
    starting = gain
    records: list[dict[str, Any]] = []
    if problem.measured == 0 or gain == 0.0:
        return LeastGain(gain, first, best, starting, (gain, gain))
    for number in range(MOST_PASSES):
        before = last = gain
        for improve in (_central_filter, _polished) if polish else (_central_filter,):
            if gain <= least_level(problem) * (1.0 + PASS_IMPROVEMENT):
                break  # nothing is below
            if best is not normalised.start:
                normalised = normalise(problem, solver=solver, start=best, gain=gain)
            better = improve(normalised, best, gain, records, solver=solver, first=number == 0)
            if better is None:
                reached = np.inf
            elif improve is _central_filter:
                reached = records[-1]["gain"] * normalised.gain  # known already, in the other coordinates
            else:
                reached = problem.achieved_gain(better)
            last = gain
            if better is not None and reached < gain:
                best, gain = better, reached
        # Where the last word adds nothing to the one before, another pass adds nothing either.
        if polish and number == 0 and gain >= last * (1.0 - PASS_IMPROVEMENT) and gain >= GOOD_COORDINATES * before:
            break
        if gain >= before * (1.0 - PASS_IMPROVEMENT) or gain <= NEGLIGIBLE_GAIN * starting:
            break
        if not polish and gain >= GOOD_COORDINATES * before:
            break
    if polish and gain <= least_level(problem) * (1.0 + PASS_IMPROVEMENT):
        records.append({"what": "least gain", "solver": "lower bound", "status": NOTHING_TO_POLISH, "gain": gain})
    gain = replace(problem, judged_exactly=True).achieved_gain(best)
    return LeastGain(gain, first, best, starting, (gain, gain), records)


def _central_filter(
    normalised: NormalisedProblem,
    best: Injection,
    gain: float,
    records: list[dict[str, Any]],
    *,
    solver: str,
    first: bool,
) -> Injection | None:
    """Return the best central filter in the given coordinates, where the artificial noise is of a natural size."""
    work, start = with_least_weight(normalised.problem), normalised.contracted(best)
    if work.order == 0:
        return None
    known: float | None = gain / normalised.gain
    if not work.weight_is_free and np.any(start.V):
        start, known = Injection(start.R, np.zeros_like(start.V)), None
    found, level = search_central_filter(work, start, known, start_is_good=not first)
    records.append({"what": "least gain", "solver": "central filter", "status": "optimal", "gain": level})
    return normalised.restore(found)


def _polished(
    normalised: NormalisedProblem,
    _best: Injection,
    _gain: float,
    records: list[dict[str, Any]],
    *,
    solver: str,
    first: bool,
) -> Injection | None:
    """Minimise by the inequality, with the bound on P that lets the solver through; ``None`` when none does."""
    for ceiling in CEILINGS:
        try:
            found = inequality_solutions.least_gain(normalised.problem, solver=solver, ceiling=ceiling)
        except (SolverError, np.linalg.LinAlgError) as error:
            records.append(dict(getattr(error, "record", {})) | {"outcome": str(error)})
            continue
        records.append(found.record)
        if np.isfinite(normalised.problem.achieved_gain(found.injection)):
            return normalised.restore(found.injection)
    return None
