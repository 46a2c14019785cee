"""Where rows come from: text, Parquet, TDMS and MDF files in chunks, data frames, and text streams row by row.

Logs as text: columns separated by commas, semicolons, tabs or bars, numbers with a point or a comma.

Columns of a whole log by name, for what needs all rows at once: read as `obsynth.run_on_data` reads them.

The columns of a log: time stamps as seconds or dates, and signals as deviations from the operating point.
"""

from __future__ import annotations

import codecs
import csv
import gc
import io
import itertools
import logging
import math
import re
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta, tzinfo
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any, TextIO, TypeAlias

import numpy as np

from obsynth.data.log_observers import LogObserver
from obsynth.errors import SpecError
from obsynth.files.outputs import input_file, reason
from obsynth.files.tables import unquoted
from obsynth.numerics.arguments import FloatArray, is_finite_number, number_in_text, read_only, require_kind

if TYPE_CHECKING:
    import pandas as pd
    from typing_extensions import TypeIs


#: What a missing sample may look like in a log.
MISSING_TEXTS = frozenset({"", "nan", "na", "n/a", "null", "none"})
_EPOCH = datetime(1970, 1, 1, tzinfo=UTC)
_EXPECTED_TIMES = "seconds, such as 12.5, or a date and a time, such as 2026-05-01T08:30:00.5+02:00"
#: Dates with points, which have the day first wherever they are written, and with slashes or dashes, which have no such
#: rule but where the year is first; those with the name of a month.
_POINTED = re.compile(r"(\d{1,2})\.(\d{1,2})\.(\d{4}|\d{2})(?!\d)(.*)")
_SLASHED = re.compile(r"(\d{1,4})([/-])(\d{1,2})\2(\d{1,4})(.*)")
_NAMED_MONTH = re.compile(
    r"(?=.*\b\d{4}\b).*\b(?:jan|feb|mar|apr|may|jun|jul|aug|sep|oct|nov|dec)[a-z]*\b.*", re.IGNORECASE
)
#: A year of two digits is one of these hundred.
_CENTURY = 2000
#: A time of day that names its zone behind it.
_ZONE = re.compile(
    r"(.*?:\d{2}[^A-Za-z+-]*?(?:\s*[AaPp]\.?[Mm]\.?)?)\s*(UTC|GMT|Z)?\s*(?:([+-])(\d{1,2})(?::?(\d{2}))?)?",
    re.IGNORECASE,
)
#: A time of day without its date, as it stands beside one; hours, minutes and seconds since a log began.
_TIME_OF_DAY = re.compile(
    r"\d{1,2}:\d{2}(?::\d{2}\S*)?(?:\s*[AaPp]\.?[Mm]\.?)?(?:\s*(?:UTC|GMT|Z|[+-]\d\S*))?", re.IGNORECASE
)
_ELAPSED = re.compile(r"(\d+):([0-5]\d):([0-5]\d(?:[.,]\d+)?)")
#: A time of day, with AM or PM where the hours are counted to twelve.
_CLOCK = re.compile(r"[ T]+(\d{1,2})(:\d{2}\S*?)(?:\s*([AaPp])\.?[Mm]\.?)?")
_HALF_DAY = 12
#: A part of a second in a date.
_PART_OF_A_SECOND = re.compile(r":\d{2}[.,]\d")
#: The part of a date that is larger is its day.
_MONTHS = 12
#: Seconds since 1970 reach this in the year 5138: larger numbers count parts of a second.
_LARGEST_SECONDS = 1e11
#: How many of them are in a second: milliseconds, microseconds, nanoseconds.
_PARTS = (1e3, 1e6, 1e9)
_MICROSECOND = timedelta(microseconds=1)
#: Seconds in a nanosecond, a microsecond and a day; microseconds in a second.
_NANO, _MICRO, _DAY_SECONDS, _MICROSECONDS = 1e-9, 1e-6, 86400.0, 1e6


#: What the unit of the time may be called in a line of units, and how many of them are a second; empty: seconds.
_UNITS_OF_TIME = {
    **dict.fromkeys(("", "-", "s", "sec", "secs", "second", "seconds", "sek"), 1.0),
    **dict.fromkeys(("ms", "msec", "millisecond", "milliseconds"), 1e3),
    **dict.fromkeys(("us", "µs", "μs", "usec", "microsecond", "microseconds"), 1e6),
    **dict.fromkeys(("ns", "nsec", "nanosecond", "nanoseconds"), 1e9),
    **dict.fromkeys(("min", "minute", "minutes"), 1 / 60),
    **dict.fromkeys(("h", "hr", "hour", "hours"), 1 / 3600),
}


def _is_number(text: str) -> bool:
    try:
        number_in_text(text.replace(",", "."))
    except ValueError:
        return False
    return True


def _clock(text: str) -> str:
    """Return a time of day, with what stands before it, as ISO 8601 writes it; other texts as they are."""
    found = _CLOCK.fullmatch(text)
    if found is None:
        return text
    hour, rest, half = int(found.group(1)), found.group(2), (found.group(3) or "").lower()
    if half and not 1 <= hour <= _HALF_DAY:
        return text
    return f"T{hour % _HALF_DAY + _HALF_DAY * (half == 'p') if half else hour:02}{rest}"


def _with_named_month(text: str) -> str:
    """Return a date with the name of a month as ISO 8601 writes it; what is none as it is."""
    import pandas as pd

    try:
        return str(pd.to_datetime(text).isoformat())
    except ValueError:
        return text


def _zone(text: str) -> tuple[str, str]:
    """Return a date and time without its zone, and the zone as ISO 8601 writes it, empty where there is none."""
    clock = text.partition(":")[2]
    if not clock or (clock[-1].isdigit() and "+" not in clock and "-" not in clock):
        return text, ""
    found = _ZONE.fullmatch(text)
    if found is None or not any(found.groups()[1:]):
        return text, ""
    body, _, sign, hours, minutes = found.groups()
    return body, f"{sign or '+'}{hours or '0':0>2}:{minutes or '00'}"


