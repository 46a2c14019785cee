"""Numbers, times and names as people read them."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence

from obsynth.numerics.arguments import is_number
from obsynth.numerics.outward import lower, upper

#: Two values this near to each other, relative to their size or one, are shown as conjugates.
SAME_NUMBER = 1e-9

#: Values that are listed; the others are counted.
MOST_LISTED_VALUES = 8

#: From these sizes on a number has an exponent (of ten), and commas.
LEAST_WITH_EXPONENT, LEAST_WITH_COMMAS = 7, 10_000
#: A time is reported in a longer unit as well from so many of it on.
LONG_TIMES = (("d", 86400.0, 2.0), ("h", 3600.0, 2.0), ("min", 60.0, 10.0))

#: From so many seconds on (2 h) a time of a log or a scenario is reported in hours as well, as in pictures.
#: From so many on six digits leave out seconds, and from so many on it is no time since a start, but one since 1970.
HOURS_FROM, MORE_DIGITS_FROM, LONGEST_RUN = 7200.0, 1e6, 1e9
SECONDS_OF_HOUR = 3600.0


def number(value: float, *, digits: int = 4) -> str:
    """Return ``value`` with a few significant digits; a dash for "not a number", whatever a changed file may hold.

    Numbers of everyday sizes have no exponent: 2140 and not 2.14e+03, with commas from ten thousand on.
    """
    if not is_number(value) or math.isnan(value):
        return "-"
    if math.isinf(value):
        return "inf" if value > 0 else "-inf"
    text = f"{value:.{digits}g}"
    if "e" not in text:
        return text
    mantissa, exponent = text.split("e")
    if 0 < int(exponent) < LEAST_WITH_EXPONENT:
        rounded = float(text)
        return f"{rounded:,.0f}" if abs(rounded) >= LEAST_WITH_COMMAS else f"{rounded:.0f}"
    return f"{mantissa}e{int(exponent)}"


def upper_number(value: float, *, digits: int = 3) -> str:
    """Return an upper bound with a few significant digits, the last rounded up: what is printed is a bound as well."""
    return _rounded(value, upper, digits)


def lower_number(value: float, *, digits: int = 3) -> str:
    """Return a lower bound with a few significant digits, the last rounded down: what is printed is a bound as well."""
    return _rounded(value, lower, digits)


def bound_number(value: float, side: str, *, digits: int = 4) -> str:
    """Return a number that bounds another one from a side, ``"at most"`` or ``"at least"``, rounded away from that one;
    any other to the nearest."""
    rounding = {"at most": upper, "at least": lower}.get(side)
    return number(value, digits=digits) if rounding is None else _rounded(value, rounding, digits)


def _rounded(value: float, rounding: Callable[[float, int], float], digits: int) -> str:
    return number(rounding(value, digits) if is_number(value) else value, digits=digits)


def duration(seconds: float, *, digits: int = 3) -> str:
    """Return a time in seconds, and in minutes, hours or days where it is long: ``2140 s (35.7 min)``."""
    text = f"{number(seconds, digits=digits)} s"
    if not math.isfinite(seconds):
        return text
    for unit, size, least in LONG_TIMES:
        if abs(seconds) >= least * size:
            return f"{text} ({number(seconds / size, digits=digits)} {unit})"
    return text


def point_in_time(seconds: float) -> str:
    """Return a time of a log or a scenario in seconds, and from two hours on in hours as well: ``86760 s (24.1 h)``."""
    text = f"{seconds:.10g} s" if abs(seconds) >= MORE_DIGITS_FROM else f"{seconds:g} s"
    is_long = HOURS_FROM <= abs(seconds) < LONGEST_RUN
    return f"{text} ({seconds / SECONDS_OF_HOUR:.4g} h)" if is_long else text


def complex_numbers(values: Iterable[complex]) -> str:
    """Return several values as text, largest first; conjugate pairs once, as ``a +- bj``; long lists are cut.

    What is below one rounding of the largest is zero: computed eigenvalues are not known better.
    """
    listed = [complex(value) for value in values]
    rounding = math.ulp(1.0) * max(map(abs, listed), default=0.0)
    waiting = sorted(
        (value if abs(value) >= rounding else 0j for value in listed),
        key=lambda value: (-abs(value), -value.real, -value.imag),
    )
    texts: list[str] = []
    while waiting:
        value = waiting.pop(0)
        partner = next((w for w in waiting if abs(w - value.conjugate()) <= SAME_NUMBER * max(1.0, abs(value))), None)
        real, size = number(value.real), number(abs(value.imag))
        if value.imag == 0.0:
            texts.append(real)
        elif partner is None:
            texts.append(f"{real} {'+' if value.imag > 0 else '-'} {size}j")
        else:
            waiting.remove(partner)
            texts.append(f"{real} +- {size}j")
    return name_list(texts, limit=MOST_LISTED_VALUES)


def name_list(names: Sequence[str], *, limit: int = 6) -> str:
    """Return names separated by commas, or by semicolons where commas are in names (``valve, 1 sample ago``); of a long
    list the first ones and how many more there are."""
    if not names:
        return "none"
    between = "; " if any("," in name for name in names) else ", "
    if len(names) <= limit + 1:
        return between.join(names)
    return f"{between.join(names[:limit])} and {len(names) - limit} more"
