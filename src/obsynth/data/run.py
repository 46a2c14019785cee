"""A design on measured data: a log or a stream in, estimates out."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, TextIO

import numpy as np

from obsynth.data.operating import FirstSecond
from obsynth.data.running import OK, DataObserver, Row
from obsynth.data.signals import Signals, delayed, estimate_columns, output_columns
from obsynth.data.sinks import FrameSink, Sink, TextSink, file_sink
from obsynth.data.sources import Data, chunks
from obsynth.data.states import digest_of_gains, resume_state, save_state
from obsynth.errors import SpecError
from obsynth.numerics.arrays import FloatArray
from obsynth.results.design import ObserverDesign

if TYPE_CHECKING:
    import pandas as pd

#: Rows that are held in memory at a time.
CHUNK_ROWS = 10_000


@dataclass(frozen=True, eq=False)
class DataRun:
    """What a run on measured data was.

    Parameters
    ----------
    rows : int
        Rows of data.
    statuses : mapping of str to int
        How many rows were ``ok``, ``warm-up``, ``gap`` and ``recovering``.
    alarms : mapping of str to float
        Time in seconds at which each column first passed its threshold.
    warnings : tuple of str
        What a user should know about the data.
    digest : str
        sha256 of the gain set.
    table : pandas.DataFrame or None
        The estimates, when they were not written anywhere.
    """

    rows: int
    statuses: Mapping[str, int]
    alarms: Mapping[str, float]
    warnings: tuple[str, ...]
    digest: str
    table: pd.DataFrame | None = field(default=None, repr=False)

    def as_dict(self) -> dict[str, Any]:
        """Return the summary as plain data, without the table."""
        return {
            "rows": self.rows, "statuses": dict(self.statuses), "alarms": dict(self.alarms),
            "warnings": list(self.warnings), "gains_sha256": self.digest,
        }  # fmt: skip


def run_on_data(
    design: ObserverDesign,
    data: Data,
    out: str | Path | TextIO | None = None,
    *,
    columns: Mapping[str, str] | None = None,
    scales: Mapping[str, float] | None = None,
    thresholds: Mapping[str, float] | None = None,
    gap: float | None = None,
    warm_up: float | None = None,
    state: str | Path | None = None,
    chunk_rows: int = CHUNK_ROWS,
    progress: Callable[[int], None] | None = None,
) -> DataRun:
    """Run a linear design on measured data, in constant memory.

    Each row of data gives one row of estimates.  The operating point is subtracted from the data and added back to
    the estimates.  An estimate that lags has a column ``time of ...``: the time of which it is the estimate.

    Parameters
    ----------
    design : ObserverDesign
        A linear design.
    data : path, text stream or pandas.DataFrame
        With a column ``time`` in seconds and a column for each known input and output.  Files are CSV or Parquet by
        their suffix; a stream is CSV and is answered row by row.
    out : path or text stream, optional
        CSV or Parquet file, written whole or not at all; or a stream for CSV.  By default a data frame is returned.
    columns : mapping, optional
        Column of a signal (or of ``time``) where their names differ.
    scales : mapping, optional, signal's unit per column's unit
        Factor of a signal's column.
    thresholds : mapping, optional
        Level of the absolute value by column of the output, such as ``fhat[actuator]`` or ``r[speed]`` (of faults
        with an operating point, of the deviation): the column ``alarm`` names those above their level.  Alarms are
        suspended in rows that are not ``ok``.
    gap : float, optional, seconds
        Continuous-time designs: longer intervals are gaps; by default those ten times the longest one before.
    warm_up : float, optional, seconds
        Marked after the start and after each gap; by default until the slowest mode has shrunk to 2 %.
    state : path, optional
        A saved state to go on from, if the file exists; the state at the end is written to it.
    chunk_rows : int, optional
        Rows that are read and written at a time; the results do not depend on it.
    progress : callable, optional
        Called with the number of rows done, after each chunk.

    Returns
    -------
    DataRun
        A summary, with the estimates if ``out`` is not given.

    Raises
    ------
    SpecError
        The design is recursive, columns are missing, a cell is no number, a time is missing, repeated, decreasing or
        does not fit the design's dt (the row is named), or a file cannot be read or written.

    Notes
    -----
    Continuous-time observers are advanced from row to row by a first-order hold over the interval as it is: exact for
    signals that are linear between rows.  In a row with a missing sample, and in a gap, the outputs of the plant model
    (faults held at their last estimate, unknown inputs zero, started from the last state estimate) stand in for the
    measured ones, so that the observer's state follows the model's; fault estimates are held, residuals are empty and
    the status is ``gap``.  The observer starts again after a gap of more than 10,000 samples, where the model has lost
    the plant (it misses the outputs by more than their size before and after the gap, as an unstable one will in the
    end), and after every gap of a plant of index 2 or more, whose model cannot be propagated.  Intervals are rounded to
    the resolution of the time stamps.
    """
    plant, observer = design.linear
    if isinstance(chunk_rows, bool) or not isinstance(chunk_rows, int) or chunk_rows < 1:
        raise SpecError(f"chunk_rows is {chunk_rows!r}: give a whole number, 1 or more.", path="chunk_rows")
    job = _Job(design, Signals.of(plant, observer, columns, scales), thresholds or {}, gap, warm_up)
    digest = digest_of_gains(design)
    if state is not None and Path(state).exists():
        resume_state(Path(state), job.observer, digest)
    header = output_columns(observer, alarms=bool(thresholds))
    with _sink(out, header) as sink:
        try:
            for chunk in chunks(data, job.signals, chunk_rows):
                sink.write(job.take(chunk))
                if progress is not None:
                    progress(job.rows)
        finally:
            # What has left on a stream cannot be taken back, so the state goes with it.
            if state is not None and isinstance(sink, TextSink) and not isinstance(out, str | Path) and job.rows:
                save_state(Path(state), job.observer, digest)
    if state is not None:
        save_state(Path(state), job.observer, digest)
    table = sink.frame() if isinstance(sink, FrameSink) else None
    return DataRun(job.rows, dict(job.statuses), dict(job.alarms), job.first.warnings(), digest, table)


@contextmanager
def _sink(out: str | Path | TextIO | None, header: tuple[str, ...]) -> Iterator[Sink]:
    if isinstance(out, str | Path):
        with file_sink(Path(out), header, {"status", "alarm"}) as sink:
            yield sink
    elif out is None:
        yield FrameSink(header)
    else:
        yield TextSink(out, header)


class _Job:
    """One run: rows of data to rows of output, and what is counted on the way."""

    def __init__(
        self, design: ObserverDesign, signals: Signals, thresholds: Mapping[str, float], gap: float | None,
        warm_up: float | None,
    ) -> None:  # fmt: skip
        observer = design.linear[1]
        names = estimate_columns(observer)
        for name, level in thresholds.items():
            if name not in names:
                raise SpecError(f"There is no column {name!r} to watch: there are {', '.join(names)}.",
                                path="thresholds")  # fmt: skip
            if not (math.isfinite(level) and level > 0.0):
                raise SpecError(f"The threshold of {name!r} is {level}: give a positive number.", path="thresholds")
        self.signals, self.observer = signals, DataObserver(design, gap=gap, warm_up=warm_up)
        self._levels = tuple((name, names.index(name), level) for name, level in thresholds.items())
        self._lags = [delay * observer.dt for _, delay in delayed(observer)]
        self._point = signals.estimates_point(observer)
        self.first, self.rows = FirstSecond(signals), 0
        self.statuses, self.alarms = Counter[str](), dict[str, float]()

    def take(self, chunk: FloatArray) -> list[list[Any]]:
        """Take rows ``[time, u, y]`` as read; return rows of output."""
        times: list[float] = chunk[:, 0].tolist()
        found = []
        for time, deviations in zip(times, self.signals.scale * chunk[:, 1:] - self.signals.offset, strict=True):
            found.append(self.observer.step(time, deviations, self.rows + 1))
            self.rows += 1
            self.first.take(time, deviations)
        values: list[list[float]] = (np.array([row.values for row in found]) + self._point).tolist()
        self.statuses.update(row.status for row in found)
        rows: list[list[Any]] = [
            [time, row.status, *(time - lag for lag in self._lags), *estimates]
            for time, row, estimates in zip(times, found, values, strict=True)
        ]
        if self._levels:
            for time, row, cells in zip(times, found, rows, strict=True):
                cells.append(self._alarm(time, row))
        return rows

    def _alarm(self, time: float, found: Row) -> str:
        above = [
            name for name, i, level in self._levels if found.status == OK and np.abs(found.values[i]) > level
        ]  # fmt: skip
        for name in above:
            self.alarms.setdefault(name, time)
        return "; ".join(above)
