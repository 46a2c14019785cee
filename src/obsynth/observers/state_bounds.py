"""Bounds on states: estimates are projected onto them in the metric of their covariance.

With a truth inside the bounds, the projection brings the error nowhere further in that metric, so that the covariance
stays an upper bound in the sense of the squared error it normalises (Simon, Chia 2002).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from obsynth.errors import SpecError
from obsynth.numerics.arrays import FloatArray, read_only
from obsynth.plants.validation import index_of


def checked_state_bounds(value: Any, names: Sequence[str]) -> FloatArray | None:
    """Return lower and upper bounds ``(nx, 2)`` from rows or from pairs by name; ``None`` where there are none."""
    if value is None:
        return None
    found = np.tile([-np.inf, np.inf], (len(names), 1))
    if isinstance(value, Mapping):
        for name, pair in value.items():
            place = index_of(name, names, what="state_bounds")
            found[place] = _pair(pair, f"state_bounds.{name}")
    else:
        rows = np.asarray(value, dtype=object)
        if rows.shape != found.shape:
            raise SpecError(f"state_bounds must be {len(names)} pairs [low, high], or pairs by name.",
                            path="state_bounds")  # fmt: skip
        for i, name in enumerate(names):
            found[i] = _pair(list(rows[i]), f"state_bounds.{name}")
    return read_only(found) if np.isfinite(found).any() else None


def _pair(pair: Any, path: str) -> tuple[float, float]:
    try:
        low, high = (float(end) for end in pair)
    except (TypeError, ValueError):
        raise SpecError(f"{path} is {pair!r}: give [low, high].", path=path) from None
    if not low < high:
        raise SpecError(f"{path}: the lower bound ({low:g}) must be below the upper one ({high:g}).", path=path)
    return low, high


def projected(x: FloatArray, factor: FloatArray, bounds: FloatArray) -> FloatArray:
    """Return the point within bounds nearest to ``x`` in the metric of the covariance ``factor factor'``.

    The shortest e with ``low <= x + factor e <= high`` by nonnegative least squares (Lawson, Hanson, LDP), so that the
    covariance may be singular.  Shapes: ``x (n,)``, ``factor (n, any)``, ``bounds (n, 2)``.
    """
    if ((bounds[:, 0] <= x) & (x <= bounds[:, 1])).all():
        return x
    from scipy.optimize import nnls

    deviations = np.sqrt(np.einsum("ij,ij->i", factor, factor))
    moving = deviations > 0.0
    rows, gaps = [], []
    for sign, ends in ((1.0, bounds[:, 0]), (-1.0, -bounds[:, 1])):
        used = moving & np.isfinite(ends)
        rows.append(sign * factor[used] / deviations[used, None])
        gaps.append((ends[used] - sign * x[used]) / deviations[used])
    sides, least = np.vstack(rows), np.concatenate(gaps)
    target = np.zeros(factor.shape[1] + 1)
    target[-1] = 1.0
    weights, rest = nnls(np.vstack((sides.T, least)), target)
    residual = np.vstack((sides.T, least)) @ weights - target
    moved = x
    # Without a rest no e keeps all of them: a state that is known exactly stands in the way.
    if rest > 0.0 and residual[-1] < 0.0:
        # The shortest e that reaches the ends that hold it, without the cancellation of the ratio of residuals.
        held = weights > 0.0
        moved = x + factor @ np.linalg.lstsq(sides[held], least[held], rcond=None)[0]
    return np.asarray(np.clip(moved, bounds[:, 0], bounds[:, 1]))
