"""Where rows come from: CSV and Parquet files in chunks, data frames, and text streams row by row."""

from __future__ import annotations

import csv
import itertools
import re
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, TextIO, TypeAlias

import numpy as np

from obsynth.data.signals import Signals
from obsynth.errors import SpecError
from obsynth.files.inputs import input_file
from obsynth.files.tables import as_meant
from obsynth.numerics.arguments import require_kind
from obsynth.numerics.arrays import FloatArray

if TYPE_CHECKING:
    import pandas as pd
    from typing_extensions import TypeIs

#: What a missing sample may look like in a stream; data frames know more words.
MISSING = frozenset({"", "nan", "na", "n/a", "null", "none"})
SUFFIXES = (".csv", ".parquet")
#: Lines that may end with CR alone.
_OLD_LINES = re.compile(r"[^\r]*\r\n?|[^\r]+")

Data: TypeAlias = "str | Path | TextIO | pd.DataFrame"


def chunks(data: Data, signals: Signals, rows: int) -> Iterator[FloatArray]:
    """Yield ``(rows, 1 + nu + ny)``: time and signals, in order; NaN where a sample is missing."""
    if isinstance(data, str | Path):
        path = Path(data)
        check_suffix(path)
        with _readable(path):
            frames = _parquet(path, signals, rows) if path.suffix.lower() == ".parquet" else _csv(path, rows)
            yield from _converted(frames, signals)
    elif is_stream(data):
        yield from _stream(data, signals)
    else:
        import pandas as pd

        require_kind(data, pd.DataFrame, "data", "the name of a file, a text stream or a pandas.DataFrame")
        yield from _converted(iter([data]), signals)


def is_stream(data: TextIO | pd.DataFrame) -> TypeIs[TextIO]:
    """Whether ``data`` is read line by line."""
    return hasattr(data, "readline")


def check_suffix(path: Path) -> None:
    """Raise `SpecError` unless a file is CSV or Parquet by its name, and Parquet can be handled."""
    suffix = path.suffix.lower()
    if suffix not in SUFFIXES:
        raise SpecError(f"{path} has an unknown suffix: use {' or '.join(SUFFIXES)}.", path=str(path))
    if suffix == ".parquet":
        try:
            import pyarrow  # noqa: F401
        except ImportError:
            raise SpecError("Parquet needs pyarrow: pip install 'obsynth[parquet]', or use CSV.",
                            path=str(path)) from None  # fmt: skip


@contextmanager
def _readable(path: Path) -> Iterator[None]:
    """Turn what can be wrong with a file into errors that name it."""
    try:
        if path.exists():
            input_file(path)
        yield
    except SpecError:
        raise
    except UnicodeDecodeError as error:
        raise SpecError(f"{path} is no UTF-8 text (byte {error.start}).", path=str(path)) from error
    except OSError as error:
        raise SpecError(f"{path} cannot be read: {error.strerror or error}.", path=str(path)) from error
    except (ValueError, Warning) as error:  # pandas: empty files, ragged rows; pyarrow: no Parquet file
        raise SpecError(f"{path} cannot be read: {' '.join(str(error).split())}", path=str(path)) from error


def _csv(path: Path, rows: int) -> Iterator[pd.DataFrame]:
    import pandas as pd

    # The header is read as data, since pandas would rename a repeated column.
    header = pd.read_csv(path, header=None, nrows=1, dtype=str, keep_default_na=False, encoding="utf-8-sig")
    names = [as_meant(str(name).strip()) for name in header.iloc[0]]
    if not _has_rows(path):
        return
    with warnings.catch_warnings():
        warnings.simplefilter("error", pd.errors.ParserWarning)
        # Text: every release of pandas reads the same, and a file gives the same numbers as a stream.
        reader = pd.read_csv(
            path, header=None, skiprows=1, chunksize=rows, dtype=str, keep_default_na=False, encoding="utf-8-sig",
            index_col=False, names=list(range(len(names))),
        )  # fmt: skip
    with reader:
        while True:
            with warnings.catch_warnings():
                # More cells than columns, which pandas would only warn of.
                warnings.simplefilter("error", pd.errors.ParserWarning)
                frame = next(reader, None)
            if frame is None:
                return
            yield frame.set_axis(names, axis=1)


