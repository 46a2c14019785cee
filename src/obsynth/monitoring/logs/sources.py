"""Where rows come from: text, Parquet, TDMS and MDF files in chunks, data frames, and text streams row by row."""

from __future__ import annotations

import io
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, TextIO, TypeAlias

import numpy as np

from obsynth.errors import SpecError
from obsynth.files.inputs import input_file, reason, suffix_error
from obsynth.monitoring.logs.binary_logs import NEEDED_PACKAGES, READERS, read_by_package
from obsynth.monitoring.logs.signals import TIME_HEADER, LogSignals, date_place, is_bad, status_places, with_date
from obsynth.monitoring.logs.stamps import Stamps
from obsynth.monitoring.logs.text_logs import WINDOWS_TEXT, no_text, number_in_cell, stream_rows, text_chunks
from obsynth.monitoring.logs.unpacked_logs import (
    COMPRESSED_SUFFIXES,
    WORKBOOK_SUFFIXES,
    as_frame,
    log_suffix,
    opened_log,
)
from obsynth.numerics.arguments import require_kind
from obsynth.numerics.arrays import FloatArray
from obsynth.plants.input_derivatives import difference_quotients

if TYPE_CHECKING:
    import pandas as pd
    from typing_extensions import TypeIs


#: Files that are text, and all that are read as text.
TEXT_SUFFIXES = (".csv", ".tsv")
READ_AS_TEXT = (*TEXT_SUFFIXES, *COMPRESSED_SUFFIXES, *WORKBOOK_SUFFIXES)

#: All kinds of logs.
LOG_SUFFIXES = (*READ_AS_TEXT, *READERS)

#: Rows that are held in memory at a time.
CHUNK_ROWS = 10_000

#: Files that estimates are written to.
TABLE_SUFFIXES = (".csv", ".parquet")

Data: TypeAlias = "str | Path | TextIO | pd.DataFrame"

#: One log, or several.
Logs: TypeAlias = "str | Path | TextIO | pd.DataFrame | Sequence[str | Path | pd.DataFrame]"


def chunks(
    data: Data, signals: LogSignals, stamps: Stamps, rows: int, *, after: float | None = None
) -> Iterator[FloatArray]:
    """Yield ``(rows, 1 + nu + ny)``: time and signals, in order; NaN where a sample is missing.  Inputs are those that
    act in a row as the design takes it.  The first rows are left out up to the time ``after``."""
    blocks = _finite(_without_days(_chunks(data, signals, stamps, rows), stamps), signals, stamps)
    blocks = _differenced(blocks, stamps, goes_on=after is None)
    if after is not None:
        blocks = _later(blocks, after)
    if not signals.delay or not signals.inputs:
        yield from blocks
    elif signals.delay > 0:
        yield from _delayed(blocks, signals, stamps)
    else:
        yield from _advanced(blocks, signals)
    # Whether columns hold numbers is known at the end, wherever the words in them stand.
    stamps.require_numbers()


def _without_days(blocks: Iterator[FloatArray], stamps: Stamps) -> Iterator[FloatArray]:
    """Yield rows, of which the first ones must not be stamped in days."""
    for count, chunk in enumerate(blocks):
        if not count:
            stamps.require_no_days(chunk[:, 0])
        yield chunk


def _finite(blocks: Iterator[FloatArray], signals: LogSignals, stamps: Stamps) -> Iterator[FloatArray]:
    """Yield rows in which infinite cells of signals are missing, and note what the columns hold."""
    for chunk in blocks:
        stamps.measured.take(chunk, signals.columns[1:], stamps.formed)
        yield chunk


def _differenced(blocks: Iterator[FloatArray], stamps: Stamps, *, goes_on: bool) -> Iterator[FloatArray]:
    """Yield rows with the derivatives of known inputs that no column has; ``goes_on``: after the rows of a state."""
    before = stamps.differenced if goes_on else {}
    for chunk in blocks:
        latest = max((float(known[0]) for known in before.values()), default=-np.inf)
        # Rows that the clock leaves out, since they are no later than others, are no samples of the input.
        rising = chunk[:, 0] > np.fmax.accumulate(np.concatenate([[latest], chunk[:, 0]]))[:-1]
        for place, (base, order) in stamps.formed.items():
            times, values = chunk[rising, 0], chunk[rising, base]
            chunk[:, place] = np.nan
            if rising.any():
                chunk[rising, place], before[place] = difference_quotients(times, values, order, before.get(place))
        stamps.differenced = before
        yield chunk


