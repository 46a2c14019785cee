"""Kalman gains with a prescribed rate of decay (Anderson, Moore, "Linear optimal control", 1971, section 4).

The default needs no numbers: as fast as a fixed price in noise allows.  This compromise is ours.
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

#: Times the Riccati equation is solved, each time in the coordinates of the last solution, which improve it.
KALMAN_ROUNDS = 2

#: From so many states on the Riccati equation is solved by doubling first: at 40 states 1 to 2 ms for 12 to 15 ms of
#: the QZ algorithm.
DOUBLING_FROM = 40

#: A rate that cannot be had at once is gone to in steps of this factor, from one that is at most so many below.
RATE_FACTOR = 4.0

MOST_RATE_STEPS = 12

#: Steps are shortened down to this factor.
LEAST_FACTOR = 1.2

#: A rate that is asked for is reached by this factor at least, or rounding would decide whether it is.
WELL_REACHED = 1.001

#: Rates that are tried below the one that is asked for: the first is half of it, where integrators have poles at twice
#: the rate; then the interval is halved.
FIRST_SHARE, RATE_BISECTIONS = 0.5, 6

#: The default pays at most this factor in noise, against the quietest Kalman filter, for being fast.
NOISE_PRICE = 10.0

#: The default rate is found to about this factor.
RATE_STEP = 1.05

#: Estimates with less than this share of the outputs' noise have none but rounding.
SILENT = 1e-8

#: Deviations that differ by more than this share from one choice of states to another are rounding.
SAME_DEVIATION = 0.1

#: A price nearer to the highest than by this share is told by the improved equation.
NEAR_THE_PRICE = 0.01

#: Halvings of the default rate before the quietest filter is taken as it is.
MOST_RATE_HALVINGS = 40


@dataclass(frozen=True, eq=False)
class KalmanProblem:
    """An observable pair with noise: ``e+ = F e + B w + drive v``, innovation ``C e + D w + background n``."""

    F: FloatArray  # (n, n)
    C: FloatArray  # (ny, n)
    B: FloatArray  # (n, k), for noise that counts, of unit covariance (dt = 0: intensity)
    D: FloatArray  # (ny, k)
    drive: FloatArray  # (n, p): so that the filter stays awake
    background: FloatArray  # (ny, q): regular where an innovation has no noise
    estimates: FloatArray  # (k, n): what the noise is counted in, the fault estimates
    dt: float  # s, 0 for continuous time

    def gain(self, decay: float, *, persistent: bool = False) -> FloatArray | None:
        """Return the gain whose poles all decay at ``decay`` (1/s) or faster; ``None`` when the equation has none."""
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
            # By shorter steps where one fails: how long a step may be is a matter of rounding.
            further = min(rate * factor, decay)
            gain, moved = self.solved(further, change)
            if gain is None:
                factor = float(np.sqrt(factor))
            else:
                best, change, rate = gain, moved, further
        return best if rate == decay else None

    def quietest_gain(self, decay: float, *, drives: Sequence[float] = (1.0,)) -> FloatArray | None:
        """Return the gain of the least prescribed rate whose poles all decay at ``decay`` (1/s) or faster; ``None``
        when the equation has none.  Poles of a rate lie well beyond it, which costs noise.

        ``drives``: shares of the drive, the whole first: a filter that is kept awake by less of it may be quieter."""
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
        """Return the gain of a rate, and coordinates (like ``change``) in which its error covariance is one.

        ``only_doubled``: of many states, ``None`` rather than the time of the QZ algorithm. ``roughly``: the first gain
        that reaches the rate, not improved."""
        if not self.F.size:
            return np.zeros((0, self.C.shape[0])), change
        # The part of the process noise that the measurements carry is taken out first.
        measured = self.D @ self.D.T + self.background @ self.background.T
        direct = np.linalg.solve(measured, self.D @ self.B.T).T
        free = self.F - direct @ self.C
        process = self.B @ self.B.T + self.drive @ self.drive.T - direct @ self.D @ self.B.T
        process = 0.5 * (process + process.T)
        bound = float(np.exp(-decay * self.dt)) if self.dt > 0.0 else -decay

        def reached(gain: FloatArray) -> bool:
            # Strictly: a rate that is only met within rounding is none.
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
            # Stable in some coordinates and not in others: only rounding tells.
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
    """Return the gain of a Kalman filter, states in which its error covariance is the identity, and whether the gain
    has reached the rate."""
    bound, dt = rate_bound
    with warnings.catch_warnings(action="ignore"), np.errstate(all="ignore"):
        # What a badly conditioned equation gives is judged by its poles.
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
    """Return gain and error covariance of a Kalman filter, NaN where the equation is not solved: by doubling, or by the
    QZ algorithm, which takes several times as long and hardly ever breaks down."""
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
    """Return the fastest gain ``(n, ny)``, up to ``rate`` (1/s), that costs at most `NOISE_PRICE` in noise; its decay
    (1/s), and the largest deviation of an estimate over that of the Kalman gain without a rate.

    ``like``: the share of the rate that the plant's gain has with other outputs, near which the search begins."""
    start = np.eye(problem.F.shape[0])
    plain, change = problem.solved(0.0, start)
    slow = rate * 2.0**-MOST_RATE_HALVINGS
    while plain is None and slow <= rate:
        # The quietest filter may be so slow that its equation is lost in rounding: that of some rate is not.
        plain, change = problem.solved(slow, start)
        slow *= 2.0
    if plain is None:
        return None
    # Each estimate by itself: they have units of their own.
    quietest = problem.deviations(plain, change)
    silent = SILENT * np.linalg.norm(problem.estimates, axis=1) * float(np.linalg.norm(problem.D))
    # A deviation that depends on the coordinates it is computed in is rounding, too.
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
        # None is quieter than the filter without a rate: what is less is rounding in that one.
        price = float(np.max(ratios, initial=1.0))
        if roughly and abs(price - NOISE_PRICE) <= NEAR_THE_PRICE * NOISE_PRICE:
            return attempt(decay, only_doubled=only_doubled, roughly=False)
        return (gain, decay, price) if price <= NOISE_PRICE else None

    slowest = float(np.min(decay_rates(eigenvalues(problem.F - plain @ problem.C), problem.dt), initial=np.inf))
    # The quietest filter is as fast as what is left by itself.
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
    # Rates are compared by gains that were not improved, which takes half as long; the one that is taken is.
    return attempt(best[1], roughly=False) or best if many else best


def fastest_halving(
    attempt: Callable[..., tuple[FloatArray, float, float] | None],
    rate: float,
    count: int,
    *,
    one_by_one: bool,
    like: float | None,
) -> tuple[FloatArray, float, float] | None:
    """Return what the fastest of ``rate, rate / 2, ...`` that is cheap enough comes to; none of ``count`` may be.

    Of many states the number of halvings is bisected, as noise grows with the rate: high rates, which nearly always
    are too noisy, take longest, as doubling breaks down there."""
    trials: dict[int, tuple[FloatArray, float, float] | None] = {}

    def trial(halvings: int) -> tuple[FloatArray, float, float] | None:
        if halvings not in trials:
            trials[halvings] = attempt(rate * 2.0**-halvings)
        return trials[halvings]

    if not one_by_one:
        best = attempt(rate, only_doubled=True)
        # No fewer halvings than `low` are enough, and `high` are.
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
    # An equation may be lost in rounding at a lower rate than one that is cheap enough.
    return next((found for found in map(trial, range(count)) if found is not None), None)
