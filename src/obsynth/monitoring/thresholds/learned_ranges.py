"""Ranges of inputs and outputs in the rows that thresholds were learned from; levels and notes for rows beyond them.

The error of a model grows with the distance of an input from the values that it was learned at.  While an input is
beyond its range, and as long as the statistics use such rows, the root of each level is raised by a rate
(`range_rates`) times that distance.  The rate is zero if the logs show that no such error exists, and one if they
cannot show it.  Outputs raise no level, since a fault may have moved them: a note names them.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from obsynth.monitoring.logs.signals import LogSignals
from obsynth.monitoring.thresholds.learned_statistics import AGES
from obsynth.numerics.arrays import FloatArray, read_only

#: Half of a range is at least this share of its middle: the model is taken as known near the value of an input that was
#: held constant.
LEAST_HALF = 0.1

#: A signal is named if it is beyond its range by more than this share of its width, since noise goes a little further
#: in each log.
NAMED_BEYOND = 0.05


class LearnedRanges(NamedTuple):
    """Least and largest deviations of signals from the operating point, known inputs first.

    Those of outputs are values that two consecutive samples reach.
    """

    names: tuple[str, ...]
    inputs: int  # number of known inputs
    low: FloatArray
    high: FloatArray
    point: FloatArray  # the operating point, which is added to deviations to give absolute values
    rates: FloatArray | None = None  # ``(nu, k)``: growth of the root of each level with each input; one by default

    def middle_and_half(self) -> tuple[FloatArray, FloatArray]:
        """Return the middle ``(nu,)`` of the range of each input and half of its width.

        Half of the width is infinite if an input was zero in all rows, since its effect is unknown.
        """
        low, high = self.low[: self.inputs], self.high[: self.inputs]
        middle = 0.5 * (low + high)
        half = np.maximum(0.5 * (high - low), LEAST_HALF * np.abs(middle + self.point[: self.inputs]))
        known = np.isfinite(half) & (half > 0.0)
        return np.where(known, middle, 0.0), np.where(known, half, np.inf)

    def distances(self, inputs: FloatArray) -> FloatArray:
        """Return the signed distances of ``inputs (..., nu)`` from the middles of their ranges, in halves of these."""
        middle, half = self.middle_and_half()
        return np.asarray((inputs - middle) / half)

    def beyond_by(self, inputs: FloatArray) -> FloatArray:
        """Return the distance of each of ``inputs (nu,)`` from the middle of its range in halves of that; one within
        the range."""
        shares = np.abs(self.distances(inputs))
        return np.asarray(np.where(shares > 1.0, shares, 1.0))

    def factors(self, beyond_by: FloatArray, count: int) -> FloatArray:
        """Return the factor of each level ``(count,)`` for inputs at distances ``beyond_by (nu,)`` from the middles of
        their ranges, in halves of these."""
        away, rates = beyond_by - 1.0, self.rates
        if rates is None:
            rates = np.ones((len(away), count))
        return np.asarray((1.0 + sum((far * own for far, own in zip(away, rates, strict=True)), np.zeros(count))) ** 2)

    def beyond(self, deviations: FloatArray, before: FloatArray) -> NDArray[np.bool_]:
        """Return in which rows ``(n, nu + ny)`` each signal is so far beyond its range that it is named.

        An output must be beyond it in the row before as well; ``before`` is the row before the first one.
        """
        room = NAMED_BEYOND * (self.high - self.low)
        all_rows = np.vstack([before, deviations])
        with np.errstate(invalid="ignore"):
            out = (all_rows > self.high + room) | (all_rows < self.low - room)
        own = out[1:].copy()
        own[:, self.inputs :] &= out[:-1, self.inputs :]
        return np.asarray(own)

    def as_dict(self) -> dict[str, Any]:
        """Return the ranges as data."""
        return {**self._asdict(), "names": list(self.names)}

    @classmethod
    def from_dict(cls, data: Mapping[str, Any]) -> LearnedRanges:
        """Return the ranges from the data that `as_dict` returned."""
        names, inputs = tuple(map(str, data["names"])), int(data["inputs"])
        low, high, point = (np.asarray(data[name], dtype=np.float64) for name in ("low", "high", "point"))
        rates = None if data.get("rates") is None else read_only(np.asarray(data["rates"], dtype=np.float64))
        fits = low.shape == high.shape == point.shape == (len(names),) and 0 <= inputs <= len(names)
        if not (fits and (rates is None or (rates.ndim == 2 and len(rates) == inputs))):
            raise ValueError("its ranges do not fit together")
        return cls(names, inputs, read_only(low), read_only(high), read_only(point), rates)


def ranges_of_rows(signals: LogSignals, deviations: FloatArray, inputs: int) -> LearnedRanges:
    """Return the ranges of signals in rows ``(n, nu + ny)``; the first ``inputs`` signals are the known inputs."""
    following = deviations[1:]
    rows = (np.minimum(deviations[:-1], following), np.maximum(deviations[:-1], following))
    both = [np.where(np.isfinite(part), part, fill) for part, fill in zip(rows, (-np.inf, np.inf), strict=True)]
    high, low = both[0].max(axis=0, initial=-np.inf), both[1].min(axis=0, initial=np.inf)
    own = deviations[:, :inputs]
    high[:inputs] = np.where(np.isfinite(own), own, -np.inf).max(axis=0, initial=-np.inf)
    low[:inputs] = np.where(np.isfinite(own), own, np.inf).min(axis=0, initial=np.inf)
    is_known = low <= high
    low, high = np.where(is_known, low, -np.inf), np.where(is_known, high, np.inf)
    return LearnedRanges(signals.names, inputs, read_only(low), read_only(high), read_only(signals.offset.copy()))


class RowsBeyond:
    """Records in which rows of a run each signal is beyond its learned range."""

    def __init__(self, ranges: LearnedRanges) -> None:
        count = len(ranges.names)
        self.ranges = ranges
        self._before = np.full((1, count), np.nan)
        self._rows, self._first, self._last = (np.zeros(count, dtype=np.int64) for _ in range(3))
        self._low, self._high = np.full(count, np.inf), np.full(count, -np.inf)
        self._latest = np.full(ranges.inputs, -max(AGES))  # row in which each input was beyond last
        self._number = 0  # of the last row

    @property
    def memory(self) -> FloatArray:
        """How many rows ago each input was beyond its range last ``(nu,)``, at most the age of the oldest change."""
        return np.asarray(np.minimum(self._number - self._latest, max(AGES)), dtype=np.float64)

    def resume(self, memory: FloatArray) -> None:
        """Continue from a saved `memory`."""
        self._latest = self._number - np.asarray(memory).astype(np.int64)

    def take(self, deviations: FloatArray, first: int) -> list[tuple[str, ...]]:
        """Take rows ``(n, nu + ny)`` of which the first one has this number; return for each which inputs are, or have
        been for as long as statistics look back, beyond their ranges."""
        beyond = self.ranges.beyond(deviations, self._before)
        self._before = deviations[-1:]
        numbers = np.arange(first, first + len(deviations))
        for i in np.flatnonzero(beyond.any(axis=0)):
            own = numbers[beyond[:, i]]
            values = deviations[beyond[:, i], i]
            self._first[i] = self._first[i] or own[0]
            self._last[i] = own[-1]
            self._rows[i] += len(own)
            self._low[i], self._high[i] = min(self._low[i], values.min()), max(self._high[i], values.max())
        return [self._recent(int(number), row) for number, row in zip(numbers, beyond, strict=True)]

    def _recent(self, number: int, beyond: NDArray[np.bool_]) -> tuple[str, ...]:
        inputs, self._number = self.ranges.inputs, number
        self._latest[np.flatnonzero(beyond[:inputs])] = number
        return tuple(self.ranges.names[i] for i in np.flatnonzero(number - self._latest < max(AGES)))

    def texts(self, rows: int) -> Iterator[str]:
        """Yield a sentence for each signal that has been beyond its range in a run of so many ``rows``."""
        ranges = self.ranges
        middle, half = ranges.middle_and_half()
        for i in np.flatnonzero(self._rows):
            low, high, least, most = (
                f"{float(ends[i] + ranges.point[i]):.4g}" for ends in (ranges.low, ranges.high, self._low, self._high)
            )
            is_below, is_above = self._low[i] < ranges.low[i], self._high[i] > ranges.high[i]
            reached = " and ".join([*([least] if is_below else []), *([most] if is_above else [])])
            text = (
                f"{ranges.names[i]} leaves the range that the thresholds were learned from ({low} to {high}) in "
                f"{self._rows[i]} of {rows} rows, from row {self._first[i]} to {self._last[i]}, and reaches {reached}: "
            )
            if i >= ranges.inputs:
                yield text + "no level is raised for an output, as a fault may be its cause."
                continue
            distance = max(abs(self._low[i] - middle[i]), abs(self._high[i] - middle[i])) / half[i]
            if distance <= 1.0:
                yield text + "nothing is known of its effect, and alarms then may be of the model."
                continue
            rates = np.ones(1) if ranges.rates is None else ranges.rates[i]
            least, most = (f"{(1.0 + float(rate) * (distance - 1.0)) ** 2:.3g}" for rate in (rates.min(), rates.max()))
            by_statistic = "" if least == most else f" (of the statistic that they matter least to, {least} times)"
            yield text + (
                f"alarm levels are up to {most} times as high{by_statistic} in these rows and the {max(AGES) - 1} "
                "rows after them, as the normal logs do not show how far errors of the model grow there. Smaller "
                "faults are missed: add a normal log with such values."
            )
