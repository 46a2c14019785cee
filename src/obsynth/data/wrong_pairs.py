"""Pairs of wrong samples in rows without faults: a gate believes the second, which the rows after it take back.

A gate leaves the first sample of a fault out and believes the second.  Two wrong samples of one sensor in a row, as far
off on one side, look the same; but once both are left out, the next sample is where it was predicted.  In rows without
faults that decides.  They count as not measured there, and the rate at which single ones come together by chance, at
which each will alarm, is taken off the rate of false alarms.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from obsynth.numerics.arrays import FloatArray

#: Probability below which so many pairs are no chance: wrong samples, or something else, come in a row here.
CHANCE = 0.01
#: Pairs may take this share of the rate of false alarms; where they would take more the levels are to hold with them.
MOST_OF_RATE = 0.5


class Pair(NamedTuple):
    """Two samples of one output: rows, and which output."""

    first: int
    second: int
    output: int


def believed_pairs(refused: Sequence[FloatArray], y: FloatArray) -> list[Pair]:
    """Return the samples that a gate believed as the second in a row, with the first, which it left out: from its
    memory after each row ``(4, ny)``, and what was measured ``(n, ny)``."""
    found, latest = [], np.full(y.shape[1], -1)
    for k, (memory, seen) in enumerate(zip(refused, np.isfinite(y), strict=True)):
        before = refused[k - 1] if k else np.zeros_like(memory)
        believed = seen & (np.abs(memory[0]) == 2.0) & (memory[1] == before[1]) & (latest >= 0)
        found += [Pair(int(latest[i]), k, int(i)) for i in np.flatnonzero(believed)]
        latest[seen] = k
    return found


def without(y: FloatArray, pairs: Sequence[Pair]) -> FloatArray:
    """Return what was measured ``(n, ny)`` without these pairs."""
    left = y.copy()
    for pair in pairs:
        left[[pair.first, pair.second], pair.output] = np.nan
    return left


def taken_back(pairs: Sequence[Pair], refused: Sequence[FloatArray], y: FloatArray) -> list[Pair]:
    """Return the pairs after which the next sample is no outlier, by the memory of a gate to which none of them was
    shown."""
    far = np.array([memory[0] != 0.0 for memory in refused])
    found = []
    for pair in pairs:
        later = np.flatnonzero(np.isfinite(y[pair.second + 1 :, pair.output]))
        if later.size and not far[pair.second + 1 + later[0], pair.output]:
            found.append(pair)
    return found


def chance_of_pairs(refused: FloatArray, seen: NDArray[np.int64]) -> float:
    """Return how many pairs there are in a row by chance, where so many samples were left out ``(ny,)`` of so many that
    were measured: a second comes with the same probability as the first, and in half of the cases on the same side."""
    shares = refused / np.maximum(seen, 1)
    return float(0.5 * np.sum(shares**2))


def are_chance(pairs: int, rate: float, rows: int, every: float) -> bool:
    """Whether so many pairs in rows are what single wrong samples make at this rate, and leave most of one alarm per
    ``every`` rows to others."""
    from scipy.special import pdtrc

    return rate * every <= MOST_OF_RATE and float(pdtrc(pairs - 1, rate * rows)) >= CHANCE
