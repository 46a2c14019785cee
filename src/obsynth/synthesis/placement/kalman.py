"""Kalman gains with a prescribed rate of decay, and the price of that rate in noise.

Source: Share Pasand, Aliyari, Taghirad mention "the optimal estimation scheme of Kalman"; the prescribed rate is
Anderson and Moore's, and the default that needs no numbers is ours.
"""

from __future__ import annotations

import warnings
from dataclasses import dataclass

import numpy as np

from obsynth.numerics.arrays import FloatArray
from obsynth.numerics.doubling import continuous_riccati_solution, doubled_riccati_solution
from obsynth.numerics.spectra import abscissa, noise_covariance

#: The default pays at most this factor in noise, against the quietest Kalman filter, for being fast.
NOISE_PRICE = 10.0
#: The default rate is found to about this factor.
RATE_STEP = 1.05
#: Times the Riccati equation is solved, each time in the coordinates of the last solution, which improve it.
ROUNDS = 2
#: Estimates with less than this share of the outputs' noise have none but rounding.
SILENT = 1e-8
#: From so many states on the Riccati equation is solved by doubling first.
MANY_STATES = 40
#: Halvings of the default rate before the quietest filter is taken as it is.
MOST_HALVINGS = 12


@dataclass(frozen=True, eq=False)
class KalmanProblem:
    """A pair with noise: ``e+ = F e + B w + drive v``, innovation ``C e + D w + background n``.

    Parameters
    ----------
    F, C : FloatArray
        ``(n, n)`` and ``(ny, n)``, observable.
    B, D : FloatArray
        ``(n, k)`` and ``(ny, k)``: how the noise that counts, of unit covariance (intensity for ``dt == 0``), enters.
    drive : FloatArray
        ``(n, p)``: what the states are driven by besides, so that the filter stays awake.
    background : FloatArray
        ``(ny, q)``: keeps the equation regular where an innovation has no noise.
    estimates : FloatArray
        ``(k, n)``: what the noise is counted in, the fault estimates.
    dt : float
        Seconds between samples, 0 for continuous time.
    """

    F: FloatArray
    C: FloatArray
    B: FloatArray
    D: FloatArray
    drive: FloatArray
    background: FloatArray
    estimates: FloatArray
    dt: float

    def gain(self, decay: float) -> FloatArray | None:
        """Return the gain whose poles all decay at ``decay`` (1/s) or faster; ``None`` when the equation has none.

        References
        ----------
        .. [AndersonMoore1971] B. D. O. Anderson, J. B. Moore, "Linear optimal control", 1971, section 4.
        """
        n = self.F.shape[0]
        if n == 0:
            return np.zeros((0, self.C.shape[0]))
        # The part of the process noise that the measurements carry is taken out first.
        measured = self.D @ self.D.T + self.background @ self.background.T
        direct = np.linalg.solve(measured, self.D @ self.B.T).T
        free = self.F - direct @ self.C
        rest = self.B @ self.B.T + self.drive @ self.drive.T - direct @ self.D @ self.B.T
        rest = 0.5 * (rest + rest.T)
        bound = float(np.exp(-decay * self.dt)) if self.dt > 0.0 else -decay
        best: FloatArray | None = None
        change = np.eye(n)
        for _ in range(ROUNDS):
            found = _filtered(free, self.C, rest, measured, (bound, self.dt), change)
            if found is None:
                break
            total = found[0] + direct
            # Strictly: a rate that is only met within rounding is none.
            if abscissa(self.F - total @ self.C, self.dt) < bound:
                best = total
            change = found[1]
        return best

    def deviations(self, gain: FloatArray) -> FloatArray:
        """Return the standard deviation of each estimate under the noise that counts (for unit intensity, dt = 0)."""
        entering = self.B - gain @ self.D
        direct = np.zeros((self.estimates.shape[0], entering.shape[1]))
        covariance = noise_covariance(self.F - gain @ self.C, entering, self.estimates, direct, self.dt)
        return np.asarray(np.sqrt(np.maximum(np.diag(covariance), 0.0)))


