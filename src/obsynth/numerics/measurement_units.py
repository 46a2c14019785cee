"""Units of measurement as texts, such as in the columns of a log, converted by pint (``obsynth[units]``)."""

from __future__ import annotations

from functools import cache
from importlib.util import find_spec
from typing import Any

from obsynth.errors import SpecError
from obsynth.numerics.libraries import imported

#: The two characters for micro that look alike: the sign of keyboards, and the letter of the Greek alphabet.
MICRO_SIGNS = ("\u00b5", "\u03bc")

#: Spellings of temperatures, whose zeros differ: no factor converts one to another.
_TEMPERATURES = {
    **dict.fromkeys(("K", "kelvin", "Kelvin"), "kelvin"),
    **dict.fromkeys(("degC", "°C", "C", "celsius", "Celsius", "deg C", "deg. C", "oC"), "degC"),
    **dict.fromkeys(("degF", "°F", "F", "fahrenheit", "Fahrenheit", "deg F"), "degF"),
}

#: The factor of a conversion has no more digits than these: it is the difference of two values.
_FACTOR_DIGITS = 12


def conversion(source: str, target: str) -> tuple[float, float] | None:
    """Return factor and shift from numbers in one unit to those in another; `None` where one is no unit that is known.

    Raises
    ------
    SpecError
        One cannot be converted to the other; or both are temperatures, and pint is not installed.
    """
    source, target = _spelled(source, target), _spelled(target, source)
    if source == target:
        return 1.0, 0.0
    if find_spec("pint") is None:
        if {source, target} <= set(_TEMPERATURES.values()):
            raise SpecError(
                f"{source} is not {target}: pip install 'obsynth[units]' to have it converted", path="units"
            )
        return None
    units = _registry()
    try:
        own, other = units.Unit(source), units.Unit(target)
    except Exception:  # noqa: BLE001 - whatever pint makes of a text that is no unit
        return None
    if own.dimensionality != other.dimensionality:
        raise SpecError(f"{source} cannot be converted to {target}", path="units")
    zero, one = (float(units.Quantity(value, own).to(other).magnitude) for value in (0.0, 1.0))
    factor = one - zero
    return (factor if zero == 0.0 else round(factor, _FACTOR_DIGITS)), zero


def is_temperature(unit: str) -> bool:
    """Whether a text is a spelling of a temperature."""
    return unit.strip() in _TEMPERATURES


def _spelled(text: str, other: str) -> str:
    """Return a unit without blanks around it, with one sign for micro; C and F are temperatures beside another one."""
    text = text.strip().replace(MICRO_SIGNS[1], MICRO_SIGNS[0])
    known = _TEMPERATURES.get(text, text)
    alone = text in ("C", "F") and other.strip() not in _TEMPERATURES
    return text if alone else known


@cache
def _registry() -> Any:
    return imported("pint", extra="units").UnitRegistry()
