"""Stationary covariances with known accuracy, by ball arithmetic where two computations in double precision disagree.

Let ``X = A X A' + B B'``.  With ``P = A^(2^k)`` and the sum S of the first 2^k terms, ``X = S + P X P'``, so that the
remainder is at most ``|P|^2 |S| / (1 - |P|^2)``.  In continuous time ``(p - A)^-1 (p + A)`` with any p > 0 takes the
place of A.
"""

from __future__ import annotations

from typing import Any

import flint
import numpy as np

from obsynth.numerics.arrays import FloatArray, largest_singular_value
from obsynth.numerics.norms import balanced_realisation
from obsynth.numerics.spectra import abscissa, noise_covariance
from obsynth.proofs.extended_balls import arb_matrix, middles

#: A variance in double precision is accepted if two computations differ by at most this share.
SURE_DIFFERENCE = 1e-6

#: With more states there is no enclosure, and a difference up to AGREEMENT is accepted.
MOST_ENCLOSED_STATES, AGREEMENT = 40, 1e-2

#: Bits of the ball arithmetic, tried in turn, most doublings of the number of terms, and the accepted relative radius.
TRIED_BITS, MOST_COVARIANCE_DOUBLINGS, RADIUS = (160, 640), 100, 1e-9


def certain_noise_covariance(a: FloatArray, b: FloatArray, c: FloatArray, d: FloatArray, dt: float) -> FloatArray:
    """Return the covariance of the outputs under unit white noise, or NaN where no computation of it is reliable.

    It is `noise_covariance` where the dual computation has the same trace, and the enclosed one otherwise.  It is
    infinite only where a pole lies on or outside the stability boundary, not where rounding errors grow.
    """
    covariance = noise_covariance(a, b, c, d, dt)
    # A negative variance, which is a rounding error, fails this comparison as well.
    variance, again = float(np.trace(covariance)), float(np.trace(noise_covariance(a.T, c.T, b.T, d.T, dt)))
    if np.isfinite(variance) and abs(variance - again) <= SURE_DIFFERENCE * variance:
        return covariance
    exact = enclosed_noise_covariance(a, b, c, d, dt)
    if exact is not None:
        return exact
    if np.isfinite(variance):
        known = abs(variance - again) <= AGREEMENT * variance
    else:
        known = not np.isfinite(again) and not abscissa(a, dt) < (1.0 if dt > 0.0 else 0.0)
    return covariance if known else np.full_like(covariance, np.nan)


def enclosed_noise_covariance(
    a: FloatArray, b: FloatArray, c: FloatArray, d: FloatArray, dt: float
) -> FloatArray | None:
    """Return the covariance to nine proved digits; ``None`` where these cannot be proved."""
    if not 0 < len(a) <= MOST_ENCLOSED_STATES or not all(np.all(np.isfinite(part)) for part in (a, b, c, d)):
        return None
    # Balanced states need fewer bits; the factors are powers of two, so that no number is rounded.
    a, b, c = balanced_realisation(a, b, c)
    for bits in TRIED_BITS:
        with flint.ctx.workprec(bits):
            driven = arb_matrix(b) * arb_matrix(b).transpose()
            states = enclosed_sum(arb_matrix(a), driven, largest_singular_value(a) or 1.0, discrete=dt > 0.0)
            if states is None:
                continue
            outputs = arb_matrix(c) * states * arb_matrix(c).transpose()
            if dt > 0.0:
                outputs = outputs + arb_matrix(d) * arb_matrix(d).transpose()
            values = np.reshape(outputs.entries(), (len(c), len(c)))
            covariance = middles(outputs)
            radii = np.array([[float(value.rad()) for value in row] for row in values]).reshape(values.shape)
        sizes = np.sqrt(np.maximum(np.diag(covariance), 0.0))
        if np.all(np.isfinite(covariance)) and np.all(radii <= RADIUS * np.outer(sizes, sizes)):
            return covariance
    return None


def enclosed_sum(a: Any, weight: Any, size: float, *, discrete: bool) -> Any | None:
    """Return balls that contain X with ``X = a X a' + weight``, in continuous time ``a X + X a' + weight = 0``.

    ``a`` and ``weight`` are `flint.arb_mat`.  ``size`` is the p of the transformation in continuous time, best near the
    size of ``a``.  ``None`` where the powers of ``a`` do not decay.
    """
    n = a.nrows()
    states, power = weight, a
    if not discrete:
        identity = flint.arb_mat(n, n, [float(i == j) for i in range(n) for j in range(n)]) * flint.arb(size)
        try:
            inverse = (identity - a).inv()
        except ZeroDivisionError:
            return None
        states, power = inverse * states * inverse.transpose() * flint.arb(2.0 * size), inverse * (identity + a)
    for _ in range(MOST_COVARIANCE_DOUBLINGS):
        states, power = states + power * states * power.transpose(), power * power
        decay = squared_norm(power)
        if not decay.is_finite():
            return None
        if decay < flint.arb(2) ** (-flint.ctx.prec):
            remainder = (decay * squared_norm(states).sqrt() / (1 - decay)).upper()
            ball = flint.arb(0, remainder)
            return states + flint.arb_mat(n, n, [ball] * (n * n))
    return None


def squared_norm(matrix: Any) -> Any:
    """Return a ball that contains the squared Frobenius norm."""
    return sum((value * value for value in matrix.entries()), flint.arb(0))
