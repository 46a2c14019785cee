"""Checks of the names and delays of an observer, and of the numbers, samples and records that it gets."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from obsynth.errors import SpecError, counted
from obsynth.numerics.arguments import is_number, is_whole, real_array, real_number, require_kind
from obsynth.numerics.arrays import FloatArray, as_given, as_matrix, matrix_or_multiple_of_identity
from obsynth.numerics.suggestions import there_are
from obsynth.plants.dae_signals import finite_vector
from obsynth.plants.signal_names import index_of

#: The fields of an observer that hold names.
NAME_FIELDS = ("input_names", "output_names", "state_names", "fault_names", "residual_names")


def require_names(names: Any, field: str) -> None:
    """Raise `SpecError` unless ``names`` is a tuple of unique, non-empty texts."""
    require_kind(names, tuple, f"{field} of the observer", "a tuple of names", path=field)
    if not all(isinstance(name, str) and name.strip() for name in names):
        raise SpecError(f"{field} of the observer must be a tuple of non-empty texts.", path=field)
    if len(set(names)) < len(names):
        repeated = sorted({name for name in names if names.count(name) > 1})
        raise SpecError(
            f"{field} of the observer repeats {', '.join(map(repr, repeated))}: names must be unique.", path=field
        )


def require_delays(names: tuple[str, ...], delays: Any) -> None:
    """Raise `SpecError` unless there is a delay of 0 or more samples for each signal."""
    are_counts = isinstance(delays, tuple) and all(is_whole(delay) and delay >= 0 for delay in delays)
    if not are_counts or len(names) != len(delays):
        raise SpecError("The observer needs one delay >= 0, in samples, for each signal.", path="delays")


def require_horizon(horizon: int | None, samples: int, *, early: bool) -> None:
    """Raise `SpecError` when a record of ``samples`` is longer than a model of ``horizon`` steps reaches."""
    if horizon is None:
        return
    reach = horizon if early else horizon + 1
    if samples > reach:
        raise SpecError(
            f"The record has {samples} samples, but the plant's horizon of {horizon} steps is good for {reach}"
            f"{' (early constraints need one step more)' if early else ''}: extend the model, or "
            "shorten the record.",
            path="horizon",
        )


def measured_record(value: ArrayLike, columns: int) -> FloatArray:
    """Return outputs ``(samples, columns)`` in which NaN marks what is missing."""
    try:
        array = real_array(value, "y")
    except SpecError:
        raise SpecError(
            "y must be numbers (NaN for a missing sample), with the same number at each sample.", path="y"
        ) from None
    if array.ndim == 1 and columns == 1:
        array = array.reshape(-1, 1)
    if array.ndim != 2 or array.shape[1] != columns:
        raise SpecError(f"y has shape {array.shape}, but the observer needs (samples, {columns}).", path="y")
    if np.isinf(array).any():
        raise SpecError("y holds an infinity: mark a missing sample by NaN.", path="y")
    return array


def _numbers(value: Any, name: str) -> FloatArray:
    """Return an array of finite real numbers of one or two dimensions; raise `SpecError` naming it."""
    raw = as_given(value, name, f"{name} is ragged: give the same number of signals at each sample.")
    return np.asarray(as_matrix(raw.reshape(1, -1), name)[0]) if raw.ndim <= 1 else as_matrix(raw, name)


def checked_record(value: Any, columns: int, name: str) -> FloatArray:
    """Return a record ``(samples, columns)``; one signal may be given as a plain list."""
    if value is None:
        raise SpecError(f"{name} is missing: the observer needs {counted(columns, 'signal')}.", path=name)
    array = _numbers(value, name)
    if array.ndim == 1 and columns == 1:
        array = array.reshape(-1, 1)
    if array.ndim != 2 or array.shape[1] != columns:
        raise SpecError(f"{name} has shape {array.shape}, but the observer needs (samples, {columns}).", path=name)
    return array


def checked_sample(value: Any, count: int, name: str) -> FloatArray:
    """Return one sample ``(count,)``."""
    array = _numbers(value, name)
    if array.shape != (count,):
        raise SpecError(
            f"{name} has shape {array.shape}, but the observer needs {counted(count, 'number')}.", path=name
        )
    return array


def whole_record(
    y: ArrayLike, u: ArrayLike | None, ny: int, nu: int, *, complete: bool = False
) -> tuple[FloatArray, FloatArray]:
    """Return outputs ``(samples, ny)``, all there where ``complete``, and known inputs ``(samples, nu)``. Inputs may be
    left out where there are none."""
    outputs = checked_record(y, ny, "y") if complete else measured_record(y, ny)
    inputs = checked_record(np.zeros((len(outputs), 0)) if u is None and not nu else u, nu, "u")
    if len(inputs) != len(outputs):
        raise SpecError(f"u has {len(inputs)} samples and y has {len(outputs)}: give the same number.", path="u")
    return outputs, inputs


def named_vector(value: Any, names: Sequence[str], default: FloatArray, option: str) -> FloatArray:
    """Return numbers ``(len(names),)`` from an array or from values by name; the default where nothing is said."""
    if not isinstance(value, Mapping):
        return finite_vector(value, names, default, option)
    vector = np.array(default)
    for name, entry in value.items():
        if name not in names:
            raise SpecError(f"{option} has no signal named {name!r}; {there_are(name, names)}", path=option)
        vector[names.index(name)] = real_number(entry, f"{option}.{name}")
    return vector


def named_covariance(
    value: Any, names: Sequence[str], option: str, default: FloatArray | None, *, others: FloatArray | None = None
) -> FloatArray:
    """Return a covariance from a matrix, one variance, or variances by name, beside which ``others`` have theirs."""
    if value is None:
        if default is None:
            raise SpecError(
                f"{option} is missing: give variances, for example by the names {', '.join(names)}.", path=option
            )
        return np.diag(default)
    if isinstance(value, Mapping):
        variances = np.zeros(len(names)) if others is None else others
        return np.diag(named_vector(value, names, variances, option))
    empty = isinstance(value, (list, tuple, np.ndarray)) and not np.asarray(value, dtype=object).size
    return np.zeros((0, 0)) if empty else matrix_or_multiple_of_identity(value, len(names), option)


def named_bounds(value: Any, names: Sequence[str], option: str) -> FloatArray:
    """Return lower and upper bounds ``(n, 2)`` from rows or from pairs by name; infinite where nothing is said."""
    bounds = np.tile([-np.inf, np.inf], (len(names), 1))
    if value is None:
        return bounds
    if isinstance(value, Mapping):
        pairs = {index_of(name, names, what=option): pair for name, pair in value.items()}
    else:
        rows = np.asarray(value, dtype=object) if isinstance(value, (list, tuple, np.ndarray)) else np.zeros(0)
        if rows.shape != bounds.shape:
            raise SpecError(f"{option} must be {len(names)} pairs [low, high], or pairs by name.", path=option)
        pairs = {i: list(row) for i, row in enumerate(rows)}
    for i, pair in pairs.items():
        path = f"{option}.{names[i]}"
        if np.shape(pair) != (2,) or not all(map(is_number, pair)):
            raise SpecError(f"{path} is {pair!r}: give [low, high].", path=path)
        if not pair[0] < pair[1]:
            raise SpecError(
                f"{path}: the lower bound ({pair[0]:g}) must be below the upper one ({pair[1]:g}).", path=path
            )
        bounds[i] = pair
    return bounds


def batch_record(
    y: ArrayLike, u: ArrayLike | None, ny: int, input_names: Sequence[str]
) -> tuple[FloatArray, FloatArray]:
    """Return outputs ``(trials, samples, ny)`` and inputs, ``(samples, nu)`` where they are those of all trials."""
    outputs, nu = real_array(y, "y"), len(input_names)
    if outputs.ndim != 3 or outputs.shape[2] != ny or not outputs.size:
        raise SpecError(f"y has shape {outputs.shape}, but (trials, samples, {ny}) is needed.", path="y")
    if np.isinf(outputs).any():
        raise SpecError("y holds an infinity: mark a missing sample by NaN.", path="y")
    trials, samples = outputs.shape[:2]
    inputs = np.zeros((samples, 0)) if u is None and not nu else real_array(u, "u")
    if inputs.shape not in ((samples, nu), (trials, samples, nu)):
        raise SpecError(
            f"u has shape {inputs.shape}, but {(samples, nu)} or {(trials, samples, nu)} is needed.", path="u"
        )
    if not np.isfinite(inputs).all():
        *trial, k, i = np.argwhere(~np.isfinite(inputs))[0]
        where = f" of trial {trial[0]}" if trial else ""
        raise SpecError(
            f"The input {input_names[i]!r}{where} is {inputs[*trial, k, i]} at k = {k}: inputs must be known.", path="u"
        )
    return outputs, inputs
