"""Swings of residuals to both sides, with which levels rise: noise that is slower than in the rows without faults.

Means of autocorrelated residuals exceed levels that were learned from faster noise, alternately on both sides.  The
effect of a fault stays on one side as long as it lasts.  Once a statistic has changed sides, its level is therefore
raised by what it reaches on both sides, as a control chart is widened for autocorrelated data (Alwan & Roberts 1988).
An alarm that stays on one side is not affected.  Slower noise makes means larger, but not single rows.  If single rows
exceed their level, as with a sensor that jumps to and fro, levels rise by less in proportion.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from obsynth.numerics.arrays import FloatArray, read_only

#: Share of its level above which a statistic counts as being on one side.
SWING = 0.5

#: A statistic swings after more than so many changes of side: a fault and a second one of the other sign are two.
LEAST_SWINGS = 2.0

#: Numbers of rows after which a swing, and a large single row, count by 1/e.
SWING_MEMORY, ROW_MEMORY = 1_500.0, 100.0

#: Levels rise by so many times the value on both sides beyond `SWING`.  With added noise of the same variance and an
#: autocorrelation of .9, 2 % of the rows after the 400th were in alarm, compared with 8 % for a rise by twice the value
#: on both sides, both without the limit by single rows.
SWING_ROOM = 4.0

#: A rise by at least this factor is reported: detectable changes are then 1.4 times as large.
REPORTED_RISE = 2.0


class Swings(NamedTuple):
    """Recent sizes of statistics on each side, in units of their levels, with decaying memory, and changes of side."""

    high: FloatArray = read_only(np.zeros(0))  # ``(k,)``: largest value above zero
    low: FloatArray = read_only(np.zeros(0))  # largest size below zero
    side: FloatArray = read_only(np.zeros(0))  # last side of the statistic: 1, -1, or 0 for none
    changes: FloatArray = read_only(np.zeros(0))  # number of changes of side
    row: float = 0.0  # largest single row, in units of its level
    since: float | None = None  # seconds: time at which levels were first raised by `REPORTED_RISE`
    most: float = 1.0  # largest factor by which levels were raised

    @classmethod
    def none(cls, statistics: int) -> Swings:
        """Return the state before the first row."""
        nothing = np.zeros(statistics)
        return cls(nothing, nothing, nothing, nothing)

    def after(self, ratios: FloatArray, row: float, time: float) -> tuple[Swings, float]:
        """Return the state after a row, and the factor by which levels are raised in it.

        ``ratios (k,)`` are the signed statistics in units of their levels, and ``row`` is the statistic of the row
        alone in units of its level.
        """
        kept = 1.0 - 1.0 / SWING_MEMORY
        known = np.where(np.isfinite(ratios), ratios, 0.0)
        side = np.where(np.abs(known) > SWING, np.sign(known), 0.0)
        comes = (side != 0.0) & (side != self.side)
        high, low = np.maximum(kept * self.high, known), np.maximum(kept * self.low, -known)
        changes, both = kept * self.changes + comes, np.minimum(high, low)
        largest = max((1.0 - 1.0 / ROW_MEMORY) * self.row, row if math.isfinite(row) else 0.0)
        swinging = both[changes > LEAST_SWINGS] / max(largest, 1.0)
        factor = 1.0 + SWING_ROOM * (float(swinging.max(initial=SWING)) - SWING)
        since = time if self.since is None and factor >= REPORTED_RISE else self.since
        state = Swings(high, low, np.where(comes, side, self.side), changes, largest, since, max(self.most, factor))
        return state, factor
