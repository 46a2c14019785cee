"""What in rows without faults is to be looked at before a monitor is learned from them: events that raise the levels,
and outputs that are stuck."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from obsynth.data.signals import Signals, Stamps
from obsynth.data.stuck_sensors import stuck_rows, stuck_texts
from obsynth.experiments.monitors.learned import Raised
from obsynth.numerics.arrays import FloatArray


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
        stuck = {
            name: [(rows.start + first, rows.start + last) for first, last in stuck_rows(log[rows, i])]
            for i, name in enumerate(signals.names[signals.inputs :], 1 + signals.inputs)
        }
        yield from stuck_texts(stuck, shown, "; if it was, blank it in these rows, or give another log")

    return tuple(found())
