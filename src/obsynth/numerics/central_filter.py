"""Central H-infinity filters: the least gain of a `GainProblem`, and filters that weigh noise at a given gain.

See `central_equation` for the equation behind them.  The true gain of the true problem decides.

The least level of a central H-infinity equation: where the margin of its solutions vanishes.

With u the squared level and m(u) u the margin, which grows at least as fast as u, ``u (1 - m)`` is a lower bound, and a
parabola through the last levels reached leads to the least in a few steps.

The Riccati equation of central H-infinity filters: gains of a `GainProblem` for each level g.

With ``h = [C; Z]``, ``k = [D; Zd]``, ``Y = A Y A' - (A Y h' + B k') (k k' - diag(0, g^2 I) + h Y h')^-1 (.)' + B B'``
has a stabilising solution with the right signs exactly when a filter of gain below g exists, and gives one. A little
artificial noise makes it regular; it can only raise the gain, and the true gain of the true problem decides.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any, NamedTuple, TypeVar

import numpy as np

from obsynth.numerics.arrays import SMALLEST, FloatArray, largest_singular_value
from obsynth.numerics.doubling import MOST_JUMPS, doubled_riccati_solution, is_positive
from obsynth.numerics.injection_problem import GainProblem, Injection, NormalisedProblem, normalise
from obsynth.numerics.norms import spectral_radius
from obsynth.numerics.pencil_points import GENERIC_POINTS

MOST_LEVELS = 60

#: Relative distance to the best gain from which a first level that fails ends the descent.
NEXT_TO = 1e-3

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


#: Artificial noise relative to the disturbance, in turn: the first is bisected, and each of the others only where it
#: reaches a level below.
NOISES = (1e-6, 1e-8, 1e-10, 1e-7, 1e-5, 1e-4, 1e-2)

#: Relative width of the bracket at which the search ends, for few and for many states.
FEW_STATES = 80

LEVEL_TOLERANCE = 1e-7

COARSE_LEVEL_TOLERANCE = 1e-5

COARSE_NOISES = (1e-6, 1e-4)

#: Distance below the best gain, in tolerances, at which another noise is tried.
PROBE = 10.0

#: The first level tried, relative to the start, for few and for many states: the margin near the start leads far down.
FIRST_LEVEL = 0.5

COARSE_START_SHARE = 0.99

#: Weights of the noise beside the disturbance, relative to their sizes, and levels of both together, relative to the
#: gain of the disturbance alone.
NOISE_WEIGHTS = np.logspace(-6.0, 3.0, 31)

LEVEL_FACTORS = (1.0, 1.5)

#: Above so many states the higher level, which makes gains up to a quarter smaller, would cost up to half of the time;
#: and one weight in so many is enough.
MOST_STATES_FOR_LEVELS = 200

COARSE_WEIGHTS = 4

WEIGHT_STEPS = 4

#: The weight that is tried first: the largest that keeps the level was within two of it in 161 of 180 random plants of
#: 6 to 32 states, and eight below it, or four above, in two power networks.
USUAL_WEIGHT = 16

#: A disturbance that does less than this share of what it does to the starting filter is decoupled; the levels at which
#: such a filter is looked for in turn, relative to the same; a point without meaning; and the share of rows xi that
#: counts as nothing.
DECOUPLED_GAIN = 1e-7

#: Pairs of level and artificial noise: what this noise costs goes with its square, but many states need some.
DECOUPLING_ATTEMPTS = ((1e-4, 1e-6), (1e-2, 1e-6), (1e-4, 1e-8), (1e-2, 1e-8))

#: The same share where states are many: no gain that is shipped is smaller than ten times that.
COARSELY_DECOUPLED = 1e-4

#: Points so far out that a combination which waits for samples, or takes the last ones alone, is told by its growth.
FAR_POINTS, MOST_FAR_GROWTH, LEAST_FAR_DECAY = (1e2, 1e3), 3.0, 0.3

SAME_ROWS = 1e-8

#: A level this far above anything a disturbance could do is no limit.
WITHOUT_LIMIT = 1e4


Found = TypeVar("Found")


#: A gain this close to one that no filter is below is the least.
AT_THE_BOUND = 1e-6

#: Coordinates in which the Riccati equations are solved, at most.
MOST_PASSES = 8

#: Riccati equations need no other coordinates when the gain is at least this fraction of that behind those they had.
GOOD_COORDINATES = 0.1

#: Gains below this fraction of the starting filter's are treated as zero: the disturbance is decoupled.
NEGLIGIBLE_GAIN = 1e-6

#: The bracket of a bisection ends at this share of the width asked for: the filter in hand is at its upper end.
BRACKET_SHARE = 0.1


class Whitened(NamedTuple):
    """Measurements ``D d + s v`` with unit noise v, in units ``L`` in which they are white, and what they leave.

    A disturbance that they show but for a little noise would cancel to rounding in ``B B' - B D' (D D' + s^2 I)^-1 D
    B'``: with ``[D, s I] = L U'``, orthonormal U, that is the square of ``[B, 0] (I - U U')``.
    """

    factor: FloatArray
    known: FloatArray
    direct: FloatArray
    state_left: FloatArray
    output_left: FloatArray

    @classmethod
    def of(cls, d: FloatArray, noise: float, b: FloatArray, zd: FloatArray) -> Whitened:
        """Return L ``(m, m)``, ``[B, 0] U``, ``[Zd, 0] U`` and what is left of both; ``noise`` is s."""
        m, nd = d.shape
        u, triangle = np.linalg.qr(np.vstack([d.T, noise * np.eye(m)]))
        known, direct = b @ u[:nd], zd @ u[:nd]
        state_left, output_left = -known @ u.T, -direct @ u.T
        state_left[:, :nd] += b
        output_left[:, :nd] += zd
        return cls(triangle.T, known, direct, state_left, output_left)

    def blocks(self, own: float) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return process, weight and cross of the equation of what is left; ``own``: noise of each state, squared."""
        m, q = len(self.factor), len(self.direct)
        process = self.state_left @ self.state_left.T
        process.reshape(-1)[:: len(process) + 1] += own
        weight = np.eye(m + q)
        weight[m:, m:] = self.output_left @ self.output_left.T
        return process, weight, np.hstack([np.zeros_like(self.known), self.state_left @ self.output_left.T])


@dataclass(frozen=True, eq=False)
class CentralEquation:
    """The equation of a problem with measurements for every level, in as few states as it takes; no limit on V.

    Where the disturbance is in no measurement, only the error on null C is left: with an orthonormal basis N of it, M
    one of its complement and ``F = A N`` (``lift``), ``Y = F K F' + B B'``, ``K = S - S N'Z' (Z N S N'Z' - g^2 I)^-1 Z
    N S``, where S solves the equation with ``N'F``, ``[M'F; ZN]``, ``N'BB'N``, ``diag(M'BB'M, -g^2 I)`` and ``[N'BB'M,
    0]``.  Each is solved for what the measurements leave of the noise (`Whitened`); their units are ``factor``.
    """

    problem: GainProblem
    a: FloatArray
    h: FloatArray
    process: FloatArray
    weight: FloatArray
    cross: FloatArray
    outputs: FloatArray
    full_weight: FloatArray
    full_cross: FloatArray
    factor: FloatArray
    lift: FloatArray | None

    @classmethod
    def of(cls, problem: GainProblem, *, noise: float) -> CentralEquation:
        """Return the equation with artificial noise, relative to the disturbance."""
        size = largest_singular_value(problem.B)
        if problem.D.any() or problem.Zd.any() or not 0 < problem.measured < problem.order or size == 0.0:
            return cls._of_all_states(problem, noise, size)
        return cls._of_hidden_states(problem, noise * size)

    @classmethod
    def _of_all_states(cls, problem: GainProblem, noise: float, size: float) -> CentralEquation:
        seen = max(largest_singular_value(part) for part in (problem.D, problem.C * size))
        white = Whitened.of(problem.D, noise * (seen or 1.0), problem.B, problem.Zd)
        shown = np.linalg.solve(white.factor, problem.C)
        return cls(
            problem,
            problem.A - white.known @ shown,
            np.vstack([shown, problem.Z - white.direct @ shown]),
            *white.blocks((noise * size) ** 2),
            np.vstack([shown, problem.Z]),
            _bordered(white.direct, problem.Zd @ problem.Zd.T),
            np.hstack([white.known, problem.B @ problem.Zd.T]),
            white.factor,
            None,
        )

    @classmethod
    def _of_hidden_states(cls, problem: GainProblem, noise: float) -> CentralEquation:
        m, a, b, z = problem.measured, problem.A, problem.B, problem.Z
        basis, triangle = np.linalg.qr(problem.C.T, mode="complete")
        known, hidden = basis[:, :m], basis[:, m:]
        lift = a @ hidden
        white = Whitened.of(known.T @ b, noise, hidden.T @ b, problem.Zd)
        shown = np.linalg.solve(white.factor, known.T @ lift)
        # What the measurements of a sample say of the noise before it, and all that this does.
        told = known @ white.factor + hidden @ white.known
        done = b @ (z @ b).T + noise**2 * z.T
        return cls(
            problem,
            hidden.T @ lift - white.known @ shown,
            np.vstack([shown, z @ hidden]),
            *white.blocks(noise**2),
            np.vstack([np.linalg.solve(white.factor, known.T), z]),
            _bordered(z @ told, z @ done),
            np.hstack([a @ told, a @ done]),
            triangle[:m].T @ white.factor,
            lift,
        )

    def filter_at(self, level: float) -> Injection | None:
        """Return the gains of the central filter at ``level``, or ``None`` when the equation gives none."""
        return self.filter_and_margin(level)[0]

    def filter_and_margin(self, level: float) -> tuple[Injection | None, float]:
        """Return the gains of the central filter at ``level``, or ``None``, and how far the level is from the least.

        The least eigenvalue of what must be negative, relative to ``-g^2 I``: twice the relative distance, or more.
        """
        try:
            y = self.solution(level)
            if y is None:
                return None, 0.0
            found, left = self._gains(*self._sums(y, level))
        except np.linalg.LinAlgError:
            return None, 0.0
        if found is None or not (np.isfinite(found.R).all() and np.isfinite(found.V).all()):
            return None, 0.0
        return found, float(np.linalg.eigvalsh(left)[0]) / level**2

    def solution(self, level: float) -> FloatArray | None:
        """Return Y ``(n, n)`` at ``level``, or ``None``, of hidden states ``F K F'``; its signs are not looked at."""
        lowered = self._lowered(self.weight, level)
        s = doubled_riccati_solution(
            self.a,
            self.h,
            self.process,
            lowered,
            self.cross,
            possible=lambda y: self._is_possible(y, level),
            most_jumps=MOST_JUMPS,
        )
        if s is None or self.lift is None:
            return s
        shown = self.h[self.problem.measured :]
        through = s @ shown.T
        k = s - through @ np.linalg.solve(shown @ through - level**2 * np.eye(len(shown)), through.T)
        return np.asarray(self.lift @ k @ self.lift.T)

    def _sums(self, y: FloatArray, level: float) -> tuple[FloatArray, FloatArray]:
        """Return ``k k' - diag(0, g^2 I) + h Y h'`` and ``A Y h' + B k'`` in all states; white measurements."""
        seen = y @ self.outputs.T
        total = self._lowered(self.full_weight + self.outputs @ seen, level)
        return total, self.problem.A @ seen + self.full_cross

    def _lowered(self, weight: FloatArray, level: float) -> FloatArray:
        lowered = weight.copy()
        lowered.reshape(-1)[self.problem.measured * (len(weight) + 1) :: len(weight) + 1] -= level**2
        return lowered

    def _is_possible(self, y: FloatArray, level: float) -> bool:
        """Whether what xi shows over finitely many steps is still below the level, with the current measurement."""
        m = self.problem.measured
        if self.problem.weight_is_free and self.lift is None:
            total = self.weight + self.h @ y @ self.h.T
            left = total[m:, :m] @ np.linalg.solve(total[:m, :m], total[:m, m:]) - total[m:, m:]
        else:
            # Without a free weight xi knows nothing of the current measurement.
            h, weight = (self.outputs, self.full_weight) if self.lift is None else (self.h, self.weight)
            left = -weight[m:, m:] - h[m:].dot(y).dot(h[m:].T)
        left.reshape(-1)[:: len(left) + 1] += level**2
        return is_positive(0.5 * (left + left.T))

    def _gains(self, total: FloatArray, through: FloatArray) -> tuple[Injection | None, FloatArray]:
        """Return the gains when the signs are right: m positive, q negative, and what must be positive of the q."""
        n, m, q = self.problem.order, self.problem.measured, self.problem.Z.shape[0]
        if self.problem.weight_is_free:
            # The estimate may use the measurement of the same sample.
            solved = np.linalg.solve(total[:m, :m], np.vstack([through[:, :m], total[m:, :m]]).T).T
            left = solved[n:] @ total[:m, m:] - total[m:, m:]
            left = 0.5 * (left + left.T)
            solved = np.linalg.solve(self.factor.T, solved.T).T
            found = Injection(np.asarray(solved[:n]), np.asarray(-solved[n:]))
            return (found if is_positive(total[:m, :m]) and is_positive(left) else None), left
        left = -0.5 * (total[m:, m:] + total[m:, m:].T)
        change = np.linalg.solve(total[m:, m:], total[m:, :m])
        reduced = total[:m, :m] - total[:m, m:] @ change
        if not (is_positive(left) and is_positive(0.5 * (reduced + reduced.T))):
            return None, left
        gain = np.linalg.solve(self.factor.T, np.linalg.solve(reduced.T, (through[:, :m] - through[:, m:] @ change).T))
        return Injection(np.asarray(gain.T), np.zeros((q, m))), left


def _bordered(border: FloatArray, corner: FloatArray) -> FloatArray:
    """Return ``[I, border'; border, corner]``."""
    m = border.shape[1]
    found = np.eye(m + len(border))
    found[m:, :m], found[:m, m:], found[m:, m:] = border, border.T, corner
    return found


def central_injection(problem: GainProblem, level: float, *, noise: float) -> Injection | None:
    """Return the gains of the central filter at ``level``, or ``None`` when the equation gives none."""
    return CentralEquation.of(problem, noise=noise).filter_at(level)


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
    ``seen``: the filters whose true gain was asked for.
    """

    equation: CentralEquation
    low: float
    high: float
    tolerance: float
    reached: list[Reached] = field(default_factory=list)
    settled: bool = False
    expects_rounding: bool = False
    judged: bool = False
    seen: list[tuple[Injection, float]] = field(default_factory=list)

    def run(self, first: float) -> None:
        """Go down from ``first``; where that is not reached and close to ``high``, nothing below is looked for."""
        level, caution, failures = first * (1.0 + self.tolerance), 1.0, 0
        for _ in range(MOST_LEVELS):
            if level >= self.high * (1.0 - 0.5 * self.tolerance):
                return
            found, margin = self.equation.filter_and_margin(level)
            if found is not None and self._is_credible(level, margin, found):
                self.reached.append(Reached(level, margin, found))
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

    def _is_credible(self, level: float, margin: float, found: Injection) -> bool:
        """Whether the margin has shrunk with the level, without which the solution is not the one looked for."""
        if margin > MOST_MARGIN:
            return False
        if self.reached and margin * level**2 >= self.reached[-1].margin * self.reached[-1].level ** 2:
            return False
        believed = not self.judged and (not self.expects_rounding or bool(self.reached))
        return believed or self._gain_within(found, level) is not None

    def _next_level(self, caution: float) -> float:
        """Return the level to try: a little above where the margin should vanish."""
        middle = 0.5 * (self.low + self.high)
        points = [(item.level**2, item.margin * item.level**2) for item in self.reached[-3:]][::-1]
        if not points or (caution > 1.0 and len(points) < len(SAFETY)):
            return middle
        u, m = points[0]
        zeros = [max(u - m, self.low**2)]
        if len(points) > 1:
            zeros.append(max(zeros[0], _vanishing(points[:2])))
        if len(points) > 2 and zeros[0] <= (parabola := _vanishing(points)) <= 0.5 * (zeros[1] + u):
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
        least, step, found = last.level, RETREAT * self.tolerance, None
        while found is None and step <= NEXT_TO and least * (1.0 + step) < self.reached[0].level:
            found, step = self._kept(least * (1.0 + step)), RETREAT * step
        if found is None:
            return None
        step, ratio = step / RETREAT, RETREAT
        for _ in range(HALVINGS):
            ratio = math.sqrt(ratio)
            lower = self._kept(least * (1.0 + step / ratio))
            found, step = (found, step) if lower is None else (lower, step / ratio)
        return found

    def judged_again(self, high: float) -> GammaIteration:
        """Return a descent in which each filter is judged by itself, down to the lowest level that failed."""
        top, last = self.reached[0].level, self.reached[-1].level
        first_fails = self._gain_within(self.reached[0].injection, top) is None
        again = GammaIteration(self.equation, top if first_fails else last, high, self.tolerance, judged=True)
        again.run(0.5 * (top + high) if first_fails else top)
        return again

    def _kept(self, level: float) -> tuple[Injection, float] | None:
        """Return the filter of a level and its true gain where the level is not exceeded."""
        found = self.equation.filter_at(level)
        gain = None if found is None else self._gain_within(found, level)
        return None if found is None or gain is None else (found, gain)

    def _gain_within(self, found: Injection, level: float) -> float | None:
        gain = self.equation.problem.achieved_gain(found)
        self.seen.append((found, gain))
        return gain if gain <= level * (1.0 + self.tolerance) else None


def _vanishing(points: list[tuple[float, float]]) -> float:
    """Return where u is for a margin of zero, by the polynomial in the margin through points (u, margin)."""
    total = 0.0
    for i, (u, margin) in enumerate(points):
        others = [m for j, (_, m) in enumerate(points) if j != i]
        total += u * math.prod(m / (m - margin) for m in others)
    return total


def central_filter_at(problem: GainProblem, level: float) -> Injection | None:
    """Return a filter whose true gain is below ``level``, from the first noise that gives one, or ``None``."""
    if problem.order == 0 or problem.measured == 0:
        return None
    work = with_least_weight(problem)
    for noise in NOISES:
        found = central_injection(work, level, noise=noise)
        if found is not None and problem.reaches(found, level):
            return found
    return None


def with_least_weight(problem: GainProblem) -> GainProblem:
    """Return the problem with V = 0 where the weight has a limit: the least weight there is meets every limit."""
    return problem if problem.weight_limit is None else replace(problem, free_weight=False, weight_limit=None)


def search_central_filter(
    problem: GainProblem,
    start: Injection,
    gain: float | None = None,
    *,
    start_is_good: bool = False,
) -> tuple[Injection, float]:
    """Return the best central filter found, and (a bound on) its true gain.

    The least level with little noise first; other noises, cheaper or less sensitive, where they reach one below.
    """
    tolerance = LEVEL_TOLERANCE if problem.order <= FEW_STATES else COARSE_LEVEL_TOLERANCE
    best, gain = start, problem.achieved_gain(start) if gain is None else gain
    low, least_noise, most_noise = least_level(problem), 0.0, np.inf
    if low <= DECOUPLED_GAIN * gain and (decoupled := _decoupling_filter(problem, gain)) is not None:
        return decoupled
    for noise in NOISES if problem.order <= FEW_STATES else COARSE_NOISES:
        if gain <= low * (1.0 + 2.0 * tolerance):
            break
        if not least_noise <= noise <= most_noise:
            continue
        close = start_is_good or best is not start
        equation = CentralEquation.of(problem, noise=noise)
        descent = GammaIteration(equation, low, gain, tolerance, expects_rounding=close)
        share = FIRST_LEVEL if problem.order <= FEW_STATES else COARSE_START_SHARE
        descent.run(max(low, gain * (1.0 - PROBE * tolerance if close else share)))
        found = descent.best()
        if found is None and descent.reached and descent.reached[0].level < gain * (1.0 - NEXT_TO):
            descent = descent.judged_again(gain)
            found = descent.best()
        # The level that is reached last may be made up by rounding, or noise may raise it: of all that were judged.
        seen = [found, *(item for item in descent.seen if math.isfinite(item[1]))]
        found = min(filter(None, seen), key=lambda item: item[1], default=None)
        if noise < most_noise < np.inf and (found is None or found[1] >= gain):
            least_noise = noise  # nor is less of it worth a try
        if found is None:
            continue
        injection, reached = found
        if descent.settled and reached <= descent.high * (1.0 + PROBE * tolerance):
            most_noise = noise  # more of it cannot cost less
        if reached < gain:
            best, gain = injection, reached
    return best, gain


def _decoupling_filter(problem: GainProblem, gain: float) -> tuple[Injection, float] | None:
    """Return a filter that no disturbance reaches, and its gain; ``None`` where there is none."""
    if not _follows_from_measurements(problem):
        return None
    # The artificial noise has a gain of its own, which in many states may be above the first level; next to a zero on
    # the unit circle only little of it leaves the equation a solution.
    best = None
    for share, noise in DECOUPLING_ATTEMPTS:
        found = central_injection(problem, share * gain, noise=noise)
        if found is None:
            continue
        reached = problem.achieved_gain(found)
        if reached <= DECOUPLED_GAIN * gain:
            return found, reached
        best = (found, reached) if best is None or reached < best[1] else best
    coarsely = best is not None and problem.order > FEW_STATES and best[1] <= COARSELY_DECOUPLED * gain
    return best if coarsely else None


def _follows_from_measurements(problem: GainProblem) -> bool:
    """Whether the rows of xi are combinations of those of state and measurements, without samples yet to come."""
    if _combined(problem, -GENERIC_POINTS[1])[1] > SAME_ROWS:
        return False
    # A sample yet to come is a factor of z, and where no weight is free past ones alone are left: a factor of 1 / z.
    size = max(1.0, spectral_radius(problem.A))
    near, far = (_combined(problem, point * size)[0] for point in FAR_POINTS)
    return far <= (MOST_FAR_GROWTH if problem.weight_is_free else LEAST_FAR_DECAY) * near


def _combined(problem: GainProblem, point: float) -> tuple[float, float]:
    """Return the size of the combination at a point of the z-plane, and what it leaves, as a share of xi."""
    from scipy.linalg import lstsq

    shifted = problem.A - point * np.eye(problem.order)
    known = np.vstack([np.hstack([shifted, problem.B]), np.hstack([problem.C, problem.D])])
    wanted = np.hstack([problem.Z, problem.Zd])
    solved = lstsq(known.T, wanted.T, lapack_driver="gelsy", check_finite=False)[0]
    left = float(np.linalg.norm(known.T @ solved - wanted.T))
    return float(np.linalg.norm(solved)), left / max(float(np.linalg.norm(wanted)), SMALLEST)


def least_level(problem: GainProblem) -> float:
    """Return what a disturbance does to xi before any measurement can help: no gain is below."""
    if problem.weight_is_free:
        return 0.0
    direct = problem.Zd if np.any(problem.D) else np.hstack([problem.Zd, problem.Z @ problem.B])
    return largest_singular_value(direct)


def least_noise_filter(problem: GainProblem) -> Injection | None:
    """Return the filter with the least variance of xi under the noise of the problem: a level without limit."""
    noise = with_least_weight(problem).noise_as_disturbance()
    if noise.order == 0 or noise.measured == 0:
        return None
    found = central_injection(noise, WITHOUT_LIMIT * max(noise.disturbance_size, 1.0), noise=NOISES[0])
    return found if found is not None and np.isfinite(problem.noise_variance(found)) else None


def noise_weighted_filters(
    problem: GainProblem, gain: float, *, reaches: Callable[[Injection], bool], artificial: float = NOISES[0]
) -> Iterator[Injection]:
    """Yield central filters with a gain of at most ``gain`` on paper, for which the noise counts as much as it can.

    The noise, times a weight, is one more disturbance; at a level above ``gain`` the true gain finds the weight.
    """
    work = with_least_weight(problem)
    sizes = [float(np.linalg.norm(np.vstack(pair))) for pair in ((work.B, work.D), (work.Bn, work.Dn))]
    if work.order == 0 or work.measured == 0 or not min(sizes) > 0.0:
        return
    coarse = 1 if work.order <= MOST_STATES_FOR_LEVELS else COARSE_WEIGHTS
    weights, begin, last = (NOISE_WEIGHTS * sizes[0] / sizes[1])[::coarse], USUAL_WEIGHT // coarse, 0

    def tried(place: int, factor: float) -> Injection | None:
        found = central_injection(_with_noise(work, weights[place]), factor * gain, noise=artificial)
        return found if found is not None and (factor == 1.0 or reaches(found)) else None

    for factor in LEVEL_FACTORS if coarse == 1 else LEVEL_FACTORS[:1]:
        # More weight than at a lower level, and not more than can be hoped for.
        places = range(last, len(weights) if factor == 1.0 else min(last + WEIGHT_STEPS, len(weights)))
        found = last_found(partial(tried, factor=factor), places, begin)
        if found is not None:
            begin = last = found[0]
            yield found[1]


def last_found(tried: Callable[[int], Found | None], places: range, begin: int) -> tuple[int, Found] | None:
    """Return the last place at which something is found, and what, by bisection that begins in small steps."""
    low, high, step = places.start, places.stop, 1
    best: tuple[int, Found] | None = None
    place = min(max(begin, low), high - 1)
    while low < high:
        found = tried(place)
        if found is None:
            high = place
        else:
            best, low = (place, found), place + 1
        if best is not None and high < places.stop:
            place = (low + high) // 2
        else:
            place, step = min(place + step, high - 1) if best is not None else max(place - step, low), 2 * step
    return best


def noise_weighted_filters_within(
    normalised: NormalisedProblem, gain: float, *, reaches: Callable[[Injection], bool]
) -> Iterator[Injection]:
    """Yield `noise_weighted_filters` of the problem before normalisation, found in its coordinates.

    Far below the gain of the starting filter the artificial noise would in others be all that counts."""

    def reached(found: Injection) -> bool:
        return reaches(normalised.restore(found))

    level = gain / normalised.gain
    for found in noise_weighted_filters(normalised.problem, level, reaches=reached, artificial=min(NOISES)):
        yield normalised.restore(found)


def _with_noise(problem: GainProblem, weight: float) -> GainProblem:
    """Return the problem with its noise, times a weight, as further disturbances."""
    return replace(
        problem,
        B=np.concatenate([problem.B, weight * problem.Bn], axis=1),
        D=np.concatenate([problem.D, weight * problem.Dn], axis=1),
        Zd=np.concatenate([problem.Zd, weight * problem.Zn], axis=1),
    )


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


def search_least_gain(problem: GainProblem) -> LeastGain:
    """Minimise the gain directly, improving the coordinates between passes."""
    first = normalised = normalise(problem)
    best = first.start
    gain = starting = first.start_gain
    records: list[dict[str, Any]] = []
    modes = None
    if problem.measured == 0 or gain == 0.0:
        return LeastGain(gain, first, best, starting, (gain, gain))
    for number in range(MOST_PASSES):
        if problem.order == 0 or gain <= least_level(problem) * (1.0 + AT_THE_BOUND):
            break  # nothing is below
        before = gain
        if best is not normalised.start:
            normalised = normalise(problem, start=best, gain=gain)
        # In coordinates in which the artificial noise is of a natural size.
        work, start = with_least_weight(normalised.problem), normalised.contracted(best)
        known: float | None = gain / normalised.gain
        if not work.weight_is_free and np.any(start.V):
            start, known = Injection(start.R, np.zeros_like(start.V)), None
        found, level = search_central_filter(work, start, known, start_is_good=number > 0)
        records.append({"what": "least gain", "solver": "central filter", "status": "optimal", "gain": level})
        if level * normalised.gain < gain:
            best, gain = normalised.restore(found), level * normalised.gain
            # Found once, in one of the two coordinates, among many states.
            modes = normalised.restored_modes(work.modes(found)) if problem.order > MOST_STATES_FOR_LEVELS else None
        if gain >= GOOD_COORDINATES * before or gain <= NEGLIGIBLE_GAIN * starting:
            break
    exact = replace(problem, judged_exactly=True)
    if modes is not None:
        exact.knows(best, modes)
    gain = exact.achieved_gain(best)
    return LeastGain(gain, first, best, starting, (gain, gain), records)


def search_by_bisection(problem: GainProblem, *, tolerance: float) -> LeastGain:
    """Minimise the gain by bisection: the paper's Algorithm 1, made to end.

    Every upper end of the bracket is the true norm of a filter in hand, the lower end a level at which none was found.
    """
    problem = replace(problem, judged_exactly=True)
    normalised = normalise(problem)
    gain = normalised.start_gain
    if problem.measured == 0 or gain == 0.0:
        return LeastGain(gain, normalised, normalised.start, gain, (gain, gain))
    work, best = normalised.problem, normalised.contracted(normalised.start)
    high, low = work.achieved_gain(best), 0.0
    while high - low > BRACKET_SHARE * tolerance * high:
        middle = 0.5 * (low + high)
        better = central_filter_at(work, middle)
        if better is None:
            low = middle
        else:
            best, high = better, min(middle, work.achieved_gain(better))
    injection, bracket = normalised.restore(best), (low * normalised.gain, high * normalised.gain)
    return LeastGain(problem.achieved_gain(injection), normalised, injection, gain, bracket)
