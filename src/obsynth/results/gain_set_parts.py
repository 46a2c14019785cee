"""The parts of a gain set, each of its type: what is damaged is named, never met later as an error of Python."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any, TypeVar

import numpy as np

from obsynth.errors import SpecError
from obsynth.numerics.arguments import is_number

_Made = TypeVar("_Made")

#: The type of every part that a gain set has, in words and as a test.
_TYPES: Mapping[str, tuple[str, Callable[[Any], bool]]] = {
    "name": ("a text", lambda value: isinstance(value, str)),
    "method": ("a text", lambda value: isinstance(value, str)),
    "plant": ("a mapping", lambda value: isinstance(value, dict)),
    "options": ("a mapping", lambda value: isinstance(value, dict)),
    "gains": ("a mapping to arrays of numbers", lambda value: _is_mapping_to(value, _is_array)),
    "observer": ("a mapping", lambda value: isinstance(value, dict)),
    "certificate": ("matrices and claims that are numbers", lambda value: _is_certificate(value)),
    "solver": ("a mapping", lambda value: isinstance(value, dict)),
    "notes": ("a list of texts", lambda value: _is_texts(value)),
    "recovery": ("maps with the names of states, or nothing", lambda value: value is None or _is_recovery(value)),
    "report": ("a mapping", lambda value: isinstance(value, dict)),
}


def checked_parts(body: Any) -> dict[str, Any]:
    """Return the content of a gain set if it has every part, each of its type; raise `SpecError` for the first."""
    if not isinstance(body, dict):
        raise SpecError("it holds no design")
    for name, (wanted, fits) in _TYPES.items():
        if name not in body:
            raise SpecError(f"{name!r} is missing")
        if not fits(body[name]):
            shown = f"{name} is {body[name]!r}, not" if name in ("name", "method") else f"its {name} must be"
            raise SpecError(f"{shown} {wanted}")
    return body


def made(part: str, make: Callable[..., _Made], *values: Any, **named: Any) -> _Made:
    """Return what a part describes; what cannot be made of it is a `SpecError`."""
    try:
        return make(*values, **named)
    except SpecError as error:
        raise SpecError(f"its {part} is refused: {str(error).rstrip('.')}") from error
    except KeyError as error:
        raise SpecError(f"its {part} has no {error}") from error
    except (AttributeError, IndexError, TypeError, ValueError, ArithmeticError) as error:
        raise SpecError(f"its {part} is damaged") from error


def _is_array(value: Any) -> bool:
    return isinstance(value, np.ndarray)


def _is_texts(value: Any) -> bool:
    return isinstance(value, list) and all(isinstance(item, str) for item in value)


def _is_mapping_to(value: Any, fits: Callable[[Any], bool]) -> bool:
    return isinstance(value, dict) and all(fits(item) for item in value.values())


def _is_certificate(value: Any) -> bool:
    return (
        isinstance(value, dict)
        and _is_mapping_to(value.get("matrices"), _is_array)
        and _is_mapping_to(value.get("claims"), is_number)
    )


def _is_recovery(value: Any) -> bool:
    if not isinstance(value, dict) or not _is_texts(value.get("names")):
        return False
    return all(_is_array(item) and item.ndim == 2 for key, item in value.items() if key.startswith("from_"))
