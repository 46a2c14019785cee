"""States of observers as numbers, arrays and mappings, to be written to a file and read back."""

from __future__ import annotations

from typing import Any, TypeVar

import numpy as np

SavedState = TypeVar("SavedState", bound=tuple[Any, ...])

#: Marks an array whose columns are contiguous: sums are rounded in another order there.
BY_COLUMNS = "by columns"


def state_as_data(state: tuple[Any, ...]) -> dict[str, Any]:
    """Return a state as numbers, arrays, lists and mappings, to be written to a file."""
    return {name: _as_data(value) for name, value in state._asdict().items()}  # type: ignore[attr-defined]


def state_from_data(like: SavedState, data: dict[str, Any]) -> SavedState:
    """Return the state of the same kind as ``like`` that `state_as_data` described."""
    if hasattr(like, "from_data"):
        restored: SavedState = like.from_data(data, state_from_data)
        return restored
    values = {name: _from_data(own, data[name]) for name, own in like._asdict().items()}  # type: ignore[attr-defined]
    return type(like)(**values)


def _as_data(value: Any) -> Any:
    if isinstance(value, np.ndarray):
        by_columns = value.ndim == 2 and value.strides[0] < value.strides[1]
        return {BY_COLUMNS: np.array(value, order="F")} if by_columns else np.array(value, order="C")
    if hasattr(value, "_asdict"):
        return state_as_data(value)
    return [_as_data(part) for part in value] if isinstance(value, tuple) else value


def _from_data(like: Any, value: Any) -> Any:
    if hasattr(like, "_asdict"):
        return state_from_data(like, value)
    if isinstance(like, tuple):
        return tuple(_array(part) for part in value)
    return _array(value) if isinstance(like, np.ndarray) else value


def _array(value: Any) -> Any:
    if isinstance(value, (int, float)):
        return value
    return np.asfortranarray(value[BY_COLUMNS]) if isinstance(value, dict) else np.array(value)
