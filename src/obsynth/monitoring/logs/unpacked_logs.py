"""Logs that are unpacked before they are read: compressed texts and workbooks as text, arrays and tables of other
libraries as data frames."""

from __future__ import annotations

import csv
import gzip
import io
import re
import zlib
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from datetime import date, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any, TextIO

import numpy as np

from obsynth.errors import SpecError
from obsynth.monitoring.logs.signals import column_of
from obsynth.monitoring.logs.text_logs import MOST_REMARKS, WINDOWS_TEXT, encoding_of

if TYPE_CHECKING:
    import pandas as pd

#: Texts that gzip has made smaller, and sheets of workbooks, which are read as text too.
COMPRESSED_SUFFIXES = (".csv.gz", ".tsv.gz")
WORKBOOK_SUFFIXES = (".xlsx", ".xlsm")

#: What a second row of a header holds where a column has no unit: nothing, or what pandas and pint-pandas write there.
NO_UNIT = re.compile(r"\s*(Unnamed: .*|No Unit|nan|None|-)?\s*\Z")

#: How a file that gzip made begins.
_GZIP = b"\x1f\x8b"


def log_suffix(path: Path) -> str:
    """Return the suffix by which a log is read: two of a compressed text."""
    return next((end for end in COMPRESSED_SUFFIXES if path.name.lower().endswith(end)), path.suffix.lower())


def as_frame(data: Any) -> Any:
    """Return a data frame of a mapping from names to columns, or of a table of another library that can become one
    (polars, pyarrow); what is neither as it is.  Raise `SpecError` for an array whose columns have no names."""
    import pandas as pd

    if isinstance(data, np.ndarray) and data.dtype.names:
        return pd.DataFrame.from_records(data)
    if isinstance(data, np.ndarray):
        raise SpecError(
            "data is an array, whose columns have no names: give a pandas.DataFrame, or columns by name, as "
            "{'t': ..., 'y1': ...}.",
            path="data",
        )
    if isinstance(data, pd.DataFrame):
        return _with_units(data)
    if isinstance(data, Mapping):
        return _of_columns({str(name): data[name] for name in data}, "data")
    if hasattr(data, "collect") and hasattr(data, "collect_schema"):
        data = data.collect()  # a polars.LazyFrame
    made = data.to_pandas() if hasattr(data, "to_pandas") else data
    return made if isinstance(made, pd.DataFrame) else data


def _with_units(frame: pd.DataFrame) -> pd.DataFrame:
    """Return a frame whose columns are called ``name [unit]`` where it states units: in a second row of its header, or
    by name in ``attrs["units"]``."""
    header = frame.columns
    if header.nlevels > 2:
        raise SpecError(
            f"The columns of the data have {header.nlevels} levels of names: give one, or names and units.", path="data"
        )
    if header.nlevels == 2:
        names, units = ([str(part) for part in header.get_level_values(level)] for level in (0, 1))
        units = ["" if NO_UNIT.match(unit) else unit for unit in units]
    else:
        stated = frame.attrs.get("units")
        if not isinstance(stated, Mapping):
            return frame
        names = [str(name) for name in header]
        units = [str(stated.get(name) or "") for name in header]
    headers = [f"{name} [{unit}]" if unit.strip() else name for name, unit in zip(names, units, strict=True)]
    return frame.set_axis(headers, axis=1)


def _of_columns(columns: Mapping[str, Any], path: str) -> pd.DataFrame:
    """Return a frame of columns ``(rows,)``, which may be matrices of one row or column."""
    import pandas as pd

    arrays: dict[str, Any] = {}
    for name, values in columns.items():
        if isinstance(values, pd.Series):
            arrays[name] = values.reset_index(drop=True)
            continue
        array = np.asarray(values)
        if array.ndim != 1 and array.size != max(array.shape, default=0):
            raise SpecError(
                f"The column {name!r} is an array of shape {array.shape}: give one number a row, and each column of a "
                "matrix a name of its own.",
                path=f"{path}.{name}",
            )
        arrays[name] = array.ravel()
    lengths = {name: len(values) for name, values in arrays.items()}
    if len(set(lengths.values())) > 1:
        listed = ", ".join(f"{name!r} {count}" for name, count in lengths.items())
        raise SpecError(f"The columns have different numbers of rows: {listed}.", path=path)
    return pd.DataFrame(arrays)


