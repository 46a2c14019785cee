"""Pairs of consecutive wrong samples in rows without faults, of which an outlier gate accepts the second.

A gate rejects the first sample after a jump of a fault and accepts the second.  Two consecutive wrong samples of a
sensor, with similar errors, look the same.  In rows without faults they are recognised by running the observer without
both: the next sample then agrees with its prediction.  Such pairs count as not measured.  By chance they also occur in
later runs, where each causes an alarm; their rate is subtracted from the rate of false alarms.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TypeAlias

import numpy as np

from obsynth.numerics.arrays import FloatArray

#: Probability that an outlier is smaller than their estimated least size, and least number of outliers to estimate it.
NEARER, LEAST_WRONG = 1e-3, 4

#: Consecutive samples of one output: the first and the last row, and the number of the output.
Pair: TypeAlias = tuple[int, int, int]


def believed_pairs(refused: Sequence[FloatArray], y: FloatArray) -> list[Pair]:
    """Return the samples that a gate accepted after it had rejected those directly before them, together with these.

    ``refused`` is the state of the gate after each row ``(4, ny)``, and ``y (n, ny)`` are the measurements.
    """
    pairs, begun = [], np.full(y.shape[1], -1)
    for k, (memory, measured) in enumerate(zip(refused, np.isfinite(y), strict=True)):
        before = refused[k - 1] if k else np.zeros_like(memory)
        begun[measured & (np.abs(memory[0]) == 1.0)] = k
        believed = measured & (np.abs(memory[0]) >= 2.0) & (memory[3] != 0.0) & (before[3] == 0.0)
        pairs += [(int(begun[i]), k, int(i)) for i in np.flatnonzero(believed)]
    return pairs


def without(y: FloatArray, pairs: Sequence[Pair]) -> FloatArray:
    """Return the measurements ``(n, ny)`` without these pairs."""
    measured = y.copy()
    for first, last, output in pairs:
        measured[first : last + 1, output] = np.nan
    return measured


def taken_back(pairs: Sequence[Pair], refused: Sequence[FloatArray], y: FloatArray) -> list[Pair]:
    """Return the pairs after which the next sample is no outlier, by the states ``refused`` of a gate in a run without
    all pairs."""
    far = np.array([memory[0] != 0.0 for memory in refused])
    wrong = []
    for first, last, output in pairs:
        later = np.flatnonzero(np.isfinite(y[last + 1 :, output]))
        if later.size and not far[last + 1 + later[0], output]:
            wrong.append((first, last, output))
    return wrong
