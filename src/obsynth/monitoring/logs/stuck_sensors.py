"""Stuck sensors: outputs that repeat one value for improbably long.

Repeats are counted row by row in constant memory, for streams and files alike.  Logs without faults give the number of
equal samples after which a sensor counts as stuck (`longest_repeats`).  In later runs each row is then decided without
later rows (`Unrepeated`).
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from obsynth.numerics.arrays import FloatArray

#: A run of equal samples may be stuck if it has at least so many samples, and is so many times as long as usual ones.
LEAST_RUN, TIMES_USUAL = 6, 3.0

#: Largest number of runs that may be stuck, and least number of other runs, which show the usual lengths.
MOST_STUCK_RUNS, LEAST_OTHER_RUNS = 100, 50

#: A run is not due to chance if the expected number of runs of its length is below this number.  That is extrapolated
#: from the second share of the other runs, the longest ones.
EXPECTED_RUNS, LONG_RUNS_SHARE = 1e-3, 0.1

#: Least share of sign changes of third differences in noise.  It is about three quarters for white noise, and less than
#: a half for smooth signals with more than four samples a period.
NOISY_REVERSALS = 0.5

#: A signal comes to rest if its last changes are below this share of the median one, or decrease to a single step of
#: its resolution; changes count as equal within the second share.  A signal that was at rest begins with changes in one
#: direction.  The third number is that of the changes that are considered.
RESTING_CHANGE, SAME_STEP, LAST_CHANGES = 0.1, 0.01, 3

#: Changes by noise reverse the one before at least in this share of cases.  If the resolution of a noisy sensor is so
#: coarse that its changes are single steps, it comes to rest only by steps in one direction at growing intervals.
TURNED_SHARE = 0.5

#: An alarm is raised if a sensor has repeated its value for so many rows more than usual, since without its values
#: faults may be missed, and no other alarm shows that.
STUCK_ALARM_ROWS = 100

#: Largest number of stretches of a stuck output in a note.
MOST_LISTED_RUNS = 3

#: Number of rows of a stream that are processed together.
_WAITING_ROWS = 1024


class _Repeats(NamedTuple):
    """A run of equal samples, and the changes before it."""

    length: int
    first: int
    last: int
    before: tuple[float, ...]  # the last changes; the run begins with the latest one
    lengths: tuple[int, ...]  # lengths of the runs between these changes


class _Output:
    """The runs of equal samples of one output, and statistics of its changes."""

    def __init__(self) -> None:
        self._lengths, self._long = Counter[int](), list[_Repeats]()  # number of runs by length; the longest runs
        self._run: _Repeats | None = None  # the present run
        self._opening, self._tail = np.zeros(0), np.zeros(0)  # first changes; last samples
        self._sizes, self._step = Counter[int](), np.inf  # number of changes by power of two; the smallest change
        self._reversals, self._pairs = 0, 0  # sign changes of third differences, and pairs of these
        self._turns = 0  # changes that reverse the one before

    def take(self, numbers: FloatArray, values: FloatArray) -> None:
        """Add samples ``(n,)`` that were measured in the rows with these ``numbers (n,)``."""
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
            changes = changes[1:]  # the first sample is no change
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
            # All runs but the last have ended, including the one before these samples.
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
        """Return first and last rows of improbably long runs, in order.

        The excess lengths of the longest tenth of the other runs are assumed to be geometric.  A sensor of coarse
        resolution, which often repeats its value, therefore has to repeat it for longer.  If a few runs alone are long,
        they are compared with the rest.  An output without noise, or one that comes to rest, is not stuck.
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
        """Whether its samples change as noise does, by the signs of third differences."""
        return self._run is not None and self._reversals >= NOISY_REVERSALS * max(self._pairs, 1)

    def longest_usual(self) -> int:
        """Return the largest number of equal consecutive samples while it was not stuck; zero if there are too few
        runs, or no noise."""
        stuck = set(self.stuck())
        if not self.is_noisy:
            return 0
        counts, runs = self._all_runs()
        counts = counts - Counter(run.length for run in runs if (run.first, run.last) in stuck)
        return max(counts) if counts.total() >= LEAST_OTHER_RUNS else 0

    def _all_runs(self) -> tuple[Counter[int], list[_Repeats]]:
        """Return the number of runs of each length, and the longest runs, both with the present one."""
        counts, runs = self._lengths.copy(), self._long
        if self._run is not None:
            counts[self._run.length] += 1
            runs = [*self._long, *([self._run] if self._run.length >= LEAST_RUN else [])]
        return counts, self._longest(runs)

    def _rests(self, run: _Repeats) -> bool:
        """Whether a run belongs to a signal without noise that came to rest, or was at rest from the beginning on."""
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
        """Return the median size of the changes, rounded down to a power of two."""
        half, count = 0.5 * self._sizes.total(), 0
        for power in sorted(self._sizes):
            count += self._sizes[power]
            if count >= half:
                return float(np.ldexp(0.5, power))
        return 0.0


