"""The Riccati equation of a Kalman filter with a prescribed rate of decay, in coordinates of choice."""

from __future__ import annotations

import warnings

import numpy as np

from obsynth.numerics.arrays import FloatArray
from obsynth.numerics.doubling import continuous_riccati_solution, doubled_riccati_solution
from obsynth.numerics.spectra import abscissa

#: From so many states on the equation is solved by doubling first.
MANY_STATES = 40


def kalman_filter(
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
