"""Time stamps of a log: numbers in a unit of time, dates in a zone, serial days; as seconds."""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from contextlib import suppress
from datetime import UTC, datetime, timedelta, timezone, tzinfo
from typing import Any
from zoneinfo import ZoneInfo

import numpy as np

from obsynth.errors import SpecError, counted
from obsynth.monitoring.logs.measured_columns import MeasuredColumns
from obsynth.numerics.arguments import number_in_text
from obsynth.numerics.arrays import FloatArray
from obsynth.numerics.measurement_units import MICRO_SIGNS
from obsynth.plants.input_derivatives import derivative_of
from obsynth.results.number_texts import point_in_time

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

#: An offset from UTC.
_OFFSET = re.compile(r"([+-])([01]\d|2[0-3]):?([0-5]\d)?")

#: Where clocks go back by an hour in autumn, stamps fall by that less the interval of the rows: by so many seconds at
#: least where these are not half an hour apart.
LEAST_FALL, AUTUMN_FALL = 1800.0, 3600.0

#: Seconds in a nanosecond, a microsecond and a day; microseconds in a second.
_NANO, _MICRO, _DAY_SECONDS, _MICROSECONDS = 1e-9, 1e-6, 86400.0, 1e6

#: What the unit of the time may be called in a line of units, and how many of them are a second, the usual name of each
#: first; empty: seconds.
UNITS_OF_TIME = {
    **dict.fromkeys(("", "-", "s", "sec", "secs", "second", "seconds", "sek"), 1.0),
    **dict.fromkeys(("ms", "msec", "millisecond", "milliseconds"), 1e3),
    **dict.fromkeys(("us", *(f"{sign}s" for sign in MICRO_SIGNS), "usec", "microsecond", "microseconds"), 1e6),
    **dict.fromkeys(("ns", "nsec", "nanosecond", "nanoseconds"), 1e9),
    **dict.fromkeys(("min", "minute", "minutes"), 1 / 60),
    **dict.fromkeys(("h", "hr", "hour", "hours"), 1 / 3600),
    **dict.fromkeys(("d", "day", "days"), 1 / 86400),
}

#: Serial days of spreadsheets (since 1900) and of MATLAB's ``datenum`` (since year 0) from 1990 to 2099.
_SERIAL_DAYS = ((32874.0, 73050.0), (726834.0, 767010.0))

#: Rows of a log in days are at most an hour apart; a log in seconds whose stamps begin hours after its start is not
#: sampled that fast (24 Hz) for so many rows.
_ROWS_OF_DAYS = 3

_STEP_IN_DAYS = 1.0 / 24.0

#: A name of a column with a unit in brackets behind it.
WITH_UNIT = re.compile(r"(.*\S)\s*[\[(]([^\[\]()]*)[\])]")


def _is_number(text: str) -> bool:
    try:
        number_in_text(text.replace(",", "."))
    except ValueError:
        return False
    return True


def _clock(text: str) -> str:
    """Return a time of day, with what stands before it, as ISO 8601 writes it; other texts as they are."""
    match = _CLOCK.fullmatch(text)
    if match is None:
        return text
    hour, minutes, half = int(match.group(1)), match.group(2), (match.group(3) or "").lower()
    if half and not 1 <= hour <= _HALF_DAY:
        return text
    return f"T{hour % _HALF_DAY + _HALF_DAY * (half == 'p') if half else hour:02}{minutes}"


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
    match = _ZONE.fullmatch(text)
    if match is None or not any(match.groups()[1:]):
        return text, ""
    body, _, sign, hours, minutes = match.groups()
    return body, f"{sign or '+'}{hours or '0':0>2}:{minutes or '00'}"


