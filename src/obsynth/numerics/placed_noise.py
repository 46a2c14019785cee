"""Variance of estimates as a function of the injection gain K, with its gradient, for pole placement with little noise.

The error is ``e+ = (F - K C) e + (B - K D) w`` (e' for dt = 0) with white noise w, and the estimates have the error
``T e``.  Their mean square is ``tr T P T'`` with the covariance P.  With the observability Gramian Q of the estimates
its gradient in K is ``-2 Q ((F - K C) P C' + (B - K D) D')``, in continuous time ``-2 Q (P C' + (B - K D) D')``.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from obsynth.numerics.arrays import SMALLEST, FloatArray
from obsynth.numerics.matrix_equations import continuous_lyapunov, discrete_lyapunov


@dataclass(frozen=True, eq=False)
class PlacedNoise:
    """The error system of an injection with white noise, and the mean square of its estimates."""

    F: FloatArray  # (n, n)
    C: FloatArray  # (ny, n)
    B: FloatArray  # (n, k)
    D: FloatArray  # (ny, k)
    estimates: FloatArray  # (m, n)
    dt: float  # s, 0 for continuous time

    def rounded(self, to_digits: Callable[[FloatArray], FloatArray]) -> PlacedNoise:
        """Return the same with rounded matrices, after scaling noise and estimates to size one."""
        of_noise = max(float(np.linalg.norm(self.D)), float(np.linalg.norm(self.B)), SMALLEST)
        of_estimates = max(float(np.linalg.norm(self.estimates)), SMALLEST)
        return PlacedNoise(
            F=to_digits(self.F),
            C=to_digits(self.C),
            B=to_digits(self.B / of_noise),
            D=to_digits(self.D / of_noise),
            estimates=to_digits(self.estimates / of_estimates),
            dt=self.dt,
        )

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
