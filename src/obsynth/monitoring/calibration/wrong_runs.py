"""Several wrong samples of one sensor in a row: far from their prediction, and gone when they are over.

What happened in the plant is seen by other sensors, or goes on.  Once wrong samples are hidden, the next one is where
it was predicted; then they count as not measured, as single ones do.  Left in a log, three of them made coloured noise
look white, or of twice its size.
"""

from __future__ import annotations

import numpy as np

from obsynth.monitoring.calibration.diagnostics import (
    LEAST_DIAGNOSED_ROWS,
    MOST_OUTLIERS,
    OUTLYING,
    BoolArray,
    usual_size,
)
from obsynth.monitoring.calibration.innovations_fit import InnovationsFit
from obsynth.monitoring.calibration.noise_proposals import LONGEST_RUN, RETURNED, whitened_run
from obsynth.monitoring.calibration.problem import CalibrationProblem


def wrong_runs(problem: CalibrationProblem, fit: InnovationsFit) -> BoolArray:
    """Return which measurements ``(n, ny)`` stand out with others of the same sensor beside them, are not seen by
    another sensor, and leave the next samples where these are predicted without them."""
    wrong = np.zeros(problem.y.shape, dtype=bool)
    measured = np.isfinite(problem.y)
    enough = measured.sum(axis=0) >= LEAST_DIAGNOSED_ROWS
    usual = np.array([usual_size(e) if many else np.inf for e, many in zip(fit.whitened.T, enough, strict=True)])
    far = measured & (np.abs(fit.whitened) > OUTLYING * usual)
    for i in range(far.shape[1]):
        for first, last in _groups(far[:, i]):
            if np.delete(far[first : last + 1], i, axis=1).any():
                continue
            end = _end(problem, fit, usual[i], i, first, last)
            if end is not None:
                wrong[first : end + 1, i] = measured[first : end + 1, i]
    return np.asarray(wrong & (wrong.sum(axis=0) <= MOST_OUTLIERS * measured.sum(axis=0)))


def _groups(far: BoolArray) -> list[tuple[int, int]]:
    """Return first and last row of what stands out together, of no more than a run and the sample after it; single ones
    are none."""
    groups: list[tuple[int, int]] = []
    for row in np.flatnonzero(far).tolist():
        if groups and row - groups[-1][1] <= LONGEST_RUN:
            groups[-1] = (groups[-1][0], row)
        else:
            groups.append((row, row))
    return [(first, last) for first, last in groups if 0 < last - first <= LONGEST_RUN]


def _end(
    problem: CalibrationProblem, fit: InnovationsFit, usual: float, output: int, first: int, last: int
) -> int | None:
    """Return the first row to which samples must be hidden so that those after it are where they are predicted; `None`
    where there is none."""
    for end in range(first, min(last, first + LONGEST_RUN - 1) + 1):
        y = problem.y.copy()
        y[first : end + 1, output] = np.nan
        after = np.flatnonzero(np.isfinite(y[end + 1 :, output]))[:RETURNED] + end + 1
        if (
            len(after) == RETURNED
            and (np.abs(whitened_run(problem, fit.v, y)[after, output]) <= OUTLYING * usual).all()
        ):
            return end
    return None
