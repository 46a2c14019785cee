"""Kalman gains with a prescribed rate of decay (Anderson, Moore, "Linear optimal control", 1971, section 4).

The default gain needs no numbers from the user: it is as fast as a fixed factor of noise above the least one allows.
This compromise is our own.
"""

from __future__ import annotations

import math
import warnings
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from obsynth.numerics.arrays import FloatArray
from obsynth.numerics.doubling import continuous_riccati_solution
from obsynth.numerics.matrix_equations import continuous_solution, discrete_solution, doubled_solution
from obsynth.numerics.spectra import abscissa, decay_rates, eigenvalues, noise_covariance

#: Number of times that the Riccati equation is solved, each time in coordinates from the last solution, which make the
#: next one more accurate.
KALMAN_ROUNDS = 2

#: From so many states on the Riccati equation is solved by doubling first: at 40 states in 1 to 2 ms, compared with 12
#: to 15 ms by the QZ algorithm.
DOUBLING_FROM = 40

#: A rate for which the equation is not solved at once is approached by this factor, from at most so many steps below.
RATE_FACTOR = 4.0

MOST_RATE_STEPS = 12

#: If a step fails, it is shortened, down to this factor.
LEAST_FACTOR = 1.2

#: A required rate is exceeded by at least this factor, so that rounding does not decide whether it is reached.
WELL_REACHED = 1.001

#: Prescribed rates below the required one that are tried: first this share of it, since integrators then have poles at
#: twice the prescribed rate; then so many bisections.
FIRST_SHARE, RATE_BISECTIONS = 0.5, 6

#: Largest ratio of the noise of the default filter to that of the quietest Kalman filter.
NOISE_PRICE = 10.0

#: The default rate is determined up to about this factor.
RATE_STEP = 1.05

#: The noise of estimates below this share of the outputs' noise is rounding.
SILENT = 1e-8

#: Deviations that differ by more than this share in different coordinates of the states are rounding.
SAME_DEVIATION = 0.1

#: A noise ratio that is nearer to the largest one than this share is computed from the improved solution.
NEAR_THE_PRICE = 0.01

#: Number of halvings of the default rate before the quietest filter is used instead.
MOST_RATE_HALVINGS = 40


