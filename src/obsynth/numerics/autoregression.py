"""Vector autoregressions: least-squares fits with the order of Akaike's criterion, whitening, and simulation.

``x_t = c + sum A_i x_{t-i} + W^-1 e_t`` with white e of unit covariance.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from obsynth.numerics.arrays import SMALLEST, FloatArray, largest_singular_value, read_only
from obsynth.numerics.ranks import independent_directions

#: Largest order that is tried, and rows that each coefficient of an equation needs.
MOST_ORDER, ROWS_PER_COEFFICIENT = 12, 20

#: Largest modulus of the roots of a fit; coefficients of one above it are multiplied by powers of the second number.
SLOWEST_FIT, SHRINKING = 0.999, 0.99

#: Ridge of the regression, as a share of the mean variance of the regressors.
REGRESSOR_SHARE = 1e-10

#: Least share of the variance of an innovation that the other signals of the same row leave unexplained.  Less than
#: that is mostly an effect outside the model (gains that change with inputs), of hundreds of deviations in single rows.
LEAST_OWN = 0.01

#: Doublings after which the slowest fit (`SLOWEST_FIT`) has decayed to nothing.
DOUBLINGS = 20

#: Least variance of a direction of the innovations, relative to a mean of one.  A smaller one is a dependence between
#: the signals, not noise.
LEAST_NEW = 1e-3


@dataclass(frozen=True, eq=False)
class Autoregression:
    """A vector autoregression: ``offset (m,)``, ``A (p, m, m)``, ``whitener (m, m)``, the W of the module's text."""

    offset: FloatArray
    A: FloatArray
    whitener: FloatArray

    @property
    def order(self) -> int:
        """Number of past rows in the regression."""
        return len(self.A)

    @property
    def channels(self) -> int:
        """Number of signals m."""
        return len(self.offset)

    @cached_property
    def mean(self) -> FloatArray:
        """Stationary mean ``(m,)``."""
        return np.asarray(np.linalg.solve(np.eye(self.channels) - self.A.sum(axis=0), self.offset))

    @property
    def longest_gain(self) -> float:
        """Largest gain from a constant innovation to the signals."""
        return largest_singular_value(np.linalg.inv(np.eye(self.channels) - self.A.sum(axis=0)))

    @property
    def is_regular(self) -> bool:
        """Whether no signal nearly follows from the past and from the other signals of the same row."""
        precision = self.whitener.T @ self.whitener
        return bool((np.diag(precision) * np.diag(np.linalg.inv(precision)) < 1.0 / LEAST_OWN).all())

    @cached_property
    def rests_on_the_past(self) -> bool:
        """Whether a signal is predicted to a tenth of its deviation, as an estimate that follows from past residuals.

        After a missing row the error of such a prediction is many times as large as otherwise.
        """
        p, m = self.order, self.channels
        if not p:
            return False
        companion = np.vstack([np.hstack(list(self.A)), np.eye((p - 1) * m, p * m)])
        new = np.zeros_like(companion)
        new[:m, :m] = np.linalg.inv(self.whitener.T @ self.whitener)
        # Doubling: after k steps the sum has 2^k terms, and what decays slowest has decayed after 2^20.
        variance, power = new, companion
        for _ in range(DOUBLINGS):
            variance, power = variance + power @ variance @ power.T, power @ power
        return bool((np.diag(new)[:m] < LEAST_OWN * np.diag(variance)[:m]).any())

    def whitened(self, x: FloatArray) -> FloatArray:
        """Return the white innovations of rows ``(..., n, m)``: zero in the first p, NaN where a needed row is NaN."""
        residuals = x - self.offset
        for i, a in enumerate(self.A, 1):
            residuals[..., i:, :] -= x[..., :-i, :] @ a.T
        residuals[..., : self.order, :] = 0.0
        return np.asarray(residuals @ self.whitener.T)

    def simulated(self, e: FloatArray) -> FloatArray:
        """Return the signals ``(runs, n, m)`` for white innovations e, from their mean on."""
        driven = e @ np.linalg.inv(self.whitener).T
        if not self.order:
            return np.asarray(driven + self.offset)
        if self.channels == 1:
            from scipy.signal import lfilter

            return np.asarray(lfilter([1.0], np.concatenate([[1.0], -self.A[:, 0, 0]]), driven, axis=1) + self.mean)
        stacked = np.vstack([a.T for a in self.A])
        past, streams = np.zeros((len(e), len(stacked))), np.empty_like(driven)
        for t in range(driven.shape[1]):
            streams[:, t] = past @ stacked + driven[:, t]
            past[:, self.channels :] = past[:, : -self.channels].copy()
            past[:, : self.channels] = streams[:, t]
        return np.asarray(streams + self.mean)


