"""Rates of false alarms, as users write them, in rows for each alarm."""

from __future__ import annotations

import math
import re

from obsynth.errors import SpecError
from obsynth.monitoring.thresholds.learned_levels import HOLD
from obsynth.numerics.arguments import is_finite_number

#: Seconds of the units of time in which a rate is reported.
UNITS = {
    "second": 1.0,
    "minute": 60.0,
    "hour": 3600.0,
    "day": 86400.0,
    "week": 604800.0,
    "month": 2629800.0,
    "year": 31557600.0,
}

#: Their usual abbreviations.
_ABBREVIATIONS = {"s": "second", "sec": "second", "min": "minute", "h": "hour", "hr": "hour", "d": "day"}

_WRITTEN_RATE = re.compile(r"\s*([0-9.eE+-]+)\s*(?:per|/)\s*([0-9.eE+]*)\s*([a-z]+?)s?\s*")


def rows_per_alarm(rate: str | float, dt: float) -> float:
    """Return how many rows, ``dt`` seconds apart, there are for each false alarm of a rate such as ``1 per week``,
    ``2 per 1000 rows``, or a number of alarms per row."""
    per_alarm: float | None = None
    if is_finite_number(rate):
        per_alarm = 1.0 / float(rate) if float(rate) > 0.0 else None
    elif isinstance(rate, str) and (match := _WRITTEN_RATE.fullmatch(rate.lower())) is not None:
        word = _ABBREVIATIONS.get(match.group(3), match.group(3))
        unit = 1.0 if word in ("row", "sample") else UNITS.get(word, 0.0) / dt
        try:
            alarms, count = float(match.group(1)), float(match.group(2) or 1.0)
        except ValueError:
            alarms, count = 0.0, 0.0
        per_alarm = count * unit / alarms if alarms > 0.0 and math.isfinite(alarms) and count * unit > 0.0 else None
    if per_alarm is None or not math.isfinite(per_alarm):
        raise SpecError(
            f"false_alarms is {rate!r}: give a rate, such as '1 per week' or '1 per 1000 rows', "
            f"by {', '.join(UNITS)} or row.",
            path="false_alarms",
        )
    if per_alarm < 2 * HOLD:
        raise SpecError(
            f"false_alarms is {rate!r}, one per {per_alarm:.3g} rows, but an alarm lasts {HOLD} rows at least: "
            "ask for a lower rate.",
            path="false_alarms",
        )
    return per_alarm
