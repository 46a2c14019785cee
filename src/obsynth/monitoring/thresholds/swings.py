"""Swings of residuals to both sides, by which levels rise: noise that has become slower than what was learned from.

Means of residuals whose noise follows itself pass levels that were learned from faster noise, now on one side and then
on the other.  What a fault does to them stays on its side for as long as it lasts.  So a level is raised by what a
statistic reaches on both sides, as a control chart is widened for autocorrelated data (Alwan & Roberts 1988), once it
has changed sides, and an alarm that stays on one side is as it was.  Slower noise makes means larger than single rows;
where these pass their level by themselves, as those of a sensor that jumps to and fro, levels rise by as much less.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from obsynth.numerics.arrays import FloatArray, read_only

#: Share of its level above which a statistic counts as on one side.
SWING = 0.5

#: A statistic swings when it has been on a side, on the other and back: a fault that comes and another one of the other
#: sign are two sides, and no more.
LEAST_SWINGS = 2.0

#: Rows after which a swing counts by 1/e of what it did, and the same of a single row that is large.
SWING_MEMORY, ROW_MEMORY = 1_500.0, 100.0

#: Levels rise by so many times what is reached on both sides beyond `SWING`.  In noise to which as much is added that
#: follows itself by .9, 8 % of the rows after the 400th were in alarm with twice what is reached (`SWING` and all) and
#: 2 % with this, before single rows limited the rise.
SWING_ROOM = 4.0

#: A rise by this factor and more is told: changes that are found are 1.4 times as large then.
TOLD_RISE = 2.0


class Swings(NamedTuple):
    """How far statistics have been on each side of late, in units of their levels, and how often they have changed."""

    high: FloatArray = read_only(np.zeros(0))  # ``(k,)``: the largest above zero
    low: FloatArray = read_only(np.zeros(0))  # the largest below
    side: FloatArray = read_only(np.zeros(0))  # the last one on which the statistic was: 1, -1, or 0 for none
    changes: FloatArray = read_only(np.zeros(0))  # how often it came to another one
    row: float = 0.0  # the largest single row, in units of its level
    since: float | None = None  # seconds: when levels were raised by `TOLD_RISE` first
    most: float = 1.0  # the largest factor by which they were

    @classmethod
    def none(cls, statistics: int) -> Swings:
        """Return the state before the first row."""
        nothing = np.zeros(statistics)
        return cls(nothing, nothing, nothing, nothing)

    def after(self, ratios: FloatArray, row: float, time: float) -> tuple[Swings, float]:
        """Return the state after a row in which statistics have ``ratios (k,)`` to their levels, with their signs, and
        the row itself one; and the factor by which levels are raised in it."""
        kept = 1.0 - 1.0 / SWING_MEMORY
        known = np.where(np.isfinite(ratios), ratios, 0.0)
        side = np.where(np.abs(known) > SWING, np.sign(known), 0.0)
        comes = (side != 0.0) & (side != self.side)
        high, low = np.maximum(kept * self.high, known), np.maximum(kept * self.low, -known)
        changes, both = kept * self.changes + comes, np.minimum(high, low)
        largest = max((1.0 - 1.0 / ROW_MEMORY) * self.row, row if math.isfinite(row) else 0.0)
        swinging = both[changes > LEAST_SWINGS] / max(largest, 1.0)
        factor = 1.0 + SWING_ROOM * (float(swinging.max(initial=SWING)) - SWING)
        since = time if self.since is None and factor >= TOLD_RISE else self.since
        state = Swings(high, low, np.where(comes, side, self.side), changes, largest, since, max(self.most, factor))
        return state, factor