class Stamps:
    """Which kind of stamps a log has, decided by its first one, and the zone in which they are written back."""

    def __init__(self) -> None:
        self.is_dated: bool | None = None
        self.are_missing = False  # of a log without stamps, whose rows are counted by who reads it
        self.zone: tzinfo | None = None  # of the first stamp, `None` where it names none (taken as UTC)
        self.digits = "auto"  # how dates are written back: with a fraction in every row where the log has one
        self.day_first: bool | None = None  # of dates with slashes, by the first one
        self.per_second: float | None = None  # how many of the numbers of the log are a second, by the first one
        self.notes: list[str] = []  # what is to be said of the file
        #: Cells that hold a word instead of a number, which are missing, by column: how many; first row and text.
        self.words: dict[str, tuple[int, int, str]] = {}
        #: Cells beside which a status says that they are bad, by column: how many; first row, text and its column.
        self.bad: dict[str, tuple[int, int, str, str]] = {}
        #: The decimal mark that numbers of a column have shown, and rows of cells that may group thousands instead.
        self.decimals: dict[str, str] = {}
        self.groups: dict[tuple[str, str], tuple[int, str]] = {}
        #: Columns that have shown a number: of the others words are no bad samples, but another kind of column.
        self.numeric: set[str] = set()
        #: Inputs ``(delay, nu)`` of the latest rows, where inputs act later than they are written.
        self.earlier: FloatArray | None = None

    def warnings(self) -> tuple[str, ...]:
        """Return what is to be said of the file, and a text for each column with words in it."""
        return (
            *self.notes,
            *(
                f"{count} cell(s) of {column!r} hold no number and count as missing, first {text!r} in row {row}."
                for column, (count, row, text) in self.words.items()
            ),
            *(
                f"{count} cell(s) of {column!r} count as missing, as {status!r} says so, first {text!r} in row {row}."
                for column, (count, row, text, status) in self.bad.items()
            ),
        )

    def take_bad(self, column: str, row: int, text: str, status: str, *, count: int = 1) -> None:
        """Count cells that are bad by the column of their status, the first of which is in a row and says a text."""
        known, first_row, first_text, _ = self.bad.get(column, (0, row, text, status))
        self.bad[column] = (known + count, first_row, first_text, status)

    def take_mark(self, column: str, row: int, cell: str, mark: str, *, may_group: bool) -> None:
        """Take which decimal mark a number of a column has, or one that may group thousands instead: a log in which it
        may mean both means neither."""
        if may_group and (column, mark) not in self.groups:
            self.groups[column, mark] = row, cell
        elif not may_group and column not in self.decimals:
            self.decimals[column] = mark
        else:
            return
        for (name, seen), (first_row, first) in self.groups.items():
            known = {self.decimals[name]} if name in self.decimals else set(self.decimals.values())
            if known and seen not in known:
                raise SpecError(
                    f"Row {first_row}, column {name!r}: in {first!r} the mark may group thousands, as the decimals of "
                    f"other numbers begin with {min(known)!r}. Leave out what groups thousands.",
                    path=f"row {first_row}",
                )

    def take_header(self, header: Sequence[str], wanted: Sequence[str], places: Sequence[int]) -> None:
        """Take the units that stand behind names of columns, which are called otherwise where they are ``wanted``."""
        found = _WITH_UNIT.fullmatch(header[places[0]])
        per_second = None if found is None else _UNITS_OF_TIME.get(found.group(2).strip().lower())
        if per_second not in (None, 1.0):
            self.per_second = per_second
        named = [repr(header[place]) for name, place in zip(wanted, places, strict=True) if header[place] != name]
        if named:
            self.notes.append(f"Columns are found by their names without units: {', '.join(named)}.")

    def take_word(self, column: str, row: int, text: str) -> None:
        """Count a cell that holds a word instead of a number."""
        count, first_row, first_text = self.words.get(column, (0, row, text))
        self.words[column] = (count + 1, first_row, first_text)

    def take_units(self, cells: Sequence[str]) -> bool:
        """Whether the line below the header holds units, of which that of the time counts: its cell is one of time, or
        is empty, and no other is a number.  ``cells`` are those that are read, the time first."""
        if not cells or not any(cells) or any(map(_is_number, cells)):
            return False
        unit = cells[0].strip("[]()").lower()
        per_second = _UNITS_OF_TIME.get(unit)
        if per_second is None or not any(cell.lower() not in MISSING_TEXTS for cell in cells):
            return False
        if unit:
            self.per_second = per_second
        self.notes.append(f"The line below the header is taken as units: {', '.join(map(repr, cells))}.")
        return True

    def require_numbers(self) -> None:
        """Raise `SpecError`, at the end of a log, for a column of words in which no row holds a number."""
        for column, (_, row, text) in self.words.items():
            if column not in self.numeric:
                advice = " Write 1 and 0." if text.lower() in ("true", "false") else ""
                raise SpecError(
                    f"The column {column!r} holds no number: row {row} has {text!r}.{advice}", path=f"columns.{column}"
                )

    def read(self, text: str, row: int, column: str, *, comma: bool = False) -> float:
        """Return the seconds of one cell; ``comma`` takes a decimal comma."""
        cell = text.strip()
        if self.are_missing or cell.lower() in MISSING_TEXTS:
            return math.nan
        if self.is_dated is not True:
            try:
                seconds = number_in_text(cell.replace(",", ".") if comma else cell)
            except ValueError:
                seconds = None
            if seconds is not None:
                self.is_dated = False
                return float(self.seconds(np.array([seconds]))[0])
            elapsed = _ELAPSED.fullmatch(cell)
            if elapsed is not None:
                self.is_dated = False
                hours, minutes, rest = elapsed.groups()
                return 3600.0 * int(hours) + 60.0 * int(minutes) + float(rest.replace(",", "."))
        if self.is_dated is not False:
            text_of_date, found = cell, None
            if cell[4:5] == "-":
                with suppress(ValueError):
                    found = datetime.fromisoformat(cell)
            if found is None:
                text_of_date = self._as_iso(cell, row, column)
                with suppress(ValueError):
                    found = datetime.fromisoformat(text_of_date)
            if found is not None:
                if self.is_dated is None and _PART_OF_A_SECOND.search(text_of_date):
                    self.digits = "microseconds"
                return self._seconds(found, row, column)
        raise SpecError(
            f"Row {row}, column {column!r}: {text!r} is no time stamp: {self._expected()}.", path=f"row {row}"
        )

    def seconds(self, numbers: FloatArray) -> FloatArray:
        """Return seconds from stamps that are numbers ``(rows,)``: those too large for seconds since 1970 count parts
        of one."""
        known = np.abs(numbers[np.isfinite(numbers)])
        if self.per_second is None and known.size:
            first = float(known[0])
            self.per_second = 1.0
            if _LARGEST_SECONDS <= first < _LARGEST_SECONDS * _PARTS[-1]:
                self.per_second = next(parts for parts in _PARTS if first < _LARGEST_SECONDS * parts)
        return numbers if self.per_second in (None, 1.0) else np.asarray(numbers / self.per_second)

    def _as_iso(self, cell: str, row: int, column: str) -> str:
        """Return a date as ISO 8601 writes it: one with points, such as 5.3.2026 08:30:00,5, has the day first; of one
        with slashes the first of the log must say what its parts are."""
        cell, zone = _zone(cell)
        pointed, slashed = _POINTED.fullmatch(cell), _SLASHED.fullmatch(cell)
        if pointed is not None:
            day, month, year, time = pointed.groups()
            year = year if len(year) > 2 else str(_CENTURY + int(year))
        elif slashed is not None and len(slashed.group(1)) > 2:
            year, _, month, day, time = slashed.groups()
        elif slashed is not None:
            one, _, two, year, time = slashed.groups()
            if self.day_first is None and max(int(one), int(two)) > _MONTHS:
                self.day_first = int(one) > _MONTHS
            if self.day_first is None and one != two:
                raise SpecError(
                    f"Row {row}, column {column!r}: {cell!r} may begin with the day or the month: write dates with "
                    f"the year first, such as {year}-12-31.",
                    path=f"row {row}",
                )
            day, month = (one, two) if self.day_first else (two, one)
        elif _NAMED_MONTH.fullmatch(cell):
            return _with_named_month(cell) + zone
        else:
            return cell[:10] + _clock(cell[10:]) + zone
        return f"{year}-{month:0>2}-{day:0>2}{_clock(time)}{zone}"

    def read_column(self, column: Any) -> FloatArray | None:
        """Return the seconds of a column of a data frame that holds dates, or no stamps; else `None`."""
        if self.are_missing:
            return np.full(len(column), np.nan)
        kind = getattr(column.dtype, "kind", "O")
        if kind not in "Mm":
            return None
        missing = np.asarray(column.isna())
        if kind == "m":
            self.is_dated = False
            seconds = np.asarray(column.dt.total_seconds(), dtype=np.float64)
        else:
            zone = column.dt.tz
            if self.is_dated is None:
                self.is_dated, self.zone = True, zone
            moments = (column if zone is None else column.dt.tz_convert("UTC").dt.tz_localize(None)).to_numpy()
            # Apart, so that the fraction keeps its digits, and in seconds, of which no date has too many.
            whole = moments.astype("datetime64[s]")
            parts = np.where(missing, 0, (moments - whole).astype("timedelta64[ns]").astype(np.int64))
            if np.any(parts):
                self.digits = "microseconds"
            seconds = whole.astype(np.int64) + parts * _NANO
        return np.where(missing, np.nan, seconds)

    def shown(self, seconds: float) -> str:
        """Return a time as the log writes it."""
        if not self.is_dated or not math.isfinite(seconds):
            return f"{seconds:g} s"
        return self.date(seconds)

    def date(self, seconds: float) -> str:
        """Return the date and time of some seconds, ISO 8601, in the zone of the log."""
        return self.moment(seconds).isoformat(timespec=self.digits)

    def moment(self, seconds: float) -> datetime:
        """Return the date and time of some seconds, to the microsecond, with the log's zone if it names one."""
        found = _EPOCH + timedelta(seconds=math.floor(seconds)) + round((seconds % 1.0) * _MICROSECONDS) * _MICROSECOND
        return found.replace(tzinfo=None) if self.zone is None else found.astimezone(self.zone)

    def _seconds(self, found: datetime, row: int, column: str) -> float:
        if self.is_dated is None:
            self.is_dated, self.zone = True, found.tzinfo
        if (found.tzinfo is None) != (self.zone is None):
            raise SpecError(
                f"Row {row}, column {column!r}: stamps with a time zone and without one cannot be mixed in one log.",
                path=f"row {row}",
            )
        past = (found if found.tzinfo is not None else found.replace(tzinfo=UTC)) - _EPOCH
        return past.days * _DAY_SECONDS + past.seconds + past.microseconds * _MICRO

    def _expected(self) -> str:
        if self.is_dated is None:
            return f"give {_EXPECTED_TIMES}"
        return "the rows before hold dates and times" if self.is_dated else "the rows before hold seconds"