def _later(blocks: Iterator[FloatArray], after: float) -> Iterator[FloatArray]:
    """Yield rows from the first one on whose time is later."""
    is_begun = False
    for chunk in blocks:
        first = 0 if is_begun else int(np.argmax(chunk[:, 0] > after))
        is_begun = is_begun or bool(chunk[first, 0] > after)
        if is_begun:
            yield chunk[first:]


def _delayed(blocks: Iterator[FloatArray], signals: LogSignals, stamps: Stamps) -> Iterator[FloatArray]:
    """Yield rows with the inputs of so many rows before; the first ones hold their own."""
    inputs = slice(1, 1 + signals.inputs)
    for chunk in blocks:
        if stamps.earlier is None:
            stamps.earlier = np.repeat(chunk[:1, inputs], signals.delay, axis=0)
        joined = np.vstack([stamps.earlier, chunk[:, inputs]])
        stamps.earlier = joined[len(chunk) :]
        chunk[:, inputs] = joined[: len(chunk)]
        yield chunk


def _advanced(blocks: Iterator[FloatArray], signals: LogSignals) -> Iterator[FloatArray]:
    """Yield rows with the inputs of so many rows after, for which they wait; the last ones hold the last."""
    inputs, wait = slice(1, 1 + signals.inputs), -signals.delay
    waiting: FloatArray | None = None
    for chunk in blocks:
        joined = chunk if waiting is None else np.vstack([waiting, chunk])
        ready = max(len(joined) - wait, 0)
        waiting = joined[ready:].copy()
        if ready:
            done = joined[:ready].copy()
            done[:, inputs] = joined[wait : wait + ready, inputs]
            yield done
    if waiting is not None and len(waiting):
        # Of a short log fewer rows than these are left.
        after = np.minimum(np.arange(len(waiting)) + wait, len(waiting) - 1)
        waiting[:, inputs] = waiting[after][:, inputs]
        yield waiting


def _chunks(data: Data, signals: LogSignals, stamps: Stamps, rows: int) -> Iterator[FloatArray]:
    if isinstance(data, str | Path):
        path = Path(data)
        check_suffix(path, LOG_SUFFIXES)
        with require_readable_log(path):
            if log_suffix(path) in READ_AS_TEXT:
                yield from text_chunks(path, opened_log(path, signals.columns), signals, stamps, rows)
            else:
                with read_by_package(path):
                    read_rows, _ = READERS[path.suffix.lower()]
                    yield from _converted(read_rows(path, signals, stamps, rows), signals, stamps)
    elif is_stream(data):
        if data is sys.stdin and isinstance(data, io.TextIOWrapper):
            data.reconfigure(errors=WINDOWS_TEXT)
        yield from stream_rows(data, signals, stamps)
    else:
        import pandas as pd

        table = as_frame(data)
        require_kind(table, pd.DataFrame, "data", "the name of a file, a text stream or a pandas.DataFrame")
        frame = _with_time(table, signals)
        numbers = all(pd.api.types.is_numeric_dtype(kind) for kind in frame.dtypes)
        # Of numbers a part says no less than the whole: no copy of all of them is made.
        parts = range(0, max(len(frame), 1), rows) if numbers else range(1)
        size = rows if numbers else max(len(frame), 1)
        for block in _converted((frame.iloc[start : start + size] for start in parts), signals, stamps):
            for start in range(0, len(block), rows):
                yield block[start : start + rows]


def samples(data: Data, signals: LogSignals) -> Iterator[tuple[float, FloatArray]]:
    """Yield time and deviations ``(nu + ny,)`` of each row."""
    for chunk in chunks(data, signals, Stamps(), CHUNK_ROWS):
        yield from zip(chunk[:, 0].tolist(), signals.deviations(chunk), strict=True)


def is_stream(data: TextIO | pd.DataFrame) -> TypeIs[TextIO]:
    """Whether ``data`` is read line by line."""
    return hasattr(data, "readline")


def check_suffix(path: Path, suffixes: tuple[str, ...] = TABLE_SUFFIXES) -> None:
    """Raise `SpecError` unless a file is of a known kind by its name, and its package is installed."""
    suffix = log_suffix(path)
    if suffix not in suffixes and path.is_dir():
        raise SpecError(f"{path} is a folder: give the name of a file.", path=str(path))
    if suffix not in suffixes:
        raise suffix_error(path, suffixes)
    if suffix in NEEDED_PACKAGES:
        package, extra = NEEDED_PACKAGES[suffix]
        try:
            import_module(package)
        except ImportError:
            raise SpecError(
                f"{suffix} files need {package}: pip install 'obsynth[{extra}]', or use CSV.", path=str(path)
            ) from None


