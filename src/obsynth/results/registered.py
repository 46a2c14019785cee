"""Functions of upper rooms that methods of results call: registered by `obsynth`, which is above every room."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

_FUNCTIONS: dict[str, Callable[..., Any]] = {}


def register(**functions: Callable[..., Any]) -> None:
    """Register functions by the names under which lower rooms call them."""
    _FUNCTIONS.update(functions)


def is_registered(name: str) -> bool:
    """Whether a function of this name is there: rooms above may be left out of an installation."""
    return name in _FUNCTIONS


def registered(name: str) -> Callable[..., Any]:
    """Return the function that was registered by this name."""
    return _FUNCTIONS[name]
