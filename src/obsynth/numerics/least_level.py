"""Gamma iteration: the least level of a central H-infinity equation, at which the margin of its solutions vanishes.

Let u be the squared level and m the relative margin.  The margin m u grows at least as fast as u, so that
``u (1 - m)`` is a lower bound of the least squared level.  A parabola through the last three levels with a solution
leads to the least level in a few steps.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field

from obsynth.numerics.central_equation import CentralEquation
from obsynth.numerics.injection_problem import Injection

#: Most levels that are tried; a bisection alone narrows a bracket to a share of 1e-15 in 50.
MOST_LEVELS = 60

#: The next level lies above the estimate of the least one by this share of a distance.  The keys are the numbers of
#: levels that the estimate uses: with one or two the distance is that from the last level to the estimate, with three
#: that between the last two estimates.
SAFETY = {1: 0.01, 2: 0.1, 3: 0.2}

#: A relative margin below this means that the level is the least one in double precision.
SMALL_MARGIN = 1e-5

#: Factor by which each failing level enlarges the safety share.
CAUTION = 10.0

#: Failing levels that end the iteration in a narrow bracket where rounding errors are expected.
MOST_FAILURES = 3

#: The relative margin of a stabilising solution is at most one, up to rounding.
MOST_MARGIN = 1.0 + 1e-6

#: A filter whose true gain exceeds its level by more than this share shows that the equation was not solved.
NORM_EXCESS = 2e-3

#: Factor between steps upwards from a level that the true gain exceeds.
RETREAT = 10.0

#: Bisections, on a logarithmic scale, of the last such step.
HALVINGS = 2

#: The iteration ends where its first level fails and lies this close to the best known gain, relative to that.
NEXT_TO = 1e-3


@dataclass(frozen=True, eq=False)
class Reached:
    """A level at which the equation has a stabilising solution, with its relative margin and central filter."""

    level: float
    margin: float
    injection: Injection


@dataclass(eq=False)
class GammaIteration:
    """A descent from ``high`` to the least level.

    Parameters
    ----------
    equation : CentralEquation
        The equation, which has solutions at all levels above the least one.
    low, high : float
        The bracket of the least level.
    tolerance : float
        Relative width of the bracket at which the descent ends.
    reached : list of Reached
        Levels with a solution, each lower than the one before.
    settled : bool
        Whether the margin shows that no lower level has a solution.
    expects_rounding : bool
        Check the true gain of the first filter, and end after a few failures in a narrow bracket.
    judged : bool
        A level counts only if the true gain of its filter does not exceed it.
    evaluated : list
        Filters with their true gains, where these were computed.
    """

    equation: CentralEquation
    low: float
    high: float
    tolerance: float
    reached: list[Reached] = field(default_factory=list)
    settled: bool = False
    expects_rounding: bool = False
    judged: bool = False
    evaluated: list[tuple[Injection, float]] = field(default_factory=list)

    def run(self, first: float) -> None:
        """Descend from the level ``first``; end at once if it fails and lies close to ``high``."""
        level, caution, failures = first * (1.0 + self.tolerance), 1.0, 0
        for _ in range(MOST_LEVELS):
            if level >= self.high * (1.0 - 0.5 * self.tolerance):
                return
            injection, margin = self.equation.filter_and_margin(level)
            if injection is not None and self._is_credible(level, margin, injection):
                self.reached.append(Reached(level, margin, injection))
                self.high, caution = level, 1.0
                if margin <= 4.0 * self.tolerance:
                    self.settled = True
                    return
            elif not self.reached and level >= self.high * (1.0 - NEXT_TO):
                return
            else:
                self.low, caution, failures = level, caution * CAUTION, failures + 1
                if self.expects_rounding and failures >= MOST_FAILURES and self.high - self.low <= NEXT_TO * self.high:
                    return
            level = self._next_level(caution)

    def _is_credible(self, level: float, margin: float, injection: Injection) -> bool:
        """Whether the margin has shrunk with the level, as that of the stabilising solution does."""
        if margin > MOST_MARGIN:
            return False
        if self.reached and margin * level**2 >= self.reached[-1].margin * self.reached[-1].level ** 2:
            return False
        needs_no_check = not self.judged and (not self.expects_rounding or bool(self.reached))
        return needs_no_check or self._gain_within(injection, level) is not None

    def _next_level(self, caution: float) -> float:
        """Return the next level: a little above the estimate at which the margin vanishes, or the middle."""
        middle = 0.5 * (self.low + self.high)
        points = [(item.level**2, item.margin * item.level**2) for item in self.reached[-3:]][::-1]
        if not points or (caution > 1.0 and len(points) < len(SAFETY)):
            return middle
        u, m = points[0]
        zeros = [max(u - m, self.low**2)]
        if len(points) > 1:
            zeros.append(max(zeros[0], place_of_zero_margin(points[:2])))
        if len(points) > 2 and zeros[0] <= (parabola := place_of_zero_margin(points)) <= 0.5 * (zeros[1] + u):
            zeros.append(parabola)
        zero = zeros[-1]
        distance = abs(zero - zeros[1]) if len(zeros) > 2 else u - zero
        step = max(SAFETY[len(zeros)] * distance, 2.0 * self.tolerance * zero)
        level = math.sqrt(zero + caution * step)
        if caution == 1.0 and level >= self.high * (1.0 - 0.5 * self.tolerance):
            self.settled = self.reached[-1].margin <= SMALL_MARGIN
            return self.high
        return level if self.low < level < self.high * (1.0 - 0.5 * self.tolerance) else middle

    def best(self) -> tuple[Injection, float] | None:
        """Return the filter of the lowest level that its true gain does not exceed, and that gain, if there is one.

        Close to the least level rounding errors may let the true gain exceed the level.
        """
        if not self.reached:
            return None
        last = self.reached[-1]
        gain = self.equation.problem.achieved_gain(last.injection)
        if gain <= last.level * (1.0 + NORM_EXCESS):
            return last.injection, gain
        least, step, within = last.level, RETREAT * self.tolerance, None
        while within is None and step <= NEXT_TO and least * (1.0 + step) < self.reached[0].level:
            within, step = self._filter_within(least * (1.0 + step)), RETREAT * step
        if within is None:
            return None
        step, ratio = step / RETREAT, RETREAT
        for _ in range(HALVINGS):
            ratio = math.sqrt(ratio)
            lower = self._filter_within(least * (1.0 + step / ratio))
            within, step = (within, step) if lower is None else (lower, step / ratio)
        return within

    def judged_again(self, high: float) -> GammaIteration:
        """Return a second descent from ``high`` in which the true gain of each filter is checked."""
        top, last = self.reached[0].level, self.reached[-1].level
        first_fails = self._gain_within(self.reached[0].injection, top) is None
        descent = GammaIteration(self.equation, top if first_fails else last, high, self.tolerance, judged=True)
        descent.run(0.5 * (top + high) if first_fails else top)
        return descent

    def _filter_within(self, level: float) -> tuple[Injection, float] | None:
        """Return the filter of a level and its true gain; ``None`` where the gain exceeds the level."""
        injection = self.equation.filter_at(level)
        gain = None if injection is None else self._gain_within(injection, level)
        return None if injection is None or gain is None else (injection, gain)

    def _gain_within(self, injection: Injection, level: float) -> float | None:
        """Return the true gain of a filter; ``None`` where it exceeds the level."""
        gain = self.equation.problem.achieved_gain(injection)
        self.evaluated.append((injection, gain))
        return gain if gain <= level * (1.0 + self.tolerance) else None


def place_of_zero_margin(points: list[tuple[float, float]]) -> float:
    """Return u at margin zero by interpolation: u is the polynomial in the margin through points (u, margin)."""
    total = 0.0
    for i, (u, margin) in enumerate(points):
        other_margins = [m for j, (_, m) in enumerate(points) if j != i]
        total += u * math.prod(m / (m - margin) for m in other_margins)
    return total