#: The column of time stamps, in seconds.
TIME_HEADER = "time"


@dataclass(frozen=True, eq=False)
class Signals:
    """Which column holds which measured signal, and how its values become deviations."""

    names: tuple[str, ...]  # signals: known inputs, then outputs
    columns: tuple[str, ...]  # the columns that are read: time, then one for each signal
    scale: FloatArray  # scale, offset: ``(nu + ny,)``: deviation = scale times the value in the column, minus offset
    offset: FloatArray
    point: Mapping[str, float]  # the operating point
    one: int | None = None  # number of the signal that is one in every row and has no column, if there is such a one
    inputs: int = 0  # columns of known inputs
    delay: int = 0  # rows by which these act later than the design takes them; negative: earlier

    @classmethod
    def of(
        cls, observer: LogObserver, columns: Mapping[str, str] | None, scales: Mapping[str, float] | None
    ) -> Signals:
        """Return the signals that a running design reads."""
        names = observer.input_names + observer.output_names
        renamed, factors = dict(columns or {}), dict(scales or {})
        unknown = [name for name in renamed if name not in (TIME_HEADER, *names)]
        unknown += [name for name in factors if name not in names]
        if unknown:
            raise SpecError(
                f"{unknown[0]!r} is no input or output of this observer, which has {', '.join(names)}.", path="columns"
            )
        for name, column in renamed.items():
            require_kind(column, str, f"The column of {name!r}", "the name of a column", path="columns")
        for name, factor in factors.items():
            if not is_finite_number(factor) or factor == 0.0:
                raise SpecError(f"The scale of {name!r} is {factor!r}: give a finite number, not zero.", path="scales")
        uncertain = getattr(getattr(observer, "plant", None), "uncertainty", None)
        shift = None if uncertain is None else uncertain.shift
        return cls(
            names,
            tuple(renamed.get(name, name) for name in (TIME_HEADER, *names) if not shift or name != shift),
            read_only(np.array([factors.get(name, observer.scales.get(name, 1.0)) for name in names])),
            read_only(np.array([observer.point.get(name, 0.0) for name in names])),
            dict(observer.point),
            names.index(shift) if shift and shift in names else None,
            len(observer.input_names) - int(bool(shift) and shift in observer.input_names),
            observer.input_delay,
        )

    def measured(self, rows: FloatArray) -> FloatArray:
        """Return signals in their units ``(rows, nu + ny)`` from rows of time and columns."""
        read = rows[:, 1:] if self.one is None else np.insert(rows[:, 1:], self.one, 1.0, axis=1)
        return np.asarray(self.scale * read)

    def deviations(self, rows: FloatArray) -> FloatArray:
        """Return deviations ``(rows, nu + ny)`` from rows of time and columns."""
        return self.measured(rows) - self.offset

    def positions(self, header: tuple[str, ...]) -> list[int]:
        """Return where in a header each column is that is read."""
        found = [column_of(header, name) for name in self.columns]
        missing = sorted({name for name, there in zip(self.columns, found, strict=True) if there is None})
        if missing:
            raise SpecError(
                f"The data have no column {', '.join(map(repr, missing))}; they have "
                f"{', '.join(map(repr, header)) or 'none'}. {_advice(header, missing)}",
                path="data",
            )
        there = [name for name in found if name is not None]
        repeated = sorted({name for name in there if header.count(name) > 1})
        if repeated:
            raise SpecError(
                f"The data have more than one column {', '.join(map(repr, repeated))}: give each a name of its own.",
                path="data",
            )
        return [header.index(name) for name in there]

    def estimates_point(self, observer: LogObserver) -> FloatArray:
        """Return what is added to the columns of estimates: the operating point of states and faults."""
        biases = getattr(getattr(observer, "plant", None), "sensor_faults", ())
        values = [self.point.get(name, 0.0) for name in observer.state_names]
        values += [0.0 if name in biases else self.point.get(name, 0.0) for name in observer.fault_names]
        return np.array(values + [0.0] * (len(observer.columns) - len(values)))


#: A name of a column with a unit in brackets behind it.
_WITH_UNIT = re.compile(r"(.*\S)\s*[\[(]([^\[\]()]*)[\])]")
#: How the column of dates beside times of day may be called; that of a status beside a value, or behind its name.
_DATE_NAMES = ("date", "datum", "day", "tag", "fecha")
_STATUS_NAMES = ("status", "quality")
#: How a status begins that says that a value is bad.
_BAD_STATUS = ("bad", "invalid", "not good")


def is_bad(status: str) -> bool:
    """Whether the text of a status says that the value beside it is bad."""
    return status.strip().lower().startswith(_BAD_STATUS)


def column_of(header: Sequence[str], name: str) -> str | None:
    """Return what a header calls a column: as it is called, or so with a unit in brackets behind it; `None` where no
    column, or more than one of the latter, is called so."""
    if name in header:
        return name
    found = [each for each in header if name in each and (unit := _WITH_UNIT.fullmatch(each)) and unit[1] == name]
    return found[0] if len(found) == 1 else None


def date_place(header: Sequence[str], places: Sequence[int]) -> int | None:
    """Return where dates stand that times of day, which are the first of the columns that are read, may lack."""
    found = [i for i, name in enumerate(header) if name.strip().lower() in _DATE_NAMES and i not in places]
    return found[0] if len(found) == 1 else None


