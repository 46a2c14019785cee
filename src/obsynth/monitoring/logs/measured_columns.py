"""Columns of a log that measure nothing, and infinite cells, which count as missing."""

from __future__ import annotations

import shlex
from collections.abc import Collection, Mapping, Sequence

import numpy as np

from obsynth.errors import counted
from obsynth.numerics.arrays import FloatArray

#: A column without a number in more than this share of the rows is named where too few rows can be used.
MISSING_SHARE = 0.25

#: An output that holds one number in so many rows, all there are, shows no noise, as a sensor that works would; a
#: coarse one may repeat a number for a while.
CONSTANT_ROWS = 100


class MeasuredColumns:
    """Which columns of a log have held finite numbers, from which to which, and which have held infinite ones."""

    def __init__(self) -> None:
        self.rows = 0
        #: The smallest and the largest number of each column, NaN where it has held none.
        self._low, self._high = np.zeros(0), np.zeros(0)
        #: By column: how many cells are infinite, and the row of the first one, from 1.
        self._infinite: dict[str, tuple[int, int]] = {}

    def take(self, chunk: FloatArray, columns: Sequence[str], formed: Collection[int] = ()) -> None:
        """Take rows of time and signals ``(n, 1 + columns)``, and make what is infinite in them missing; columns that
        are ``formed`` from others hold nothing of their own, and those that several signals share count once."""
        before, self.rows = self.rows, self.rows + len(chunk)
        values = chunk[:, 1:]
        infinite = np.isinf(values)
        for place in np.flatnonzero(infinite.any(axis=0)).tolist():
            if place + 1 not in formed and columns.index(columns[place]) == place:
                rows = np.flatnonzero(infinite[:, place])
                count, first = self._infinite.get(columns[place], (0, before + int(rows[0]) + 1))
                self._infinite[columns[place]] = count + len(rows), first
        values[infinite] = np.nan
        low, high = np.fmin.reduce(values, axis=0), np.fmax.reduce(values, axis=0)
        if before:
            low, high = np.fmin(low, self._low), np.fmax(high, self._high)
        self._low, self._high = low, high

    def empty(self, signals: Sequence[tuple[str, str]]) -> list[tuple[str, str]]:
        """Return those columns, each with its signal, in which no row has held a finite number."""
        return [pair for pair, low in zip(signals, self._low, strict=False) if np.isnan(low)]

    def notes(self, signals: Sequence[tuple[str, str]], inputs: int) -> list[str]:
        """Return texts for columns, each with its signal, of which the first are ``inputs``, that hold nothing, and for
        outputs that hold one number."""
        names = [signal for _, signal in signals]
        ranges = list(zip(names, self._low.tolist(), self._high.tolist(), strict=False))
        return [
            *(never_measured(column, signal) for column, signal in self.empty(signals)),
            *constant_texts(ranges[inputs:], self.rows),
        ]

    def warnings(self) -> list[str]:
        """Return a text for each column with infinite cells."""
        return [
            f"{counted(count, 'infinite cell')} of {column!r} counted as missing, first in row {row}."
            for column, (count, row) in self._infinite.items()
        ]


def never_measured(column: str, signal: str) -> str:
    """Return what is wrong with a column without a number, and what mends it."""
    return (
        f"The column {column!r} holds no number: {signal!r} is never measured. Name the column that holds it (--map "
        f"{shlex.quote(signal)}=COLUMN, or columns={{{signal!r}: 'COLUMN'}}), or leave it out of the plant."
    )


def constant_texts(ranges: Sequence[tuple[str, float, float]], rows: int) -> list[str]:
    """Return what is to be said of outputs, each with its smallest and its largest number, that hold one in all rows,
    where these are many."""
    if rows < CONSTANT_ROWS:
        return []
    return [
        f"{signal} is {low:.6g} in all {rows} rows: its sensor may be stuck, or not connected."
        for signal, low, high in ranges
        if low == high
    ]


def mostly_missing(rows: FloatArray, signals: Mapping[str, int]) -> str:
    """Return the signals, each with its place in rows ``(n, columns)``, that are missing in many of them, as a sentence
    with a blank before it; empty where there are none."""
    counts = {name: int((~np.isfinite(rows[:, place])).sum()) for name, place in signals.items()}
    listed = [f"{name} in {count}" for name, count in counts.items() if count > MISSING_SHARE * len(rows)]
    return f" Of its {len(rows)} rows these are missing: {', '.join(listed)}." if listed else ""
