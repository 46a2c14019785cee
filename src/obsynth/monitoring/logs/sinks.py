"""Where estimates go: CSV and Parquet files that appear whole or not at all, data frames, and streams."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any, TextIO, TypeAlias

import numpy as np

from obsynth.files.outputs import FileKind, replacement_of
from obsynth.files.tables import table_writer
from obsynth.monitoring.logs.signals import TIME_HEADER
from obsynth.monitoring.logs.sources import check_suffix
from obsynth.monitoring.logs.stamps import Stamps

if TYPE_CHECKING:
    import pandas as pd


#: A table that a run on measured data has written, as CSV or as Parquet.
ESTIMATES = FileKind("a table of estimates of obsynth", rb"\Atime,status,|\APAR1(?s:.*)status(?s:.*)hat\[")

#: Columns of a table that hold text.
TEXT_COLUMNS = ("status", "alarm")

#: Takes rows of cells: texts, and numbers of which NaN is an empty cell.
Sink: TypeAlias = Callable[[Sequence[Sequence[Any]]], None]


def time_columns(header: Sequence[str]) -> tuple[int, ...]:
    """Return which columns hold times."""
    return tuple(i for i, name in enumerate(header) if name == TIME_HEADER or name.startswith(f"{TIME_HEADER} of "))


def dated(rows: Sequence[Sequence[Any]], places: Sequence[int], date_of: Callable[[float], Any]) -> list[list[Any]]:
    """Return rows in which the times are dates."""
    with_dates = [list(row) for row in rows]
    for row in with_dates:
        for place in places:
            row[place] = date_of(row[place])
    return with_dates


def text_sink(stream: TextIO, header: Sequence[str], stamps: Stamps) -> Sink:
    """Return what writes CSV to a text stream, flushed after each call; floats so that they are read back bit for bit,
    and dates as such."""
    write_rows, times = table_writer(stream, header), time_columns(header)
    # Who reads a stream may wait for the header before a row is sent.
    stream.flush()

    def write(rows: Sequence[Sequence[Any]]) -> None:
        write_rows(dated(rows, times, stamps.date) if stamps.is_dated else rows)
        stream.flush()

    return write


class FrameSink:
    """A sink whose rows come to a data frame, in which dates stay dates.

    Numbers stand where the frame will have them, room for ``rows`` at first: parts that are joined in the end would be
    there twice."""

    def __init__(self, header: Sequence[str], stamps: Stamps, rows: int) -> None:
        self._header, self._stamps, self._count = list(header), stamps, 0
        self._times = frozenset(time_columns(header))
        self._numbers = [np.empty(rows) for _ in header]
        self._others: list[list[Any]] = [[] for _ in header]

    def __call__(self, rows: Sequence[Sequence[Any]]) -> None:
        """Keep rows."""
        self.keep(zip(*rows, strict=True), len(rows))

    def keep(self, columns: Iterable[Any], count: int) -> None:
        """Keep so many rows, which are given as columns."""
        end = self._count + count
        for place, cells in enumerate(columns):
            if self._header[place] in TEXT_COLUMNS:
                self._others[place].extend(cells)
            elif self._stamps.is_dated and place in self._times:
                self._others[place].extend(map(self._stamps.moment, cells))
            else:
                numbers = self._numbers[place]
                if end > len(numbers):
                    self._numbers[place] = numbers = np.concatenate([numbers, np.empty(end)])
                numbers[self._count : end] = cells
        self._count = end

    def frame(self) -> pd.DataFrame:
        """Return the data frame."""
        import pandas as pd

        if not self._count:
            return pd.DataFrame([], columns=self._header)
        columns = zip(self._header, self._others, self._numbers, strict=True)
        series = [
            pd.Series(objects or numbers[: self._count], name=name, copy=False) for name, objects, numbers in columns
        ]
        frame = pd.DataFrame(dict(enumerate(series)), copy=False)
        frame.columns = pd.Index(self._header)
        return frame


@contextmanager
def parquet_sink(path: str, header: Sequence[str]) -> Iterator[Sink]:
    """Give what writes a Parquet file, one row group for each call."""
    import pyarrow as pa
    import pyarrow.parquet as pq

    schema = pa.schema([(name, pa.string() if name in TEXT_COLUMNS else pa.float64()) for name in header])
    with pq.ParquetWriter(path, schema) as writer:

        def write(rows: Sequence[Sequence[Any]]) -> None:
            if rows:
                columns = zip(zip(*rows, strict=True), schema, strict=True)
                arrays = [pa.array(list(cells), field.type) for cells, field in columns]
                writer.write_table(pa.Table.from_arrays(arrays, schema=schema))

        yield write


@contextmanager
def sink_for(out: str | Path | TextIO, header: Sequence[str], stamps: Stamps) -> Iterator[Sink]:
    """Give a sink for a stream, or for a file that replaces ``out`` when all went well, and not at all else.
    In a Parquet file times are seconds, since 1970 where the log has dates."""
    if not isinstance(out, str | Path):
        yield text_sink(out, header, stamps)
        return
    path = Path(out)
    check_suffix(path)
    with replacement_of(path) as (handle, temporary):
        if path.suffix.lower() == ".parquet":
            os.close(handle)
            with parquet_sink(temporary, header) as sink:
                yield sink
        else:
            with os.fdopen(handle, "w", encoding="utf-8", newline="") as stream:
                yield text_sink(stream, header, stamps)
