"""How far the logs support that levels rise beyond the learned range of an input: by what of each statistic follows it.

A statistic's root is a seminorm of residuals, which are noise and the error of the model.  The logs say how large the
error is that follows an input: a regression of the whitened rows on the input and what filters remember of it.  Beyond
the range that part grows in proportion to the distance, and the noise as far as its size follows the input; the rest
stays.  Uncertainty is that of the jackknife by blocks of rows (Kunsch 1989): where the logs cannot say, as an input
hardly moves or a part of them says otherwise, the bound reaches one, and the whole root grows in proportion.
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

#: Rows back that a regressor of its own has each, and shares of the exponential means of an input: what a residual
#: remembers of it is between one row and as long as statistics look back.
OWN_ROWS, SHARES = 3, (0.3, 0.1, 0.03, 0.01)

#: Blocks of rows that are left out in turn: of one log, or of all logs, each in so many parts at least.
BLOCKS = 8

#: Confidence of the bound on what follows an input.
RATE_CONFIDENCE = 0.95

#: Singular values below this share of the largest are of regressors that say the same.
SAME_REGRESSORS = 1e-6


@dataclass(frozen=True, eq=False)
class _Rows:
    """Rows without faults, as regressions take them."""

    regressors: tuple[FloatArray, ...]  # ``(n, p)`` of each input, of mean zero and deviation one
    distances: FloatArray  # ``(n, nu)``: of inputs from the middle of their ranges, in halves of these
    white: FloatArray  # ``(n, m)``, zero where a row is not known
    known: NDArray[np.bool_]  # ``(n,)``
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
    """Return which share of the root of each learned level follows each input, ``(nu, k)``, from whitened rows
    ``(n, m)`` of logs and the ``distances (n, nu)`` of their inputs from the middles of their ranges, in halves of
    these; ``scores``: what these rows say of faults."""
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
    """Return distances ``(n, nu)`` with those before where one is missing, and zero before any."""
    places = np.where(np.isfinite(distances), np.arange(1, len(distances) + 1)[:, None], 0)
    latest = np.maximum.accumulate(places, axis=0)
    padded = np.vstack([np.zeros((1, distances.shape[1])), distances])
    return np.asarray(np.take_along_axis(padded, latest, axis=0))


def _blocks(n: int, logs: Sequence[slice]) -> list[NDArray[np.bool_]]:
    """Return rows ``(n,)`` without one block each: parts of the logs."""
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
    """Return an input, its square, and what filters remember of both, of mean zero and deviation one."""
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
    """Return the shares ``(nu, k)`` as ``chosen`` rows have them."""
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
    """Return what of a ``target (n, m)`` follows each input: by least squares over ``chosen`` rows, which count by the
    root of ``weights (n,)``, with a constant."""
    table = np.hstack([np.ones((len(target), 1)), *regressors])
    roots = np.ones(len(target)) if weights is None else np.sqrt(weights)
    solution = np.linalg.lstsq(
        roots[chosen, None] * table[chosen], roots[chosen, None] * target[chosen], rcond=SAME_REGRESSORS
    )[0]
    ends = 1 + np.cumsum([0, *(part.shape[1] for part in regressors)])
    return [part @ solution[first:last] for part, (first, last) in zip(regressors, pairwise(ends), strict=True)]


def _of_faults(rows: _Rows, scores: Scores, chosen: NDArray[np.bool_]) -> list[FloatArray]:
    """Return the statistics of faults ``(2 nf, n)`` of what follows each input in scores and estimates."""
    own = np.einsum("kii->ki", scores.information)
    away, theta = scores.away(rows.centre), scores.theta - rows.centre
    changes, squares = [], []
    for i in range(len(rows.centre)):
        informed = own[:, i] > 0.0
        # A change of the fault that the sample alone would say.
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
    """Return by which share of its size at the end of the range the noise ``(n, m)`` grows with each distance,
    ``(nu,)``."""
    own = chosen & rows.known
    sizes = np.linalg.norm(noise[own], axis=1)
    table = np.hstack([np.ones((len(sizes), 1)), np.abs(rows.distances[own])])
    usual, *slopes = np.linalg.lstsq(table, sizes, rcond=SAME_REGRESSORS)[0]
    at_end = np.maximum(usual + np.array(slopes), SMALLEST)
    return np.asarray(np.clip(np.array(slopes) / at_end, 0.0, 1.0))
