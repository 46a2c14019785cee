"""The least level of a central H-infinity equation: where the margin of its solutions vanishes.

With u the squared level and m(u) u the margin, which grows at least as fast as u, ``u (1 - m)`` is a lower bound, and a
parabola through the last levels reached leads to the least in a few steps.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field

from obsynth.numerics.central_equation import CentralEquation
from obsynth.numerics.injection_problem import Injection

MOST_LEVELS = 60

#: Shares of the distance to where the margin should vanish, told by one level or by two, by which the next stays above
#: that; with three levels, a share of the distance between the last two estimates.
SAFETY = {1: 0.01, 2: 0.1, 3: 0.2}

#: A margin below this belongs to a level next to the least.
SMALL_MARGIN = 1e-5

#: Growth of that share with each level that fails.
CAUTION = 10.0

#: Levels that may fail in a narrow bracket where rounding is to be expected.
MOST_FAILURES = 3

#: A margin is at most one, up to rounding, or the solution is not the one looked for.
MOST_MARGIN = 1.0 + 1e-6

#: A filter whose true gain is above its level by this relative amount shows that the equation was not solved.
NORM_EXCESS = 2e-3

#: Steps away from a level that the true gain exceeds, each longer than the one before, and halvings (of their
#: logarithm) back.
RETREAT = 10.0

HALVINGS = 2

#: Relative distance to the best gain from which a first level that fails ends the descent.
NEXT_TO = 1e-3


@dataclass(frozen=True, eq=False)
class Reached:
    """A level at which the equation has a solution of the right signs, and its margin and central filter."""

    level: float
    margin: float
    injection: Injection


@dataclass(eq=False)
class GammaIteration:
    """The way down from ``high`` to the least level; low and high are the bracket, tolerance its relative width.

    ``settled``: the margin tells that nothing is below; ``expects_rounding``: the first filter is judged and a few
    failures in a narrow bracket end it; ``judged``: a level counts only when the true gain of its filter is within it;
    ``evaluated``: the filters whose true gain was asked for.
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
        """Go down from ``first``; where that is not reached and close to ``high``, nothing below is looked for."""
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
        """Whether the margin has shrunk with the level, without which the solution is not the one looked for."""
        if margin > MOST_MARGIN:
            return False
        if self.reached and margin * level**2 >= self.reached[-1].margin * self.reached[-1].level ** 2:
            return False
        believed = not self.judged and (not self.expects_rounding or bool(self.reached))
        return believed or self._gain_within(injection, level) is not None

    def _next_level(self, caution: float) -> float:
        """Return the level to try: a little above where the margin should vanish."""
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

        Next to the least level, where the margin vanishes, rounding may let the true gain exceed the level.
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
        """Return a descent in which each filter is judged by itself, down to the lowest level that failed."""
        top, last = self.reached[0].level, self.reached[-1].level
        first_fails = self._gain_within(self.reached[0].injection, top) is None
        again = GammaIteration(self.equation, top if first_fails else last, high, self.tolerance, judged=True)
        again.run(0.5 * (top + high) if first_fails else top)
        return again

    def _filter_within(self, level: float) -> tuple[Injection, float] | None:
        """Return the filter of a level and its true gain where the level is not exceeded."""
        injection = self.equation.filter_at(level)
        gain = None if injection is None else self._gain_within(injection, level)
        return None if injection is None or gain is None else (injection, gain)

    def _gain_within(self, injection: Injection, level: float) -> float | None:
        gain = self.equation.problem.achieved_gain(injection)
        self.evaluated.append((injection, gain))
        return gain if gain <= level * (1.0 + self.tolerance) else None


def place_of_zero_margin(points: list[tuple[float, float]]) -> float:
    """Return where u is for a margin of zero, by the polynomial in the margin through points (u, margin)."""
    total = 0.0
    for i, (u, margin) in enumerate(points):
        other_margins = [m for j, (_, m) in enumerate(points) if j != i]
        total += u * math.prod(m / (m - margin) for m in other_margins)
    return total
