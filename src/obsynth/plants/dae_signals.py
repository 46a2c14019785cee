"""Inputs, initial values and steps with which a nonlinear plant runs, checked."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from obsynth.errors import SpecError, counted
from obsynth.numerics.arguments import real_array, real_number
from obsynth.numerics.arrays import FloatArray, as_given
from obsynth.numerics.quantities import in_seconds
from obsynth.plants.dae_fields import DAEFields


def step_length(dt: Any) -> float:
    """Return the seconds between samples; raise `SpecError` unless they are a positive number."""
    return real_number(in_seconds(dt, "dt"), "dt", "the seconds between samples, a positive number", above=0.0)


def checked_inputs(model: DAEFields, u: Any, samples: int | None = None) -> FloatArray:
    """Return known inputs ``(samples, nu)``; raise `SpecError` naming the signal and k where one is not finite."""
    if u is None and (model.nu or samples is None):
        raise SpecError(
            f"u is missing: the model has {counted(model.nu, 'input')}: {', '.join(model.input_names)}.", path="u"
        )
    raw = np.zeros((samples or 0, 0)) if u is None else as_given(u, "u", "u has rows of different lengths.")
    if raw.ndim == 1 and model.nu == 1:
        raw = raw[:, None]
    if raw.dtype.kind in "OUSbc" or raw.ndim != 2 or raw.shape[1] != model.nu:
        what = "no numbers" if raw.dtype.kind in "OUSbc" else f"of shape {raw.shape}"
        raise SpecError(f"u is {what}, but (samples, {model.nu}) numbers are needed.", path="u")
    array = raw.astype(np.float64)
    if not np.isfinite(array).all():
        k, i = np.argwhere(~np.isfinite(array))[0]
        raise SpecError(
            f"The input {model.input_names[i]!r} is {array[k, i]} at k = {k}: inputs must be known. Fill the gap, or "
            "make the signal a state with a sensor.",
            path="u",
        )
    if samples is not None and len(array) != samples:
        raise SpecError(f"u has {len(array)} samples and y has {samples}: give the same number.", path="u")
    return array


def finite_vector(value: Any, names: Sequence[str], default: FloatArray, what: str) -> FloatArray:
    """Return ``(len(names),)`` finite numbers, the default for ``None``; raise `SpecError` naming what is wrong."""
    if value is None:
        return np.array(default)
    try:
        vector = np.atleast_1d(real_array(value, what))
    except SpecError:
        raise SpecError(f"{what} must be {counted(len(names), 'finite number')}.", path=what) from None
    if vector.shape != (len(names),):
        raise SpecError(f"{what} must be {counted(len(names), 'finite number')}: {', '.join(names)}.", path=what)
    for name, entry in zip(names, vector, strict=True):
        if not np.isfinite(entry):
            raise SpecError(f"{what}.{name} is {entry}: give a finite number.", path=f"{what}.{name}")
    return vector