@dataclass(frozen=True, eq=False)
class KalmanProblem:
    """An observable pair with noise: ``e+ = F e + B w + drive v``, innovation ``C e + D w + background n``."""

    F: FloatArray  # (n, n)
    C: FloatArray  # (ny, n)
    B: FloatArray  # (n, k), for the stated noise, of unit covariance (dt = 0: intensity)
    D: FloatArray  # (ny, k)
    drive: FloatArray  # (n, p): assumed process noise, without which gains of a filter may vanish
    background: FloatArray  # (ny, q): assumed sensor noise, which makes the covariance of the innovation regular
    estimates: FloatArray  # (k, n): the fault estimates, whose noise is compared
    dt: float  # s, 0 for continuous time

    def gain(self, decay: float, *, persistent: bool = False) -> FloatArray | None:
        """Return the gain whose poles all decay at ``decay`` (1/s) or faster; ``None`` if the equation has no solution.

        If ``persistent``, a rate for which the equation is not solved at once is approached from lower rates.
        """
        plain = np.eye(self.F.shape[0])
        best, change = self.solved(decay, plain)
        if best is not None or not persistent:
            return best
        rate, steps = decay, 0
        while best is None and steps <= MOST_RATE_STEPS:
            rate, steps = rate / RATE_FACTOR, steps + 1
            best, change = self.solved(rate, plain)
        factor = RATE_FACTOR
        while best is not None and rate < decay and factor > LEAST_FACTOR:
            # Steps are shortened if one fails; the possible length depends on rounding.
            further = min(rate * factor, decay)
            gain, moved = self.solved(further, change)
            if gain is None:
                factor = float(np.sqrt(factor))
            else:
                best, change, rate = gain, moved, further
        return best if rate == decay else None

    def quietest_gain(self, decay: float, *, drives: Sequence[float] = (1.0,)) -> FloatArray | None:
        """Return the gain for the least prescribed rate with which all poles decay at ``decay`` (1/s) or faster.

        The result is ``None`` if the equation has no solution.  The poles for a prescribed rate usually lie well beyond
        it, which costs noise.  ``drives`` are shares of the assumed process noise that are tried, one first: with less
        of it a filter may be quieter.
        """
        best, noise = self._quietest_of_drive(decay)
        for share in drives[1:] if best is not None and best.size else ():
            gain, less = replace(self, drive=share * self.drive)._quietest_of_drive(decay)
            if gain is None or not np.all(less <= noise):
                break
            best, noise = gain, less
        return best

    def _quietest_of_drive(self, decay: float) -> tuple[FloatArray | None, FloatArray]:
        """Return the gain of `quietest_gain` for this drive, and the deviation of each estimate."""
        start = np.eye(self.F.shape[0])
        best, change = self.solved(decay, start)
        noise = np.zeros(0) if best is None or not best.size else self.deviations(best, change)
        if not noise.size or decay == 0.0:
            return best, noise
        wanted, low, high = WELL_REACHED * decay, 0.0, decay
        for _ in range(RATE_BISECTIONS):
            middle = 0.5 * (low + high) if low > 0.0 else FIRST_SHARE * high
            gain, change = self.solved(middle, start)
            reached = 0.0 if gain is None else float(np.min(decay_rates(eigenvalues(self.F - gain @ self.C), self.dt)))
            if gain is None or reached < wanted:
                low = middle
                continue
            less = self.deviations(gain, change)
            if not np.all(less <= noise):
                break
            best, noise, high = gain, less, middle
        return best, noise

    def solved(
        self, decay: float, change: FloatArray, *, only_doubled: bool = False, roughly: bool = False
    ) -> tuple[FloatArray | None, FloatArray]:
        """Return the gain for a rate, and coordinates (like ``change``) in which its error covariance is the identity.

        With ``only_doubled`` the QZ algorithm, which is slow for many states, is not used: the gain may be ``None``.
        With ``roughly`` the first gain that reaches the rate is returned, without improvement.
        """
        if not self.F.size:
            return np.zeros((0, self.C.shape[0])), change
        # The part of the process noise that is correlated with the measurement noise is eliminated first.
        measured = self.D @ self.D.T + self.background @ self.background.T
        direct = np.linalg.solve(measured, self.D @ self.B.T).T
        free = self.F - direct @ self.C
        process = self.B @ self.B.T + self.drive @ self.drive.T - direct @ self.D @ self.B.T
        process = 0.5 * (process + process.T)
        bound = float(np.exp(-decay * self.dt)) if self.dt > 0.0 else -decay

        def reached(gain: FloatArray) -> bool:
            # The inequality is strict, since a rate that is only reached up to rounding does not count.
            return abscissa(self.F - (gain + direct) @ self.C, self.dt) < bound

        best: FloatArray | None = None
        for _ in range(KALMAN_ROUNDS):
            filtered = _filtered(
                free, self.C, process, measured, (bound, self.dt), change, reached=reached, only_doubled=only_doubled
            )
            if filtered is None:
                break
            gain, change, fast_enough = filtered
            if fast_enough:
                best = gain + direct
                if roughly:
                    break
        return best, change

    def deviations(self, gain: FloatArray, change: FloatArray) -> FloatArray:
        """Return the deviation of each estimate (unit intensity where dt = 0); ``gain (n, ny)``, ``change (n, n)``."""
        driving = np.asarray(np.linalg.solve(change, self.B - gain @ self.D), dtype=np.float64)
        moved = np.asarray(np.linalg.solve(change, (self.F - gain @ self.C) @ change), dtype=np.float64)
        direct = np.zeros((self.estimates.shape[0], driving.shape[1]))
        bound = 1.0 if self.dt > 0.0 else 0.0
        if not abscissa(moved, self.dt) < bound:
            # Stable in some coordinates and not in others, because of rounding.
            return np.full(len(direct), np.inf)
        covariance = noise_covariance(moved, driving, self.estimates @ change, direct, self.dt, is_stable=True)
        return np.asarray(np.sqrt(np.maximum(np.diag(covariance), 0.0)))


