"""Statistics of a change: weighted squares, two-sided cumulative sums, tails of chi-square; runs are leading axes."""

from __future__ import annotations

import numpy as np

from obsynth.numerics.arrays import FloatArray


def tail(degrees: FloatArray, value: FloatArray) -> FloatArray:
    """Return the probability that chi-square passes a value."""
    from scipy.special import chdtrc

    return np.asarray(chdtrc(degrees, value))


def quantile(degrees: FloatArray, probability: float) -> FloatArray:
    """Return what chi-square passes with a probability; infinite where there are no degrees of freedom."""
    from scipy.special import chdtri

    return np.where(degrees > 0.0, chdtri(np.maximum(degrees, 1.0), probability), np.inf)


def weighted_squares(away: FloatArray, covariances: FloatArray) -> FloatArray:
    """Return ``d' P^+ d`` of distances ``(..., n)`` with covariances ``(..., n, n)``: chi-square without a change."""
    return np.asarray(np.einsum("...i,...ij,...j->...", away, np.linalg.pinv(covariances, hermitian=True), away))


def two_sided_sums(levels: FloatArray, along: FloatArray, squares: FloatArray, change: FloatArray) -> FloatArray:
    """Return cumulative sums ``(..., 2 n)`` of log likelihood ratios for a change ``(..., n)`` of either sign, one
    sample later: of scores ``along (..., n)`` with variances ``squares``; none falls below zero."""
    signs = np.concatenate([change, -change], axis=-1)
    rise = np.concatenate([along, along], axis=-1) * signs
    rise -= 0.5 * np.concatenate([squares, squares], axis=-1) * signs**2
    return np.asarray(np.maximum(levels + rise, 0.0))


def alone(scores: FloatArray, information: FloatArray) -> int:
    """Return the parameter whose change alone explains most (``scores (nq,)``, ``information (nq,)``)."""
    return int(np.argmax(scores**2 / np.maximum(information, np.finfo(np.float64).tiny)))