@contextmanager
def require_readable_log(path: Path) -> Iterator[None]:
    """Turn what can be wrong with a file into errors that name it."""
    try:
        input_file(path)
        yield
    except SpecError:
        raise
    except UnicodeDecodeError as error:
        raise no_text(path, error) from error
    except OSError as error:
        raise SpecError(f"{path} cannot be read: {reason(error)}.", path=str(path)) from error


def _with_time(frame: pd.DataFrame, signals: LogSignals) -> pd.DataFrame:
    """Return a frame whose index of dates, of time differences, or called as the time, is a column."""
    import pandas as pd

    time, names = signals.columns[0], [str(name) for name in frame.columns]
    frame = frame.set_axis(names, axis=1)
    dated = isinstance(frame.index, (pd.DatetimeIndex, pd.TimedeltaIndex))
    if time in names or not (frame.index.name == time or (dated and time == TIME_HEADER)):
        return frame
    return frame.assign(**{time: frame.index}).reset_index(drop=True)


def _converted(frames: Iterator[pd.DataFrame], signals: LogSignals, stamps: Stamps) -> Iterator[FloatArray]:
    done = 0
    for frame in frames:
        header = tuple(str(name) for name in frame.columns)
        places = signals.positions(header)
        if not done:
            stamps.take_header(header, signals.columns, places)
            factors, shifts = signals.conversions(header, places, stamps)
        date = date_place(header, places)
        times = _times(frame.iloc[:, places[0]], done, stamps, None if date is None else frame.iloc[:, date])
        values = []
        for place, state in zip(places[1:], status_places(header, places)[1:], strict=True):
            column = _numbers(frame.iloc[:, place], done, stamps)
            states = None if state is None else frame.iloc[:, state]
            values.append(column if states is None else _without_bad(column, header[place], states, done, stamps))
        yield np.column_stack(
            [times, *(factor * value + shift for factor, value, shift in zip(factors, values, shifts, strict=True))]
        )
        done += len(frame)
    if done == 0:
        raise SpecError("The data have no rows.", path="data")


def _without_bad(values: FloatArray, name: str, states: pd.Series, done: int, stamps: Stamps) -> FloatArray:
    """Return samples ``(n,)`` without those of which their status says that they are bad."""
    texts = [str(cell).strip() for cell in states]
    bad = np.array([is_bad(text) for text in texts], dtype=bool)
    if bad.any():
        first = int(np.argmax(bad))
        stamps.take_bad(name, done + first + 1, texts[first], str(states.name), count=int(bad.sum()))
    return np.where(bad, np.nan, values)


def _times(column: pd.Series, done: int, stamps: Stamps, dates: pd.Series | None) -> FloatArray:
    """Return a column of time stamps as seconds; ``dates`` may stand beside times of day."""
    import pandas as pd

    seconds = stamps.read_column(column)
    if seconds is not None:
        return seconds
    if pd.api.types.is_numeric_dtype(column):
        stamps.take_number()
        return stamps.seconds(_numbers(column, done))
    texts = ["" if pd.isna(cell) else str(cell) for cell in column]
    if dates is not None:
        texts = [with_date(str(date), text) for date, text in zip(dates, texts, strict=True)]
    return np.array([stamps.read(text, done + i + 1, str(column.name)) for i, text in enumerate(texts)])


def _numbers(column: pd.Series, done: int, stamps: Stamps | None = None) -> FloatArray:
    """Return a column as numbers; a cell that is no number is named with its row."""
    import pandas as pd

    if pd.api.types.is_complex_dtype(column):
        raise SpecError(f"The column {str(column.name)!r} holds complex numbers: give real ones.", path="columns")
    if pd.api.types.is_numeric_dtype(column) and not pd.api.types.is_bool_dtype(column):
        numbers = np.asarray(column.to_numpy(dtype=np.float64, na_value=np.nan))
        if stamps is not None and not np.isnan(numbers).all():
            stamps.numeric.add(str(column.name))
        return numbers
    texts = [None if pd.isna(cell) else str(cell) for cell in column]
    return np.array([number_in_cell(text, done + i + 1, str(column.name), stamps) for i, text in enumerate(texts)])