def _filtered(
    f: FloatArray,
    c: FloatArray,
    driven: FloatArray,
    measured: FloatArray,
    rate_bound: tuple[float, float],
    change: FloatArray,
    *,
    reached: Callable[[FloatArray], bool],
    only_doubled: bool,
) -> tuple[FloatArray, FloatArray, bool] | None:
    """Return the gain of a Kalman filter, coordinates in which its error covariance is the identity, and whether the
    gain reaches the rate."""
    bound, dt = rate_bound
    with warnings.catch_warnings(action="ignore"), np.errstate(all="ignore"):
        # The solution of a badly conditioned equation is judged by the poles.
        try:
            inverse = np.linalg.inv(change)
            moved, noise = inverse @ f @ change, inverse @ driven @ inverse.T
            moved = moved / bound if dt > 0.0 else moved - bound * np.eye(len(f))
            noise = 0.5 * (noise + noise.T)
            ways = (False,) if len(f) < DOUBLING_FROM else (True,) if only_doubled else (True, False)
            for doubled in ways:
                gain, covariance = _solved(moved, c @ change, noise, measured, dt, doubled=doubled)
                gain = change @ (bound * gain if dt > 0.0 else gain)
                fast_enough = bool(np.all(np.isfinite(gain))) and reached(gain)
                if fast_enough:
                    break
            values, vectors = np.linalg.eigh(0.5 * (covariance + covariance.T))
        except (np.linalg.LinAlgError, ValueError, ArithmeticError):
            return None
    if not np.all(np.isfinite(gain)) or not np.all(np.isfinite(values)) or values[-1] <= 0.0:
        return None
    floor = float(np.finfo(np.float64).eps) * values[-1]
    return np.asarray(gain), np.asarray(change @ (vectors * np.sqrt(np.maximum(values, floor)))), fast_enough


def _solved(
    f: FloatArray, c: FloatArray, noise: FloatArray, measured: FloatArray, dt: float, *, doubled: bool
) -> tuple[FloatArray, FloatArray]:
    """Return the gain and the error covariance of a Kalman filter, NaN if the equation is not solved.

    The equation is solved by doubling, or by the QZ algorithm, which takes several times as long and rarely fails.
    """
    if dt > 0.0:
        y = (doubled_solution if doubled else discrete_solution)(f, c, noise, measured, np.zeros((len(f), len(c))))
    else:
        y = (continuous_riccati_solution if doubled else continuous_solution)(f, c, noise, measured)
    if y is None:
        return np.full((len(f), len(c)), np.nan), np.eye(len(f))
    if dt > 0.0:
        return np.asarray(np.linalg.solve(c @ y @ c.T + measured, c @ y @ f.T).T), y
    return np.asarray(np.linalg.solve(measured, c @ y).T), y


