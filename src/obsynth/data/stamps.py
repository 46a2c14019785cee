"""Time stamps: seconds as numbers, or dates and times, which are read as seconds since 1970 and written back.

Time stamps: what is refused, what is a gap, and how long an interval is.
"""

from __future__ import annotations

import math
from datetime import UTC, datetime, timedelta, tzinfo
from typing import Any

import numpy as np

from obsynth.errors import SpecError
from obsynth.numerics.arrays import FloatArray

#: What a missing sample may look like in a log.
MISSING = frozenset({"", "nan", "na", "n/a", "null", "none"})
_ZERO = datetime(1970, 1, 1, tzinfo=UTC)
_EXPECTED = "seconds, such as 12.5, or a date and a time, such as 2026-05-01T08:30:00.5+02:00"
_MICROSECOND = timedelta(microseconds=1)
#: Seconds in a nanosecond, a microsecond and a day; microseconds in a second.
_NANO, _MICRO, _DAY, _MICROSECONDS = 1e-9, 1e-6, 86400.0, 1e6


class Stamps:
    """Which kind of stamps a log has, decided by its first one, and the zone in which they are written back.
    Attributes: is_dated: Dates and times; zone: Of the first stamp, `None` where it names none (taken as UTC)."""

    def __init__(self) -> None:
        self.is_dated: bool | None = None
        self.zone: tzinfo | None = None

    def read(self, text: str, row: int, column: str, *, comma: bool = False) -> float:
        """Return the seconds of one cell; ``comma`` takes a decimal comma."""
        cell = text.strip()
        if cell.lower() in MISSING:
            return math.nan
        if self.is_dated is not True:
            try:
                seconds = float(cell.replace(",", ".") if comma else cell)
            except ValueError:
                seconds = None
            if seconds is not None:
                self.is_dated = False
                return seconds
        if self.is_dated is not False:
            found = _date(cell)
            if found is not None:
                return self._seconds(found, row, column)
        raise SpecError(
            f"Row {row}, column {column!r}: {text!r} is no time stamp: {self._expected()}.", path=f"row {row}"
        )

    def read_column(self, column: Any, done: int) -> FloatArray | None:
        """Return the seconds of a column of a data frame that holds dates; `None` where it holds none."""
        kind = getattr(column.dtype, "kind", "O")
        if kind not in "Mm" and not hasattr(column.dtype, "tz"):
            return None
        missing = np.asarray(column.isna())
        if kind == "m":
            self.is_dated = False
            seconds = np.asarray(column.dt.total_seconds(), dtype=np.float64)
        else:
            if self.is_dated is None:
                self.is_dated, self.zone = True, getattr(column.dtype, "tz", None)
            plain = column.dt.tz_convert("UTC").dt.tz_localize(None) if hasattr(column.dtype, "tz") else column
            counts = plain.to_numpy().astype("datetime64[ns]").astype(np.int64)
            # Apart, so that the fraction keeps its digits.
            seconds = (counts // 1_000_000_000).astype(np.float64) + (counts % 1_000_000_000) * _NANO
        return np.where(missing, np.nan, seconds)

    def shown(self, seconds: float) -> str:
        """Return a time as the log writes it."""
        if not self.is_dated or not math.isfinite(seconds):
            return f"{seconds:g} s"
        return self.date(seconds)

    def date(self, seconds: float) -> str:
        """Return the date and time of some seconds, ISO 8601, in the zone of the log."""
        return self.moment(seconds).isoformat()

    def moment(self, seconds: float) -> datetime:
        """Return the date and time of some seconds, to the microsecond, with the log's zone if it names one."""
        found = _ZERO + timedelta(seconds=math.floor(seconds)) + round((seconds % 1.0) * _MICROSECONDS) * _MICROSECOND
        return found.replace(tzinfo=None) if self.zone is None else found.astimezone(self.zone)

    def _seconds(self, found: datetime, row: int, column: str) -> float:
        if self.is_dated is None:
            self.is_dated, self.zone = True, found.tzinfo
        if (found.tzinfo is None) != (self.zone is None):
            raise SpecError(f"Row {row}, column {column!r}: stamps with a time zone and without one stand in one log.",
                            path=f"row {row}")  # fmt: skip
        past = (found if found.tzinfo is not None else found.replace(tzinfo=UTC)) - _ZERO
        return past.days * _DAY + past.seconds + past.microseconds * _MICRO

    def _expected(self) -> str:
        if self.is_dated is None:
            return f"give {_EXPECTED}"
        return "the rows before hold dates and times" if self.is_dated else "the rows before hold seconds"


def _date(cell: str) -> datetime | None:
    try:
        return datetime.fromisoformat(cell)
    except ValueError:
        return None


#: A sampled design accepts intervals that differ from a multiple of dt by this share of dt.
FITTING_SHARE = 0.01
#: Without another word, an interval is a gap when it is longer than this many times the longest one before.
GAP_FACTOR = 10.0
#: A gap of more samples than this cannot be counted in double precision.
MOST_SAMPLES = 2.0**53


class Clock:
    """Checks one time stamp after the other. Fields: dt: Seconds between samples of the design; 0 for continuous time;
    gap: Continuous time: intervals longer than this are gaps, in seconds."""

    def __init__(self, dt: float, gap: float | None) -> None:
        self.dt, self.gap = dt, gap
        self.last: float | None = None
        self.longest = 0.0

    def advance(self, time: float, row: int) -> tuple[float, int]:
        """Take the stamp of the next row."""
        if not math.isfinite(time):
            raise SpecError(f"Row {row} has no time: each row needs a finite number of seconds.", path=f"row {row}")
        last = self.last
        if last is None:
            self.last = time
            return 0.0, 0
        if time == last:
            raise SpecError(f"Row {row} repeats the time {time:.17g} s of the row before.", path=f"row {row}")
        if time < last:
            raise SpecError(f"Row {row}: the time falls from {last:.17g} to {time:.17g} s.", path=f"row {row}")
        step = interval(last, time)
        missing = self._sampled(step, row) if self.dt > 0.0 else self._continuous(step, row)
        self.last = time
        if not missing:
            self.longest = max(self.longest, step)
        return step, missing

    def _sampled(self, step: float, row: int) -> int:
        count = _counted(step / self.dt, step, row)
        if count < 1 or abs(step - count * self.dt) > FITTING_SHARE * self.dt:
            raise SpecError(
                f"Row {row} comes {step:.10g} s after the row before, but the design has dt = {self.dt:.10g} s: "
                "irregular time stamps need a continuous-time design.", path=f"row {row}",
            )  # fmt: skip
        if count > 1 and self.longest == 0.0:
            raise SpecError(
                f"Row {row}: the data begin with an interval of {step:.10g} s, but the design has dt = "
                f"{self.dt:.10g} s: the sampling time does not fit.", path=f"row {row}",
            )  # fmt: skip
        return count - 1

    def _continuous(self, step: float, row: int) -> int:
        typical = self.longest or step
        if step <= (GAP_FACTOR * typical if self.gap is None else self.gap):
            return 0
        unit = typical if self.longest else min(step, self.gap or step)
        _counted(step / unit, step, row)
        return max(math.ceil(step / unit * (1.0 - FITTING_SHARE)) - 1, 1)


def _counted(samples: float, step: float, row: int) -> int:
    """Return a whole number of samples; more than can be counted are no gap but a mistake."""
    if not samples < MOST_SAMPLES:
        raise SpecError(
            f"Row {row} comes {step:.10g} s after the row before, {samples:.3g} samples: are the times in seconds?",
            path=f"row {row}",
        )
    return round(samples)


def interval(before: float, after: float) -> float:
    """Return ``after - before``, rounded to what the two stamps can resolve, so that equal intervals are equal."""
    resolution = 2.0 * max(math.ulp(before), math.ulp(after))
    digits = -math.ceil(math.log10(resolution))
    rounded = round(after - before, digits)
    return rounded if rounded > 0.0 else after - before
