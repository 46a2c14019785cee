"""Slow offsets in rows without faults: how far the mean of a signal may be elsewhere than where a log has it.

A log says where a signal usually is only as well as it holds independent values of what moves slowly: an offset that
drifts through the whole log is one value of it.  Each log is divided into so many parts, and the variance of their
means beyond that of noise, with as few degrees of freedom as there are parts, gives a prediction interval for the mean
of a part of another log (Hahn & Meeker 1991, section 4.7).  The widest over all numbers of parts counts: in two or
three parts drifts show, in many what comes and goes.  With several logs the parts of all are compared with each other,
and where there are three and more, whole logs.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from obsynth.numerics.arrays import FloatArray

#: Numbers of parts of a log; a part has so many rows at least.
PARTS, LEAST_PART = (1, 3, 6, 12, 24), 100
#: Confidence of the interval on each side, and level of the test whether there is more than noise.
CONFIDENCE, SIGNIFICANCE = 0.975, 0.99


def offset_bound(values: FloatArray, weights: FloatArray, logs: Sequence[slice]) -> float:
    """Return the bound on a slow offset in units of ``values / weights``, from values ``(n,)`` of mean ``weights *
    offset`` and variance ``weights (n,)``; zero where the means of parts show nothing but noise."""
    from scipy.special import chdtri, stdtrit

    bound = 0.0
    for parts in PARTS:
        sums = np.array(
            [
                (values[part].sum(), weights[part].sum())
                for log in logs
                for part in np.array_split(np.arange(len(values))[log], parts)
                if len(part) >= LEAST_PART
            ]
        ).reshape(-1, 2)
        sums = sums[sums[:, 1] > 0.0]
        count = len(sums)
        if count < 3:
            continue
        means, noise = sums[:, 0] / sums[:, 1], float(np.mean(1.0 / sums[:, 1]))
        variance = float(means.var(ddof=1))
        if variance > noise * float(chdtri(count - 1, 1.0 - SIGNIFICANCE)) / (count - 1):
            quantile = float(stdtrit(count - 1, CONFIDENCE))
            bound = max(bound, quantile * float(np.sqrt((1.0 + 1.0 / count) * (variance - noise))))
    return bound
