"""Means of the last fault estimates of an observer: registers behind it, and the observer without them again."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from obsynth.observers.linear.observer import LinearObserver


def averaged(observer: LinearObserver, mean: int) -> LinearObserver:
    """Return the observer whose fault estimates are means of its last ``mean`` ones."""
    rows, order, count = observer.fault_rows, observer.order, len(observer.fault_names)
    register_count = (mean - 1) * count
    az, cz = np.zeros((order + register_count,) * 2), np.zeros((len(observer.Cz), order + register_count))
    az[:order, :order], cz[:, :order] = observer.Az, observer.Cz
    first = slice(order, order + count)
    az[first, :order] = observer.Cz[rows]
    for j in range(1, mean - 1):
        place = slice(order + j * count, order + (j + 1) * count)
        az[place, order + (j - 1) * count : order + j * count] = np.eye(count)
    cz[rows] = cz[rows] / mean
    for j in range(mean - 1):
        cz[rows, order + j * count : order + (j + 1) * count] = np.eye(count) / mean
    below = np.zeros((register_count - count, 1))

    def widened(matrix: np.ndarray, direct: np.ndarray) -> np.ndarray:
        return np.vstack([matrix, direct[rows], np.repeat(below, matrix.shape[1], axis=1)])

    du, dy = observer.Du.copy(), observer.Dy.copy()
    du[rows], dy[rows] = du[rows] / mean, dy[rows] / mean
    return replace(
        observer,
        Az=az,
        Bu=widened(observer.Bu, observer.Du),
        By=widened(observer.By, observer.Dy),
        Cz=cz,
        Du=du,
        Dy=dy,
        fault_delays=tuple(delay + (mean - 1) // 2 for delay in observer.fault_delays),
    )


def unaveraged(observer: LinearObserver, mean: int) -> LinearObserver | None:
    """Return the observer that `averaged` was given; ``None`` where this is not exactly what it makes of one."""
    rows, count = observer.fault_rows, len(observer.fault_names)
    order = observer.order - (mean - 1) * count
    if order < 0 or not all(np.all(np.isfinite(part)) for part in (observer.Az, observer.Cz, observer.Du, observer.Dy)):
        return None
    first = slice(order, order + count)
    cz, du, dy = observer.Cz[:, :order].copy(), observer.Du.copy(), observer.Dy.copy()
    cz[rows], du[rows], dy[rows] = observer.Az[first, :order], observer.Bu[first], observer.By[first]
    earlier = tuple(delay - (mean - 1) // 2 for delay in observer.fault_delays)
    if min(earlier, default=0) < 0:
        return None
    base = replace(
        observer,
        Az=observer.Az[:order, :order],
        Bu=observer.Bu[:order],
        By=observer.By[:order],
        Cz=cz,
        Du=du,
        Dy=dy,
        fault_delays=earlier,
    )
    again = averaged(base, mean)
    same = all(np.array_equal(getattr(again, n), getattr(observer, n)) for n in ("Az", "Bu", "By", "Cz", "Du", "Dy"))
    return base if same else None
