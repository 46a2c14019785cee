"""Checking what an observer is made of, and the samples it is given."""

from __future__ import annotations

from typing import Any

import numpy as np

from obsynth.errors import SpecError
from obsynth.numerics.arrays import FloatArray, as_matrix

#: The fields of an observer that hold names.
NAME_FIELDS = ("input_names", "output_names", "state_names", "fault_names", "residual_names")


def require_names(names: Any, field: str) -> None:
    """Raise `SpecError` unless ``names`` is a tuple of unique, non-empty texts."""
    if not isinstance(names, tuple):
        raise SpecError(f"{field} of the observer is a {type(names).__name__}: give a tuple of names.", path=field)
    if not all(isinstance(name, str) and name.strip() for name in names):
        raise SpecError(f"{field} of the observer must be a tuple of non-empty texts.", path=field)
    repeated = sorted({name for name in names if names.count(name) > 1})
    if repeated:
        raise SpecError(
            f"{field} of the observer repeats {', '.join(map(repr, repeated))}: names must be unique.", path=field
        )


def is_delay(delay: Any) -> bool:
    """Whether ``delay`` is a whole number of samples, 0 or more."""
    return isinstance(delay, int) and not isinstance(delay, bool) and delay >= 0


def _numbers(value: Any, name: str) -> FloatArray:
    """Return an array of finite real numbers of one or two dimensions; raise `SpecError` naming it."""
    try:
        raw = np.asarray(value)
    except ValueError:
        raise SpecError(f"{name} is ragged: give the same number of signals at each sample.", path=name) from None
    if raw.ndim <= 1:
        return np.asarray(as_matrix(raw.reshape(1, -1), name)[0])
    return as_matrix(raw, name)


def checked_record(value: Any, columns: int, name: str) -> FloatArray:
    """Return a record ``(steps, columns)``; one signal may be given as a plain list."""
    if value is None:
        raise SpecError(f"{name} is missing: the observer needs {columns} signal(s).", path=name)
    array = _numbers(value, name)
    if array.ndim == 1 and columns == 1:
        array = array.reshape(-1, 1)
    if array.ndim != 2 or array.shape[1] != columns:
        raise SpecError(f"{name} has shape {array.shape}, but the observer needs (steps, {columns}).", path=name)
    return array


def checked_sample(value: Any, count: int, name: str) -> FloatArray:
    """Return one sample ``(count,)``."""
    array = _numbers(value, name)
    if array.shape != (count,):
        raise SpecError(f"{name} has shape {array.shape}, but the observer needs {count} number(s).", path=name)
    return array