@contextmanager
def opened_log(path: Path, wanted: Sequence[str]) -> Iterator[TextIO]:
    """Open a log as text, of which columns are wanted, the time first: a text as it is, one that is compressed
    unpacked, and the sheet of a workbook in which the columns are."""
    suffix = log_suffix(path)
    if suffix in WORKBOOK_SUFFIXES:
        yield io.StringIO(_sheet_text(path, wanted), newline="")
    elif suffix in COMPRESSED_SUFFIXES:
        with path.open("rb") as own:
            if own.read(2) != _GZIP:
                raise SpecError(f"{path} cannot be read: it is no gzip file.", path=str(path))
        try:
            with gzip.open(path, "rb") as packed:
                encoding = encoding_of(packed)
            with gzip.open(path, "rt", encoding=encoding, errors=WINDOWS_TEXT, newline="") as stream:
                yield stream
        except (EOFError, zlib.error, gzip.BadGzipFile) as error:
            raise SpecError(
                f"{path} cannot be read: {error}. If its end is missing, copy it again.", path=str(path)
            ) from error
    else:
        with path.open("rb") as own:
            encoding = encoding_of(own)
        with path.open(encoding=encoding, errors=WINDOWS_TEXT, newline="") as stream:
            yield stream


def _sheet_text(path: Path, wanted: Sequence[str]) -> str:
    """Return the first sheet in which the columns are, or else the first of all, as text separated by commas."""
    import openpyxl

    book = None
    try:
        book = openpyxl.load_workbook(path, read_only=True, data_only=True)
        sheets = [[list(row) for row in sheet.iter_rows(values_only=True)] for sheet in book.worksheets]
    except Exception as error:  # readers of damaged bytes raise what comes
        cause = " ".join(str(error).split()) or type(error).__name__
        raise SpecError(f"{path} cannot be read: openpyxl says {cause!r}.", path=str(path)) from error
    finally:
        if book is not None:
            book.close()
    rows = next((rows for rows in sheets if _has_columns(rows, wanted)), next(iter(sheets), []))
    text = io.StringIO(newline="")
    # A row that is empty has no comma, as it is no row of the table.
    writer = csv.writer(text)
    for row in rows:
        while row and row[-1] is None:
            row.pop()
        writer.writerow([_cell_text(cell) for cell in row])
    return text.getvalue()


def _has_columns(rows: Sequence[Sequence[Any]], wanted: Sequence[str]) -> bool:
    """Whether one of the first rows of a sheet names all columns."""
    heads = ([str(cell).strip() for cell in row if cell is not None] for row in rows[: MOST_REMARKS + 1])
    return any(all(column_of(head, name) for name in wanted) for head in heads)


def _cell_text(cell: Any) -> str:
    """Return the value of a cell as text: numbers with all their digits, dates as ISO 8601 writes them."""
    if cell is None:
        return ""
    if isinstance(cell, (datetime, date)):
        return cell.isoformat()
    return repr(cell) if isinstance(cell, float) else str(cell)


def npz_channels(path: Path) -> list[tuple[str, str, Any]]:
    """Return the arrays of a ``.npz`` file: no group, name and values."""
    with np.load(path, allow_pickle=False) as file:
        return [("", name, file[name]) for name in file.files]


def mat_channels(path: Path) -> list[tuple[str, str, Any]]:
    """Return the variables of a ``.mat`` file, and fields of its structs, which are groups: group, name and values."""
    import scipy.io

    try:
        held = scipy.io.loadmat(path, struct_as_record=False, squeeze_me=True)
    except NotImplementedError as error:
        raise SpecError(
            f"{path} is a MAT file of version 7.3, which is not read as a log: save it in MATLAB with "
            "save(..., '-v7'), or as CSV with writetable.",
            path=str(path),
        ) from error
    channels: list[tuple[str, str, Any]] = []
    for name, value in held.items():
        if name.startswith("__"):
            continue
        fields = getattr(value, "_fieldnames", None)
        channels += [("", name, value)] if fields is None else [(name, own, getattr(value, own)) for own in fields]
    return channels


def channel_frame(arrays: Mapping[str, Any], path: Path) -> pd.DataFrame:
    """Return a frame of arrays by the names of the columns that are read."""
    for name, values in arrays.items():
        array = np.asarray(values)
        if array.dtype.names is not None or array.dtype.kind not in "biufcmMUO":
            raise SpecError(
                f"{path}: {name!r} holds no numbers but {type(values).__name__}: of a table or timetable save the "
                "columns (in MATLAB table2struct(T, 'ToScalar', true), or writetable as CSV).",
                path=str(path),
            )
    return _of_columns(dict(arrays), str(path))
