"""Time stamps: what is refused, what is a gap, and how long an interval is."""

from __future__ import annotations

import math

from obsynth.errors import SpecError

#: A sampled design accepts intervals that differ from a multiple of dt by this share of dt.
FITTING_SHARE = 0.01
#: Without another word, an interval is a gap when it is longer than this many times the longest one before.
GAP_FACTOR = 10.0

#: A gap of more samples than this cannot be counted in double precision.
MOST_SAMPLES = 2.0**53


class Clock:
    """Checks one time stamp after the other.

    Fields: dt: Seconds between samples of the design; 0 for continuous time; gap: Continuous time: intervals longer
    than this are gaps, in seconds.
    """

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
