"""What a lower package leaves to an upper one, such as how a design is printed: asked for by name here.

Only `obsynth` itself, above everything, says which function that is.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from importlib import import_module
from typing import Any

_PLACES: dict[str, str] = {}


def provide(places: Mapping[str, str]) -> None:
    """Say where the functions are that lower packages ask for: ``module:function`` by name, imported when asked for."""
    _PLACES.update(places)


def extension(name: str) -> Callable[..., Any]:
    """Return the function of that name."""
    module, function = _PLACES[name].split(":")
    found: Callable[..., Any] = getattr(import_module(module), function)
    return found
