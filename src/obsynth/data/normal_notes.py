"""What in rows without faults is to be looked at before a monitor is learned from them.

Events that raise the levels, and outputs that repeat one value for longer than the log itself makes probable: sensors
that are stuck.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from obsynth.data.signals import Signals, Stamps
from obsynth.experiments.monitors.learned import Raised
from obsynth.numerics.arrays import FloatArray

#: A run of repeats counts from so many samples on, and where it is so many times as long as any that is usual.
LEAST_RUN, TIMES_USUAL = 6, 3.0
#: So many runs may be stuck; others must be this many to show what is usual.
MOST_STUCK_RUNS, LEAST_OTHER_RUNS = 100, 50
#: Expected number of runs so long, by the longest of the others, below which none is chance, and the share of these.
EXPECTED_RUNS, LONG_RUNS_SHARE = 1e-3, 0.1


def stuck_rows(values: FloatArray) -> list[tuple[int, int]]:
    """Return the first and last row of each run of equal samples of ``values (n,)``, NaN where there is none, that is
    improbable beside the others.

    Lengths of the longest tenth of the others are taken as geometric beyond the shortest of these: so a sensor of
    coarse steps, which repeats its value often, has to repeat it for longer.  Where a few runs alone are long, these
    are compared with the rest.
    """
    rows = np.flatnonzero(np.isfinite(values))
    begins = np.flatnonzero(np.diff(values[rows], prepend=np.nan) != 0.0)
    lengths = np.diff(np.append(begins, len(rows)))
    order = np.argsort(-lengths, kind="stable")
    for count in range(min(MOST_STUCK_RUNS, len(order) - LEAST_OTHER_RUNS), 0, -1):
        shortest, others = int(lengths[order[count - 1]]), np.sort(lengths[order[count:]])
        usual = others[-max(int(LONG_RUNS_SHARE * len(others)), 1) :]
        above = float((usual - usual[0]).mean())
        chance = len(usual) * (above / (1.0 + above)) ** (shortest - int(usual[0]))
        if shortest >= max(LEAST_RUN, TIMES_USUAL * int(usual[-1])) and chance < EXPECTED_RUNS:
            stuck = np.sort(order[:count])
            return [(int(rows[begins[i]]), int(rows[begins[i] + lengths[i] - 1])) for i in stuck]
    return []


#: Stretches in which an output is stuck that a note names.
MOST_RUNS_TOLD = 3


def notes_of_normal_rows(
    raised: Raised, numbers: NDArray[np.int64], log: FloatArray, rows: slice, signals: Signals, stamps: Stamps
) -> tuple[str, ...]:
    """Return the notes on ``rows`` of a ``log (n, 1 + nu + ny)``, from 0: on events that stand in rows of these
    ``numbers``, and on outputs that are stuck."""

    def shown(first: int, last: int) -> str:
        begin, end = (stamps.shown(float(log[row, 0])) for row in (first, last))
        return f"row {first} ({begin})" if first == last else f"rows {first} to {last} ({begin} to {end})"

    def found() -> Iterator[str]:
        if raised.events:
            where = ", ".join(
                f"{event.signal} in {shown(int(numbers[event.first]), int(numbers[event.last]))}"
                for event in raised.events
            )
            yield (
                f"What stands out of {where} raises the levels: without these rows, a change {raised.factor:.2g} times "
                f"smaller would pass that of {raised.statistic!r}. Look whether the plant was as usual there; if it "
                "was not, blank its outputs in these rows, or give another log."
            )
        for i, name in enumerate(signals.names[signals.inputs :], 1 + signals.inputs):
            runs = [(rows.start + first, rows.start + last) for first, last in stuck_rows(log[rows, i])]
            if runs:
                where = ", ".join(shown(*run) for run in runs[:MOST_RUNS_TOLD])
                more = f", and {len(runs) - MOST_RUNS_TOLD} more times" if len(runs) > MOST_RUNS_TOLD else ""
                yield (
                    f"{name} repeats one value in {where}{more}, for longer than it otherwise does. Look whether its "
                    "sensor was stuck; if it was, blank it in these rows, or give another log."
                )

    return tuple(found())
