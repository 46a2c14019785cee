"""Kalman gains with a prescribed rate of decay, and the price of that rate in noise.

Source: Share Pasand, Aliyari, Taghirad mention "the optimal estimation scheme of Kalman"; the prescribed rate is
Anderson and Moore's, and the default that needs no numbers is ours.
"""

from __future__ import annotations

import warnings
from dataclasses import dataclass

import numpy as np

from obsynth.numerics.arrays import FloatArray
from obsynth.numerics.spectra import abscissa, noise_covariance

#: The default pays at most this factor in noise, against the quietest Kalman filter, for being fast.
NOISE_PRICE = 10.0
#: The default rate is found to about this factor.
RATE_STEP = 1.05
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
        import control

        n = self.F.shape[0]
        if n == 0:
            return np.zeros((0, self.C.shape[0]))
        # The part of the process noise that the measurements carry is taken out first.
        measured = self.D @ self.D.T + self.background @ self.background.T
        direct = np.linalg.solve(measured, self.D @ self.B.T).T
        free = self.F - direct @ self.C
        rest = self.B @ self.B.T + self.drive @ self.drive.T - direct @ self.D @ self.B.T
        rest = 0.5 * (rest + rest.T)
        with warnings.catch_warnings(), np.errstate(all="ignore"):
            # What a badly conditioned equation gives is judged below, by its poles.
            warnings.simplefilter("ignore")
            try:
                if self.dt > 0.0:
                    radius = np.exp(-decay * self.dt)
                    found = radius * control.dlqe(free / radius, np.eye(n), self.C, rest, measured)[0]
                else:
                    found = control.lqe(free + decay * np.eye(n), np.eye(n), self.C, rest, measured)[0]
            except (np.linalg.LinAlgError, ValueError, ArithmeticError):
                return None
        total = np.asarray(found) + direct
        if not np.all(np.isfinite(total)):
            return None
        bound = np.exp(-decay * self.dt) if self.dt > 0.0 else -decay
        # Strictly: a rate that is only met within rounding is none.
        return total if abscissa(self.F - total @ self.C, self.dt) < bound else None

    def deviations(self, gain: FloatArray) -> FloatArray:
        """Return the standard deviation of each estimate under the noise that counts (for unit intensity, dt = 0)."""
        entering = self.B - gain @ self.D
        direct = np.zeros((self.estimates.shape[0], entering.shape[1]))
        covariance = noise_covariance(self.F - gain @ self.C, entering, self.estimates, direct, self.dt)
        return np.asarray(np.sqrt(np.maximum(np.diag(covariance), 0.0)))


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
    counted = quietest > 0.0
    best = Compromise(plain, 0.0, 1.0)

    def attempt(decay: float) -> Compromise | None:
        gain = problem.gain(decay)
        if gain is None:
            return None
        price = float(np.max(problem.deviations(gain)[counted] / quietest[counted], initial=0.0))
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
