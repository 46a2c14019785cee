"""Pairs of wrong samples in rows without faults, of which an outlier gate accepts the second and later rows refute it.

A gate leaves the first sample of a fault out and believes the second.  Two wrong samples of one sensor in a row, as far
off on one side, look the same; but once both are left out, the next sample is where it was predicted.  In rows without
faults that decides.  They count as not measured there, and the rate at which single ones come together by chance, at
which each will alarm, is taken off the rate of false alarms.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TypeAlias

import numpy as np

from obsynth.numerics.arrays import FloatArray

#: Probability with which an outlier is nearer than what is taken as their least size, and how many show that.
NEARER, LEAST_WRONG = 1e-3, 4

#: Samples of one output: the first and the last of their rows, and which output.
Pair: TypeAlias = tuple[int, int, int]


def believed_pairs(refused: Sequence[FloatArray], y: FloatArray) -> list[Pair]:
    """Return the samples that a gate believed after those before them in a row, which it left out, with these: from its
    memory after each row ``(4, ny)``, and what was measured ``(n, ny)``."""
    pairs, begun = [], np.full(y.shape[1], -1)
    for k, (memory, measured) in enumerate(zip(refused, np.isfinite(y), strict=True)):
        before = refused[k - 1] if k else np.zeros_like(memory)
        begun[measured & (np.abs(memory[0]) == 1.0)] = k
        believed = measured & (np.abs(memory[0]) >= 2.0) & (memory[3] != 0.0) & (before[3] == 0.0)
        pairs += [(int(begun[i]), k, int(i)) for i in np.flatnonzero(believed)]
    return pairs


def without(y: FloatArray, pairs: Sequence[Pair]) -> FloatArray:
    """Return what was measured ``(n, ny)`` without these pairs."""
    measured = y.copy()
    for first, last, output in pairs:
        measured[first : last + 1, output] = np.nan
    return measured


def taken_back(pairs: Sequence[Pair], refused: Sequence[FloatArray], y: FloatArray) -> list[Pair]:
    """Return the pairs after which the next sample is no outlier, by the memory of a gate to which none of them was
    shown."""
    far = np.array([memory[0] != 0.0 for memory in refused])
    wrong = []
    for first, last, output in pairs:
        later = np.flatnonzero(np.isfinite(y[last + 1 :, output]))
        if later.size and not far[last + 1 + later[0], output]:
            wrong.append((first, last, output))
    return wrong
