"""Short stretches of rows without faults that raise learned levels: their explanation, and by how much."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from obsynth.monitoring.thresholds.learned_levels import HOLD, normal_statistics
from obsynth.monitoring.thresholds.learned_statistics import AGES, Statistics
from obsynth.monitoring.thresholds.parameter_scores import Scores
from obsynth.numerics.arrays import FloatArray

#: Parts of a log whose largest statistics are compared, the share of them that is taken as usual, and how many times
#: that an event stands out at least: a fifth of the parts of a log may hold events.
LOG_PARTS, USUAL_PARTS_SHARE, EVENT_SIZE = 20, 0.75, 2.0

#: So many events, and this share of the rows, may be left out at most: what comes more often is how the plant is.
MOST_EXCLUDED_EVENTS, MOST_EXCLUDED_SHARE = 5, 0.1


class Event(NamedTuple):
    """A stretch of rows that stands out."""

    first: int  # the first row that stands out
    last: int  # the last one whose signals do, or in which the statistics are largest
    begun: int  # from here to there the statistics are larger than usual
    ended: int
    signal: str  # of those watched, the one that deviates most


def events_of(
    x: FloatArray, columns: tuple[str, ...], statistics: Statistics, levels: FloatArray, scores: Scores | None,
    centre: FloatArray,
) -> tuple[Event, ...]:  # fmt: skip
    """Return the events in watched rows ``(n, m)`` from which ``levels (k,)`` were learned, in order; none where what
    stands out is too much of the log.  ``scores``: what the rows say of faults, which are usually at the ``centre``."""
    statistic_shares = normal_statistics(x, statistics, scores, (centre, np.ones(len(centre)))) / levels[:, None]
    # After a blank, rows are not whitened for as long as the autoregression looks back: signals themselves show events.
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
        # Statistics look back: after the event they fade, from their largest value on.
        last = int(part[(signal_sizes[part] > EVENT_SIZE) | (statistic_sizes[part] == statistic_sizes[part].max())][-1])
        signal = columns[int(np.argmax(np.nan_to_num(own[first : last + 1]).max(axis=0)))]
        events.append(Event(first, last, int(part[0]), int(part[-1]), signal))
    return tuple(events)


def _in_usual(values: FloatArray) -> FloatArray:
    """Return values ``(n,)`` in units of what is usually the largest in a part of them."""
    usual = float(np.quantile([part.max() for part in np.array_split(values, LOG_PARTS)], USUAL_PARTS_SHARE))
    # Where most parts are blank, nothing is usual.
    return values / usual if usual > 0.0 else np.zeros_like(values)


def factors(
    statistics: Statistics, levels: FloatArray, others: Statistics, other_levels: FloatArray
) -> dict[str, float]:
    """Return how many times as large a change has to be to reach the level of each statistic as with ``others`` of the
    same names: a step that lasts `HOLD` rows, for those of all columns in the direction in which this is most."""
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
    # What samples say of faults is in the observer's own deviations, whatever rows were learned from.
    return {
        name: float(np.sqrt(a / b * gains.get(name, 1.0)))
        for name, a, b in zip(names, levels, other_levels, strict=True)
    }


def _powers(statistics: Statistics) -> tuple[FloatArray, FloatArray]:
    """Return the squares of what a step of each signature does to white rows ``(s,)``: to its first, to `HOLD` rows."""
    steps = statistics.responses()[0][: len(statistics.signature_names)]
    squares = np.sum(steps**2, axis=-1)
    return squares[:, 0], squares[:, np.minimum(np.arange(HOLD), squares.shape[1] - 1)].sum(axis=1)
