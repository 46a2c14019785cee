"""Events in rows without faults: short stretches that stand out, and how much they raise the learned levels."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from obsynth.monitoring.thresholds.learned_levels import HOLD, normal_statistics
from obsynth.monitoring.thresholds.learned_statistics import AGES, Statistics
from obsynth.monitoring.thresholds.parameter_scores import Scores
from obsynth.numerics.arrays import FloatArray

#: A log is divided into so many blocks; this quantile of the block maxima is the usual largest value, and an event
#: exceeds so many times it.  A fifth of the blocks may contain events.
LOG_PARTS, USUAL_PARTS_SHARE, EVENT_SIZE = 20, 0.75, 2.0

#: Largest number of events that may be left out, and their largest share of the rows: more frequent ones belong to the
#: normal behaviour of the plant.
MOST_EXCLUDED_EVENTS, MOST_EXCLUDED_SHARE = 5, 0.1


class Event(NamedTuple):
    """A stretch of rows that stands out."""

    first: int  # the first row that stands out
    last: int  # the last row whose signals stand out, or in which the statistics are largest
    begun: int  # the first row of the stretch in which statistics or signals are larger than usual
    ended: int  # the last row of that stretch
    signal: str  # the watched signal that deviates most


def events_of(
    x: FloatArray, columns: tuple[str, ...], statistics: Statistics, levels: FloatArray, scores: Scores | None,
    centre: FloatArray,
) -> tuple[Event, ...]:  # fmt: skip
    """Return the events in rows without faults, in the order of the log; none if they are too much of the log.

    Parameters
    ----------
    x : FloatArray
        The watched columns of these rows ``(n, m)``.
    columns : tuple of str
        Names of these columns.
    statistics : Statistics
        The statistics of these columns.
    levels : FloatArray
        ``(k,)``: levels that were learned from these rows.
    scores : Scores or None
        Scores of the rows for the faults.
    centre : FloatArray
        ``(nf,)``: usual values of the faults.
    """
    statistic_shares = normal_statistics(x, statistics, scores, (centre, np.ones(len(centre)))) / levels[:, None]
    # Rows after a blank cannot be whitened until the autoregression has enough rows: there the signals show events.
    away = np.nan_to_num((x - np.nanmedian(x, axis=0)) ** 2 / np.nanvar(x, axis=0))
    statistic_sizes, signal_sizes = _in_usual(statistic_shares.max(axis=0)), _in_usual(away.max(axis=1))
    values = np.maximum(statistic_sizes, signal_sizes)
    places = np.flatnonzero(values > 1.0)
    stretches = np.split(places, np.flatnonzero(np.diff(places) > HOLD) + 1)
    out = [part for part in stretches if part.size and values[part].max() > EVENT_SIZE]
    if len(out) > MOST_EXCLUDED_EVENTS or sum(part[-1] - part[0] + 1 for part in out) > MOST_EXCLUDED_SHARE * len(x):
        return ()
    own = np.abs(statistics.model.whitened(x) @ np.linalg.inv(statistics.model.whitener).T)
    own = own / np.sqrt(np.nanmean(own**2, axis=0))
    events = []
    for part in out:
        first = int(part[values[part] > EVENT_SIZE][0])
        # Statistics depend on earlier rows: after an event they decay from their largest value.
        last = int(part[(signal_sizes[part] > EVENT_SIZE) | (statistic_sizes[part] == statistic_sizes[part].max())][-1])
        signal = columns[int(np.argmax(np.nan_to_num(own[first : last + 1]).max(axis=0)))]
        events.append(Event(first, last, int(part[0]), int(part[-1]), signal))
    return tuple(events)


def _in_usual(values: FloatArray) -> FloatArray:
    """Return values ``(n,)`` in units of the 75 % quantile of their block maxima."""
    usual = float(np.quantile([part.max() for part in np.array_split(values, LOG_PARTS)], USUAL_PARTS_SHARE))
    # The quantile is zero if most blocks are blank.
    return values / usual if usual > 0.0 else np.zeros_like(values)


def factors(
    statistics: Statistics, levels: FloatArray, others: Statistics, other_levels: FloatArray
) -> dict[str, float]:
    """Return how many times larger a change must be to reach the level of each statistic than with ``others``.

    The change is a step that lasts `HOLD` rows.  For statistics of all columns, its direction is the one with the
    largest factor.  ``others`` have statistics of the same names.
    """
    (first, held_power), (other_first, other_held) = _powers(statistics), _powers(others)
    gains = {
        "T2": float((other_first / first).max()),
        **dict.fromkeys(
            (name for name in others.names if name.startswith("MEWMA")), float((other_held / held_power).max())
        ),
    }
    names, by_age = statistics.names, (others.levels_by_age / statistics.levels_by_age)[:, AGES.index(HOLD)]
    ratios = names[len(gains) : len(gains) + len(by_age)]
    gains |= dict(zip(ratios, (np.tile(other_held / held_power, 2) / by_age).tolist(), strict=True))
    # Scores of faults are in units of the observer's own deviations, which do not depend on the rows without faults.
    return {
        name: float(np.sqrt(a / b * gains.get(name, 1.0)))
        for name, a, b in zip(names, levels, other_levels, strict=True)
    }


def _powers(statistics: Statistics) -> tuple[FloatArray, FloatArray]:
    """Return the squared effects ``(s,)`` of a step of each signature on whitened rows: on the first one, and summed
    over `HOLD` rows."""
    steps = statistics.responses()[0][: len(statistics.signature_names)]
    squares = np.sum(steps**2, axis=-1)
    return squares[:, 0], squares[:, np.minimum(np.arange(HOLD), squares.shape[1] - 1)].sum(axis=1)