def compromise(
    problem: KalmanProblem, rate: float, *, like: float | None = None
) -> tuple[FloatArray, float, float] | None:
    """Return the fastest gain ``(n, ny)``, up to ``rate`` (1/s), with at most `NOISE_PRICE` times the least noise.

    It is returned with its decay (1/s) and its noise ratio: the largest ratio of the deviation of an estimate to that
    of the Kalman gain without a prescribed rate.  ``like`` is the decay with other outputs as a share of ``rate``, near
    which the search begins.
    """
    start = np.eye(problem.F.shape[0])
    plain, change = problem.solved(0.0, start)
    slow = rate * 2.0**-MOST_RATE_HALVINGS
    while plain is None and slow <= rate:
        # The quietest filter may be so slow that its equation cannot be solved in double precision; then the one with
        # the least rate for which it can be solved is used.
        plain, change = problem.solved(slow, start)
        slow *= 2.0
    if plain is None:
        return None
    # Ratios are computed for each estimate, since their units differ.
    quietest = problem.deviations(plain, change)
    silent = SILENT * np.linalg.norm(problem.estimates, axis=1) * float(np.linalg.norm(problem.D))
    # A deviation that depends on the coordinates of its computation is rounding as well.
    again = problem.deviations(plain, start)
    counted = (quietest > silent) & np.isclose(quietest, again, rtol=SAME_DEVIATION, atol=0.0) & np.isfinite(quietest)

    many = len(problem.F) >= DOUBLING_FROM

    def attempt(
        decay: float, *, only_doubled: bool = False, roughly: bool = many
    ) -> tuple[FloatArray, float, float] | None:
        gain, change = problem.solved(decay, start, only_doubled=only_doubled, roughly=roughly)
        if gain is None:
            return None
        ratios = problem.deviations(gain, change)[counted] / quietest[counted]
        # No filter is quieter than the one without a rate, so that a ratio below one is rounding.
        price = float(np.max(ratios, initial=1.0))
        if roughly and abs(price - NOISE_PRICE) <= NEAR_THE_PRICE * NOISE_PRICE:
            return attempt(decay, only_doubled=only_doubled, roughly=False)
        return (gain, decay, price) if price <= NOISE_PRICE else None

    slowest = float(np.min(decay_rates(eigenvalues(problem.F - plain @ problem.C), problem.dt), initial=np.inf))
    # Rates below the decay of the quietest filter need not be tried.
    count = 1
    while count < MOST_RATE_HALVINGS and rate * 2.0**-count > slowest:
        count += 1
    best = fastest_halving(attempt, rate, count, one_by_one=not many, like=like)
    if best is None:
        return plain, 0.0, 1.0
    low, high = best[1], 2.0 * best[1]
    while best[1] < rate and high > RATE_STEP * low:
        middle = float(np.sqrt(low * high))
        trial = attempt(middle)
        if trial is None:
            high = middle
        else:
            best, low = trial, middle
    # For many states rates are compared by gains without improvement, in half the time; the final gain is improved.
    return attempt(best[1], roughly=False) or best if many else best


def fastest_halving(
    attempt: Callable[..., tuple[FloatArray, float, float] | None],
    rate: float,
    count: int,
    *,
    one_by_one: bool,
    like: float | None,
) -> tuple[FloatArray, float, float] | None:
    """Return the result of ``attempt`` for the fastest of ``rate, rate / 2, ...`` (``count`` rates) that has one.

    Without ``one_by_one``, for many states, the number of halvings is bisected, since noise grows with the rate.  High
    rates are nearly always too noisy and take the longest, since doubling fails for them.
    """
    trials: dict[int, tuple[FloatArray, float, float] | None] = {}

    def trial(halvings: int) -> tuple[FloatArray, float, float] | None:
        if halvings not in trials:
            trials[halvings] = attempt(rate * 2.0**-halvings)
        return trials[halvings]

    if not one_by_one:
        best = attempt(rate, only_doubled=True)
        # Invariant: fewer halvings than `low` do not suffice, and `high` halvings do.
        low, high = 0, 0 if best is not None else count
        near = None if like is None else math.ceil(-math.log2(like))
        while low < high:
            middle = near if near is not None and low <= near < high else (low + high) // 2
            further = trial(middle)
            if further is None:
                low = middle + 1
            else:
                best, high = further, middle
            if near is not None:
                near = middle + 1 if further is None else middle - 1
        if best is not None:
            return best
    # At lower rates the equation may not be solvable in double precision although it is at some higher rate.
    return next((found for found in map(trial, range(count)) if found is not None), None)
