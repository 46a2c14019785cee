"""Quantities: numbers that carry a unit of measurement, of pint, unyt and astropy.

Each of these libraries has its own class; what is common is asked for by name (duck typing), and none is imported.
"""

from __future__ import annotations

from collections.abc import Mapping
from contextlib import suppress
from datetime import timedelta
from typing import Any

import numpy as np

from obsynth.errors import SpecError

#: How a number is converted: ``to`` of pint and astropy (unyt has both).
_NUMBER = ("magnitude", "value")

#: How pint calls a unit of differences of temperature: ``delta_degC``.
_DELTA = "delta_"

#: What numpy counts time in that has no length in seconds: months, years, and no unit at all.
_NO_LENGTH = frozenset({"Y", "M", "generic"})

#: Digits of the size of a degree that subtracting two temperatures of some hundred degrees leaves.
_DIGITS_OF_DEGREES = 12

#: What dimensionless units are called.
_NO_UNIT = frozenset({"", "1", "dimensionless"})


def unit_of(value: Any) -> str | None:
    """Return the unit that a number or an array carries, as text; `None` where it carries none."""
    if isinstance(value, (int, float, str, np.generic, Mapping, list, tuple)) or type(value) is np.ndarray:
        return None
    unit = getattr(value, "units", getattr(value, "unit", None))
    if unit is None or not any(hasattr(value, name) for name in _NUMBER) or callable(unit):
        return None
    return str(unit).strip()


def require_plain(value: Any, name: str) -> Any:
    """Return numbers that carry no unit; raise `SpecError` for a quantity, also for one in a list of rows."""
    if isinstance(value, (list, tuple)):
        return [require_plain(item, name) for item in value] if any(map(_may_carry, value)) else value
    unit = unit_of(value)
    if unit is None:
        return value
    if unit in _NO_UNIT:
        return _number(value)
    raise SpecError(
        f"{name} is a quantity in {unit}, but plain numbers are taken here: convert it to the unit of the model and "
        "give the number alone.",
        path=name,
    )


def in_unit(value: Any, unit: str | None, name: str, *, is_difference: bool = False) -> Any:
    """Return a quantity as a number in the ``unit`` that a plant states; other values as they are.

    A difference of temperatures, such as a deviation, has no zero: 0.1 K are 0.1 degC then.

    Raises
    ------
    SpecError
        No unit is stated, or the quantity cannot be converted to it.
    """
    own = unit_of(value)
    if own is None:
        return value
    if unit is None:
        if own in _NO_UNIT:
            return _number(value)
        raise SpecError(
            f"{name} is a quantity in {own}, but the plant states no unit of this signal: state it "
            "(units={...}), or give a plain number.",
            path=name,
        )
    try:
        return _difference(value, unit) if is_difference else _number(value.to(unit))
    except Exception as error:  # each library has its own errors, which share no base class
        raise SpecError(
            f"{name} is a quantity in {own}, which cannot be converted to {unit!r}, the unit of this signal: {error}",
            path=name,
        ) from error


def in_seconds(value: Any, name: str) -> Any:
    """Return a quantity of time, a `timedelta` or numpy's ``timedelta64`` as a number of seconds; other values as they
    are."""
    if isinstance(value, np.timedelta64):
        if np.datetime_data(value.dtype)[0] in _NO_LENGTH:
            raise SpecError(f"{name} is {value!r}, which is no number of seconds: give it in s or ms.", path=name)
        return float(value / np.timedelta64(1, "s"))
    return value.total_seconds() if isinstance(value, timedelta) else in_unit(value, "s", name)


def numbers_in_units(values: Any, units: Mapping[str, str], name: str, *, are_differences: bool = False) -> Any:
    """Return a mapping from signals, or from signals to mappings of numbers, with each quantity as a number in the unit
    that is stated of its signal; anything else as it is."""

    def number(value: Any, signal: str, place: str) -> Any:
        return in_unit(value, units.get(signal), place, is_difference=are_differences)

    if not isinstance(values, Mapping):
        return values
    return {
        signal: {key: number(item, signal, f"{name}[{signal!r}].{key}") for key, item in value.items()}
        if isinstance(value, Mapping)
        else number(value, signal, f"{name}[{signal!r}]")
        for signal, value in values.items()
    }


def _may_carry(value: Any) -> bool:
    return isinstance(value, (list, tuple)) or unit_of(value) is not None


def _difference(value: Any, unit: str) -> Any:
    """Return a difference as a number in ``unit``, which may be one that counts from a zero of its own."""
    own = getattr(value, "units", getattr(value, "unit", None))
    if str(own).startswith(_DELTA):
        # As pint calls degrees of differences; kelvins are their own.
        with suppress(Exception):  # each library has its own errors, which share no base class
            return _number(value.to(unit))
        return _number(value.to(f"{_DELTA}{unit}"))
    nothing = _number(type(value)(0.0, own).to(unit))
    if not nothing:
        return _number(value.to(unit))
    step = _number(type(value)(1.0, own).to(unit)) - nothing
    return _number(value) * float(f"{step:.{_DIGITS_OF_DEGREES}g}")


def _number(value: Any) -> Any:
    number = next(getattr(value, name) for name in _NUMBER if hasattr(value, name))
    return float(number) if np.ndim(number) == 0 else np.asarray(number)
