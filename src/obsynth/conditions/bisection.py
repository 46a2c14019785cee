"""Bisection over a parameter of matrix inequalities by a solver that may fail.

A solver has three answers and not two: values that satisfy the constraints, "infeasible", and neither, which says
nothing of the level: an error, an iteration limit, "inaccurate", or "optimal" with values that violate a constraint.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

import numpy as np

from obsynth.numerics.suggestions import fields_suggested

#: Levels of one sign whose ratio is above this are halved on a logarithmic scale.
GEOMETRIC_RATIO = 4.0

#: Where between the ends a level is tried, in turn, until one has an answer.
PLACES = (0.5, 0.375, 0.625)

#: Most halvings on each side: a double has no more digits.
MOST_HALVINGS = 60

Answer = Literal["feasible", "infeasible", "unknown"]


@fields_suggested
@dataclass(frozen=True)
class Bisection:
    """Where conditions change from feasible to infeasible, as far as a solver finds out.

    Parameters
    ----------
    feasible : float
        The level nearest to the other end at which values satisfy every constraint: those that the variables have now.
    infeasible : float
        The level nearest to it that the solver calls infeasible, which is no proof; NaN where there is none.
    unknown : tuple of float
        Levels without an answer: the solver failed, stopped early, or its values violate a constraint.
    """

    feasible: float
    infeasible: float
    unknown: tuple[float, ...]


def bisected(answer: Callable[[float], Answer], feasible: float, infeasible: float, tolerance: float) -> Bisection:
    """Return where the answer changes.

    That of the feasible end is known; where the other end is feasible too, that is the result.  A level without an
    answer bounds the search for feasible ones on one side and the search for infeasible ones on the other.
    """
    known: dict[float, Answer] = {}

    def nearest(first: float, last: float, target: Answer) -> float:
        """Return the level nearest to the last, from the first on, that has the wanted answer."""
        for _ in range(MOST_HALVINGS):
            if abs(last - first) <= tolerance * max(abs(first), abs(last)):
                break
            levels = [_between(first, last, share) for share in PLACES]
            for level in levels:
                known.setdefault(level, answer(level))
                if known[level] != "unknown":
                    break
            else:
                last = levels[0]
                continue
            first, last = (level, last) if known[level] == target else (first, level)
        return first

    known[infeasible] = answer(infeasible)
    if known[infeasible] == "feasible":
        return Bisection(infeasible, np.nan, ())
    least = nearest(feasible, infeasible, "feasible")
    refuted = np.nan
    if known[infeasible] == "infeasible":
        refuted_levels = [level for level, verdict in known.items() if verdict == "infeasible"]
        refuted = nearest(min(refuted_levels, key=lambda level: abs(level - least)), least, "infeasible")
    return Bisection(least, refuted, tuple(sorted(level for level, verdict in known.items() if verdict == "unknown")))


def _between(first: float, last: float, share: float) -> float:
    """Return a level between two, on a logarithmic scale where they are far apart."""
    if first * last > 0.0 and max(first / last, last / first) > GEOMETRIC_RATIO:
        return float(np.copysign(abs(first) ** (1.0 - share) * abs(last) ** share, first))
    return (1.0 - share) * first + share * last
