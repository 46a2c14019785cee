"""The default gain, which needs no numbers: as fast as a fixed price in noise allows.  This compromise is ours."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from obsynth.methods.placement.kalman import KalmanProblem
from obsynth.numerics.arrays import FloatArray
from obsynth.numerics.spectra import decay_rates, eigenvalues

#: The default pays at most this factor in noise, against the quietest Kalman filter, for being fast.
NOISE_PRICE = 10.0
#: The default rate is found to about this factor.
RATE_STEP = 1.05
#: Estimates with less than this share of the outputs' noise have none but rounding.
SILENT = 1e-8
#: Deviations that differ by more than this share from one choice of states to another are rounding.
SAME_DEVIATION = 0.1
#: Halvings of the default rate before the quietest filter is taken as it is.
MOST_HALVINGS = 40


@dataclass(frozen=True, eq=False)
class Compromise:
    """What the default found.

    Fields: K: ``(n, ny)``; decay: 1/s; price: Largest ratio of the standard deviation of an estimate to that with the
    Kalman gain without a rate.
    """

    K: FloatArray
    decay: float
    price: float


def compromise(problem: KalmanProblem, rate: float) -> Compromise | None:
    """Return the fastest gain, up to ``rate`` (1/s), that costs at most `NOISE_PRICE` in noise.

    The plain Kalman filter leaves modes slow that cost much to see (-0.0085 on the Kundur network); a fixed rate may
    cost any amount of noise.
    """
    start = np.eye(problem.F.shape[0])
    plain, change = problem.solved(0.0, start)
    if plain is None:
        return None
    # Each estimate by itself: they have units of their own.
    quietest = problem.deviations(plain, change)
    silent = SILENT * np.linalg.norm(problem.estimates, axis=1) * float(np.linalg.norm(problem.D))
    # A deviation that depends on the coordinates it is computed in is rounding, too.
    again = problem.deviations(plain, start)
    counted = (quietest > silent) & np.isclose(quietest, again, rtol=SAME_DEVIATION, atol=0.0) & np.isfinite(quietest)
    best = Compromise(plain, 0.0, 1.0)

    def attempt(decay: float) -> Compromise | None:
        gain, change = problem.solved(decay, start)
        if gain is None:
            return None
        ratios = problem.deviations(gain, change)[counted] / quietest[counted]
        price = float(np.max(ratios)) if ratios.size else 1.0
        return Compromise(gain, decay, price) if price <= NOISE_PRICE else None

    high = rate
    slowest = float(np.min(decay_rates(eigenvalues(problem.F - plain @ problem.C), problem.dt), initial=np.inf))
    for _ in range(MOST_HALVINGS):
        found = attempt(high)
        if found is not None:
            best = found
            break
        high /= 2.0
        if high <= slowest:
            # The quietest filter is as fast as that by itself.
            break
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
