"""Which rows of a long log a search is made on: the fit of all rows begins where it ends.

What is chosen by trying (steps, the delay of inputs, states for coloured noise and offsets, starts of the search) costs
hundreds of runs over the rows, and a thousand rows decide as well as all of them.  The rows are the first ones: they
begin where the log does.
"""

from __future__ import annotations

import numpy as np

from obsynth.monitoring.calibration.logs import RecordedLog

#: Rows that a search needs, and from how many times as many on it is made on these alone.
SEARCHED_ROWS, LONG_LOG = 1000, 2

#: Share of its deviation and of its measured samples that a signal must have in these rows, or they are twice as many.
MOVING_SHARE = 0.5


def is_long(log: RecordedLog) -> bool:
    """Whether a search is made on some rows of a log alone."""
    return log.samples >= LONG_LOG * SEARCHED_ROWS


def searched_rows(log: RecordedLog) -> RecordedLog:
    """Return the first rows of a log, as many as a search needs; the log itself where it is not much longer."""
    count = SEARCHED_ROWS
    while count * LONG_LOG <= log.samples:
        if _moves(log, count):
            return log.first(count)
        count *= 2
    return log


def _moves(log: RecordedLog, count: int) -> bool:
    """Whether inputs move in the first rows as they do later, and outputs are measured as often."""
    inputs = np.std(log.u[:count], axis=0) >= MOVING_SHARE * np.std(log.u, axis=0)
    seen = np.isfinite(log.y)
    return bool(inputs.all() and (seen[:count].mean(axis=0) >= MOVING_SHARE * seen.mean(axis=0)).all())
