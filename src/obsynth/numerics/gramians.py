"""Gramians of a stable matrix as sums of its powers, also near the stability boundary."""

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


def gramian_factor(a: FloatArray, b: FloatArray) -> FloatArray:
    """Return R with ``R R' = sum_k a^k b b' a'^k``, n columns at most: small directions keep their digits."""
    factor, power = np.array(b), np.array(a)
    for _ in range(MOST_DOUBLINGS):
        added = power @ factor
        factor = np.hstack([factor, added])
        if factor.shape[1] > len(a):
            factor = np.asarray(np.linalg.qr(factor.T, mode="r")).T
        if not float(np.linalg.norm(added)) > DOUBLED_SHARE * float(np.linalg.norm(factor)):
            break
        power = power @ power
    return np.asarray(factor)