def with_date(date: str, text: str) -> str:
    """Return a time of day with the date beside it; what is none as it is."""
    # A frame may show midnight behind its dates.
    return f"{date.strip().removesuffix(' 00:00:00')} {text.strip()}" if _TIME_OF_DAY.fullmatch(text.strip()) else text


def status_places(header: Sequence[str], places: Sequence[int]) -> list[int | None]:
    """Return where the status of each column stands that is read ``(1 + nu + ny,)``: a column that is called as it with
    a word such as ``status`` behind, or right of it by such a word alone."""
    found: list[int | None] = [None]
    lower = [name.strip().lower() for name in header]
    for place in places[1:]:
        unit = _WITH_UNIT.fullmatch(lower[place])
        base = unit[1] if unit else lower[place]
        own = [i for i, name in enumerate(lower)
               if name.startswith(base) and name[len(base) :].strip(" ._-:()[]/") in _STATUS_NAMES]  # fmt: skip
        beside = [place + 1] if place + 1 < len(lower) and lower[place + 1] in _STATUS_NAMES else []
        found.append(next((i for i in (*own, *beside) if i not in places), None))
    return found


#: How columns of time stamps are often called; a column of dates stands beside one of times of day.
_TIME_NAMES = ("timestamp", "datetime", "zeit", "uhrzeit", "time", "date")


def _advice(header: tuple[str, ...], missing: list[str]) -> str:
    if len(header) == 1 and any(mark in header[0] for mark in ":#~^ "):
        return "Separate columns by commas, semicolons, tabs or bars."
    found = next((name for kind in _TIME_NAMES for name in header if name.lower().startswith(kind)), None)
    found = found or next((name for name in header if name.lower() == "t"), None)
    if TIME_HEADER in missing and found is not None:
        return f"If {found!r} is the time: --time-column {found!r}, or columns={{'time': {found!r}}}."
    return "Map signals to columns where their names differ."


#: What may separate columns, the first one that fits.
SEPARATORS = (",", ";", "\t", "|")
#: How programs of Microsoft say what separates the columns, in a line before the header.
_SEPARATOR_LINE = re.compile(r"\s*sep=(.)\s*", re.IGNORECASE)
#: What a remark of the logger begins with, before the header.
REMARK = "#"
#: Lines that may end with CR alone.
_OLD_LINES = re.compile(r"[^\r]*\r\n?|[^\r]+")


#: What groups thousands: a blank of some kind or an apostrophe, or a point or comma that is not the decimal mark, or
#: stands twice; and a number whose only mark may do so.
_GROUPED = re.compile(
    r"([+-]?\d{1,3}(?:([ '\u00a0\u2009\u202f\u2019])\d{3}(?:\2\d{3})*"
    r"|(?:\.\d{3})+(?=,)|(?:,\d{3})+(?=\.)|(?:\.\d{3}){2,}|(?:,\d{3}){2,}))(?:([.,])(\d*))?"
)
_ONE_GROUP = re.compile(r"[+-]?[1-9]\d{0,2}[.,]\d{3}")


def number_in_cell(
    text: str | None, row: int, column: str, stamps: Stamps | None = None, *, comma: bool = False
) -> float:
    """Return the number in a cell, NaN where it is missing; a cell that is none is named with its row.
    A word is what loggers write for a bad sample: ``stamps`` counts these, and which columns show numbers; ``comma``:
    whether a comma in a number stands for its point."""
    cell = "" if text is None else text.strip()
    if cell.lower() in MISSING_TEXTS:
        return float("nan")
    try:
        found = number_in_text(cell.replace(",", ".") if comma and "." not in cell else cell)
        if comma and stamps is not None and ("," in cell or "." in cell):
            mark = "." if "." in cell else ","
            if stamps.decimals.get(column) != mark:
                stamps.take_mark(column, row, cell, mark, may_group=bool(_ONE_GROUP.fullmatch(cell)))
    except ValueError:
        grouped = _GROUPED.fullmatch(cell)
        if grouped is not None and stamps is not None:
            whole, mark, decimals = grouped[1], grouped[3] or "", grouped[4] or ""
            if mark:
                stamps.take_mark(column, row, cell, mark, may_group=False)
            stamps.numeric.add(column)
            return float(re.sub(r"[^\d+-]", "", whole) + "." + decimals)
        if stamps is not None and ("#" in cell or not any(letter.isdigit() for letter in cell)):
            stamps.take_word(column, row, cell)
            return float("nan")
        advice = ""
        if "," in cell:
            advice = (
                " Separate the columns by semicolons where numbers have a decimal comma."
                if not comma
                else " Leave out what groups thousands."
            )
        raise SpecError(f"Row {row}, column {column!r}: {text!r} is no number.{advice}", path=f"row {row}") from None
    if stamps is not None:
        stamps.numeric.add(column)
    return found


def _as_windows(error: UnicodeError) -> tuple[str, int]:
    """Return bytes that are no UTF-8 as Windows writes western letters, such as the degree in a unit."""
    if isinstance(error, UnicodeDecodeError) and error.encoding.lower().startswith("utf-8"):
        with suppress(UnicodeDecodeError):
            return error.object[error.start : error.end].decode("cp1252"), error.end
    raise error


#: The name by which texts are opened that may hold such bytes.
_WINDOWS = "obsynth.windows"
codecs.register_error(_WINDOWS, _as_windows)


def encoding_of(path: Path) -> str:
    """Return the encoding of a text: UTF-8 but where its first bytes say UTF-16 or UTF-32, with or without a mark."""
    with path.open("rb") as stream:
        first = stream.read(4)
    if first in (codecs.BOM_UTF32_LE, codecs.BOM_UTF32_BE):
        return "utf-32"
    if first[:2] in (codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE):
        return "utf-16"
    # A header begins with characters of ASCII, whose upper byte is zero.
    return {b"\1\0": "utf-16-le", b"\0\1": "utf-16-be"}.get(bytes(map(bool, first[:2])), "utf-8-sig")


#: What helps where a file is in another encoding than it seems to be.
SAVE_AS_TEXT = "If another program reads it, save it there as UTF-8."


def no_text(path: Path, error: UnicodeDecodeError) -> SpecError:
    """Return what is told of a file whose bytes are no text."""
    name = next((name for name in ("UTF-16", "UTF-32") if error.encoding.upper().startswith(name)), "UTF-8")
    return SpecError(f"{path} is no {name} text (byte {error.start}). {SAVE_AS_TEXT}", path=str(path))


def text_chunks(path: Path, signals: Signals, stamps: Stamps, rows: int) -> Iterator[FloatArray]:
    """Yield ``(rows, 1 + nu + ny)`` of a file."""
    with path.open(encoding=encoding_of(path), errors=_WINDOWS, newline="") as stream:
        if not stream.readline():
            raise SpecError(f"{path} cannot be read: it is empty.", path=str(path))
        stream.seek(0)
        try:
            yield from _together(stream_rows(stream, signals, stamps), rows)
        except SpecError as error:
            if (error.path or "").startswith("cells"):
                raise SpecError(f"{path} cannot be read: {error}", path=str(path)) from error
            raise


