"""Extreme points of a convex hull, and the other points as convex combinations of them."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from obsynth.numerics.arrays import FloatArray

#: Points up to which it is examined whether one lies among the others: a tenth of a second.
MOST_EXAMINED = 32
#: Relative distance of a point to a mean of others at which it is that mean: some thousand roundings.
MEAN_TOLERANCE = 1e-12


def spanning_points(points: Sequence[FloatArray]) -> tuple[list[int], FloatArray] | None:
    """Return which points span the hull, in their order, and the weights ``(N, used)`` with which each is their mean.

    ``None`` where all of them do, or are more than `MOST_EXAMINED`.

    Parameters
    ----------
    points : sequence of FloatArray
        Vectors of one length.
    """
    count = len(points)
    if not 1 < count <= MOST_EXAMINED:
        return None
    flat, first = [np.asarray(point, np.float64) + 0.0 for point in points], dict[bytes, int]()  # one zero
    eye = np.eye(count)
    weights = eye[[first.setdefault(each.tobytes(), place) for place, each in enumerate(flat)]]
    used = sorted(first.values())
    for place in list(used) if len(used) > 2 else []:
        others = [other for other in used if other != place]
        shares = _shares_of_mean(np.array([flat[other] for other in others]) - flat[place])
        if shares is not None:
            used = others
            # Of points that were means of this one, too.
            weights += np.outer(weights[:, place], np.bincount(others, shares, count) - eye[place])
    return None if len(used) == count else (used, weights[:, used])


def _shares_of_mean(spread: FloatArray) -> FloatArray | None:
    """Return shares, one in all, with which the mean of vectors is zero; ``None`` where none is."""
    from scipy.optimize import nnls

    sizes = np.max(np.abs(spread), axis=0)
    scaled = spread[:, sizes > 0.0] / sizes[sizes > 0.0]
    target = np.zeros(scaled.shape[1] + 1)
    target[-1] = 1.0
    try:
        shares, distance = nnls(np.vstack([scaled.T, np.ones(len(scaled))]), target)
    except RuntimeError:  # its iteration did not end
        return None
    return np.asarray(shares / shares.sum()) if distance <= MEAN_TOLERANCE * np.sqrt(len(target)) else None
