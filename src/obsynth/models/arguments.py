"""Arguments of another kind than a call can use: refused in words, not by whatever fails first."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import numpy as np

from obsynth.errors import SpecError


def require_kind(value: Any, kinds: type | tuple[type, ...], name: str, wanted: str) -> None:
    """Raise `SpecError` unless an argument is of some kind.

    Parameters
    ----------
    value : object
        The argument.
    kinds : type or tuple of type
        What it may be.
    name : str
        Of the argument.
    wanted : str
        What to give, in words.

    Raises
    ------
    SpecError
        It is something else.
    """
    if not isinstance(value, kinds):
        raise SpecError(f"{name} is a {type(value).__name__}: give {wanted}.", path=name)


def is_number(value: Any) -> bool:
    """Whether a value is a finite real number; booleans are none."""
    number = isinstance(value, (int, float, np.integer, np.floating)) and not isinstance(value, bool)
    return number and math.isfinite(value)


def require_mapping(value: Any, name: str) -> None:
    """Raise `SpecError` unless an optional argument is a mapping from names.

    Parameters
    ----------
    value : object
        The argument.
    name : str
        Of the argument.

    Raises
    ------
    SpecError
        It is something else.
    """
    if value is not None:
        require_kind(value, Mapping, name, "a mapping from names, such as {'speed': 1.0}")
