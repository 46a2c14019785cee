"""Registry of functions of upper rooms that lower rooms call by name; `obsynth/__init__.py` registers them.

Lower rooms do not import upper ones, but a design's methods, such as its summary, need functions from there.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

_FUNCTIONS: dict[str, Callable[..., Any]] = {}


def register(**functions: Callable[..., Any]) -> None:
    """Register functions under the names by which lower rooms call them."""
    _FUNCTIONS.update(functions)


def is_registered(name: str) -> bool:
    """Whether a function has this name: an installation may lack the room that registers it."""
    return name in _FUNCTIONS


def registered(name: str) -> Callable[..., Any]:
    """Return the function that is registered under this name."""
    return _FUNCTIONS[name]
