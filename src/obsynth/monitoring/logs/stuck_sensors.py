"""Outputs that repeat one value for longer than the log itself makes probable: sensors that are stuck.

Repeats are counted row by row in constant memory, in streams as in files.  Normal logs decide after how many equal
samples a sensor counts as stuck (`longest_repeats`); that is then decided in the row itself, whatever comes later
(`Unrepeated`).
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from obsynth.numerics.arrays import FloatArray

#: A run of repeats counts from so many samples on, and where it is so many times as long as any that is usual.
LEAST_RUN, TIMES_USUAL = 6, 3.0

#: So many runs may be stuck; others must be this many to show what is usual.
MOST_STUCK_RUNS, LEAST_OTHER_RUNS = 100, 50

#: Expected number of runs so long, by the longest of the others, below which none is chance, and the share of these.
EXPECTED_RUNS, LONG_RUNS_SHARE = 1e-3, 0.1

#: Third differences of noise change their sign in about three of four samples, those of a smooth course with more than
#: four samples a period in fewer than half of them.
NOISY_REVERSALS = 0.5

#: What comes to rest does so by changes that are this small beside the median one, or that shrink to a single step of
#: its rounding, equal within the second share; what was at rest begins with changes to one side.  So many are looked
#: at.
RESTING_CHANGE, SAME_STEP, LAST_CHANGES = 0.1, 0.01, 3

#: Where noise makes the changes, at least this share of them turns back the one before.  If a sensor is so coarse that
#: they are single steps, only what goes to one side, and takes longer from step to step, comes to rest.
TURNED_SHARE = 0.5

#: An alarm says that a sensor is stuck where it has repeated its value for so many rows more than it may: what it does
#: not say would be missed, and no other alarm may come without it.
STUCK_ALARM_ROWS = 100

#: Stretches in which an output is stuck that a note names.
MOST_LISTED_RUNS = 3

#: Rows of a stream that wait to be looked at together.
_WAITING_ROWS = 1024


class _Repeats(NamedTuple):
    """A run of equal samples, and the changes before it."""

    length: int
    first: int
    last: int
    before: tuple[float, ...]  # the last changes, of which the latest begins it
    lengths: tuple[int, ...]  # of the runs between these


class _Output:
    """What one output has shown so far."""

    def __init__(self) -> None:
        self._lengths, self._long = Counter[int](), list[_Repeats]()
        self._run: _Repeats | None = None  # the one that goes on
        self._opening, self._tail = np.zeros(0), np.zeros(0)  # first changes; last samples
        self._sizes, self._step = Counter[int](), np.inf  # of changes: how many of which power of two; the smallest
        self._reversals, self._pairs = 0, 0  # of third differences
        self._turns = 0  # changes that go back on the one before

    def take(self, numbers: FloatArray, values: FloatArray) -> None:
        """Take samples ``(n,)`` that were measured in the rows of these ``numbers (n,)``."""
        if not len(values):
            return
        recent = np.concatenate([self._tail, values])
        third = np.diff(recent, n=3)
        signs = third[:-1] * third[1:]
        self._reversals += int(np.sum(signs < 0.0))
        self._pairs += int(np.sum(signs != 0.0))
        changed = np.diff(values, prepend=self._tail[-1] if len(self._tail) else np.nan)
        begins = np.flatnonzero(changed != 0.0)
        changes = changed[begins]
        if self._run is None:
            changes = changes[1:]  # the first sample changes nothing
        self._sizes.update(np.frexp(changes)[1].tolist())
        self._step = float(np.min(np.abs(changes), initial=self._step))
        before = () if self._run is None else self._run.before
        all_changes = np.concatenate([before, changes])
        self._turns += int(np.sum(all_changes[max(len(before), 1) :] * all_changes[max(len(before), 1) - 1 : -1] < 0.0))
        self._opening = np.concatenate([self._opening, changes])[:LAST_CHANGES]
        earlier = () if self._run is None else self._run.lengths
        edges = np.append(begins, len(values))
        if self._run is not None and edges[0]:
            self._run = self._run._replace(length=self._run.length + int(edges[0]), last=int(numbers[edges[0] - 1]))
        lengths = np.diff(edges)
        if len(lengths):
            # All but the last are over, and what went on before them is.
            if self._run is not None:
                self._end(self._run)
                earlier = (*earlier, self._run.length)
            shift, runs = len(all_changes) - len(begins) + 1, [*earlier, *lengths.tolist()]
            for i in [*np.flatnonzero(lengths[:-1] >= LEAST_RUN), len(lengths) - 1]:
                run = _Repeats(
                    int(lengths[i]),
                    int(numbers[edges[i]]),
                    int(numbers[edges[i + 1] - 1]),
                    tuple(all_changes[max(i + shift - LAST_CHANGES, 0) : i + shift].tolist()),
                    tuple(runs[max(i + len(earlier) - LAST_CHANGES + 1, 0) : i + len(earlier)]),
                )
                if i < len(lengths) - 1:
                    self._long.append(run)
                else:
                    self._run = run
            self._lengths.update(lengths[:-1].tolist())
            if len(self._long) > 2 * MOST_STUCK_RUNS:
                self._long = self._longest(self._long)
        self._tail = recent[-LAST_CHANGES - 1 :]

    def _end(self, run: _Repeats) -> None:
        self._lengths[run.length] += 1
        if run.length >= LEAST_RUN:
            self._long.append(run)

    @staticmethod
    def _longest(runs: Sequence[_Repeats]) -> list[_Repeats]:
        return sorted(runs, key=lambda run: (-run.length, run.first))[:MOST_STUCK_RUNS]

    def stuck(self) -> list[tuple[int, int]]:
        """Return first and last rows of the runs that are improbable beside the others, in order.

        Lengths of the longest tenth of the others are taken as geometric beyond the shortest of these: so a sensor of
        coarse steps, which repeats its value often, has to repeat it for longer.  Where a few runs alone are long,
        these are compared with the rest.  What has no noise, or comes to rest, is not stuck.
        """
        if not self.is_noisy:
            return []
        counts, runs = self._all_runs()
        for count in range(min(len(runs), counts.total() - LEAST_OTHER_RUNS), 0, -1):
            shortest, other_lengths = runs[count - 1].length, counts - Counter(run.length for run in runs[:count])
            least, mean, longest, size = _longest_tenth(other_lengths)
            above = mean - least
            chance = size * (above / (1.0 + above)) ** (shortest - least)
            if shortest >= TIMES_USUAL * longest and chance < EXPECTED_RUNS:
                stuck_runs = [run for run in runs[:count] if not self._rests(run)]
                return [(run.first, run.last) for run in sorted(stuck_runs, key=lambda run: run.first)]
        return []

    @property
    def is_noisy(self) -> bool:
        """Whether its samples move as noise does."""
        return self._run is not None and self._reversals >= NOISY_REVERSALS * max(self._pairs, 1)

    def longest_usual(self) -> int:
        """Return how many samples in a row have been equal at most, where it was not stuck; zero where too few runs
        show that, or it has no noise."""
        stuck = set(self.stuck())
        if not self.is_noisy:
            return 0
        counts, runs = self._all_runs()
        counts = counts - Counter(run.length for run in runs if (run.first, run.last) in stuck)
        return max(counts) if counts.total() >= LEAST_OTHER_RUNS else 0

    def _all_runs(self) -> tuple[Counter[int], list[_Repeats]]:
        """Return how often runs of each length have been, and the longest of them, that which goes on among them."""
        counts, runs = self._lengths.copy(), self._long
        if self._run is not None:
            counts[self._run.length] += 1
            runs = [*self._long, *([self._run] if self._run.length >= LEAST_RUN else [])]
        return counts, self._longest(runs)

    def _rests(self, run: _Repeats) -> bool:
        """Whether a run begins as that of a course without noise does that comes to rest, or was at rest before."""
        changes = np.array(run.before) if run.before else self._opening
        sizes = np.abs(changes)
        if (sizes <= RESTING_CHANGE * self._usual_change()).all():
            return True
        is_to_one_side = bool((changes > 0.0).all() or (changes < 0.0).all())
        if not run.before:
            return is_to_one_side
        single = sizes <= (1.0 + SAME_STEP) * self._step
        if single.all() and self._turns >= TURNED_SHARE * self._sizes.total():
            return is_to_one_side and bool((np.diff(run.lengths) > 0).all())
        slower = sizes[1:] <= (1.0 + SAME_STEP) * sizes[:-1]
        return bool(slower.all() and single[-1])

    def _usual_change(self) -> float:
        """Return the median change, as the power of two below it."""
        half, count = 0.5 * self._sizes.total(), 0
        for power in sorted(self._sizes):
            count += self._sizes[power]
            if count >= half:
                return float(np.ldexp(0.5, power))
        return 0.0


def _longest_tenth(counts: Counter[int]) -> tuple[int, float, int, int]:
    """Return shortest, mean, longest and number of the longest tenth of lengths that occur so often."""
    lengths = np.array(sorted(counts, reverse=True))
    often = np.array([counts[length] for length in lengths.tolist()])
    size = max(int(LONG_RUNS_SHARE * often.sum()), 1)
    before = np.cumsum(often) - often
    taken = np.clip(size - before, 0, often)
    return int(lengths[taken > 0][-1]), float(lengths @ taken) / size, int(lengths[0]), size


class RepeatedValues:
    """Gathers rows of outputs, to tell which of them are stuck, and in which rows."""

    def __init__(self, outputs: int) -> None:
        self._outputs = [_Output() for _ in range(outputs)]
        self._waiting, self._waits, self._rows = list[FloatArray](), 0, 0

    def take(self, values: FloatArray) -> None:
        """Take rows ``(n, ny)``, NaN where nothing was measured; they are counted from 0."""
        self._waiting.append(np.array(values))
        self._waits += len(values)
        if self._waits >= _WAITING_ROWS:
            self._look()

    def _look(self) -> None:
        if not self._waits:
            return
        values = np.concatenate(self._waiting)
        numbers = np.arange(self._rows, self._rows + len(values))
        self._waiting, self._waits, self._rows = [], 0, self._rows + len(values)
        for output, column in zip(self._outputs, values.T, strict=True):
            measured = np.isfinite(column)
            # Wild numbers have differences that overflow, which are no repeats.
            with np.errstate(over="ignore", invalid="ignore"):
                output.take(numbers[measured], column[measured])

    def stuck(self) -> list[list[tuple[int, int]]]:
        """Return by output the rows in which it is stuck."""
        self._look()
        return [output.stuck() for output in self._outputs]


def stuck_rows(values: FloatArray) -> list[tuple[int, int]]:
    """Return the rows in which an output ``(n,)``, NaN where it was not measured, is stuck."""
    gathered = RepeatedValues(1)
    gathered.take(values[:, None])
    return gathered.stuck()[0]


def without_repeats(values: FloatArray, stuck: Iterable[Sequence[tuple[int, int]]]) -> FloatArray:
    """Return outputs ``(n, ny)`` with NaN for what each repeats in the rows in which it is stuck: no noise of its
    sensor is there."""
    outputs = np.array(values)
    for i, runs in enumerate(stuck):
        for first, last in runs:
            outputs[first + 1 : last + 1, i] = np.nan
    return outputs


def rising(times: Sequence[float], earlier: float = -np.inf) -> NDArray[np.bool_]:
    """Return which rows come later than all before them, and than a time ``earlier`` than these ``(n,)``: others are
    left out."""
    latest = np.maximum.accumulate([earlier, *times[:-1]])
    return np.asarray(np.asarray(times) > latest)


def longest_repeats(logs: Sequence[FloatArray]) -> FloatArray:
    """Return from which equal sample in a row on each output says nothing any more ``(ny,)``, from normal logs
    ``(n, ny)``: `TIMES_USUAL` times as many as there ever are where it is not stuck, or the second one where there are
    never two; that costs one sample where it is chance. Infinite where it is not known."""
    limits = np.full(logs[0].shape[1], np.inf)
    for i in range(len(limits)):
        outputs = [_Output() for _ in logs]
        for output, log in zip(outputs, logs, strict=True):
            measured = np.flatnonzero(np.isfinite(log[:, i]))
            with np.errstate(over="ignore", invalid="ignore"):
                output.take(measured.astype(np.float64), log[measured, i])
        usual = [output.longest_usual() for output in outputs]
        if all(usual):
            limits[i] = np.ceil(TIMES_USUAL * max(usual)) if max(usual) > 1 else 2.0
    return limits


class Unrepeated:
    """Leaves out what each output repeats after so many equal samples ``longest (ny,)``, row by row: from then on, its
    sensor may be stuck, and says nothing.  A missing sample is no other one."""

    def __init__(self, longest: FloatArray) -> None:
        self.longest = np.array(longest)
        #: The last value of each output, and how many samples in a row have had it ``(2, ny)``.
        self.memory = np.zeros((2, len(self.longest)))

    def of_rows(self, values: FloatArray, counted: NDArray[np.bool_]) -> tuple[FloatArray, FloatArray]:
        """Return outputs ``(n, ny)`` without what they repeat in rows that are ``counted (n,)``, and the memory after
        each row ``(n, 2, ny)``; nothing is remembered yet."""
        outputs, after = np.array(values), np.empty((len(values), 2, len(self.longest)))
        rows = np.arange(1, len(values) + 1)
        for i, (last, equal) in enumerate(self.memory.T.tolist()):
            measured = np.flatnonzero(np.isfinite(values[:, i]) & counted)
            own = values[measured, i]
            place, goes_on = np.arange(len(own)), np.diff(own, prepend=last) == 0.0
            if not equal:
                goes_on[:1] = False
            begun = np.maximum.accumulate(np.where(goes_on, -1, place))
            counts = place - begun + np.where(begun < 0, equal, 1.0)
            outputs[measured[counts >= self.longest[i]], i] = np.nan
            # What is remembered after a row is what its last sample made it.
            latest = np.searchsorted(measured + 1, rows, side="right")
            after[:, 0, i] = np.concatenate([[last], own])[latest]
            after[:, 1, i] = np.concatenate([[equal], counts])[latest]
        return outputs, after


def _rows(first: int, last: int) -> str:
    return f"rows {first} to {last}"


def stuck_texts(
    stuck: Mapping[str, Sequence[tuple[int, int]]], rows_text: Callable[[int, int], str] = _rows, more: str = ""
) -> Iterator[str]:
    """Yield a sentence on each output that is stuck: ``shown`` says its rows, ``more`` what to do if its sensor was."""
    for name, runs in stuck.items():
        if runs:
            where = ", ".join(rows_text(*run) for run in runs[:MOST_LISTED_RUNS])
            further = f", and {len(runs) - MOST_LISTED_RUNS} more times" if len(runs) > MOST_LISTED_RUNS else ""
            yield (
                f"{name} repeats one value in {where}{further}, for longer than it otherwise does. Look whether its "
                f"sensor was stuck{more}."
            )
