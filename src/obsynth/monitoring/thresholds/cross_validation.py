"""Block cross-validation of learned levels within a log and between logs.

Levels from the rows that the model was fitted to are too low for other rows, whose means, variances and
autocorrelations differ.  Therefore each log, or each fifth of a single log, is evaluated with the model of the others;
blocks are used since rows are autocorrelated (Racine 2000).  The largest values of a statistic in the parts give a
prediction interval for that of another part, and its level is at least the end of this interval.  All statistics
together keep the rate of false alarms in held-out parts.  The share of healthy time in alarm is that of the rows of a
part that exceed the levels from the other parts.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from itertools import pairwise
from typing import NamedTuple

import numpy as np

from obsynth.monitoring.thresholds.learned_levels import HOLD, SETTLING, exchangeable_level, normal_statistics
from obsynth.monitoring.thresholds.learned_statistics import Statistics
from obsynth.monitoring.thresholds.parameter_scores import Scores
from obsynth.numerics.arrays import FloatArray, read_only
from obsynth.numerics.autoregression import fitted_autoregression

#: Number of parts of a single log that are held out in turn, and confidence that another part stays below a level.
PARTS_OF_ONE_LOG, PART_CONFIDENCE = 5, 0.95

#: One log does not show how logs differ.  Noise and model errors are assumed to be up to a fifth larger in another log,
#: and scores of faults, which are in units of the observer's own deviations, up to a twentieth.  Levels, which are
#: squares, are raised by these factors.
ONE_LOG_FACTOR, ONE_LOG_FACTOR_OF_FAULTS = 1.2**2, 1.05**2

#: Confidence of the interval on each side, and upper limit of rows in alarm if there are none: three alarms (the rule
#: of three: Hanley & Lippman-Hand 1983) of the least duration of an alarm.
SHARE_CONFIDENCE, UNSEEN_ROWS = 0.975, 3 * HOLD


class HeldOut(NamedTuple):
    """Statistics of rows without faults, each part with the model of the others."""

    values: FloatArray  # ``(k, n)``
    parts: tuple[slice, ...]  # the rows of each part

    def without(self, place: int) -> HeldOut:
        """Return the statistics without one part."""
        return self._replace(parts=self.parts[:place] + self.parts[place + 1 :])


class HealthyTime(NamedTuple):
    """The expected share of healthy rows in alarm, and its confidence interval."""

    expected: float
    low: float
    high: float


def room_for_other_logs(statistics: Statistics, logs: Sequence[slice]) -> FloatArray:
    """Return the factor of the level of each statistic ``(k,)`` for differences between logs, which one log does not
    show; ones for several logs."""
    factors = np.ones(len(statistics.names))
    if len(logs) < 2:
        factors[:] = ONE_LOG_FACTOR
        if statistics.estimates:
            factors[-2 * len(statistics.estimates) :] = ONE_LOG_FACTOR_OF_FAULTS
    return factors


def held_out(x: FloatArray, statistics: Statistics, scores: Scores | None, logs: Sequence[slice]) -> HeldOut:
    """Return the statistics of rows ``(n, m)`` with the autoregression and the centres of the other logs, or of the
    other parts of one log; ``scores`` are those of these rows for the faults."""
    n = len(x)
    ends = np.linspace(0, n, PARTS_OF_ONE_LOG + 1).astype(np.int64).tolist()
    parts = tuple(logs) if len(logs) > 1 else tuple(slice(a, b) for a, b in pairwise(ends))
    values = np.zeros((len(statistics.names), n))
    for part in parts:
        is_other = np.ones(n, dtype=bool)
        is_other[part] = False
        model = fitted_autoregression(np.where(is_other[:, None], x, np.nan), order=statistics.model.order)
        usual = None
        if scores is not None:
            other_scores = scores.chosen(is_other)
            centre = other_scores.centre() if other_scores.determine else scores.centre()
            usual = centre, np.ones(len(centre))
        values[:, part] = normal_statistics(x, replace(statistics, model=model), scores, usual)[:, part]
    return HeldOut(values, parts)


def not_held_out(x: FloatArray, statistics: Statistics, scores: Scores | None) -> HeldOut:
    """Return the statistics of rows ``(n, m)`` with the model of these rows themselves, as one part."""
    usual = None if scores is None else (scores.centre(), np.ones(len(statistics.estimates)))
    return HeldOut(normal_statistics(x, statistics, scores, usual), (slice(0, len(x)),))


def levels_of_other_parts(levels: FloatArray, held: HeldOut, every: float) -> FloatArray:
    """Return levels ``(k,)``, none below ``levels``, that are valid for held-out rows.

    Each is at least the end of the prediction interval for the largest value in another part, and all together give one
    alarm per ``every`` rows.
    """
    from scipy.special import stdtrit

    largest = np.sqrt([held.values[:, part].max(axis=1) for part in held.parts])
    count = len(largest)
    raised = levels
    if count > 1:
        reach = float(stdtrit(count - 1, PART_CONFIDENCE)) * float(np.sqrt(1.0 + 1.0 / count))
        raised = np.maximum(levels, (largest.mean(axis=0) + reach * largest.std(axis=0, ddof=1)) ** 2)
    union = np.concatenate([(held.values[:, part] / raised[:, None]).max(axis=0) for part in held.parts])[None]
    rows = max(union.shape[1] - SETTLING, 1)
    return read_only(raised * max(1.0, exchangeable_level(union, rows, every)))


def healthy_time(levels: FloatArray, held: HeldOut, every: float, factors: FloatArray) -> HealthyTime:
    """Return the share of the rows of a part in alarm with the levels from the other parts.

    These are at least ``levels (k,)``, and are finally multiplied by ``factors (k,)``.
    """
    from scipy.special import stdtrit

    shares, rows = [], 0
    for i, part in enumerate(held.parts):
        own = factors * levels_of_other_parts(levels, held.without(i), every)
        shares.append(float(((held.values[:, part] / own[:, None]).max(axis=0) > 1.0).mean()))
        rows += held.values[:, part].shape[1]
    count, expected = len(shares), float(np.mean(shares))
    reach = float(stdtrit(count - 1, SHARE_CONFIDENCE)) * float(np.std(shares, ddof=1)) / float(np.sqrt(count))
    unseen = UNSEEN_ROWS / rows
    return HealthyTime(expected, max(expected - reach, 0.0), min(max(expected + reach, expected + unseen), 1.0))