def _longest_tenth(counts: Counter[int]) -> tuple[int, float, int, int]:
    """Return the shortest, mean and longest length, and the number, of the longest tenth of runs; ``counts`` are their
    numbers by length."""
    lengths = np.array(sorted(counts, reverse=True))
    often = np.array([counts[length] for length in lengths.tolist()])
    size = max(int(LONG_RUNS_SHARE * often.sum()), 1)
    before = np.cumsum(often) - often
    taken = np.clip(size - before, 0, often)
    return int(lengths[taken > 0][-1]), float(lengths @ taken) / size, int(lengths[0]), size


class RepeatedValues:
    """Collects rows of outputs, and returns which outputs are stuck, and in which rows."""

    def __init__(self, outputs: int) -> None:
        self._outputs = [_Output() for _ in range(outputs)]
        self._waiting, self._waits, self._rows = list[FloatArray](), 0, 0

    def take(self, values: FloatArray) -> None:
        """Add rows ``(n, ny)``, NaN where nothing was measured; rows are counted from 0."""
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
            # Differences of very large numbers may overflow; these are no repeats.
            with np.errstate(over="ignore", invalid="ignore"):
                output.take(numbers[measured], column[measured])

    def stuck(self) -> list[list[tuple[int, int]]]:
        """Return, for each output, the rows in which it is stuck."""
        self._look()
        return [output.stuck() for output in self._outputs]


def stuck_rows(values: FloatArray) -> list[tuple[int, int]]:
    """Return the rows in which an output ``(n,)``, NaN where it was not measured, is stuck."""
    gathered = RepeatedValues(1)
    gathered.take(values[:, None])
    return gathered.stuck()[0]


def without_repeats(values: FloatArray, stuck: Iterable[Sequence[tuple[int, int]]]) -> FloatArray:
    """Return outputs ``(n, ny)`` with NaN for repeated values of stuck outputs, which have no noise of the sensor."""
    outputs = np.array(values)
    for i, runs in enumerate(stuck):
        for first, last in runs:
            outputs[first + 1 : last + 1, i] = np.nan
    return outputs


def rising(times: Sequence[float], earlier: float = -np.inf) -> NDArray[np.bool_]:
    """Return which rows ``(n,)`` are later than all rows before them, and later than a time ``earlier``."""
    latest = np.maximum.accumulate([earlier, *times[:-1]])
    return np.asarray(np.asarray(times) > latest)


def longest_repeats(logs: Sequence[FloatArray]) -> FloatArray:
    """Return the number of equal consecutive samples from which on each output counts as stuck ``(ny,)``.

    It is `TIMES_USUAL` times the largest number in logs without faults ``(n, ny)``.  If these have no equal consecutive
    samples, it is two, which costs one sample if it occurs by chance.  It is infinite if the logs do not show it.
    """
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
    """Removes repeated values of each output from the equal sample number ``longest (ny,)`` on, row by row, since its
    sensor may be stuck.  A missing sample does not end a run of equal ones."""

    def __init__(self, longest: FloatArray) -> None:
        self.longest = np.array(longest)
        #: The last value of each output, and the number of consecutive samples with this value ``(2, ny)``.
        self.memory = np.zeros((2, len(self.longest)))

    def of_rows(self, values: FloatArray, counted: NDArray[np.bool_]) -> tuple[FloatArray, FloatArray]:
        """Return outputs ``(n, ny)`` without repeated values, and the memory after each row ``(n, 2, ny)``.

        Only rows that are ``counted (n,)`` are considered.  The own `memory` does not change.
        """
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
            # The memory after a row is that after its last measured sample.
            latest = np.searchsorted(measured + 1, rows, side="right")
            after[:, 0, i] = np.concatenate([[last], own])[latest]
            after[:, 1, i] = np.concatenate([[equal], counts])[latest]
        return outputs, after


def _rows(first: int, last: int) -> str:
    return f"rows {first} to {last}"


def stuck_texts(
    stuck: Mapping[str, Sequence[tuple[int, int]]], rows_text: Callable[[int, int], str] = _rows, more: str = ""
) -> Iterator[str]:
    """Yield a sentence on each stuck output; ``rows_text`` formats its rows, and ``more`` ends the sentence."""
    for name, runs in stuck.items():
        if runs:
            where = ", ".join(rows_text(*run) for run in runs[:MOST_LISTED_RUNS])
            further = f", and {len(runs) - MOST_LISTED_RUNS} more times" if len(runs) > MOST_LISTED_RUNS else ""
            yield (
                f"{name} repeats one value in {where}{further}, for longer than it otherwise does. Look whether its "
                f"sensor was stuck{more}."
            )
