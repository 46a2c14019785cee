"""The clock of a log: the sample of each row by its time stamp; missing, stale and irregular rows."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any

from obsynth.errors import SpecError
from obsynth.monitoring.logs.stamps import UNITS_OF_TIME

#: Statuses of rows whose stamps do not increase; these rows are left out.
REPEATED_STAMP, OUT_OF_ORDER = "repeated stamp", "out of order"

STALE = (REPEATED_STAMP, OUT_OF_ORDER)

#: Gaps longer than this many samples are not bridged: the observer starts again.
LONGEST_BRIDGE = 10_000

#: A sampled design assigns a stamp to the nearest sample; it may differ from it by at most this share of dt.
STAMP_SHARE = 0.45

#: In continuous designs, a gap that exceeds a whole number of intervals by this share has no further missing row.
COUNTING_SHARE = 0.01

#: Share of the difference between stamp and sample that is left in the next one, so that a fast or slow clock is
#: followed.
FOLLOWING_SHARE = 0.9

#: Stamps whose mean difference from the samples is above this share of dt belong to another sampling time.  The mean is
#: exponential with the second number as the weight of a new row, and starts at zero.
OTHER_SHARE, AVERAGED_SHARE = 0.25, 0.05

#: More consecutive rows than this whose stamps do not increase are an error.
MOST_STALE = 10

#: An interval that differs from dt by at most this share certainly has no missing rows.
SURE_SHARE = 0.009

#: If stamps are uneven, an interval that differs from dt by more than this share is one of its own.
SAME_INTERVAL = 1e-9

#: By default, an interval is a gap if it is longer than so many times the longest one before.
GAP_FACTOR = 10.0

#: A gap of more samples than this cannot be counted in double precision.
MOST_COUNTED_SAMPLES = 2.0**53


#: An interval may be one in another unit if it differs from that by at most this share, since stamps jitter.
UNIT_SHARE = 0.05

#: Remedy for a log whose time decreases.
SORTED = "Sort the log by its time; if logs were joined, give each by itself"


def unit_advice(samples: float) -> str:
    """Return a sentence on the unit of the stamps, with a blank before it; empty if no other unit than seconds fits.

    ``samples`` is the interval between rows in samples of the design.
    """
    others = {unit: size for unit, size in UNITS_OF_TIME.items() if size != 1.0}
    fits = [unit for unit, size in others.items() if abs(samples / size - 1.0) <= UNIT_SHARE]
    return f" If the stamps are in {fits[0]}, call their column 'time [{fits[0]}]'." if fits else ""


class StampError(SpecError):
    """A stamp that is earlier than that of the row before."""

    def __init__(self, message: str, row: int, last: float, time: float) -> None:
        super().__init__(message, path=f"row {row}")
        self.row, self.last, self.time = row, last, time

    def dated(self, date_of: Callable[[float], str], *, is_autumn: bool) -> str:
        """Return the message with dates in the format of the log, and the remedy.

        ``is_autumn``: the time decreases as at the end of daylight saving, in dates without a time zone.
        """
        mend = (
            "Clocks go back like this in autumn, and the stamps name no time zone: state it (time_zone, --time-zone "
            "Europe/Berlin), or sort the log by its time"
            if is_autumn
            else SORTED
        )
        return f"Row {self.row}: the time falls from {date_of(self.last)} to {date_of(self.time)}. {mend}."


class Clock:
    """Checks time stamps one after another.

    ``dt`` is 0 in continuous time, where an interval longer than ``gap`` seconds is a gap.  ``why`` is the reason why a
    recursive design accepts no other interval than dt.
    """

    def __init__(self, dt: float, gap: float | None, *, irregular: bool = False, why: str = "") -> None:
        self.dt, self.gap, self.irregular, self.why = dt, gap, irregular, why
        # For sampled designs that accept any interval: whether the last interval was an irregular one, the sum of the
        # differences of such intervals from dt, and whether stamps are uneven.
        self.is_own, self.longer, self.is_uneven = False, 0.0, False
        # Time of the last row; for sampled designs that of its sample, near its stamp.
        self.last: float | None = None
        self.longest = 0.0
        self.stamp, self.away, self.left_out = -math.inf, 0.0, 0
        # For sampled designs: number of the last sample, counted from the first row.
        self.count = 0
        self.is_resumed = False  # whether no row has been taken since the run was resumed

    def as_dict(self) -> dict[str, Any]:
        """Return the state between rows as data."""
        state = {name: getattr(self, name) for name in ("last", "longest", "stamp", "away", "left_out", "count")}
        return state | ({"longer": self.longer, "is_uneven": self.is_uneven} if self.irregular else {})

    def resume(self, data: Mapping[str, Any]) -> None:
        """Restore the state from the data that `as_dict` returned."""
        vars(self).update(data)
        self.is_resumed = True

    def at(self, time: float, before: int = 0) -> float:
        """Return the time of the last sample, whose stamp is ``time``, or of the one ``before`` samples earlier.

        Sampled designs count samples, so that the jitter of stamps does not matter.
        """
        return (self.count - before) * self.dt + self.longer if self.dt > 0.0 else time

    def advance(self, time: float, row: int) -> tuple[float, int]:
        """Take the stamp of the next row; return the seconds and the number of missing rows since the row before."""
        if not math.isfinite(time):
            raise SpecError(f"Row {row} has no time: each row needs a finite number of seconds.", path=f"row {row}")
        last = self.last
        if last is None:
            self.last = self.stamp = time
            return 0.0, 0
        if time == last:
            since = f", as all rows from row {row - self.left_out} on" if 0 < self.left_out < row else ""
            raise SpecError(
                f"Row {row} repeats the time {time:.17g} s of the row before{since}. Name the column of the time "
                "(--time-column).",
                path=f"row {row}",
            )
        if time < last:
            since = f", as it has since row {row - self.left_out}" if 0 < self.left_out < row else ""
            raise StampError(
                f"Row {row}: the time falls from {last:.17g} to {time:.17g} s{since}. {SORTED}.", row, last, time
            )
        step = interval(last, time)
        self.is_own = self.irregular and self._is_irregular(step)
        if self.is_own:
            missing, self.longer = 0, self.longer + step - self.dt
        else:
            missing = self._sampled(step, row) if self.dt > 0.0 else self._continuous(step, row)
        self.last = time
        self.count += missing + 1
        if self.dt > 0.0 and not self.is_own:
            away = step - (missing + 1) * self.dt
            # Regular stamps are used directly, so that rounding does not accumulate.
            self.last = time if abs(away) <= SURE_SHARE * self.dt else time - FOLLOWING_SHARE * away
        self.stamp, self.left_out, self.is_resumed = time, 0, False
        if not missing:
            self.longest = max(self.longest, step)
        return step, missing

    def stale(self, time: float) -> str:
        """Return the status of a row whose stamp does not increase, which is left out; empty for other rows.

        A run that continues from a saved state may begin with any number of rows from before that state.
        """
        last = self.last
        if last is None or not math.isfinite(time) or (self.left_out >= MOST_STALE and not self.is_resumed):
            return ""
        # In a sampled design the last sample may be reported again with a slightly later stamp.
        before = max(self.stamp, last - STAMP_SHARE * self.dt) if self.dt > 0.0 else last
        if time > before and time != last:
            return ""
        self.left_out += 1
        return REPEATED_STAMP if time in (self.stamp, last) else OUT_OF_ORDER

    def regular(self, times: Sequence[float]) -> list[float]:
        """Return the intervals to the first of these stamps, as far as they certainly have no gaps between them; the
        clock does not change."""
        steps: list[float] = []
        if self.last is None or not self.longest > 0.0:
            return steps
        before, longest = self.last, GAP_FACTOR * self.longest if self.gap is None else self.gap
        lowest, highest = 0.0, longest
        if self.dt > 0.0:
            # Narrower limits than those of `advance`, so that rounding of an interval does not matter.
            lowest, highest = (1.0 - SURE_SHARE) * self.dt, (1.0 + SURE_SHARE) * self.dt
        for time in times:
            step = interval(before, time) if time > before and time < math.inf else 0.0
            if not lowest <= step <= highest or step <= 0.0:
                break
            steps.append(step)
            before = time
        return steps

    def take(self, times: Sequence[float], steps: Sequence[float]) -> None:
        """Take stamps for which `regular` has returned the intervals ``steps``."""
        self.last, self.longest = times[-1], max(self.longest, *steps)
        self.stamp, self.left_out, self.away = times[-1], 0, 0.0
        self.count += len(times)

    def _is_irregular(self, step: float) -> bool:
        """Whether an interval is an irregular one, over which the design takes one step.

        Such an interval is near dt, but differs from it; or the stamps are uneven, so that this interval or one before
        is no whole number of samples.  Gaps are not irregular intervals.
        """
        samples = step / self.dt
        if samples > LONGEST_BRIDGE:
            return False
        count = max(round(samples), 1)
        away = abs(samples - count)
        if count == 1:
            self.is_uneven = self.is_uneven or away > STAMP_SHARE
            return away > (SAME_INTERVAL if self.is_uneven else SURE_SHARE)
        # Rows can only be missing if intervals of about dt have occurred.
        fits = away <= (OTHER_SHARE if self.longest else SURE_SHARE) and (self.longest > 0.0 or not self.count)
        self.is_uneven = self.is_uneven or not fits
        return self.is_uneven

    def _sampled(self, step: float, row: int) -> int:
        count = _counted(step / self.dt, step, row)
        away = abs(step - count * self.dt) / self.dt
        average = (1.0 - AVERAGED_SHARE) * self.away + AVERAGED_SHARE * away
        if count < 1 or away > STAMP_SHARE or average > OTHER_SHARE:
            raise SpecError(
                f"Row {row} comes {step:.10g} s after the row before, but the design has dt = {self.dt:.10g} s: "
                "a time stamp may be off by 45 % of dt, and all of them by 25 % on average; irregular time stamps "
                "need a continuous-time design, or a recursive one of a continuous plant that was sampled"
                f"{f' (this recursive design takes no other interval: {self.why})' if self.why else ''}."
                f"{unit_advice(step / self.dt)}",
                path=f"row {row}",
            )
        # One gap may be the first interval of a log.
        if count > 1 and self.longest == 0.0 and self.count > 0:
            raise SpecError(
                f"Row {row}: the log is sampled every {step:.6g} s, but the design needs {self.dt:.6g} s: resample the "
                f"log, or design with sample_time: {step:.6g}.{unit_advice(step / self.dt)}",
                path=f"row {row}",
            )
        self.away = average
        return count - 1

    def _continuous(self, step: float, row: int) -> int:
        typical = self.longest or step
        if step <= (GAP_FACTOR * typical if self.gap is None else self.gap):
            return 0
        unit = typical if self.longest else min(step, self.gap or step)
        _counted(step / unit, step, row)
        return max(math.ceil(step / unit * (1.0 - COUNTING_SHARE)) - 1, 1)


def _counted(samples: float, step: float, row: int) -> int:
    """Return a whole number of samples; raise `SpecError` for more than can be counted, which are a mistake."""
    if not samples < MOST_COUNTED_SAMPLES:
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
