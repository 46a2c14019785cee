"""Dead times: delays of known inputs and of sensor readings, in seconds."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping, Sequence
from typing import Any

from obsynth.errors import SpecError
from obsynth.numerics.arguments import is_finite_number, number_in_text, require_mapping, shown
from obsynth.numerics.arrays import require_no_overflow
from obsynth.numerics.measurement_units import MICRO_SIGNS
from obsynth.numerics.quantities import in_seconds
from obsynth.numerics.suggestions import suggestion

#: Seconds in the units of time that a text may have.
SECONDS_IN_UNIT: Mapping[str, float] = {
    "us": 1e-6,
    "ms": 1e-3,
    "s": 1.0,
    "min": 60.0,
    "h": 3600.0,
    "d": 86400.0,
}

_TEXT = re.compile(r"\s*([-+0-9.eE]+)\s*([a-z]+)?\s*")

#: A dead time this near to a whole number of samples, relative to itself, is one: both were written in decimals.
WHOLE_SAMPLES = 1e-9


def checked_delays(entries: Any, inputs: Sequence[str], outputs: Sequence[str]) -> dict[str, float]:
    """Return dead times in seconds by input or output, without those that are zero."""
    require_mapping(entries, "delays")
    delays, both = {}, set(inputs) & set(outputs)
    for name, value in (entries or {}).items():
        if name in both:
            raise SpecError(
                f"delays names {name!r}, which is an input and an output: give them different names.", path="delays"
            )
        if isinstance(name, tuple) or isinstance(value, (list, tuple, Mapping)) or bool(getattr(value, "ndim", 0)):
            raise SpecError(
                f"delays[{name!r}] is {shown(value)}: a signal has one delay, in seconds. Where an input reaches the "
                "outputs by paths with delays of their own, give it once for each delay, as inputs with names of their "
                "own and the same values, and to each the columns of B and D of its paths.",
                path="delays",
            )
        if name not in (*inputs, *outputs):
            near = suggestion(str(name), [*inputs, *outputs])
            raise SpecError(
                f"delays names {name!r}, which is no input or output of the plant.{near} "
                "Faults and unknown inputs need none: their time is counted from when they act.",
                path="delays",
            )
        seconds = seconds_of(value, f"delays[{name!r}]")
        if seconds:
            delays[str(name)] = seconds
    return delays


def seconds_of(value: Any, name: str) -> float:
    """Return a dead time in seconds: a number, a text such as ``"2.5 s"``, a `timedelta` or a quantity.

    Raises
    ------
    SpecError
        It is no such time, or it is negative.
    """
    number = in_seconds(value, name)
    if isinstance(number, str):
        number = _seconds_in_text(number, name)
    if not is_finite_number(number) or number < 0.0:
        raise SpecError(
            f"{name} is {shown(value)}: give seconds, 0 or more, or a text with a unit such as '300 ms' "
            f"({', '.join(SECONDS_IN_UNIT)}).",
            path="delays",
        )
    require_no_overflow(number, name, "delays")
    return float(number)


def _seconds_in_text(text: str, name: str) -> float:
    spelled = text.translate(dict.fromkeys(map(ord, MICRO_SIGNS), "u"))
    parts = _TEXT.fullmatch(spelled)
    unit = "s" if parts is None or parts[2] is None else parts[2]
    try:
        return math.nan if parts is None else number_in_text(parts[1]) * SECONDS_IN_UNIT[unit]
    except ValueError:
        return math.nan
    except KeyError:
        raise SpecError(
            f"{name} is {text!r}: {unit!r} is no unit of time that is known here; use one of "
            f"{', '.join(SECONDS_IN_UNIT)}.",
            path="delays",
        ) from None


def in_samples(delay: float, step: float) -> tuple[int, float]:
    """Return a dead time as whole samples of ``step`` seconds, and the seconds that are left, below one sample."""
    samples = delay / step
    whole = round(samples)
    if abs(samples - whole) <= WHOLE_SAMPLES * max(samples, 1.0):
        return whole, 0.0
    return math.floor(samples), delay - math.floor(samples) * step


def delays_in_words(delays: Mapping[str, float]) -> str:
    """Return dead times as they stand in a message."""
    return ", ".join(f"{name} {seconds:g} s" for name, seconds in delays.items())
