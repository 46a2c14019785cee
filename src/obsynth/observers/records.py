"""Checking what an observer is made of, and the samples and records it is given.

Known inputs that are missing in some samples: taken as they last were, within what their past lets them be off by.

An input moves by no more from one sample to the next than it did before, and not out of its range.  In m samples it may
have moved that far all the time: as the same error acts in all of them, what it does is added up, and not its squares.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from obsynth.errors import SpecError
from obsynth.numerics.arguments import FloatArray, as_given, as_matrix, is_number, real_array, real_number, require_kind
from obsynth.plants.dae import finite_vector
from obsynth.plants.descriptor import index_of, suggestion

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
        raise SpecError(f"{name} is missing: the observer needs {columns} signal(s).", path=name)
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
        raise SpecError(f"{name} has shape {array.shape}, but the observer needs {count} number(s).", path=name)
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


def named_vector(value: Any, names: Sequence[str], default: FloatArray, what: str) -> FloatArray:
    """Return numbers ``(len(names),)`` from an array or from values by name; the default where nothing is said."""
    if not isinstance(value, Mapping):
        return finite_vector(value, names, default, what)
    vector = np.array(default)
    for name, entry in value.items():
        if name not in names and not suggestion(name, names):
            raise SpecError(f"{what} has no signal named {name!r}; there are: {', '.join(names)}.", path=what)
        vector[index_of(name, names, what=what)] = real_number(entry, f"{what}.{name}")
    return vector


def named_covariance(
    value: Any, names: Sequence[str], what: str, default: FloatArray | None, *, others: FloatArray | None = None
) -> FloatArray:
    """Return a covariance from a matrix, one variance, or variances by name, beside which ``others`` have theirs."""
    if value is None:
        if default is None:
            raise SpecError(
                f"{what} is missing: give variances, for example by the names {', '.join(names)}.", path=what
            )
        return np.diag(default)
    if isinstance(value, Mapping):
        variances = np.zeros(len(names)) if others is None else others
        return np.diag(named_vector(value, names, variances, what))
    empty = isinstance(value, (list, tuple, np.ndarray)) and not np.asarray(value, dtype=object).size
    matrix = np.zeros((0, 0)) if empty else as_matrix(value, what)
    return float(matrix[0, 0]) * np.eye(len(names)) if np.ndim(value) == 0 else matrix


def named_bounds(value: Any, names: Sequence[str], what: str) -> FloatArray:
    """Return lower and upper bounds ``(n, 2)`` from rows or from pairs by name; infinite where nothing is said."""
    found = np.tile([-np.inf, np.inf], (len(names), 1))
    if value is None:
        return found
    if isinstance(value, Mapping):
        pairs = {index_of(name, names, what=what): pair for name, pair in value.items()}
    else:
        rows = np.asarray(value, dtype=object) if isinstance(value, (list, tuple, np.ndarray)) else np.zeros(0)
        if rows.shape != found.shape:
            raise SpecError(f"{what} must be {len(names)} pairs [low, high], or pairs by name.", path=what)
        pairs = {i: list(row) for i, row in enumerate(rows)}
    for i, pair in pairs.items():
        path = f"{what}.{names[i]}"
        if np.shape(pair) != (2,) or not all(map(is_number, pair)):
            raise SpecError(f"{path} is {pair!r}: give [low, high].", path=path)
        if not pair[0] < pair[1]:
            raise SpecError(
                f"{path}: the lower bound ({pair[0]:g}) must be below the upper one ({pair[1]:g}).", path=path
            )
        found[i] = pair
    return found


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
    known = np.zeros((samples, 0)) if u is None and not nu else real_array(u, "u")
    if known.shape not in ((samples, nu), (trials, samples, nu)):
        raise SpecError(
            f"u has shape {known.shape}, but {(samples, nu)} or {(trials, samples, nu)} is needed.", path="u"
        )
    if not np.isfinite(known).all():
        *trial, k, i = np.argwhere(~np.isfinite(known))[0]
        where = f" of trial {trial[0]}" if trial else ""
        raise SpecError(
            f"The input {input_names[i]!r}{where} is {known[*trial, k, i]} at k = {k}: inputs must be known.", path="u"
        )
    return outputs, known


class TakenInputs(NamedTuple):
    """What the inputs of a sample are taken as."""

    u: FloatArray  # ``(nu,)``: without gaps
    history: FloatArray  # after the sample, see `no_inputs`
    # ``(nu,)``, variances: of those that are missing, and of those of samples before that are known again and have
    # moved further than was thought of; ``None`` where there are none
    missing: FloatArray | None
    returned: FloatArray | None

    @property
    def variances(self) -> FloatArray | None:
        """Both together ``(nu,)``."""
        if self.missing is None or self.returned is None:
            return self.missing if self.returned is None else self.returned
        return np.asarray(self.missing + self.returned)


def no_inputs(count: int) -> FloatArray:
    """Return what is known of inputs before the first sample ``(5, nu)``: the lowest and the highest value, the largest
    change from one sample to the next, the samples in a row that are missing, and the sum of what these may be off
    by."""
    return np.zeros((5, count))


def require_inputs(u: FloatArray, names: tuple[str, ...], k: int) -> None:
    """Raise `SpecError` unless inputs ``u (nu,)`` are as many as their names; where one is infinite, or missing (NaN)
    before it was ever known."""
    if u.shape != (len(names),):
        raise SpecError(f"u must be {len(names)} finite number(s) at k = {k}.", path="u")
    wrong = np.isinf(u) | (np.isnan(u) if k == 0 else False)
    if wrong.any():
        i = int(np.argmax(wrong))
        raise SpecError(
            f"The input {names[i]!r} is {u[i]} at k = {k}: inputs must be known at the first sample and finite later "
            "(NaN: missing). Begin where all are known, or make the signal a state with a sensor.",
            path="u",
        )


def held_inputs(held: FloatArray, u: FloatArray) -> FloatArray | None:
    """Return inputs with those before (``held (nu,)``) in the place of what is missing; ``None`` where nothing is."""
    return np.where(np.isnan(u), held, u) if math.isnan(u.dot(u)) else None


def taken_inputs(history: FloatArray, held: FloatArray, u: FloatArray, *, is_first: bool) -> TakenInputs:
    """Return what inputs ``u (nu,)`` are taken as, where NaN is what is missing; ``held (nu,)``: those before."""
    if is_first:
        return TakenInputs(u, np.stack((u, u, *np.zeros((3, len(u))))), None, None)
    used = held_inputs(held, u)
    # Lists of few numbers are compared in a tenth of the time of arrays.
    lowest_yet, highest_yet, change_yet, absent, _ = history.tolist()
    if used is None and not any(absent):
        known = zip(lowest_yet, u.tolist(), highest_yet, held.tolist(), change_yet, strict=True)
        if all(low <= now <= high and abs(now - before) <= most for low, now, high, before, most in known):
            return TakenInputs(u, history, None, None)
        after = history.copy()
        np.minimum(history[0], u, out=after[0])
        np.maximum(history[1], u, out=after[1])
        np.maximum(history[2], np.abs(u - held), out=after[2])
        return TakenInputs(u, after, None, None)
    gone, used = np.isnan(u), u if used is None else used
    lowest, highest, change, count, off = history
    moved = np.abs(used - held)
    reach = np.minimum((count + 1.0) * change, highest - lowest)
    total = off + reach
    missing = np.where(gone, total * total - off * off, 0.0)
    further = ~gone & (count > 0.0) & (moved > reach)
    returned = np.where(further, np.maximum((count * moved) ** 2 - off * off, 0.0), 0.0)
    after = np.stack((np.minimum(lowest, used), np.maximum(highest, used), np.maximum(change, moved / (count + 1.0)),
                      np.where(gone, count + 1.0, 0.0), np.where(gone, total, 0.0)))  # fmt: skip
    return TakenInputs(used, after, missing, returned)


def over_samples(history: FloatArray, held: FloatArray, u: FloatArray) -> FloatArray:
    """Return the history after samples in which all inputs ``(samples, nu)`` are known."""
    moved = np.abs(np.diff(u, axis=0, prepend=held[None])).max(axis=0)
    return np.stack((np.minimum(history[0], u.min(axis=0)), np.maximum(history[1], u.max(axis=0)),
                     np.maximum(history[2], moved), history[3], history[4]))  # fmt: skip
