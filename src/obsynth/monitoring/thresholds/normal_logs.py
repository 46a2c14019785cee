"""Logs without faults that thresholds are learned from: their rows one after the other, and what is stuck in them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from obsynth.errors import SpecError
from obsynth.monitoring.logs.log_tables import parsed_rows
from obsynth.monitoring.logs.measured_columns import mostly_missing
from obsynth.monitoring.logs.signals import LogSignals
from obsynth.monitoring.logs.sources import CHUNK_ROWS, Data, Logs, chunks
from obsynth.monitoring.logs.stamps import Stamps
from obsynth.monitoring.logs.stuck_sensors import Unrepeated, longest_repeats, rising, stuck_rows
from obsynth.monitoring.logs.unit_check import UnitCheck
from obsynth.monitoring.thresholds.learned_from_rows import LEAST_NORMAL
from obsynth.numerics.arrays import FloatArray
from obsynth.results.design import ObserverDesign


def read_normal_logs(
    design: ObserverDesign,
    data: Logs,
    signals: LogSignals,
    *,
    time_zone: str | None,
    time_unit: str | None,
    units_as_is: bool,
) -> NormalLogs:
    """Return the logs that are given, in the units of the plant unless these are not to be checked."""
    read = [_read(log, signals, time_zone, time_unit) for log in several(data)]
    rows = [log_rows for log_rows, _ in read]
    if not units_as_is:
        _require_units(design, signals, rows)
    return NormalLogs.of(rows, signals, [stamps for _, stamps in read])


@dataclass(frozen=True, eq=False)
class NormalLogs:
    """Logs without faults, one after the other, and what is stuck in them."""

    rows: FloatArray  # ``(n, 1 + nu + ny)``: NaN for what a stuck sensor repeats
    borders: NDArray[np.int64]  # of the logs, from 0 to n
    stuck: dict[str, list[tuple[int, int]]]  # by output: first and last rows
    repeats: FloatArray  # ``(ny,)``: from which equal sample on an output counts as not measured
    stamps: tuple[Stamps, ...]  # how to write the times of each log

    @classmethod
    def of(cls, logs: Sequence[FloatArray], signals: LogSignals, stamps: Sequence[Stamps]) -> NormalLogs:
        """Return logs that hold enough rows, with the samples that a stuck sensor repeats taken as not measured."""
        rows, borders = np.vstack(logs), np.cumsum([0, *map(len, logs)])
        if len(rows) < LEAST_NORMAL:
            raise SpecError(f"The log has {len(rows)} rows: give {LEAST_NORMAL} and more.", path="normal")
        before = 1 + signals.inputs
        ends = _ends_of(borders)
        stuck = [
            [(first + a, last + a) for a, b in ends for first, last in stuck_rows(column[a:b])]
            for column in rows[:, before:].T
        ]
        # As runs do it: a sample counts as not measured before it is known for how long it is repeated.
        repeats = longest_repeats([rows[a:b, before:] for a, b in ends])
        parts = [rows[a:b] for a, b in ends if a < b]
        unrepeated = [Unrepeated(repeats).of_rows(part[:, before:], rising(part[:, 0].tolist()))[0] for part in parts]
        by_output = dict(zip(signals.names[signals.inputs :], stuck, strict=True))
        return cls(np.hstack([rows[:, :before], np.vstack(unrepeated)]), borders, by_output, repeats, tuple(stamps))

    @property
    def ends(self) -> list[tuple[int, int]]:
        """First row of each log, and the one after its last."""
        return _ends_of(self.borders)

    def missing(self, signals: LogSignals) -> str:
        """Return which signals many rows are without, as a sentence; empty where there are none."""
        return mostly_missing(self.rows, {name: i for i, (_, name) in enumerate(signals.columns_and_signals(), 1)})

    def chosen(self, rows: str | slice | Sequence[int] | None) -> list[tuple[int, int]]:
        """Return the first of the rows of each log that are free of faults, and the one after the last; ``rows``: as
        they are stated for each log."""
        return [(a + first, a + last) for a, b in self.ends for first, last in [parsed_rows(rows, b - a)]]

    def notes_of_cells(self, signals: LogSignals) -> list[str]:
        """Return what is to be said of the cells of the logs."""
        return [
            f"Log {number}: {text}" if len(self.stamps) > 1 else text
            for number, stamps in enumerate(self.stamps, 1)
            for text in (*stamps.warnings(), *stamps.measured.notes(signals.columns_and_signals(), signals.inputs))
        ]

    def slices_of(self, numbers: NDArray[np.int64]) -> tuple[slice, ...]:
        """Return for each log which of some ascending row numbers are its own."""
        return tuple(slice(a, b) for a, b in _ends_of(np.searchsorted(numbers, self.borders)))


def _ends_of(borders: NDArray[np.int64]) -> list[tuple[int, int]]:
    return list(zip(borders[:-1].tolist(), borders[1:].tolist(), strict=True))


def several(data: Logs) -> list[Data]:
    """Return the logs that are given: one, several, or all files of a folder by their names."""
    if isinstance(data, Sequence) and not isinstance(data, str):
        if not data:
            raise SpecError("There is no log: give one without faults.", path="normal")
        return list(data)
    if not (isinstance(data, str | Path) and Path(data).is_dir()):
        return [data]
    files = sorted(file for file in Path(data).iterdir() if file.is_file() and not file.name.startswith("."))
    if not files:
        raise SpecError(f"There is no log in {data}: give one without faults.", path="normal")
    return [*files]


def _read(data: Data, signals: LogSignals, time_zone: str | None, time_unit: str | None) -> tuple[FloatArray, Stamps]:
    """Return the rows of a log ``(n, 1 + nu + ny)``, and how to write its times."""
    stamps = Stamps(time_zone, time_unit)
    return np.vstack([np.zeros((0, 1 + len(signals.names))), *chunks(data, signals, stamps, CHUNK_ROWS)]), stamps


def _require_units(design: ObserverDesign, signals: LogSignals, logs: Sequence[FloatArray]) -> None:
    """Raise `SpecError` where a signal of a log is likely in another unit than that of the plant."""
    for rows in logs:
        units = UnitCheck(design, signals)
        units.take(signals.deviations(rows))
        units.finish()
