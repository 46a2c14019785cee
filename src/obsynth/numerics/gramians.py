"""Sums of powers of a stable matrix, near the boundary too."""

from __future__ import annotations

import numpy as np

from obsynth.numerics.arrays import FloatArray

#: Squarings of a sum over all samples.
MOST_DOUBLINGS = 60
#: A sum over all samples is complete when its last doubling adds no more than this share.
DOUBLED_SHARE = 1e-17


def gramian(a: FloatArray, weight: FloatArray) -> FloatArray:
    """Return ``sum_k a^k weight a'^k`` by doubling: of a stable matrix, near the boundary too."""
    total, power = np.array(weight), np.array(a)
    with np.errstate(all="ignore"):
        for _ in range(MOST_DOUBLINGS):
            added = power @ total @ power.T
            total, power = total + added, power @ power
            size = float(np.linalg.norm(added))
            if not np.isfinite(size) or size <= DOUBLED_SHARE * float(np.linalg.norm(total)):
                break
    return np.asarray(total)
