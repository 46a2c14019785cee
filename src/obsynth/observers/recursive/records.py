"""Checking the records that a recursive observer is given."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from obsynth.errors import SpecError
from obsynth.numerics.arguments import real_array
from obsynth.numerics.arrays import FloatArray, as_matrix, unmasked


def require_horizon(horizon: int | None, samples: int, *, early: bool) -> None:
    """Raise `SpecError` when a record of ``samples`` is longer than a model of ``horizon`` steps reaches."""
    if horizon is None:
        return
    reach = horizon if early else horizon + 1
    if samples > reach:
        raise SpecError(
            f"The record has {samples} samples, but the plant's horizon of {horizon} steps is good for {reach}"
            f"{' (early constraints need one step more)' if early else ''}: extend the model, or "
            "shorten the record.", path="horizon",
        )  # fmt: skip


def measured_record(value: ArrayLike, columns: int) -> FloatArray:
    """Return outputs ``(samples, columns)`` in which NaN marks what is missing."""
    try:
        array = real_array(value, "y")
    except SpecError:
        raise SpecError("y must be numbers (NaN for a missing sample), with the same number at each sample.",
                        path="y") from None  # fmt: skip
    if array.ndim == 1 and columns == 1:
        array = array.reshape(-1, 1)
    if array.ndim != 2 or array.shape[1] != columns:
        raise SpecError(f"y has shape {array.shape}, but the observer needs (samples, {columns}).", path="y")
    if np.isinf(array).any():
        raise SpecError("y holds an infinity: mark a missing sample by NaN.", path="y")
    return array


def checked_record(value: Any, columns: int, name: str) -> FloatArray:
    """Return a record ``(samples, columns)`` of finite numbers."""
    if value is None:
        raise SpecError(f"{name} is missing: the observer needs {columns} signal(s).", path=name)
    raw = np.asarray(unmasked(value))
    array = np.zeros((len(raw), 0)) if raw.ndim == 2 and raw.shape[1] == 0 else None
    if array is None:
        array = as_matrix(raw.reshape(-1, 1) if raw.ndim == 1 and columns == 1 else raw, name)
    if array.shape[1] != columns:
        raise SpecError(f"{name} has shape {array.shape}, but the observer needs (samples, {columns}).", path=name)
    return array


def whole_record(y: ArrayLike, u: ArrayLike | None, ny: int, nu: int) -> tuple[FloatArray, FloatArray]:
    """Return outputs ``(samples, ny)`` and known inputs ``(samples, nu)``, optional when there are none."""
    outputs = measured_record(y, ny)
    inputs = checked_record(np.zeros((len(outputs), 0)) if u is None and not nu else u, nu, "u")
    if len(inputs) != len(outputs):
        raise SpecError(f"u has {len(inputs)} samples and y has {len(outputs)}: give the same number.", path="u")
    return outputs, inputs
