"""Notes on rows without faults: events that raise the levels, stuck outputs, residuals that grow where inputs move."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from obsynth.monitoring.logs.stamps import Stamps
from obsynth.monitoring.logs.stuck_sensors import stuck_texts
from obsynth.monitoring.thresholds.learned import LearnedThresholds, duration
from obsynth.monitoring.thresholds.learned_from_rows import LeftOut, Raised
from obsynth.monitoring.thresholds.learned_levels import CHANCE_DEVIATIONS, normal_scores
from obsynth.numerics.arrays import FloatArray
from obsynth.results.number_texts import number

#: An input counts as moving in a row if it changes by more than so many times its median change.  A held input moves
#: wherever it changes, and a sine nowhere.
MOVES = 5.0

#: Number of rows from a move on whose residuals are compared with those of other rows, least number of moves, share of
#: the residuals that count as large, and factor by which these must be larger to be reported.
AFTER_A_MOVE, LEAST_MOVES, LARGE_SHARE, LARGER = 3, 20, 0.1, 2.0


#: Levels are useless if events raise them so much that a change must be so many times larger; factors above the second
#: number are not printed.
USELESS_FACTOR, MOST_REPORTED_FACTOR = 100.0, 1000.0

#: Suggested level of an estimate that is not watched, in units of its largest value without a fault.
ROOM_ABOVE = 1.5


def notes_of_normal_rows(
    raised: Raised,
    numbers: NDArray[np.int64],
    times: FloatArray,
    wanted: Sequence[tuple[int, int]],
    stuck: Mapping[str, Sequence[tuple[int, int]]],
    ends: Sequence[tuple[int, int]],
    stamps: Sequence[Stamps],
) -> tuple[str, ...]:
    """Return the notes on ``wanted`` rows of logs: on events that raise levels, and on stuck outputs.

    ``numbers`` are those of the rows that levels were learned from, in which events are counted.  ``times (n,)`` are
    those of all rows, and ``ends`` the first and last rows of each log.
    """

    def shown(first: int, last: int) -> str:
        place = next(i for i, (_, end) in enumerate(ends) if first < end)
        begin, end = (stamps[place].shown(float(times[row])) for row in (first, last))
        a, b = first - ends[place][0], last - ends[place][0]
        of_log = f" of log {place + 1}" if len(ends) > 1 else ""
        return f"row {a}{of_log} ({begin})" if a == b else f"rows {a} to {b}{of_log} ({begin} to {end})"

    def notes() -> Iterator[str]:
        if raised.events:
            where = ", ".join(
                f"{event.signal} in {shown(int(numbers[event.first]), int(numbers[event.last]))}"
                for event in raised.events
            )
            yield _on_events(where, raised)
        runs_in_rows = {
            name: [(begin, end) for begin, end in runs if any(end >= a and begin < b for a, b in wanted)]
            for name, runs in stuck.items()
        }
        yield from stuck_texts(runs_in_rows, shown, ": what it repeats there counts as not measured")

    return tuple(notes())


def _on_events(where: str, raised: Raised) -> str:
    """Return the note on events in the rows ``where``."""
    if raised.factor >= USELESS_FACTOR:
        most = raised.factor > MOST_REPORTED_FACTOR
        times = f"more than {MOST_REPORTED_FACTOR:.0f}" if most else f"{raised.factor:.3g}"
        return (
            f"These thresholds are of no use: what stands out of {where} is no noise (a fault, or wrong samples), and "
            f"with it a change has to be {times} times larger to pass the level of {raised.statistic!r}. Blank its "
            "outputs in these rows, or give another log."
        )
    return (
        f"What stands out of {where} raises the levels: without these rows, a change {raised.factor:.2g} times "
        f"smaller would pass that of {raised.statistic!r}. Look whether the plant was as usual there; if it "
        "was not, blank its outputs in these rows, or give another log."
    )


def notes_of_sizes(white: FloatArray, inputs: FloatArray) -> tuple[str, ...]:
    """Return a note if whitened residuals ``(n, m)`` are larger after moves of ``inputs (n, nu)``."""
    count, ratio = _larger_at_moves(np.sum(white**2, axis=1), inputs)
    if ratio < LARGER:
        return ()
    return (
        f"Where inputs move, and in the {AFTER_A_MOVE - 1} rows after, large residuals are {ratio:.2g} times as "
        f"large as elsewhere ({count} moves): errors of the model raise the levels, more than noise does. A "
        "design that follows the plant there has lower levels: with calibrated constants, or a nonlinear observer "
        "in place of that of a linearised plant.",
    )


def notes_of_starts(divided: Mapping[str, float]) -> tuple[str, ...]:
    """Return notes on faults whose estimates are ``divided`` from the offset of a sensor at the start of a log."""
    return tuple(
        f"The estimate of {name} stays what the start of this log made of it and of the unknown offset of a sensor: it "
        f"varies by {share:.2g} of its standard deviation here. A run with another start may alarm without a fault: go "
        "on from the state of this log (--state), or state the offset."
        for name, share in divided.items()
    )


def notes_of_left_out(
    estimates: Sequence[LeftOut], learned: LearnedThresholds, units: Mapping[str, str]
) -> tuple[str, ...]:
    """Return notes on estimates of faults that are not watched; ``units``: of the plant's signals, by name."""

    def reason(estimate: LeftOut) -> str:
        if estimate.is_redundant:
            return "the other columns follow from it in these rows, or it from them"
        if estimate.needed:
            lasting = duration(estimate.needed * learned.dt)
            needed = f"about {estimate.needed:,} ({lasting}) are needed"
            return f"it varies too slowly for {learned.rows:,} rows; {needed}"
        return "it follows something slow or periodic in these rows, which is no noise"

    def note(estimate: LeftOut) -> str:
        unit = units.get(estimate.name.removeprefix("fhat[").removesuffix("]"), "1")
        largest, level = number(estimate.largest, digits=3), number(ROOM_ABOVE * estimate.largest, digits=2)
        if unit not in ("", "1"):
            largest, level = f"{largest} {unit}", f"{level} {unit}"
        return (
            f"{estimate.name} is not watched: {reason(estimate)}. It is {largest} at most here: a level above "
            f"(--threshold, thresholds), such as {level}, alarms for as long as a fault lasts, with no rate that is "
            "known."
        )

    return tuple(note(estimate) for estimate in estimates)


def _larger_at_moves(sizes: FloatArray, inputs: FloatArray) -> tuple[int, float]:
    """Return the number of moves of ``inputs (n, nu)``, and the factor by which residuals with squares ``sizes (n,)``
    are larger after them; zero if that may be chance."""
    windows = np.lib.stride_tricks.sliding_window_view(sizes, AFTER_A_MOVE).mean(axis=1)
    changes = np.abs(np.diff(inputs, axis=0, prepend=inputs[:1]))
    moves = np.any(changes > MOVES * np.nanmedian(changes, axis=0), axis=1)
    close = np.convolve(moves, np.ones(2 * AFTER_A_MOVE - 1), mode="same") > 0.0
    finite = np.isfinite(windows)
    after, calm = windows[finite & moves[: len(windows)]], windows[finite & ~close[: len(windows)]]
    count = len(after)
    if min(count, len(calm)) < LEAST_MOVES:
        return count, 0.0
    lead = float(normal_scores(np.concatenate([after, calm]))[:count].mean() * np.sqrt(count))
    large = 1.0 - LARGE_SHARE
    return count, float(np.sqrt(np.quantile(after, large) / np.quantile(calm, large))) * (lead > CHANCE_DEVIATIONS)
