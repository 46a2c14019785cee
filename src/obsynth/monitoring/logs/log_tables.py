"""Columns of a whole log by name, for what needs all rows at once: read as `obsynth.run_on_data` reads them."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np

from obsynth.errors import SpecError
from obsynth.files.inputs import input_file
from obsynth.monitoring.logs.binary_logs import READERS, read_by_package
from obsynth.monitoring.logs.signals import TIME_HEADER, HeaderUnit, LogSignals, column_of
from obsynth.monitoring.logs.sources import (
    CHUNK_ROWS,
    LOG_SUFFIXES,
    READ_AS_TEXT,
    check_suffix,
    chunks,
    require_readable_log,
)
from obsynth.monitoring.logs.stamps import Stamps
from obsynth.monitoring.logs.text_logs import no_text, opened_text
from obsynth.monitoring.logs.unpacked_logs import as_frame, log_suffix, opened_log
from obsynth.numerics.arguments import require_kind
from obsynth.numerics.arrays import FloatArray

#: Decimals of seconds that dates are reported to.
SECOND_DECIMALS = 6


def log_table(
    data: str | Path | Any,
    names: Sequence[str],
    time: str = TIME_HEADER,
    *,
    units: Mapping[str, str] = MappingProxyType({}),
    in_header: dict[str, HeaderUnit] | None = None,
) -> tuple[dict[str, FloatArray], list[str], tuple[str, ...]]:
    """Return those of some columns that a log has ``(rows,)``, dates as seconds since the first, the names of all
    columns, and what is to be said of the cells; ``data`` is the name of a file or a data frame, ``time`` the column of
    the stamps, ``units`` those that columns are converted to from what the header says, with which ``in_header`` is
    filled."""
    data = data if isinstance(data, str | Path) else as_frame(data)
    header = _header(data, [time, *names])
    present = [name for name in dict.fromkeys(names) if column_of(header, name) and name != time]
    # A log without stamps is read like others: a column stands where they would.
    has_stamps = column_of(header, time) is not None
    first = time if has_stamps else next(iter(present), None)
    if first is None:
        return {}, header, ()
    ones, zeros = np.ones(len(present)), np.zeros(len(present))
    signals = LogSignals(tuple(present), (first, *present), ones, zeros, {}, units=units)
    stamps = Stamps()
    stamps.are_missing = not has_stamps
    rows = np.concatenate(list(chunks(data, signals, stamps, CHUNK_ROWS)))
    if in_header is not None:
        in_header.update(signals.in_header)
    columns, times = dict(zip(present, rows[:, 1:].T, strict=True)), rows[:, 0]
    if stamps.is_dated:
        # Seconds since 1970 in double precision have lost what is below a microsecond.
        times = np.round(times - times[0], SECOND_DECIMALS)
    return {**({time: times} if has_stamps else {}), **columns}, header, stamps.warnings()


def _header(data: Any, wanted: Sequence[str]) -> list[str]:
    """Return the names of all columns, of which some are wanted, the time first."""
    if not isinstance(data, str | Path):
        names = [str(name) for name in data.columns]
        dated = getattr(data.index, "dtype", None) is not None and data.index.dtype.kind in "Mm"
        return [
            *([TIME_HEADER] if TIME_HEADER not in names and (dated or data.index.name == TIME_HEADER) else []),
            *names,
        ]
    path = Path(data)
    check_suffix(path, LOG_SUFFIXES)
    input_file(path)
    if log_suffix(path) in READ_AS_TEXT:
        try:
            with opened_log(path, wanted) as stream:
                return list(opened_text(stream, wanted)[0])
        except UnicodeDecodeError as error:
            raise no_text(path, error) from error
        except OSError as error:
            raise SpecError(f"{path} cannot be read: {error.strerror or error}.", path=str(path)) from error
    with require_readable_log(path), read_by_package(path):
        _, names_of = READERS[path.suffix.lower()]
        return names_of(path, wanted)


def parsed_rows(rows: str | slice | Sequence[int] | None, count: int) -> tuple[int, int]:
    """Return first row and one past the last of ``"a:b"``, a slice or a pair, as Python counts."""
    if isinstance(rows, str):
        match = re.fullmatch(r"\s*(-?\d*)\s*:\s*(-?\d*)\s*", rows)
        if match is None:
            raise SpecError(f"rows is {rows!r}: give a:b, such as 0:56 for the first 56 rows.", path="rows")
        rows = slice(*(int(text) if text else None for text in match.groups()))
    elif isinstance(rows, (Sequence, np.ndarray)):
        if len(rows) != 2 or not all(isinstance(row, (int, np.integer)) for row in rows):
            raise SpecError(f"rows is {list(rows)}: give the first row and one past the last.", path="rows")
        rows = slice(int(rows[0]), int(rows[1]))
    elif rows is not None:
        require_kind(rows, slice, "rows", "a:b, a slice, or the first row and one past the last")
    first, last, step = (rows or slice(None)).indices(count)
    if step != 1 or last <= first:
        wanted = rows if isinstance(rows, slice) else slice(None)
        range_text = ":".join("" if end is None else str(end) for end in (wanted.start, wanted.stop))
        asked_for = f"rows {range_text} holds nothing" if range_text != ":" else "The log is empty"
        raise SpecError(f"{asked_for}: the log has {count} rows.", path="rows")
    if isinstance(rows, slice) and any(end is not None and abs(end) > count for end in (rows.start, rows.stop)):
        raise SpecError(f"rows asks for {rows.start}:{rows.stop}, but the log has {count} rows.", path="rows")
    return first, last