def fitted_autoregression(x: FloatArray, order: int | None = None) -> Autoregression:
    """Return the autoregression of rows ``(n, m)``, some of which may be NaN, with the order of least criterion.

    Linearly dependent signals are fitted in independent directions.  The covariance of the innovations is shrunk
    towards that of independent signals by an amount that depends on the number of rows (Ledoit & Wolf 2004), and none
    of its directions has a variance below `LEAST_NEW`, relative to a mean of one.
    """
    n, m = x.shape
    most = _most_order(np.asarray(np.isfinite(x).all(axis=1)), m) if order is None else order
    mean, units = np.nanmean(x, axis=0), np.nanstd(x, axis=0)
    units = np.where(units > 0.0, units, 1.0)
    z = (x - mean) / units
    turned = independent_directions(z)
    r = turned.shape[1]
    projected = z @ turned
    lags = np.hstack([np.ones((n - most, 1)), *(projected[most - i : n - i] for i in range(1, most + 1))])
    aims = z[most:]
    known = np.isfinite(lags).all(axis=1) & np.isfinite(aims).all(axis=1)
    lags, aims = lags[known], aims[known]
    count = len(aims)
    gram, cross, power = lags.T @ lags, lags.T @ aims, aims.T @ aims
    ridge = REGRESSOR_SHARE * np.trace(gram) / len(gram)
    best: tuple[float, FloatArray, FloatArray] | None = None
    for p in range(most + 1) if order is None else [order]:
        k = 1 + p * r
        fit = np.linalg.solve(gram[:k, :k] + ridge * np.eye(k), cross[:k])
        # What is new along the independent directions decides on the order.
        innovation_covariance = turned.T @ (power - fit.T @ cross[:k]) @ turned
        criterion = np.linalg.slogdet(innovation_covariance / count)[1] + 2.0 * p * r * r / count
        if best is None or criterion < best[0]:
            best = float(criterion), fit, aims - lags[:, :k] @ fit
    if best is None:
        raise ValueError("no order was tried")
    coefficients, new = best[1:]
    a = (coefficients[1:].reshape(-1, r, m).transpose(0, 2, 1) @ turned.T) * units[:, None] / units
    a = _stable(a)
    offset = mean + coefficients[0] * units - a.sum(axis=0) @ mean
    whitener = _whitener(new, max(count - len(coefficients), 1)) / units
    return Autoregression(read_only(offset), read_only(a), read_only(whitener))


def _most_order(known: NDArray[np.bool_], channels: int) -> int:
    """Return the largest order that the ``known (n,)`` rows determine; zero where no known row follows another."""
    after, longest = known, 0
    for order in range(1, MOST_ORDER + 1):
        after = after[1:] & known[:-order]
        if len(known) < ROWS_PER_COEFFICIENT * channels * order or after.sum() < 1 + channels * order:
            break
        longest = order
    return longest


def _stable(a: FloatArray) -> FloatArray:
    """Return coefficients ``(p, m, m)`` shrunk until all roots are within `SLOWEST_FIT`."""
    p, m = a.shape[:2]
    powers = SHRINKING ** np.arange(1, p + 1)[:, None, None]
    while p:
        companion = np.vstack([np.hstack(list(a)), np.eye((p - 1) * m, p * m)])
        if np.abs(np.linalg.eigvals(companion)).max() < SLOWEST_FIT:
            break
        a = a * powers
    return a


def _whitener(new: FloatArray, degrees: int) -> FloatArray:
    """Return the lower triangular whitener ``(m, m)`` of zero-mean rows ``(n, m)`` with ``degrees`` of freedom."""
    n, m = new.shape
    units = np.sqrt(np.maximum(np.sum(new**2, axis=0) / degrees, SMALLEST))
    rows = new / units
    covariance = rows.T @ rows / n
    # Ledoit & Wolf (2004); in these units the target is the identity.
    spread = float(np.sum((covariance - np.eye(m)) ** 2))
    error = float((np.sum(np.sum(rows**2, axis=1) ** 2) / n - np.sum(covariance**2)) / n)
    share = min(max(error / spread, 0.0), 1.0) if spread > 0.0 else 1.0
    covariance = (1.0 - share) * covariance * (n / degrees) + share * np.eye(m)
    sizes, vectors = np.linalg.eigh((covariance + covariance.T) / 2.0)
    floored = (vectors * np.maximum(sizes, LEAST_NEW)) @ vectors.T
    return np.asarray(np.linalg.inv(np.linalg.cholesky(floored)) / units)
