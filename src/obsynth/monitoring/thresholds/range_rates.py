"""Rates at which levels rise beyond the learned range of an input: the share of each statistic that follows the input.

The root of a statistic is a seminorm of the residuals, which consist of noise and the error of the model.  A regression
of the whitened rows on an input and on filtered values of it gives the part of the error that follows the input.
Beyond the range this part is assumed to grow in proportion to the distance, and so is the part of the noise whose size
follows the input; the rest is constant.  The jackknife by blocks of rows (Kunsch 1989) gives a confidence bound of this
rate.  If an input hardly moves, or parts of the logs disagree, the bound reaches one: the whole root then grows in
proportion to the distance.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from obsynth.monitoring.thresholds.learned import LearnedThresholds
from obsynth.monitoring.thresholds.learned_statistics import AGES, Statistics
from obsynth.monitoring.thresholds.parameter_scores import Scores, change_ratios
from obsynth.numerics.arrays import SMALLEST, FloatArray, read_only

#: Regressors of an input: its values in so many last rows, and exponential means with these weights of the newest row.
#: They cover memories of a residual from one row to that of the statistics.
OWN_ROWS, SHARES = 3, (0.3, 0.1, 0.03, 0.01)

#: Least number of blocks of rows that are left out in turn; each log is divided into equally many.
BLOCKS = 8

#: Confidence of the bound on the rate.
RATE_CONFIDENCE = 0.95

#: Singular values of the regressors below this share of the largest one count as zero.
SAME_REGRESSORS = 1e-6


@dataclass(frozen=True, eq=False)
class _Rows:
    """Rows without faults, with the data of the regressions."""

    regressors: tuple[FloatArray, ...]  # ``(n, p)`` of each input, of mean zero and deviation one
    distances: FloatArray  # ``(n, nu)``: of inputs from the middle of their ranges, in halves of these
    white: FloatArray  # ``(n, m)``: whitened rows, zero where a row is unknown
    known: NDArray[np.bool_]  # ``(n,)``: whether a row is known
    statistics: Statistics
    levels: FloatArray
    scores: Scores | None
    centre: FloatArray


def range_rates(
    distances: FloatArray,
    white: FloatArray,
    learned: LearnedThresholds,
    scores: Scores | None,
    logs: Sequence[slice],
) -> FloatArray:
    """Return the share of the root of each learned level that follows each input, ``(nu, k)``.

    Parameters
    ----------
    distances : FloatArray
        ``(n, nu)``: distances of the inputs from the middles of their ranges, in halves of these.
    white : FloatArray
        ``(n, m)``: whitened rows of the logs.
    learned : LearnedThresholds
        Statistics and levels.
    scores : Scores or None
        Scores of these rows for the faults.
    logs : sequence of slice
        Rows of each log.
    """
    from scipy.special import stdtrit

    known = np.asarray(np.isfinite(white).all(axis=1))
    distances = _held(distances)
    moves = np.ptp(distances, axis=0) > 0.0
    statistics, levels = learned.statistics, learned.levels
    rates = np.ones((distances.shape[1], len(levels)))
    if not moves.any():
        return read_only(rates)
    own = distances[:, moves]
    rows = _Rows(
        tuple(_regressors(column) for column in own.T), own, np.where(known[:, None], white, 0.0), known,
        replace(statistics, bands=None), levels, scores if statistics.estimates else None,
        learned.centres,
    )  # fmt: skip
    blocks = _blocks(len(white), logs)
    without = np.array([_rates(rows, without_block) for without_block in blocks])
    count = len(without)
    spread = np.sqrt((count - 1) / count * np.sum((without - without.mean(axis=0)) ** 2, axis=0))
    rates[moves] = np.clip(_rates(rows, known) + float(stdtrit(count - 1, RATE_CONFIDENCE)) * spread, 0.0, 1.0)
    return read_only(rates)


def _held(distances: FloatArray) -> FloatArray:
    """Return distances ``(n, nu)`` in which missing ones have the last known value, or zero at the beginning."""
    places = np.where(np.isfinite(distances), np.arange(1, len(distances) + 1)[:, None], 0)
    latest = np.maximum.accumulate(places, axis=0)
    padded = np.vstack([np.zeros((1, distances.shape[1])), distances])
    return np.asarray(np.take_along_axis(padded, latest, axis=0))


def _blocks(n: int, logs: Sequence[slice]) -> list[NDArray[np.bool_]]:
    """Return, for each block of the logs, which rows ``(n,)`` are outside it."""
    parts = list(logs) or [slice(0, n)]
    each = -(-BLOCKS // len(parts))
    ends = [np.linspace(part.start, part.stop, each + 1).astype(np.int64).tolist() for part in parts]
    blocks = []
    for first, last in [pair for part in ends for pair in pairwise(part)]:
        chosen = np.ones(n, dtype=bool)
        chosen[first:last] = False
        blocks.append(chosen)
    return blocks


def _regressors(distance: FloatArray) -> FloatArray:
    """Return the regressors of an input, scaled to mean zero and deviation one: its last values, its square, and
    exponential means of both."""
    from scipy.signal import lfilter

    columns = [
        np.concatenate([np.full(back, distance[0]), distance[: len(distance) - back]]) for back in range(OWN_ROWS)
    ]
    columns.append(distance**2)
    for signal in (distance, distance**2):
        columns += [lfilter([share], [1.0, share - 1.0], signal, zi=[(1.0 - share) * signal[0]])[0] for share in SHARES]
    table = np.stack(columns, axis=1)
    return np.asarray((table - table.mean(axis=0)) / np.maximum(table.std(axis=0), SMALLEST))


def _rates(rows: _Rows, chosen: NDArray[np.bool_]) -> FloatArray:
    """Return the shares ``(nu, k)`` in ``chosen`` rows."""
    followed = _followed(rows.regressors, rows.white, chosen & rows.known)
    parts = [rows.statistics.of_rows(np.where(rows.known[:, None], part, 0.0)[None])[:, 0] for part in followed]
    if rows.scores is not None:
        of_faults = _of_faults(rows, rows.scores, chosen)
        parts = [np.concatenate(pair) for pair in zip(parts, of_faults, strict=True)]
    roots = np.sqrt(np.array([part.max(axis=1) for part in parts]) / rows.levels)
    noise = _noise_rates(rows, rows.white - np.sum(followed, axis=0), chosen)
    return np.asarray(roots + noise[:, None])


def _followed(regressors: Sequence[FloatArray], target: FloatArray, chosen: NDArray[np.bool_],
              weights: FloatArray | None = None) -> list[FloatArray]:  # fmt: skip
    """Return the part of a ``target (n, m)`` that follows each input, by least squares with a constant.

    The regression is over ``chosen`` rows with the ``weights (n,)``, one by default.
    """
    table = np.hstack([np.ones((len(target), 1)), *regressors])
    roots = np.ones(len(target)) if weights is None else np.sqrt(weights)
    solution = np.linalg.lstsq(
        roots[chosen, None] * table[chosen], roots[chosen, None] * target[chosen], rcond=SAME_REGRESSORS
    )[0]
    ends = 1 + np.cumsum([0, *(part.shape[1] for part in regressors)])
    return [part @ solution[first:last] for part, (first, last) in zip(regressors, pairwise(ends), strict=True)]


def _of_faults(rows: _Rows, scores: Scores, chosen: NDArray[np.bool_]) -> list[FloatArray]:
    """Return the statistics of faults ``(2 nf, n)`` for the part of scores and estimates that follows each input."""
    own = np.einsum("kii->ki", scores.information)
    away, theta = scores.away(rows.centre), scores.theta - rows.centre
    changes, squares = [], []
    for i in range(len(rows.centre)):
        informed = own[:, i] > 0.0
        # The estimate of the change of the fault from this sample alone.
        change = np.divide(away[:, i], own[:, i], out=np.zeros(len(own)), where=informed)
        by_change = _followed(rows.regressors, change[:, None], chosen & informed & rows.known, own[:, i])
        changes.append([part[:, 0] * own[:, i] for part in by_change])
        is_known = np.isfinite(theta[:, i]) & np.isfinite(scores.deviations[:, i])
        by_theta = _followed(rows.regressors, np.where(is_known, theta[:, i], 0.0)[:, None], chosen & is_known)
        deviations = np.where(is_known, scores.deviations[:, i], np.inf)
        squares.append([(part[:, 0] / deviations) ** 2 for part in by_theta])
    return [
        np.concatenate([change_ratios(np.stack(moved, axis=1), own, AGES), np.stack(square)])
        for moved, square in zip(zip(*changes, strict=True), zip(*squares, strict=True), strict=True)
    ]


def _noise_rates(rows: _Rows, noise: FloatArray, chosen: NDArray[np.bool_]) -> FloatArray:
    """Return the growth of the size of the noise ``(n, m)`` with the distance of each input ``(nu,)``, relative to its
    size at the end of the range."""
    own = chosen & rows.known
    sizes = np.linalg.norm(noise[own], axis=1)
    table = np.hstack([np.ones((len(sizes), 1)), np.abs(rows.distances[own])])
    usual, *slopes = np.linalg.lstsq(table, sizes, rcond=SAME_REGRESSORS)[0]
    at_end = np.maximum(usual + np.array(slopes), SMALLEST)
    return np.asarray(np.clip(np.array(slopes) / at_end, 0.0, 1.0))