def zone_of(name: str) -> tzinfo:
    """Return a time zone: a name such as ``Europe/Berlin``, or an offset such as ``+01:00``; raise `SpecError`."""
    match = _OFFSET.fullmatch(name)
    if match is not None:
        sign, hours, minutes = match.groups()
        offset = timedelta(hours=int(hours), minutes=int(minutes or 0))
        return timezone(-offset if sign == "-" else offset)
    try:
        return ZoneInfo(name)
    except (LookupError, ValueError, OSError) as error:
        raise SpecError(
            f"{name!r} is no time zone that is known here: give a name, such as Europe/Berlin, or an offset from UTC, "
            "such as +01:00.",
            path="time_zone",
        ) from error


def _per_second(unit: str) -> float:
    """Return how many of a unit of time are a second."""
    count = UNITS_OF_TIME.get(str(unit).strip().lower()) if str(unit).strip() else None
    if count is None:
        raise SpecError(
            f"{unit!r} is no unit of time: give one of s, ms, us, ns, min, h, d (or days).", path="time_unit"
        )
    return count


class Stamps:
    """Which kind of stamps a log has, decided by its first one, and the zone in which they are written back."""

    def __init__(self, time_zone: str | None = None, time_unit: str | None = None) -> None:
        #: The zone of dates that name none, where it is stated.
        self.stated = None if time_zone is None else zone_of(time_zone)
        #: Whether dates name no zone, the latest of them, and the interval before it, in seconds.
        self.are_local: bool | None = None
        self.latest, self.step = -math.inf, 0.0
        self.is_dated: bool | None = None
        self.are_missing = False  # of a log without stamps, whose rows are counted by who reads it
        self.zone: tzinfo | None = None  # of the first stamp, `None` where it names none (taken as UTC)
        self.digits = "auto"  # how dates are written back: with a fraction in every row where the log has one
        self.day_first: bool | None = None  # of dates with slashes, by the first one
        self.per_second: float | None = None  # how many of the numbers of the log are a second, by the first one
        self.has_unit = False  # whether the file states the unit of its stamps
        self.unit = time_unit  # the unit that is stated beside the file
        if time_unit is not None:
            self.per_second, self.has_unit = _per_second(time_unit), True
        self.notes: list[str] = []  # what is to be said of the file
        #: Cells that hold a word instead of a number, which are missing, by column: how many; first row and text.
        self.words: dict[str, tuple[int, int, str]] = {}
        #: Cells beside which a status says that they are bad, by column: how many; first row, text and its column.
        self.bad: dict[str, tuple[int, int, str, str]] = {}
        #: The decimal mark that numbers of a column have shown, and rows of cells that may group thousands instead.
        self.decimals: dict[str, str] = {}
        self.groups: dict[tuple[str, str], tuple[int, str]] = {}
        #: Which columns have held a finite number, and which infinite ones.
        self.measured = MeasuredColumns()
        #: Columns that have shown a number: of the others words are no bad samples, but another kind of column.
        self.numeric: set[str] = set()
        #: Inputs ``(delay, nu)`` of the latest rows, where inputs act later than they are written.
        self.earlier: FloatArray | None = None
        #: Columns of derivatives that are formed, by their place in a row: the place of the input, and the order.
        self.formed: dict[int, tuple[int, int]] = {}
        #: Of each of them what the differences of the next rows need of the latest ones.
        self.differenced: dict[int, FloatArray] = {}

    def warnings(self) -> tuple[str, ...]:
        """Return what is to be said of the file, and a text for each column with words in it."""
        return (
            *self.notes,
            *(
                f"{counted(count, 'cell')} of {column!r} without a number: counted as missing, first {text!r} in "
                f"row {row}."
                for column, (count, row, text) in self.words.items()
            ),
            *self.measured.warnings(),
            *(
                f"{counted(count, 'cell')} of {column!r} counted as missing, as {status!r} says so, first {text!r} in "
                f"row {row}."
                for column, (count, row, text, status) in self.bad.items()
            ),
        )

    def take_number(self) -> None:
        """Take the first stamp as seconds."""
        if self.stated is not None and self.is_dated is None:
            raise SpecError(
                "The stamps are seconds, which are in no time zone: leave time_zone (--time-zone) out.",
                path="time_zone",
            )
        self.is_dated = False

    def take_bad(self, column: str, row: int, text: str, status: str, *, count: int = 1) -> None:
        """Count cells that are bad by the column of their status, the first of which is in a row and says a text."""
        earlier_count, first_row, first_text, _ = self.bad.get(column, (0, row, text, status))
        self.bad[column] = (earlier_count + count, first_row, first_text, status)

    def take_mark(self, column: str, row: int, cell: str, mark: str, *, may_group: bool) -> None:
        """Take which decimal mark a number of a column has, or one that may group thousands instead: a log in which it
        may mean both means neither."""
        if may_group and (column, mark) not in self.groups:
            self.groups[column, mark] = row, cell
        elif not may_group and column not in self.decimals:
            self.decimals[column] = mark
        else:
            return
        for (name, group_mark), (first_row, first) in self.groups.items():
            decimal_marks = {self.decimals[name]} if name in self.decimals else set(self.decimals.values())
            if decimal_marks and group_mark not in decimal_marks:
                raise SpecError(
                    f"Row {first_row}, column {name!r}: in {first!r} the mark may group thousands, as the decimals of "
                    f"other numbers begin with {min(decimal_marks)!r}. Leave out what groups thousands.",
                    path=f"row {first_row}",
                )

    def take_header(self, header: Sequence[str], wanted: Sequence[str], places: Sequence[int]) -> None:
        """Take the units that stand behind names of columns, which are called otherwise where they are ``wanted``."""
        match = WITH_UNIT.fullmatch(header[places[0]])
        per_second = None if match is None else UNITS_OF_TIME.get(match.group(2).strip().lower())
        if per_second is not None:
            self._take_unit(per_second, header[places[0]])
        for i, name in enumerate(wanted):
            base = derivative_of(name, wanted) if header[places[i]] != name else None
            if base is not None and places[i] == places[wanted.index(base[0])]:
                self.formed[i] = (wanted.index(base[0]), base[1])
                self.notes.append(f"{name} is formed from {base[0]} by differences from row to row.")
        named = [
            repr(header[place])
            for i, (name, place) in enumerate(zip(wanted, places, strict=True))
            if header[place] != name and i not in self.formed
        ]
        if named:
            self.notes.append(f"Columns are found by their names without units: {', '.join(named)}.")

    def _take_unit(self, per_second: float, text: str) -> None:
        """Take the unit of the time that the file states; one that is stated beside it must be the same."""
        if self.unit is not None and self.per_second != per_second:
            raise SpecError(
                f"The time of the log is called {text!r}, but its unit is stated as {self.unit!r}: leave time_unit "
                "(--time-unit) out, or correct it.",
                path="time_unit",
            )
        self.has_unit = True
        if per_second != 1.0:
            self.per_second = per_second

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
        per_second = UNITS_OF_TIME.get(unit)
        if per_second is None or not any(cell.lower() not in MISSING_TEXTS for cell in cells):
            return False
        if unit:
            self._take_unit(per_second, cells[0])
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
                self.take_number()
                if self.per_second is not None:
                    return seconds if self.per_second == 1.0 else seconds / self.per_second
                return float(self.seconds(np.array([seconds]))[0])
            elapsed = _ELAPSED.fullmatch(cell)
            if elapsed is not None:
                self.take_number()
                hours, minutes, seconds_text = elapsed.groups()
                return 3600.0 * int(hours) + 60.0 * int(minutes) + float(seconds_text.replace(",", "."))
        if self.is_dated is not False:
            text_of_date, moment = cell, None
            if cell[4:5] == "-":
                with suppress(ValueError):
                    moment = datetime.fromisoformat(cell)
            if moment is None:
                text_of_date = self._as_iso(cell, row, column)
                with suppress(ValueError):
                    moment = datetime.fromisoformat(text_of_date)
            if moment is not None:
                if self.is_dated is None and _PART_OF_A_SECOND.search(text_of_date):
                    self.digits = "microseconds"
                return self._seconds(moment, row, column)
        raise SpecError(
            f"Row {row}, column {column!r}: {text!r} is no time stamp: {self._expected()}.", path=f"row {row}"
        )

    def seconds(self, numbers: FloatArray) -> FloatArray:
        """Return seconds from stamps that are numbers ``(rows,)``: those too large for seconds since 1970 count parts
        of one."""
        sizes = np.abs(numbers[np.isfinite(numbers)])
        if self.per_second is None and sizes.size:
            first = float(sizes[0])
            self.per_second = 1.0
            if _LARGEST_SECONDS <= first < _LARGEST_SECONDS * _PARTS[-1]:
                self.per_second = next(parts for parts in _PARTS if first < _LARGEST_SECONDS * parts)
        return numbers if self.per_second in (None, 1.0) else np.asarray(numbers / self.per_second)

    def require_no_days(self, seconds: FloatArray) -> None:
        """Raise `SpecError` for stamps ``(rows,)`` of the first rows that can only be serial days, taken as seconds."""
        finite = seconds[np.isfinite(seconds)]
        if self.is_dated is not False or self.per_second not in (None, 1.0) or self.has_unit:
            return
        if finite.size < _ROWS_OF_DAYS:
            return
        steps = np.diff(finite)
        within = any(low <= finite[0] and finite[-1] <= high for low, high in _SERIAL_DAYS)
        if within and np.all(steps > 0.0) and np.max(steps) <= _STEP_IN_DAYS:
            raise SpecError(
                f"The time begins with {float(finite[0]):.10g} and rises by {float(np.median(steps)):.3g} a row: these "
                "are serial days of a spreadsheet or of MATLAB, not seconds. State the unit (time_unit, --time-unit "
                "days), or in the name of the column, 'time [d]' or 'time [s]'.",
                path="data",
            )

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
            first_part, _, second_part, year, time = slashed.groups()
            if self.day_first is None and max(int(first_part), int(second_part)) > _MONTHS:
                self.day_first = int(first_part) > _MONTHS
            if self.day_first is None and first_part != second_part:
                raise SpecError(
                    f"Row {row}, column {column!r}: {cell!r} may begin with the day or the month: write dates with "
                    f"the year first, such as {year}-12-31.",
                    path=f"row {row}",
                )
            day, month = (first_part, second_part) if self.day_first else (second_part, first_part)
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
            self.take_number()
            seconds = np.asarray(column.dt.total_seconds(), dtype=np.float64)
        else:
            zone = column.dt.tz
            if self.is_dated is None:
                self._dated(zone)
            moments = (column if zone is None else column.dt.tz_convert("UTC").dt.tz_localize(None)).to_numpy()
            # Apart, so that the fraction keeps its digits, and in seconds, of which no date has too many.
            whole_seconds = moments.astype("datetime64[s]")
            parts = np.where(missing, 0, (moments - whole_seconds).astype("timedelta64[ns]").astype(np.int64))
            if np.any(parts):
                self.digits = "microseconds"
            seconds = whole_seconds.astype(np.int64) + parts * _NANO
            if zone is None and self.stated is not None:
                dates = [
                    datetime.min if gone else date for date, gone in zip(whole_seconds.tolist(), missing, strict=True)
                ]
                local = [
                    math.nan if gone else self._local(date, row, str(column.name)).timestamp()
                    for row, (date, gone) in enumerate(zip(dates, missing, strict=True), 1)
                ]
                seconds = np.array(local) + parts * _NANO
        return np.where(missing, np.nan, seconds)

    def shown(self, seconds: float) -> str:
        """Return a time for people: as the log writes it, and long ones in seconds in hours as well."""
        return self.date(seconds) if self.is_dated and math.isfinite(seconds) else point_in_time(seconds)

    def written(self, seconds: float) -> str:
        """Return a time for programs: as the log writes it."""
        return self.date(seconds) if self.is_dated and math.isfinite(seconds) else f"{seconds:.10g} s"

    def date(self, seconds: float) -> str:
        """Return the date and time of some seconds, ISO 8601, in the zone of the log."""
        return self.moment(seconds).isoformat(timespec=self.digits)

    def moment(self, seconds: float) -> datetime:
        """Return the date and time of some seconds, to the microsecond, with the log's zone if it names one."""
        utc = _EPOCH + timedelta(seconds=math.floor(seconds)) + round((seconds % 1.0) * _MICROSECONDS) * _MICROSECOND
        return utc.replace(tzinfo=None) if self.zone is None else utc.astimezone(self.zone)

    def _dated(self, zone: tzinfo | None) -> None:
        """Take the first stamp as a date in a zone, or in none."""
        if self.unit is not None:
            raise SpecError(
                "The stamps are dates, which have no unit: leave time_unit (--time-unit) out.", path="time_unit"
            )
        if self.stated is not None and zone is not None:
            raise SpecError("The stamps name their time zone: leave time_zone (--time-zone) out.", path="time_zone")
        self.is_dated, self.are_local = True, zone is None
        self.zone = self.stated if zone is None else zone

    def _local(self, moment: datetime, row: int, column: str) -> datetime:
        """Return a date that names no zone in the stated one. Of an hour that comes twice, as clocks go back, it is the
        second one where the first would not come after the stamps before it."""
        first, second = (moment.replace(tzinfo=self.stated, fold=fold) for fold in (0, 1))
        seconds = first.timestamp()
        if (ahead := second.utcoffset()) != (before := first.utcoffset()):
            if before is not None and ahead is not None and before < ahead:
                raise SpecError(
                    f"Row {row}, column {column!r}: there is no {moment.isoformat(sep=' ')} in {self.stated}, where "
                    "clocks go forward then. If the clock of the log does not, name its offset (--time-zone +01:00).",
                    path=f"row {row}",
                )
            # The same stamp again is the next hour only where rows are as far apart.
            if seconds < self.latest or (seconds == self.latest and self.step >= second.timestamp() - seconds):
                first, seconds = second, second.timestamp()
        if seconds > self.latest:
            self.step = seconds - self.latest if math.isfinite(self.latest) else 0.0
            self.latest = seconds
        return first

    @property
    def may_be_autumn(self) -> bool:
        """Whether dates without a zone have fallen by as much as clocks do in autumn."""
        return any("clocks go back" in note for note in self.notes)

    def _note_of_autumn(self, moment: datetime, seconds: float, row: int) -> None:
        """Say what dates without a zone may be that fall by an hour, as clocks do in autumn."""
        fallen = self.latest - seconds
        if LEAST_FALL <= fallen <= AUTUMN_FALL and not self.may_be_autumn:
            before = self.moment(self.latest).isoformat(sep=" ")
            self.notes.append(
                f"Row {row}: the time falls from {before} to {moment.isoformat(sep=' ')}, as where clocks go back in "
                "autumn. The stamps name no time zone: state it (time_zone, --time-zone Europe/Berlin), so that no "
                "row of this hour is left out."
            )
        self.latest = max(self.latest, seconds)

    def _seconds(self, moment: datetime, row: int, column: str) -> float:
        if self.is_dated is None:
            self._dated(moment.tzinfo)
        if (moment.tzinfo is None) != bool(self.are_local):
            raise SpecError(
                f"Row {row}, column {column!r}: stamps with a time zone and without one cannot be mixed in one log.",
                path=f"row {row}",
            )
        if self.are_local and self.stated is not None:
            moment = self._local(moment, row, column)
        elif self.are_local:
            self._note_of_autumn(moment, (moment.replace(tzinfo=UTC) - _EPOCH).total_seconds(), row)
        past = (moment if moment.tzinfo is not None else moment.replace(tzinfo=UTC)) - _EPOCH
        return past.days * _DAY_SECONDS + past.seconds + past.microseconds * _MICRO

    def _expected(self) -> str:
        if self.is_dated is None:
            return f"give {_EXPECTED_TIMES}"
        return "the rows before hold dates and times" if self.is_dated else "the rows before hold seconds"