def stream_rows(stream: TextIO, signals: Signals, stamps: Stamps) -> Iterator[FloatArray]:
    """Yield one row at a time, ``(1, 1 + nu + ny)``, as soon as its line is there."""
    header, comma, table = _opened(stream, signals.columns)
    if not header:
        raise SpecError("The data are empty: their first line is the names of the columns.", path="data")
    places = signals.positions(header)
    stamps.take_header(header, signals.columns, places)
    date, states = date_place(header, places), status_places(header, places)
    row = 0
    for cells in table:
        if not any(cell.strip() for cell in cells):
            continue
        if row == 0 and stamps.take_units([cells[place].strip() for place in places if place < len(cells)]):
            continue
        row += 1
        if any(cell.strip() for cell in cells[len(header) :]):
            raise SpecError(
                f"Row {row} has {len(cells)} cells, but the header has {len(header)}.", path=f"cells of row {row}"
            )
        cells = [*cells[: len(header)], *[""] * (len(header) - len(cells))]
        stamp = cells[places[0]] if date is None else with_date(cells[date], cells[places[0]])
        time = stamps.read(stamp, row, header[places[0]], comma=comma)
        values = [number_in_cell(cells[place], row, header[place], stamps, comma=comma) for place in places[1:]]
        for i, place in enumerate(states):
            if place is not None and is_bad(cells[place]):
                stamps.take_bad(header[places[i]], row, cells[place].strip(), header[place])
                values[i - 1] = float("nan")
        yield np.array([[time, *values]])
    if row == 0:
        raise SpecError("The data have no rows.", path="data")


def _opened(stream: TextIO, wanted: Sequence[str]) -> tuple[tuple[str, ...], bool, Iterator[list[str]]]:
    """Return the names of the columns, whether numbers may have a decimal comma, and the cells of the lines below the
    header.  What a logger remarks before the header, in blank lines and in lines that begin with ``#`` and name no
    column that is read, is passed over."""
    lines = _text_lines(stream)
    head = next(lines, "")
    while (head and not head.strip()) or (
        head.startswith(REMARK)
        and not any(column_of(_names(head, separator), name) for separator in SEPARATORS for name in wanted)
    ):
        head = next(lines, "")
    told = _SEPARATOR_LINE.fullmatch(head)
    head = next(lines, "") if told else head
    separator = told.group(1) if told else _separator_of(head, wanted)
    # A name in quotes may go on in the next line.
    table = _cells(itertools.chain([head], lines), separator)
    return tuple(unquoted(name.strip()) for name in next(table, [])), separator != ",", table


def _together(rows: Iterator[FloatArray], count: int) -> Iterator[FloatArray]:
    while block := list(itertools.islice(rows, count)):
        yield np.concatenate(block)


def _separator_of(head: str, wanted: Sequence[str]) -> str:
    """Return what separates the columns of a log: what finds the columns that are read, or finds most."""
    found = {separator: _names(head, separator) for separator in SEPARATORS}
    whole = next((s for s, names in found.items() if all(column_of(names, name) for name in wanted)), None)
    return whole or max(SEPARATORS, key=lambda s: len(found[s]))


def _names(head: str, separator: str) -> Sequence[str]:
    try:
        return [unquoted(name.strip()) for name in next(csv.reader([head], delimiter=separator), [])]
    except csv.Error:
        return []


def _cells(lines: Iterator[str], separator: str) -> Iterator[list[str]]:
    """Yield the cells of each line; what is no text, or no table, is a `SpecError`."""
    table = csv.reader(lines, delimiter=separator)
    for row in itertools.count():
        try:
            cells = next(table, None)
        except csv.Error as error:
            raise SpecError(f"Row {row} of the data cannot be read: {error}.", path=f"row {row}") from error
        if cells is None:
            return
        yield cells


def _text_lines(stream: TextIO) -> Iterator[str]:
    """Yield lines as they come; lines that end with CR alone, as of old, come together where a stream keeps these."""
    is_first = True
    for count in itertools.count():
        try:
            block = stream.readline()
        except UnicodeDecodeError as error:
            name = getattr(stream, "name", "The data")
            raise SpecError(
                f"{name} is no text of its encoding after line {count}. {SAVE_AS_TEXT}", path="data"
            ) from error
        if not block:
            return
        for line in _OLD_LINES.findall(block):
            # A byte order mark is no part of the first name.
            yield line.removeprefix("\ufeff") if is_first else line
            is_first = False


#: Files that are read as text, and those that need a package: its name and the extra that installs it.
TEXT_SUFFIXES = (".csv", ".tsv")
NEEDED_PACKAGES = {
    ".parquet": ("pyarrow", "parquet"),
    ".tdms": ("nptdms", "tdms"),
    ".mf4": ("asammdf", "mdf"),
    ".mdf": ("asammdf", "mdf"),
    ".dat": ("asammdf", "mdf"),
}
#: Rows that are held in memory at a time.
CHUNK_ROWS = 10_000
#: Files that estimates are written to.
TABLE_SUFFIXES = (".csv", ".parquet")
Data: TypeAlias = "str | Path | TextIO | pd.DataFrame"


def chunks(data: Data, signals: Signals, stamps: Stamps, rows: int) -> Iterator[FloatArray]:
    """Yield ``(rows, 1 + nu + ny)``: time and signals, in order; NaN where a sample is missing.  Inputs are those that
    act in a row as the design takes it."""
    found = _chunks(data, signals, stamps, rows)
    if not signals.delay or not signals.inputs:
        yield from found
    elif signals.delay > 0:
        yield from _delayed(found, signals, stamps)
    else:
        yield from _advanced(found, signals)
    # Whether columns hold numbers is known at the end, wherever the words in them stand.
    stamps.require_numbers()


def _delayed(found: Iterator[FloatArray], signals: Signals, stamps: Stamps) -> Iterator[FloatArray]:
    """Yield rows with the inputs of so many rows before; the first ones hold their own."""
    inputs = slice(1, 1 + signals.inputs)
    for chunk in found:
        if stamps.earlier is None:
            stamps.earlier = np.repeat(chunk[:1, inputs], signals.delay, axis=0)
        whole = np.vstack([stamps.earlier, chunk[:, inputs]])
        stamps.earlier = whole[len(chunk) :]
        chunk[:, inputs] = whole[: len(chunk)]
        yield chunk


def _advanced(found: Iterator[FloatArray], signals: Signals) -> Iterator[FloatArray]:
    """Yield rows with the inputs of so many rows after, for which they wait; the last ones hold the last."""
    inputs, wait = slice(1, 1 + signals.inputs), -signals.delay
    kept: FloatArray | None = None
    for chunk in found:
        whole = chunk if kept is None else np.vstack([kept, chunk])
        ready = max(len(whole) - wait, 0)
        kept = whole[ready:].copy()
        if ready:
            done = whole[:ready].copy()
            done[:, inputs] = whole[wait : wait + ready, inputs]
            yield done
    if kept is not None and len(kept):
        # Of a short log fewer rows than these are left.
        after = np.minimum(np.arange(len(kept)) + wait, len(kept) - 1)
        kept[:, inputs] = kept[after][:, inputs]
        yield kept