def _filtered(
    f: FloatArray,
    c: FloatArray,
    driven: FloatArray,
    measured: FloatArray,
    asked: tuple[float, float],
    change: FloatArray,
) -> tuple[FloatArray, FloatArray] | None:
    """Return the gain of a Kalman filter, and states in which its error covariance is the identity.

    Parameters
    ----------
    f, c, driven, measured : FloatArray
        The pair and its noise covariances, uncorrelated.
    asked : tuple of float
        Bound of the poles, and seconds between samples.
    change : FloatArray
        ``(n, n)``: the equation is solved in states ``change^-1 e``.
    """
    bound, dt = asked
    with warnings.catch_warnings(), np.errstate(all="ignore"):
        # What a badly conditioned equation gives is judged by its poles.
        warnings.simplefilter("ignore")
        try:
            inverse = np.linalg.inv(change)
            moved, noise = inverse @ f @ change, inverse @ driven @ inverse.T
            moved = moved / bound if dt > 0.0 else moved - bound * np.eye(len(f))
            noise = 0.5 * (noise + noise.T)
            for equation in (_by_doubling, _by_the_library) if len(f) >= MANY_STATES else (_by_the_library,):
                found, covariance = equation(moved, c @ change, noise, measured, dt)
                gain = change @ (bound * found if dt > 0.0 else found)
                values, vectors = np.linalg.eigh(0.5 * (covariance + covariance.T))
                if np.all(np.isfinite(gain)) and abscissa(f - gain @ c, dt) < bound:
                    break
        except (np.linalg.LinAlgError, ValueError, ArithmeticError):
            return None
    if not np.all(np.isfinite(gain)) or not np.all(np.isfinite(values)) or values[-1] <= 0.0:
        return None
    floor = float(np.finfo(np.float64).eps) * values[-1]
    return np.asarray(gain), np.asarray(change @ (vectors * np.sqrt(np.maximum(values, floor))))


def _by_doubling(
    f: FloatArray, c: FloatArray, noise: FloatArray, measured: FloatArray, dt: float
) -> tuple[FloatArray, FloatArray]:
    """Return gain and error covariance of a Kalman filter; NaN where the doubling breaks down."""
    nothing = np.full((len(f), len(c)), np.nan)
    if dt > 0.0:
        y = doubled_riccati_solution(f, c, noise, measured, np.zeros_like(nothing))
        if y is None:
            return nothing, np.eye(len(f))
        return np.asarray(np.linalg.solve(c @ y @ c.T + measured, c @ y @ f.T).T), y
    y = continuous_riccati_solution(f, c, noise, measured)
    if y is None:
        return nothing, np.eye(len(f))
    return np.asarray(np.linalg.solve(measured, c @ y).T), y


def _by_the_library(
    f: FloatArray, c: FloatArray, noise: FloatArray, measured: FloatArray, dt: float
) -> tuple[FloatArray, FloatArray]:
    """Return the same by the QZ algorithm, which takes several times as long and hardly ever breaks down."""
    import control

    # By scipy, so that no gain depends on whether slycot is there.
    solve = control.dlqe if dt > 0.0 else control.lqe
    found, covariance, _ = solve(f, np.eye(len(f)), c, noise, measured, method="scipy")
    return np.asarray(found), np.asarray(covariance)


@dataclass(frozen=True, eq=False)
class Compromise:
    """What the default found.

    Parameters
    ----------
    K : FloatArray
        ``(n, ny)``.
    decay : float
        1/s.
    price : float
        Largest ratio of the standard deviation of an estimate to that with the Kalman gain without a rate.
    """

    K: FloatArray
    decay: float
    price: float


def compromise(problem: KalmanProblem, rate: float) -> Compromise | None:
    """Return the fastest gain, up to ``rate`` (1/s), that costs at most `NOISE_PRICE` in noise.

    The plain Kalman filter leaves modes slow that cost much to see (-0.0085 on the Kundur network); a fixed rate may
    cost any amount of noise.

    Parameters
    ----------
    problem : KalmanProblem
        The pair and its noise.
    rate : float, 1/s
        As fast as makes sense for the plant.
    """
    plain = problem.gain(0.0)
    if plain is None:
        return None
    # Each estimate by itself: they have units of their own.
    quietest = problem.deviations(plain)
    silent = SILENT * np.linalg.norm(problem.estimates, axis=1) * float(np.linalg.norm(problem.D))
    counted = (quietest > silent) & np.isfinite(quietest)
    best = Compromise(plain, 0.0, 1.0)

    def attempt(decay: float) -> Compromise | None:
        gain = problem.gain(decay)
        if gain is None:
            return None
        ratios = problem.deviations(gain)[counted] / quietest[counted]
        price = float(np.max(ratios)) if ratios.size else 1.0
        return Compromise(gain, decay, price) if price <= NOISE_PRICE else None

    high = rate
    for _ in range(MOST_HALVINGS):
        found = attempt(high)
        if found is not None:
            best = found
            break
        high /= 2.0
    if best.decay in (0.0, rate):
        return best
    low, high = best.decay, 2.0 * best.decay
    while high > RATE_STEP * low:
        middle = float(np.sqrt(low * high))
        found = attempt(middle)
        if found is None:
            high = middle
        else:
            best, low = found, middle
    return best
