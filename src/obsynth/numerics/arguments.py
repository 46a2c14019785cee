"""What a caller gives, checked: never a raw TypeError, always the name of the argument."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from obsynth.errors import SpecError
from obsynth.numerics.arrays import FloatArray, unmasked


def real_number(value: Any, name: str, what: str = "a number") -> float:
    """Return a finite real number; raise `SpecError` naming the argument and ``what`` it should be."""
    if not is_number(value) or not np.isfinite(value):
        raise SpecError(f"{name} is {shown(value)}: give {what}.", path=name)
    return float(value)


def whole_number(value: Any, name: str, what: str = "a whole number", *, least: int = 1) -> int:
    """Return an integer that is ``least`` or more; raise `SpecError` naming the argument and ``what`` it should be."""
    if isinstance(value, bool) or not isinstance(value, (int, np.integer)) or value < least:
        raise SpecError(f"{name} is {shown(value)}: give {what}, at least {least}.", path=name)
    return int(value)


def truth(value: Any, name: str) -> bool:
    """Return True or False; raise `SpecError` for anything else."""
    if not isinstance(value, (bool, np.bool_)):
        raise SpecError(f"{name} is {shown(value)}: give True or False.", path=name)
    return bool(value)


def real_vector(value: Any, size: int, name: str) -> FloatArray:
    """Return ``(size,)`` finite real numbers; a single one may be given as such."""
    wanted = SpecError(f"{name} must be {size} finite number(s).", path=name)
    try:
        vector = np.atleast_1d(real_array(value, name))
    except SpecError:
        raise wanted from None
    if vector.shape != (size,) or not np.isfinite(vector).all():
        raise wanted
    return vector


def real_array(value: Any, name: str) -> FloatArray:
    """Return real numbers of any shape, NaN and infinities among them; raise `SpecError` for anything else.

    Masked entries become NaN: what lies under a mask is no number.
    """
    try:
        raw = np.asarray(unmasked(value))
    except (TypeError, ValueError):
        raise SpecError(f"{name} has rows of different lengths.", path=name) from None
    if raw.dtype.kind not in "fiu" and raw.size:
        raise SpecError(f"{name} is {shown(value)}: give real numbers.", path=name)
    return np.asarray(raw, dtype=np.float64) if raw.size else np.zeros(raw.shape)


def chosen(value: Any, name: str, choices: tuple[str, ...]) -> str:
    """Return a text that is one of ``choices``; raise `SpecError` listing them."""
    if not isinstance(value, str) or value not in choices:
        raise SpecError(f"{name} is {shown(value)}: use one of {', '.join(choices)}.", path=name)
    return value


def is_number(value: Any) -> bool:
    """Whether ``value`` is a single real number, of Python or numpy."""
    return isinstance(value, (int, float, np.integer, np.floating)) and not isinstance(value, bool)


def require_kind(value: Any, kinds: type | tuple[type, ...], name: str, wanted: str) -> None:
    """Raise `SpecError` unless an argument is of some kind."""
    if not isinstance(value, kinds):
        raise SpecError(f"{name} is a {type(value).__name__}: give {wanted}.", path=name)


def require_mapping(value: Any, name: str) -> None:
    """Raise `SpecError` unless an optional argument is a mapping from names."""
    if value is not None:
        require_kind(value, Mapping, name, "a mapping from names, such as {'speed': 1.0}")


def is_finite_number(value: Any) -> bool:
    """Whether ``value`` is a single finite real number."""
    return is_number(value) and bool(np.isfinite(value))


def shown(value: Any) -> str:
    """Return a value as it may stand in a message: short, and on one line."""
    if value is None:
        return "missing"
    text = repr(value.item() if isinstance(value, np.generic) else value)
    return text if len(text) <= 60 and "\n" not in text else f"a {type(value).__name__}"