def _has_rows(path: Path) -> bool:
    with path.open(encoding="utf-8-sig") as stream:
        stream.readline()
        return any(line.strip() for line in stream)


def _parquet(path: Path, signals: Signals, rows: int) -> Iterator[pd.DataFrame]:
    import pyarrow.parquet

    with pyarrow.parquet.ParquetFile(path) as file:
        signals.positions(tuple(file.schema_arrow.names))
        for batch in file.iter_batches(batch_size=rows, columns=list(dict.fromkeys(signals.columns))):
            yield batch.to_pandas()


def _converted(frames: Iterator[pd.DataFrame], signals: Signals) -> Iterator[FloatArray]:
    done = 0
    for frame in frames:
        places = signals.positions(tuple(str(name) for name in frame.columns))
        yield np.column_stack([_numbers(frame.iloc[:, place], done) for place in places])
        done += len(frame)
    if done == 0:
        raise SpecError("The data have no rows.", path="data")


def _numbers(column: pd.Series, done: int) -> FloatArray:
    """Return a column as numbers; a cell that is no number is named with its row."""
    import pandas as pd

    if pd.api.types.is_numeric_dtype(column) and not pd.api.types.is_bool_dtype(column):
        return np.asarray(column.to_numpy(dtype=np.float64, na_value=np.nan))
    texts = [None if pd.isna(cell) else str(cell) for cell in column]
    return np.array([_number(text, done + i + 1, str(column.name)) for i, text in enumerate(texts)])


def _number(text: str | None, row: int, column: str) -> float:
    if text is None or text.strip().lower() in MISSING:
        return float("nan")
    try:
        return float(text)
    except ValueError:
        # What looks like a date is most likely the time.
        advice = " Give the time in seconds." if ":" in text else ""
        raise SpecError(f"Row {row}, column {column!r}: {text!r} is no number.{advice}", path=f"row {row}") from None


def _stream(stream: TextIO, signals: Signals) -> Iterator[FloatArray]:
    # Line by line: a reader of its own would wait for more than one.
    lines = _cells(stream)
    header = tuple(as_meant(name.strip()) for name in next(lines, []))
    places = signals.positions(header)
    row = 0
    for cells in lines:
        if not any(cell.strip() for cell in cells):
            continue
        row += 1
        if len(cells) > len(header):
            raise SpecError(f"Row {row} has {len(cells)} cells, but the header has {len(header)}.", path=f"row {row}")
        cells += [""] * (len(header) - len(cells))
        yield np.array([[_number(cells[place], row, header[place]) for place in places]])
    if row == 0:
        raise SpecError("The data have no rows.", path="data")


def _cells(stream: TextIO) -> Iterator[list[str]]:
    """Yield the cells of each line; what is no text, or no table, is a `SpecError`."""
    lines = csv.reader(_text_lines(stream))
    for row in itertools.count():
        try:
            cells = next(lines, None)
        except csv.Error as error:
            raise SpecError(f"Row {row} of the data cannot be read: {error}.", path=f"row {row}") from error
        except UnicodeDecodeError as error:
            raise SpecError(f"The data are no UTF-8 text after row {row}.", path=f"row {row}") from error
        if cells is None:
            return
        yield cells


def _text_lines(stream: TextIO) -> Iterator[str]:
    """Yield lines as they come; lines that end with CR alone, as of old, come together where a stream keeps these."""
    is_first = True
    for block in iter(stream.readline, ""):
        for line in _OLD_LINES.findall(block):
            # A byte order mark is no part of the first name.
            yield line.removeprefix("\ufeff") if is_first else line
            is_first = False