def _chunks(data: Data, signals: Signals, stamps: Stamps, rows: int) -> Iterator[FloatArray]:
    if isinstance(data, str | Path):
        path = Path(data)
        check_suffix(path, (*TEXT_SUFFIXES, *NEEDED_PACKAGES))
        with _readable(path):
            if path.suffix.lower() in TEXT_SUFFIXES:
                yield from text_chunks(path, signals, stamps, rows)
            else:
                with _read_by_package(path):
                    read_rows, _ = _READERS[path.suffix.lower()]
                    yield from _converted(read_rows(path, signals, stamps, rows), signals, stamps)
    elif is_stream(data):
        if data is sys.stdin and isinstance(data, io.TextIOWrapper):
            data.reconfigure(errors=_WINDOWS)
        yield from stream_rows(data, signals, stamps)
    else:
        import pandas as pd

        require_kind(data, pd.DataFrame, "data", "the name of a file, a text stream or a pandas.DataFrame")
        frame = _with_time(data, signals)
        numbers = all(pd.api.types.is_numeric_dtype(kind) for kind in frame.dtypes)
        # Of numbers a part says no less than the whole: no copy of all of them is made.
        parts = range(0, max(len(frame), 1), rows) if numbers else range(1)
        size = rows if numbers else max(len(frame), 1)
        for whole in _converted((frame.iloc[start : start + size] for start in parts), signals, stamps):
            for start in range(0, len(whole), rows):
                yield whole[start : start + rows]


def samples(data: Data, signals: Signals) -> Iterator[tuple[float, FloatArray]]:
    """Yield time and deviations ``(nu + ny,)`` of each row."""
    for chunk in chunks(data, signals, Stamps(), CHUNK_ROWS):
        yield from zip(chunk[:, 0].tolist(), signals.deviations(chunk), strict=True)


def is_stream(data: TextIO | pd.DataFrame) -> TypeIs[TextIO]:
    """Whether ``data`` is read line by line."""
    return hasattr(data, "readline")


def check_suffix(path: Path, suffixes: tuple[str, ...] = TABLE_SUFFIXES) -> None:
    """Raise `SpecError` unless a file is of a known kind by its name, and its package is installed."""
    suffix = path.suffix.lower()
    if suffix not in suffixes:
        raise SpecError(f"{path} has an unknown suffix: use one of {', '.join(suffixes)}.", path=str(path))
    if suffix in NEEDED_PACKAGES:
        package, extra = NEEDED_PACKAGES[suffix]
        try:
            import_module(package)
        except ImportError:
            raise SpecError(
                f"{suffix} files need {package}: pip install 'obsynth[{extra}]', or use CSV.", path=str(path)
            ) from None


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
        raise no_text(path, error) from error
    except OSError as error:
        raise SpecError(f"{path} cannot be read: {reason(error)}.", path=str(path)) from error


@contextmanager
def _read_by_package(path: Path) -> Iterator[None]:
    """Turn whatever the package of a file raises about it, as it may be damaged in any place, into an error that names
    both.  What the package would log is in that error."""
    wanted = _BEGINNINGS[path.suffix.lower()]
    with path.open("rb") as stream:
        if stream.read(len(wanted)) != wanted:
            # Its package would read nothing.
            raise SpecError(f"{path} cannot be read: it is no {path.suffix} file.", path=str(path))
    package = NEEDED_PACKAGES[path.suffix.lower()][0]
    import_module(package)
    loggers = [
        logging.getLogger(name) for name in (package, *logging.root.manager.loggerDict) if name.startswith(package)
    ]
    were_disabled = [logger.disabled for logger in loggers]
    for logger in loggers:
        logger.disabled = True
    try:
        yield
    except SpecError:
        raise
    except Exception as error:  # readers of damaged bytes raise what comes: struct.error, TypeError, a bare Exception
        raise _unreadable(path, package, error) from error
    finally:
        for logger, was_disabled in zip(loggers, were_disabled, strict=True):
            logger.disabled = was_disabled


def _unreadable(path: Path, package: str, error: Exception) -> SpecError:
    told = " ".join(reason(error).split()) or type(error).__name__
    return SpecError(
        f"{path} cannot be read: {package} says {told!r}. If the file is damaged, or its end is missing, copy it or "
        "export it again.",
        path=str(path),
    )


def _parquet(path: Path, signals: Signals, stamps: Stamps, rows: int) -> Iterator[pd.DataFrame]:
    import pyarrow.parquet

    time = signals.columns[0]
    with pyarrow.parquet.ParquetFile(path) as file:
        header, own, counted = _parquet_header(file.schema_arrow, time)
        places = signals.positions(tuple(header))
        more = [date_place(header, places), *status_places(header, places)]
        wanted = [
            own if header[place] == time else header[place]
            # In their order: a status stands right of its value.
            for place in sorted({place for place in (*places, *more) if place is not None})
            if header[place] != time or not counted
        ]
        done = 0
        for batch in file.iter_batches(batch_size=rows, columns=wanted):
            # What pandas notes about an index would take it out of the columns.
            frame = batch.to_pandas(ignore_metadata=True).rename(columns={own: time})
            if counted is not None:
                frame[time] = counted[0] + counted[1] * np.arange(done, done + len(frame))
            done += len(frame)
            yield frame


def _parquet_names(path: Path, wanted: Sequence[str]) -> list[str]:
    import pyarrow.parquet

    return _parquet_header(pyarrow.parquet.read_schema(path), wanted[0])[0]


def _parquet_header(schema: Any, time: str) -> tuple[list[str], str, tuple[float, float] | None]:
    """Return the names of all columns, how the file itself calls the time, and first number and step of the time where
    it is an index that counts, which pandas writes to no column.  Dates and time differences may have no name."""
    import pyarrow as pa

    names = list(schema.names)
    indices = [] if time in names else (schema.pandas_metadata or {}).get("index_columns", [])
    for index in indices:
        if isinstance(index, dict) and index.get("kind") == "range" and index.get("name") == time:
            return [*names, time], time, (float(index["start"]), float(index["step"]))
        if time == TIME_HEADER and isinstance(index, str) and index.startswith(_UNNAMED_INDEX):
            kind = schema.field(index).type
            if pa.types.is_timestamp(kind) or pa.types.is_duration(kind):
                return [time if name == index else name for name in names], index, None
    return names, time, None


#: How pandas calls the column of an index without a name.
_UNNAMED_INDEX = "__index_level_"


def _only(path: Path, name: str, channels: Sequence[tuple[str, str, Any]]) -> Any:
    """Return the channel that is called so, or as its group and it, such as ``rig/level``; `None` where there is none.
    ``channels`` are groups, names and channels."""
    found = [(group, channel) for group, own, channel in channels if name in (own, f"{group}/{own}")]
    found = found or [(group, channel) for group, own, channel in channels if column_of([own], name)]
    if len(found) > 1:
        groups = ", ".join(repr(group) for group, _ in found)
        raise SpecError(
            f"{path} has more than one channel {name!r}, in the groups {groups}: name the group too, such as "
            f"'{found[0][0]}/{name}' (--map, or columns={{...}}).",
            path=str(path),
        )
    return found[0][1] if found else None


#: Waveforms whose samples are further apart than this share of their interval are no rows of one table.
LARGEST_SHIFT = 0.5


def _tdms(path: Path, signals: Signals, stamps: Stamps, rows: int) -> Iterator[pd.DataFrame]:
    """Yield the channels of a TDMS file; where no channel is the time, that of the waveforms is."""
    from nptdms import TdmsFile

    with path.open("rb") as stream, TdmsFile.open(stream) as file:
        if file.file_status.incomplete_final_segment:
            stamps.notes.append(f"{path} ends within its last segment: what follows was lost, or not written yet.")
        channels = _tdms_channels(file)
        found = {name: _only(path, name, channels) for name in signals.columns}
        wanted = {name: channel for name, channel in found.items() if channel is not None}
        frame: dict[str, Any] = {name: channel[:] for name, channel in wanted.items()}
        time = signals.columns[0]
        lengths = {name: len(values) for name, values in frame.items()}
        if len(set(lengths.values())) > 1:
            told = ", ".join(f"{name!r} {count}" for name, count in lengths.items())
            raise SpecError(f"{path}: the channels have different numbers of samples: {told}.", path=str(path))
        if time not in frame and wanted:
            waves = {name: channel for name, channel in wanted.items() if "wf_increment" in channel.properties}
            if waves:
                frame = {time: _wave_times(path, waves), **frame}
        others = {name: np.zeros(0) for _, name, _ in channels if name not in frame}
        yield from _frames(frame, others, signals, rows)


