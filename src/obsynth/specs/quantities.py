"""Numbers with a unit in a spec, such as ``5 mV``, converted to the unit that the spec states for the signal."""

from __future__ import annotations

import re
from typing import Any

from pydantic_core import PydanticCustomError

from obsynth.errors import SpecError
from obsynth.numerics.measurement_units import conversion, is_temperature

#: A number with the word behind it.
QUANTITY = re.compile(r"\s*([+-]?(?:\d+\.?\d*|\.\d+)(?:[eE][+-]?\d+)?)\s*((?![eE][+-]?\d)[^\d\s.,].*?)\s*")

#: Groups of numbers by signal whose zeros count, and those that are differences: 0.1 K are 0.1 degC there.
_VALUES = ("operating_point", "states", "inputs")
_DIFFERENCES = ("sensor_noise", "offset", "walks")


def with_numbers(section: Any) -> Any:
    """Return a raw section of a plant with the texts of quantities as numbers."""
    if not isinstance(section, dict):
        return section
    units = section.get("units")
    changed = dict(section)
    for group in (*_VALUES, *_DIFFERENCES):
        listed = section.get(group)
        if isinstance(listed, dict):
            changed[group] = {
                name: _number(value, f"{group}.{name}", _unit_of(name, units), is_difference=group in _DIFFERENCES)
                for name, value in listed.items()
            }
    return changed


def _unit_of(name: Any, units: Any) -> str | None:
    unit = units.get(name) if isinstance(units, dict) else None
    return unit if isinstance(unit, str) else None


def _number(value: Any, where: str, stated: str | None, *, is_difference: bool) -> Any:
    """Return a quantity in the unit that is stated; what is none as it is."""
    match = QUANTITY.fullmatch(value) if isinstance(value, str) else None
    if match is None:
        return value
    number, unit = float(match[1]), match[2]
    if stated is None:
        raise _problem(f"{where} is in {unit}, but units states none of this signal: state it, or give a number.")
    if is_difference and is_temperature(unit) and is_temperature(stated) and "F" not in unit + stated:
        return number
    try:
        way = conversion(unit, stated)
    except SpecError as error:
        raise _problem(f"{where}: {error}.") from error
    if way is None:
        raise _problem(
            f"{where} is in {unit}, and its unit is {stated}: pip install 'obsynth[units]' to have it converted, "
            f"or give the number in {stated}."
        )
    factor, shift = way
    return factor * number + (0.0 if is_difference else shift)


def _problem(text: str) -> PydanticCustomError:
    return PydanticCustomError("stated", "{text}", {"text": text})
