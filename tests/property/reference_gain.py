"""The least gain by a second route: central H-infinity filters from Riccati equations, no matrix inequality, no solver.

For every level the central filter of the problem with a little artificial noise is computed, and its true gain on the
problem without that noise.  The best of them is an upper bound on the least gain, and close to it.
"""

from __future__ import annotations

import warnings
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.linalg import null_space, solve_discrete_are

import obsynth
from obsynth.numerics.norms import hinf_norm

Array = np.ndarray[Any, np.dtype[np.float64]]
NOISES = (1e-1, 1e-2, 1e-3, 1e-4, 1e-5)


@dataclass(frozen=True)
class ErrorProblem:
    """``e+ = (A - R C) e + (B - R D) d``, fault error ``(Z + V C) e + (Zd + V D) d``, with R and perhaps V free."""

    A: Array
    B: Array
    C: Array
    D: Array
    Z: Array
    Zd: Array
    free_weight: bool

    @classmethod
    def of(cls, design: obsynth.ObserverDesign, *, free_weight: bool = False) -> ErrorProblem:
        """Return the problem behind ``design`` (no sensor faults), for its T, N and W; R and perhaps V start afresh."""
        plant, gains = design.plant, design.gains
        t, n, w, psi, upsilon = (gains[name] for name in ("T", "N", "W", "Psi", "Upsilon"))
        ta, outputs = t @ plant.A, np.eye(plant.ny) - plant.C @ n
        v = null_space(upsilon.T).T
        first = ta @ psi @ w
        bd, dd = t @ plant.Bd - ta @ n @ plant.Dd, outputs @ plant.Dd
        return cls(ta - first @ plant.C, bd - first @ dd, v @ plant.C, v @ dd, w @ plant.C, w @ dd, free_weight)

    def achieved(self, r: Array, v: Array) -> float:
        """Return the true gain with the given gains, infinite when unstable."""
        return hinf_norm(self.A - r @ self.C, self.B - r @ self.D, self.Z + v @ self.C, self.Zd + v @ self.D).upper

    def central(self, level: float, noise: float) -> tuple[Array, Array] | None:
        """Return the gains of the central filter at ``level``, or nothing when the equation has no solution."""
        n, m, q = len(self.A), len(self.C), len(self.Z)
        size = np.linalg.norm(self.B, 2)
        through = max(np.linalg.norm(self.D, 2), np.linalg.norm(self.C, 2) * size)
        b = np.hstack([self.B, noise * size * np.eye(n), np.zeros((n, m))])
        d = np.hstack([self.D, np.zeros((m, n)), noise * through * np.eye(m)])
        zd = np.hstack([self.Zd, np.zeros((q, n + m))])
        h, k = np.vstack([self.C, self.Z]), np.vstack([d, zd])
        weight = k @ k.T - np.diag([0.0] * m + [level**2] * q)
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")  # many levels have no solution: that is what is being looked for
                y = solve_discrete_are(self.A.T, h.T, b @ b.T, weight, s=b @ k.T)
                total, gains = weight + h @ y @ h.T, self.A @ y @ h.T + b @ k.T
                if self.free_weight:
                    inverse = np.linalg.inv(total[:m, :m])
                    return gains[:, :m] @ inverse, -total[m:, :m] @ inverse
                change = np.linalg.solve(total[m:, m:], total[m:, :m])
                schur = total[:m, :m] - total[:m, m:] @ change
                return (gains[:, :m] - gains[:, m:] @ change) @ np.linalg.inv(schur), np.zeros((q, m))
        except (np.linalg.LinAlgError, ValueError):
            return None

    def best(self, start: float) -> float:
        """Return the least gain found below ``start``."""
        least = start
        for noise in NOISES:
            low, high = 0.0, start
            for _ in range(25):
                level = 0.5 * (low + high)
                found = self.central(level, noise)
                reached = self.achieved(*found) if found is not None and np.all(np.isfinite(found[0])) else np.inf
                least = min(least, reached)
                low, high = (low, level) if reached <= level * (1.0 + 1e-6) else (level, high)
        return least