def _tdms_channels(file: Any) -> list[tuple[str, str, Any]]:
    return [(group.name, channel.name, channel) for group in file.groups() for channel in group.channels()]


def _tdms_names(path: Path, wanted: Sequence[str]) -> list[str]:
    from nptdms import TdmsFile

    with path.open("rb") as stream, TdmsFile.read_metadata(stream) as file:
        channels = _tdms_channels(file)
        have_times = any("wf_increment" in channel.properties for _, name, channel in channels if name in wanted)
        return _called(channels, wanted, have_times=have_times)


def _called(channels: Sequence[tuple[str, str, Any]], wanted: Sequence[str], *, have_times: bool) -> list[str]:
    """Return the names of channels, with the group too where they are wanted so; the time, which is wanted first, as
    well where the file has times without a channel of that name."""
    names = list(dict.fromkeys(name for _, name, _ in channels))
    full = {f"{group}/{name}" for group, name, _ in channels}
    names += [name for name in dict.fromkeys(wanted) if name in full and name not in names]
    return [*names, wanted[0]] if have_times and wanted[0] not in names else names


def _wave_times(path: Path, waves: dict[str, Any]) -> FloatArray:
    """Return the times of waveforms ``(rows,)``, which must be the same for all of them."""
    first = next(iter(waves))
    times = np.asarray(waves[first].time_track())
    start = waves[first].properties.get("wf_start_time")
    for name, wave in waves.items():
        own = np.asarray(wave.time_track())
        begin = wave.properties.get("wf_start_time")
        if begin is not None and start is not None:
            own = own + (begin - start) / np.timedelta64(1, "s")
        step = abs(float(waves[first].properties["wf_increment"]))
        if not np.all(np.abs(own - times) <= LARGEST_SHIFT * step):
            raise SpecError(
                f"{path}: the waveforms {first!r} and {name!r} have other times: resample them to the same times.",
                path=str(path),
            )
    return times


def _mdf(path: Path, signals: Signals, stamps: Stamps, rows: int) -> Iterator[pd.DataFrame]:
    """Yield the channels of an MDF file on the raster of the first signal, with the stamps of the time channel."""
    with _mdf_file(path) as file:
        known = _mdf_channels(file)
        masters = set(file.masters_db.items())
        time = signals.columns[0]
        found = {name: _only(path, name, known) for name in signals.columns[1:]}
        wanted = {name: place for name, place in found.items() if place is not None}
        frame: dict[str, Any] = {}
        if wanted:
            raster = np.asarray(file.get_master(next(iter(wanted.values()))[0]), dtype=np.float64)
            of_time = _only(path, time, [entry for entry in known if entry[2] not in masters])
            names = {name for _, name, place in known if place in masters}
            if of_time is not None:
                frame[time] = _on_raster(file, time, of_time, raster)
            elif time == TIME_HEADER or time in names:
                frame[time] = raster
            frame.update({name: _on_raster(file, name, place, raster) for name, place in wanted.items()})
        yield from _frames(frame, dict.fromkeys(name for _, name, _ in known), signals, rows)


def _mdf_channels(file: Any) -> list[tuple[str, str, tuple[int, int]]]:
    return [(str(group), name, (group, at)) for name, places in file.channels_db.items() for group, at in places]


def _mdf_names(path: Path, wanted: Sequence[str]) -> list[str]:
    with _mdf_file(path) as file:
        return _called(_mdf_channels(file), wanted, have_times=wanted[0] == TIME_HEADER)


@contextmanager
def _mdf_file(path: Path) -> Iterator[Any]:
    """Open an MDF file.  What asammdf leaves of one that it cannot open fails once more when it is thrown away: nobody
    is to read of it."""
    from asammdf import MDF

    hook = sys.unraisablehook
    sys.unraisablehook = lambda _: None
    try:
        file = MDF(path)
    except Exception as error:
        # Without its traceback nothing holds what is half open but itself.
        error.with_traceback(None)
        gc.collect()
        raise _unreadable(path, "asammdf", error) from error
    finally:
        sys.unraisablehook = hook
    with file:
        _require_channels_within_records(path, file)
        yield file


def _require_channels_within_records(path: Path, file: Any) -> None:
    """Raise `SpecError` for an MDF file with a channel outside of its records, as changed bytes make them: code of
    asammdf in C would read there, and end the process."""
    for group in file.groups:
        bits = 8 * (group.channel_group.samples_byte_nr + getattr(group.channel_group, "invalidation_bytes_nr", 0))
        for channel in group.channels:
            # Version 4, and those before.
            start = (
                8 * channel.byte_offset + channel.bit_offset
                if hasattr(channel, "byte_offset")
                else 8 * getattr(channel, "additional_byte_offset", 0) + channel.start_offset
            )
            if start + channel.bit_count > bits:
                raise SpecError(
                    f"{path} cannot be read: its channel {channel.name!r} lies outside of its records. The file is "
                    "damaged: copy it or export it again.",
                    path=str(path),
                )


def _on_raster(file: Any, name: str, place: tuple[int, int], raster: FloatArray) -> Any:
    """Return a channel on a raster ``(rows,)``: interpolated between its samples, missing where it has none or where
    the logger says that they are invalid."""
    group, index = place
    signal = file.get(group=group, index=index)
    if signal.samples.ndim != 1 or signal.samples.dtype.names:
        raise SpecError(f"The channel {name!r} holds arrays: give one that holds a number a sample.", path="columns")
    own = np.asarray(file.get_master(group), dtype=np.float64)
    valid = np.isin(own, signal.timestamps)
    if np.array_equal(own, raster) and valid.all():
        return _cells_of(signal.samples)
    if np.any(np.diff(own) < 0) or not len(signal.samples):
        raise SpecError(
            f"The channel {name!r} has {'times that fall' if len(signal.samples) else 'no valid sample'}.",
            path="columns",
        )
    # Half a step before the first sample and after the last one these still count.
    margin = LARGEST_SHIFT * float(np.median(np.diff(own))) if len(own) > 1 else 0.0
    within = np.interp(raster, own, valid.astype(np.float64)) == 1.0
    within &= (raster >= own[0] - margin) & (raster <= own[-1] + margin)
    cells = _cells_of(signal.interp(raster).samples)
    return np.where(within, cells, None if cells.dtype == object else np.nan)


def _cells_of(samples: Any) -> Any:
    """Return samples ``(rows,)`` as numbers, or as the texts of a channel of words."""
    if samples.dtype.kind == "S":
        return np.array([cell.decode("utf-8", "replace") for cell in samples], dtype=object)
    return np.asarray(samples, dtype=object if samples.dtype.kind == "U" else np.float64)


