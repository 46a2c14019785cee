"""What a running observer carries from sample to sample, as data: to save it, and to undo a sample."""

from __future__ import annotations

from collections import deque
from collections.abc import Mapping
from typing import Any

import numpy as np

from obsynth.observers.recursive.parameter_reset import ParameterReset

#: Marks an array whose columns are contiguous: sums are rounded in another order there.
_FORTRAN = "by columns"
_NOTHING = object()


def captured_state(moving: object) -> dict[str, Any]:
    """Return every attribute that is data: numbers, arrays, and tuples and windows of them.

    What else a running observer has (its model, its prepared factorisations) follows from the observer.
    """
    found = {name: _saved(value) for name, value in vars(moving).items()}
    return {name: value for name, value in found.items() if value is not _NOTHING}


def resume(moving: object, data: Mapping[str, Any]) -> None:
    """Bring a running observer back to what `captured_state` described."""
    for name, value in data.items():
        own = getattr(moving, name)
        if isinstance(own, deque):
            own.clear()
            own.extend(_loaded(item) for item in value)
        elif isinstance(own, ParameterReset):
            resume(own, value)
        elif hasattr(own, "_fields"):
            setattr(moving, name, type(own)(**{key: _loaded(item) for key, item in value.items()}))
        else:
            setattr(moving, name, _loaded(value))


def _saved(value: Any) -> Any:
    if isinstance(value, np.ndarray):
        by_columns = value.ndim == 2 and value.strides[0] < value.strides[1]
        return {_FORTRAN: np.array(value, order="F")} if by_columns else np.array(value, order="C")
    if value is None or isinstance(value, (bool, int, float, np.floating)):
        return value
    if isinstance(value, ParameterReset):
        return captured_state(value)
    if hasattr(value, "_asdict"):
        items = {key: _saved(item) for key, item in value._asdict().items()}
        return _NOTHING if any(item is _NOTHING for item in items.values()) else items
    if isinstance(value, (list, tuple, deque)):
        parts = [_saved(item) for item in value]
        return _NOTHING if any(part is _NOTHING for part in parts) else parts
    return _NOTHING


def _loaded(value: Any) -> Any:
    if isinstance(value, Mapping):
        return np.asfortranarray(value[_FORTRAN])
    if isinstance(value, list):
        return tuple(_loaded(item) for item in value)
    return np.array(value) if isinstance(value, np.ndarray) else value
