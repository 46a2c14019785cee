"""Slow offsets in rows without faults: a bound on the distance of the mean of a signal in another log.

A log determines the usual mean of a signal only from independent values of slow offsets: an offset that drifts through
the whole log is a single value.  Each log is divided into parts.  The variance of their means beyond that of noise,
with as few degrees of freedom as there are parts, gives a prediction interval for the mean of a part of another log
(Hahn & Meeker 1991, section 4.7).  The widest interval over several numbers of parts is used: few parts show drifts,
and many parts show temporary offsets.  The parts of several logs are compared with each other; with three or more logs,
so are whole logs.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from obsynth.numerics.arrays import FloatArray

#: Numbers of parts of a log, and least number of rows of a part.
PARTS, LEAST_PART = (1, 3, 6, 12, 24), 100
#: Confidence of the interval on each side, and confidence of the test for more variance than that of noise.
CONFIDENCE, SIGNIFICANCE = 0.975, 0.99


def offset_bound(values: FloatArray, weights: FloatArray, logs: Sequence[slice]) -> float:
    """Return the bound on a slow offset in units of ``values / weights``; zero if the means of parts show only noise.

    The ``values (n,)`` have the means ``weights * offset`` and the variances ``weights (n,)``.
    """
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
