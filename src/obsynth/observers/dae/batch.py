"""Batches of trials with one observer of a DAE."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import ArrayLike

from obsynth.errors import SolverError, SpecError
from obsynth.numerics.arrays import FloatArray
from obsynth.observers.dae.c_code import BATCH_PARTS
from obsynth.observers.dae.compiled_library import compiler
from obsynth.observers.dae.estimates import DAERow
from obsynth.observers.dae.observer import DAEObserver
from obsynth.observers.dae.records import advanced
from obsynth.observers.estimates import Estimates, named_estimates
from obsynth.observers.progress import shown_progress

#: Samples in one call of the library: a second or less, so that progress shows and an interrupt is heard.
SAMPLES_PER_CALL = 100_000
#: Steps from which it pays to compile unasked: compiling takes about a second, and the rest thirty microseconds a step.
WORTH_COMPILING = 50_000


def run_dae_batch(
    observer: DAEObserver, y: ArrayLike, u: ArrayLike | None = None, *, compiled: bool | None = None,
    progress: bool | Callable[[int], None] | None = None,
) -> Estimates:  # fmt: skip
    """Run many trials; see `obsynth.run_batch`: ``y (trials, samples, ny)``."""
    outputs, inputs = _checked(observer, y, u)
    trials, samples = outputs.shape[:2]
    alone = observer.outside_graph
    if alone and compiled:
        raise SpecError(f"The C knows no {alone}: leave compiled=True out, or leave {alone} out.", path="compiled")
    if compiled is None and not alone:
        compiled = trials * samples >= WORTH_COMPILING and compiler() is not None
    take = _in_c if compiled else _in_casadi
    with shown_progress(progress, trials, "trials") as note:
        parts = take(observer, outputs, inputs, note)
    received = ~np.isnan(outputs)
    return named_estimates(
        observer, states=parts["posterior"], faults=parts["theta"], residuals=parts["residual"],
        fault_covariances=parts["spread"], innovations=np.where(received, parts["innovation"], np.nan),
        nis=parts["nis"][..., 0], nis_degrees=received.sum(axis=2).astype(np.float64), received=received,
    )  # fmt: skip


def _checked(observer: DAEObserver, y: ArrayLike, u: ArrayLike | None) -> tuple[FloatArray, FloatArray]:
    model = observer.model
    outputs = np.asarray(y, dtype=np.float64)
    if outputs.ndim != 3 or outputs.shape[2] != model.ny or not outputs.size:
        raise SpecError(f"y has shape {outputs.shape}, but (trials, samples, {model.ny}) is needed.", path="y")
    if np.isinf(outputs).any():
        raise SpecError("y holds an infinity: mark a missing sample by NaN.", path="y")
    samples = outputs.shape[1]
    known = np.zeros((samples, 0)) if u is None and not model.nu else np.asarray(u, dtype=np.float64)
    if known.shape not in ((samples, model.nu), (len(outputs), samples, model.nu)):
        raise SpecError(f"u has shape {known.shape}, but (trials, samples, {model.nu}) is needed.", path="u")
    if not np.isfinite(known).all():
        *trial, k, i = np.argwhere(~np.isfinite(known))[0]
        where = f" of trial {trial[0]}" if trial else ""
        raise SpecError(f"The input {model.input_names[i]!r}{where} is {known[*trial, k, i]} at k = {k}: inputs must "
                        "be known.", path="u")  # fmt: skip
    return outputs, known


def _of_trial(inputs: FloatArray, trials: slice | int) -> FloatArray:
    return inputs if inputs.ndim == 2 else inputs[trials]


def _in_c(observer: DAEObserver, y: FloatArray, u: FloatArray, note: Callable[[int], object]) -> dict[str, FloatArray]:
    library, begin = observer.library, 0
    found: list[dict[str, FloatArray]] = []
    while begin < len(y):
        trials = slice(begin, min(begin + max(1, SAMPLES_PER_CALL // y.shape[1]), len(y)))
        taken, parts = library.batch(y[trials], _of_trial(u, trials))
        found.append({name: part[:taken] for name, part in parts.items()})
        begin += taken
        if begin < trials.stop:
            # The message is written there.
            found.append({name: part[None] for name, part in _one(observer, y, u, begin).items()})
            begin += 1
        note(begin)
    return {name: np.concatenate([parts[name] for parts in found]) for name in BATCH_PARTS}


def _in_casadi(
    observer: DAEObserver, y: FloatArray, u: FloatArray, note: Callable[[int], object]
) -> dict[str, FloatArray]:
    found = []
    for trial in range(len(y)):
        found.append(_one(observer, y, u, trial))
        note(trial + 1)
    return {name: np.array([parts[name] for parts in found]) for name in BATCH_PARTS}


def _one(observer: DAEObserver, y: FloatArray, u: FloatArray, trial: int) -> dict[str, FloatArray]:
    rows: list[DAERow] = []
    try:
        if observer.outside_graph:
            state = observer.steps.first
            for outputs, inputs in zip(y[trial], _of_trial(u, trial), strict=True):
                state, row = observer.steps.advance(state, outputs, inputs)
                rows.append(row)
        else:
            advanced(observer.steps, y[trial], _of_trial(u, trial), rows.append)
    except SolverError as error:
        raise SolverError(f"Trial {trial}: {error}", record={**error.record, "trial": trial}) from error
    return {name: np.concatenate([row.several.part(name) for row in rows]) for name in BATCH_PARTS}
