"""Estimates from a limited number of runs, each with its confidence interval."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from obsynth.numerics.arrays import FloatArray


@dataclass(frozen=True)
class Interval:
    """A number estimated from runs.

    Parameters
    ----------
    value : float
        The share, or the mean; NaN without any run that counts.
    low, high : float
        Confidence interval; NaN where too few runs count.
    count : int
        Runs that count.
    """

    value: float
    low: float
    high: float
    count: int


def share(hits: int, count: int, confidence: float) -> Interval:
    """Return a share with its exact (Clopper-Pearson) interval."""
    from scipy.special import betaincinv

    if count == 0:
        return Interval(float("nan"), float("nan"), float("nan"), 0)
    tail = (1.0 - confidence) / 2.0
    low = 0.0 if hits == 0 else float(betaincinv(hits, count - hits + 1, tail))
    high = 1.0 if hits == count else float(betaincinv(hits + 1, count - hits, 1.0 - tail))
    return Interval(hits / count, low, high, count)


def mean(values: FloatArray, confidence: float) -> Interval:
    """Return a mean with Student's interval; NaN among the values does not count."""
    from scipy.special import stdtrit

    known = values[~np.isnan(values)]
    if known.size < 2:
        centre = float(known[0]) if known.size else float("nan")
        return Interval(centre, float("nan"), float("nan"), int(known.size))
    centre = float(np.mean(known))
    half = float(stdtrit(known.size - 1, (1.0 + confidence) / 2.0) * np.std(known, ddof=1) / np.sqrt(known.size))
    return Interval(centre, centre - half, centre + half, int(known.size))
