"""System norms of continuous-time realisations ``(A, B, C, D)``, with numpy alone: through the bilinear transform."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from obsynth.numerics.arrays import FloatArray
from obsynth.numerics.norms import hinf_norm


@dataclass(frozen=True)
class ContinuousHinfNorm:
    """The H-infinity norm of a stable continuous-time system.

    Fields: value: Largest singular value found on the imaginary axis: a lower bound that is attained; upper: Level that
    no singular value exceeds, as far as double precision can tell (computed, not proved); frequency: Where the peak is,
    rad/s; infinite when it is the feedthrough.
    """

    value: float
    upper: float
    frequency: float


def spectral_abscissa(a: FloatArray) -> float:
    """Return the largest real part of an eigenvalue of ``a (n, n)``; minus infinity for no states, NaN for NaN."""
    if not a.size:
        return -np.inf
    if not np.all(np.isfinite(a)):
        return float("nan")
    return float(np.max(np.linalg.eigvals(a).real))


def continuous_hinf_norm(a: FloatArray, b: FloatArray, c: FloatArray, d: FloatArray) -> ContinuousHinfNorm:
    r"""Return the H-infinity norm of a continuous-time system.

    The substitution ``s = w (z - 1) / (z + 1)`` takes the imaginary axis to the unit circle and keeps every gain, so
    the norm is that of a discrete-time system; w is the geometric mean of the moduli of the eigenvalues.

    Shapes: ``a (n, n)``, ``b (n, m)``, ``c (p, n)``, ``d (p, m)``.
    """
    if b.shape[1] == 0 or c.shape[0] == 0:
        return ContinuousHinfNorm(0.0, 0.0, 0.0)
    n = a.shape[0]
    if not all(np.all(np.isfinite(part)) for part in (a, b, c, d)) or (n and spectral_abscissa(a) >= 0.0):
        return ContinuousHinfNorm(np.inf, np.inf, np.nan)
    if n == 0:
        size = float(np.linalg.norm(d, 2))
        return ContinuousHinfNorm(size, size, 0.0)
    w = float(np.exp(np.mean(np.log(np.abs(np.linalg.eigvals(a))))))
    resolvent = np.linalg.inv(w * np.eye(n) - a)
    through = resolvent @ b
    found = hinf_norm(
        resolvent @ (w * np.eye(n) + a), np.sqrt(2.0 * w) * through, np.sqrt(2.0 * w) * c @ resolvent, d + c @ through
    )
    frequency = np.inf if found.angle >= np.pi else w * float(np.tan(0.5 * found.angle))
    return ContinuousHinfNorm(found.value, found.upper, float(frequency))
