"""What noise does to estimates by an injection K, as a function of K: what given poles leave free is spent on it.

With ``e+ = (F - K C) e + (B - K D) w`` (e' for dt = 0), w white, and estimates ``T e`` the mean square is
``tr T P T'``, P the covariance; by Q, the Gramian of the estimates, its slope in K is
``-2 Q ((F - K C) P C' + (B - K D) D')``, in continuous time ``-2 Q (P C' + (B - K D) D')``.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from obsynth.numerics.arrays import FloatArray
from obsynth.numerics.matrix_equations import continuous_lyapunov, discrete_lyapunov


@dataclass(frozen=True, eq=False)
class PlacedNoise:
    """The mean square of estimates, of the errors of an injection."""

    F: FloatArray  # (n, n)
    C: FloatArray  # (ny, n)
    B: FloatArray  # (n, k)
    D: FloatArray  # (ny, k)
    estimates: FloatArray  # (m, n)
    dt: float  # s, 0 for continuous time

    def value_and_slope(self, gain: FloatArray) -> tuple[float, FloatArray]:
        """Return the mean square for a gain ``(n, ny)`` that makes the errors decay, and its slope in each entry."""
        a, driven, read = self.F - gain @ self.C, self.B - gain @ self.D, self.estimates
        if self.dt > 0.0:
            covariance = discrete_lyapunov(a, driven @ driven.T, method="bilinear")
            gramian = discrete_lyapunov(a.T, read.T @ read, method="bilinear")
            moved = a @ covariance
        else:
            covariance, gramian = continuous_lyapunov(a, -driven @ driven.T), continuous_lyapunov(a.T, -read.T @ read)
            moved = covariance
        value = float(np.trace(read @ covariance @ read.T))
        return value, np.asarray(-2.0 * gramian @ (moved @ self.C.T + driven @ self.D.T))