def _frames(found: dict[str, Any], others: dict[str, Any], signals: Signals, rows: int) -> Iterator[pd.DataFrame]:
    """Yield columns in chunks; names that are not there are told with all that are."""
    import pandas as pd

    if not set(signals.columns) <= set(found):
        signals.positions(tuple(dict.fromkeys((*found, *others))))
    frame = pd.DataFrame(found)
    for start in range(0, max(len(frame), 1), rows):
        yield frame.iloc[start : start + rows]


#: How files of these kinds begin.
_BEGINNINGS = {".parquet": b"PAR1", ".tdms": b"TDSm", ".mf4": b"MDF ", ".mdf": b"MDF ", ".dat": b"MDF "}


#: What yields the rows of a file, and what names all of its columns, of which some are wanted, the time first.
_READERS: dict[
    str,
    tuple[Callable[[Path, Signals, Stamps, int], Iterator[Any]], Callable[[Path, Sequence[str]], list[str]]],
] = {
    ".parquet": (_parquet, _parquet_names),
    ".tdms": (_tdms, _tdms_names),
    ".mf4": (_mdf, _mdf_names),
    ".mdf": (_mdf, _mdf_names),
    ".dat": (_mdf, _mdf_names),
}


def _with_time(frame: pd.DataFrame, signals: Signals) -> pd.DataFrame:
    """Return a frame whose index of dates, of time differences, or called as the time, is a column."""
    import pandas as pd

    time, names = signals.columns[0], [str(name) for name in frame.columns]
    frame = frame.set_axis(names, axis=1)
    dated = isinstance(frame.index, (pd.DatetimeIndex, pd.TimedeltaIndex))
    if time in names or not (frame.index.name == time or (dated and time == TIME_HEADER)):
        return frame
    return frame.assign(**{time: frame.index}).reset_index(drop=True)


def _converted(frames: Iterator[pd.DataFrame], signals: Signals, stamps: Stamps) -> Iterator[FloatArray]:
    done = 0
    for frame in frames:
        header = tuple(str(name) for name in frame.columns)
        places = signals.positions(header)
        if not done:
            stamps.take_header(header, signals.columns, places)
        date = date_place(header, places)
        times = _times(frame.iloc[:, places[0]], done, stamps, None if date is None else frame.iloc[:, date])
        values = []
        for place, state in zip(places[1:], status_places(header, places)[1:], strict=True):
            column = _numbers(frame.iloc[:, place], done, stamps)
            states = None if state is None else frame.iloc[:, state]
            values.append(column if states is None else _without_bad(column, header[place], states, done, stamps))
        yield np.column_stack([times, *values])
        done += len(frame)
    if done == 0:
        raise SpecError("The data have no rows.", path="data")


def _without_bad(values: FloatArray, name: str, states: pd.Series, done: int, stamps: Stamps) -> FloatArray:
    """Return samples ``(n,)`` without those of which their status says that they are bad."""
    said = [str(cell).strip() for cell in states]
    bad = np.array([is_bad(text) for text in said], dtype=bool)
    if bad.any():
        first = int(np.argmax(bad))
        stamps.take_bad(name, done + first + 1, said[first], str(states.name), count=int(bad.sum()))
    return np.where(bad, np.nan, values)


def _times(column: pd.Series, done: int, stamps: Stamps, dates: pd.Series | None) -> FloatArray:
    """Return a column of time stamps as seconds; ``dates`` may stand beside times of day."""
    import pandas as pd

    found = stamps.read_column(column)
    if found is not None:
        return found
    if pd.api.types.is_numeric_dtype(column):
        stamps.is_dated = False
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
        found = np.asarray(column.to_numpy(dtype=np.float64, na_value=np.nan))
        if stamps is not None and not np.isnan(found).all():
            stamps.numeric.add(str(column.name))
        return found
    texts = [None if pd.isna(cell) else str(cell) for cell in column]
    return np.array([number_in_cell(text, done + i + 1, str(column.name), stamps) for i, text in enumerate(texts)])


#: Decimals of seconds that dates are told to.
SECOND_DECIMALS = 6


def log_table(
    data: str | Path | Any, names: Sequence[str], time: str = TIME_HEADER
) -> tuple[dict[str, FloatArray], list[str], tuple[str, ...]]:
    """Return those of some columns that a log has ``(rows,)``, dates as seconds since the first, the names of all
    columns, and what is to be said of the cells; ``data`` is the name of a file or a data frame, ``time`` the column of
    the stamps."""
    header = _header(data, [time, *names])
    there = [name for name in dict.fromkeys(names) if column_of(header, name) and name != time]
    # A log without stamps is read like others: a column stands where they would.
    has_stamps = column_of(header, time) is not None
    first = time if has_stamps else next(iter(there), None)
    if first is None:
        return {}, header, ()
    signals = Signals(tuple(there), (first, *there), np.ones(len(there)), np.zeros(len(there)), {})
    stamps = Stamps()
    stamps.are_missing = not has_stamps
    rows = np.concatenate(list(chunks(data, signals, stamps, CHUNK_ROWS)))
    found, times = dict(zip(there, rows[:, 1:].T, strict=True)), rows[:, 0]
    if stamps.is_dated:
        # Seconds since 1970 in double precision have lost what is below a microsecond.
        times = np.round(times - times[0], SECOND_DECIMALS)
    return {**({time: times} if has_stamps else {}), **found}, header, stamps.warnings()


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
    check_suffix(path, (*TEXT_SUFFIXES, *NEEDED_PACKAGES))
    input_file(path)
    if path.suffix.lower() in TEXT_SUFFIXES:
        try:
            with path.open(encoding=encoding_of(path), errors=_WINDOWS, newline="") as stream:
                return list(_opened(stream, wanted)[0])
        except UnicodeDecodeError as error:
            raise no_text(path, error) from error
        except OSError as error:
            raise SpecError(f"{path} cannot be read: {error.strerror or error}.", path=str(path)) from error
    with _readable(path), _read_by_package(path):
        _, names_of = _READERS[path.suffix.lower()]
        return names_of(path, wanted)


def parsed_rows(rows: str | slice | Sequence[int] | None, count: int) -> tuple[int, int]:
    """Return first row and one past the last of ``"a:b"``, a slice or a pair, as Python counts."""
    if isinstance(rows, str):
        found = re.fullmatch(r"\s*(-?\d*)\s*:\s*(-?\d*)\s*", rows)
        if found is None:
            raise SpecError(f"rows is {rows!r}: give a:b, such as 0:56 for the first 56 rows.", path="rows")
        rows = slice(*(int(text) if text else None for text in found.groups()))
    elif isinstance(rows, (Sequence, np.ndarray)):
        if len(rows) != 2 or not all(isinstance(row, (int, np.integer)) for row in rows):
            raise SpecError(f"rows is {list(rows)}: give the first row and one past the last.", path="rows")
        rows = slice(int(rows[0]), int(rows[1]))
    elif rows is not None:
        require_kind(rows, slice, "rows", "a:b, a slice, or the first row and one past the last")
    first, last, step = (rows or slice(None)).indices(count)
    if step != 1 or last <= first:
        asked = rows if isinstance(rows, slice) else slice(None)
        told = ":".join("" if end is None else str(end) for end in (asked.start, asked.stop))
        asked_for = f"rows {told} holds nothing" if told != ":" else "The log is empty"
        raise SpecError(f"{asked_for}: the log has {count} rows.", path="rows")
    if isinstance(rows, slice) and any(end is not None and abs(end) > count for end in (rows.start, rows.stop)):
        raise SpecError(f"rows asks for {rows.start}:{rows.stop}, but the log has {count} rows.", path="rows")
    return first, last
