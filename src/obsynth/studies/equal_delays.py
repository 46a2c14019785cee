"""Detection delays on a log at equal false-alarm rates: each design gets the threshold that has this rate.

A threshold trades healthy time in alarm for delay, so that designs can only be compared where one of them is equal.
The level of each fault's estimate is what at most a share of the rows without faults is beyond, from their median.
Where a log has a column of a fault, its alarm is looked for in the rows of the fault; else what the scenario's fault
does to the estimate is added to rows of the log, at several places: estimates of linear observers are sums.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from obsynth.monitoring.thresholds.learned_levels import HOLD
from obsynth.numerics.arrays import FloatArray

#: Share of normal rows in alarm: the usual target of an alarm that operators keep, far above what few rows can show.
HEALTHY_TIME = 0.01

#: A fault is found where this share of its rows is in alarm: ten times as many as without it, which is no chance.
FOUND_SHARE = 10.0 * HEALTHY_TIME

#: Rows of which this share beyond the level is an alarm: of normal rows, of which one in a hundred is, 6 of 20 are once
#: in 20 million.
DENSE_ROWS, DENSE_SHARE = 20, 0.3

#: Normal rows below which a level says nothing: one of them is the share in alarm.
LEAST_ROWS = 100

#: Places of a log at which a scenario's fault begins.
PLACES = 20


def normal_rows(truth: FloatArray, decided: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Return which rows count as normal ``(n,)``: those before the first fault, or all without one where these are too
    few; ``truth (n, nf)``: the faults, ``decided (n,)``: whether a decision may be taken."""
    is_faulty = np.asarray((np.nan_to_num(truth) != 0.0).any(axis=1))
    # What nobody labelled is neither.
    decided = decided & ~np.isnan(truth).any(axis=1)
    before = decided & ~np.logical_or.accumulate(is_faulty)
    return before if before.sum() >= LEAST_ROWS else decided & ~is_faulty


def level_of_normal_rows(values: FloatArray, normal: NDArray[np.bool_]) -> tuple[float, float]:
    """Return the median of normal values ``(n,)`` and how far from it at most `HEALTHY_TIME` of them are further; NaN
    where they are too few."""
    usual = values[normal & np.isfinite(values)]
    if len(usual) < LEAST_ROWS:
        return float("nan"), float("nan")
    centre = float(np.median(usual))
    return centre, float(np.quantile(np.abs(usual - centre), 1.0 - HEALTHY_TIME, method="higher"))


def delay_on_log(values: FloatArray, times: FloatArray, fault: FloatArray, centre: float, level: float) -> float:
    """Return the median time from begins of a fault ``(n,)`` to the first value ``(n,)`` beyond the level, in seconds;
    infinite where the fault is not found, NaN where there is none."""
    acts = np.flatnonzero(np.nan_to_num(fault))
    if not acts.size or not np.isfinite(level):
        return float("nan")
    # A fault that passes through zero for some rows is still the same one.
    begins = np.flatnonzero(np.diff(acts, prepend=-HOLD - 2) > HOLD)
    ends = [*(acts[begins[1:] - 1] + 1), acts[-1] + 1]
    beyond = np.abs(np.nan_to_num(values - centre)) > level
    return float(np.median([
        _first(beyond[acts[begin] : end], times[acts[begin] : end]) for begin, end in zip(begins, ends, strict=True)
    ]))  # fmt: skip


def delay_of_scenario(
    values: FloatArray, effects: FloatArray, fault: FloatArray, dt: float, centre: float, level: float
) -> float:
    """Return the same where a scenario's ``fault (steps,)`` moves normal values ``(n,)`` of a log by ``effects (runs,
    steps)``, from several rows on."""
    acts = np.flatnonzero(fault)
    if not acts.size or not np.isfinite(level):
        return float("nan")
    moved = effects[:, acts[0] : acts[-1] + 1]
    length = min(moved.shape[1], len(values))
    times, delays = dt * np.arange(length), []
    for i, place in enumerate(np.linspace(0, len(values) - length, PLACES).astype(np.int64)):
        own = values[place : place + length] - centre + moved[i % len(moved), :length]
        delays.append(_first(np.abs(np.nan_to_num(own)) > level, times))
    return float(np.median(delays))


def _first(beyond: NDArray[np.bool_], times: FloatArray) -> float:
    """Return the time from the first row to the first one in alarm that is followed by others, where no window is dense
    to that of the densest; infinite where no more are in alarm than by chance."""
    if beyond.mean() <= FOUND_SHARE:
        return float("inf")
    window = min(DENSE_ROWS, len(beyond))
    counts = np.convolve(beyond, np.ones(window), "valid")
    dense = counts >= DENSE_SHARE * window
    start = int(np.argmax(dense if dense.any() else counts))
    return float(times[start + int(np.argmax(beyond[start:]))] - times[0])
