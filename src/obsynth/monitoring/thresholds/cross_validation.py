"""Block cross-validation of learned levels: on rows that nothing was learned from, within a log and between logs.

A level that rows keep from which everything was learned says little of other rows: centres, scales and colours are
those of these rows.  So each log (or each fifth of a single log) is judged with what the others say (blocks, as rows
follow each other: Racine 2000).  The largest value of each statistic in a part gives a prediction interval for that of
another part, which its level is not below; all together keep the rate of false alarms there; and the share of these
rows that is in alarm, where also the level comes from the other parts, is the share of healthy time in alarm.
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

#: Parts of a single log that are left out in turn, and the confidence with which another part stays below a level.
PARTS_OF_ONE_LOG, PART_CONFIDENCE = 5, 0.95

#: One log says nothing of how logs differ.  Noise and errors of the model are taken to be up to a fifth larger in
#: another one, and what samples say of faults, which are in the observer's own deviations, by a twentieth: levels,
#: which are squares, are so many times as high.
ONE_LOG_FACTOR, ONE_LOG_FACTOR_OF_FAULTS = 1.2**2, 1.05**2

#: Confidence of the interval on each side, and the rows in alarm that are still likely where none is seen: three alarms
#: (the rule of three: Hanley & Lippman-Hand 1983), which last as long as an alarm does at least.
SHARE_CONFIDENCE, UNSEEN_ROWS = 0.975, 3 * HOLD


class HeldOut(NamedTuple):
    """Statistics ``(k, n)`` of normal rows by what was learned from the others, and the parts that were left out."""

    values: FloatArray
    parts: tuple[slice, ...]

    def without(self, place: int) -> HeldOut:
        """Return these without one part."""
        return self._replace(parts=self.parts[:place] + self.parts[place + 1 :])


class HealthyTime(NamedTuple):
    """The share of healthy rows in alarm: what is expected, and the interval that holds it."""

    expected: float
    low: float
    high: float


def room_for_other_logs(statistics: Statistics, logs: Sequence[slice]) -> FloatArray:
    """Return by how much the level of each statistic is raised ``(k,)`` as nothing shows how logs differ."""
    factors = np.ones(len(statistics.names))
    if len(logs) < 2:
        factors[:] = ONE_LOG_FACTOR
        if statistics.estimates:
            factors[-2 * len(statistics.estimates) :] = ONE_LOG_FACTOR_OF_FAULTS
    return factors


def held_out(x: FloatArray, statistics: Statistics, scores: Scores | None, logs: Sequence[slice]) -> HeldOut:
    """Return the statistics of rows ``(n, m)`` with the autoregression and the centres of the other logs, or of the
    other parts of one log; ``scores``: what these rows say of faults."""
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
    """Return the statistics of rows ``(n, m)`` by what was learned from themselves."""
    usual = None if scores is None else (scores.centre(), np.ones(len(statistics.estimates)))
    return HeldOut(normal_statistics(x, statistics, scores, usual), (slice(0, len(x)),))


def levels_of_other_parts(levels: FloatArray, held: HeldOut, every: float) -> FloatArray:
    """Return levels ``(k,)``, none below ``levels``, that rows keep which nothing was learned from: each statistic the
    largest that is to be expected in another part, and all of them together one alarm per ``every`` rows."""
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
    """Return the share of the rows of another part in alarm, by levels ``(k,)`` and those parts whose level comes from
    the others; ``factors (k,)``: by how much they are raised after that."""
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
