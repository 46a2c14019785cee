"""Batches of trials, for every observer that has one."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from obsynth.errors import SolverError, SpecError
from obsynth.numerics.arguments import arguments_worded
from obsynth.numerics.arrays import FloatArray, read_only
from obsynth.observers.estimates import Estimates
from obsynth.observers.linear.observer import LinearObserver
from obsynth.observers.nonlinear.c_code import BATCH_PARTS, compiler
from obsynth.observers.nonlinear.estimates import DAERow
from obsynth.observers.nonlinear.observer import DAEObserver, advanced
from obsynth.observers.progress import shown_progress
from obsynth.observers.records import batch_record
from obsynth.observers.recursive.batches import run_batch as run_recursive_batch
from obsynth.observers.recursive.observer import RecursiveObserver
from obsynth.observers.running import named_estimates

#: Samples in one call of the library: a second or less, so that progress shows and an interrupt takes effect.
BATCH_SAMPLES_PER_CALL = 100_000

#: Steps from which it pays to compile unasked: compiling takes about a second, and the rest thirty microseconds a step.
WORTH_COMPILING = 50_000


def run_dae_batch(
    observer: DAEObserver,
    y: ArrayLike,
    u: ArrayLike | None = None,
    *,
    compiled: bool | None = None,
    progress: bool | Callable[[int], None] | None = None,
) -> Estimates:
    """Run many trials; see `obsynth.run_batch` (``y (trials, samples, ny)``)."""
    outputs, inputs = batch_record(y, u, observer.model.ny, observer.model.input_names)
    trials, samples = outputs.shape[:2]
    not_in_c = observer.outside_graph
    if not_in_c and compiled:
        raise SpecError(
            f"The C code has no {not_in_c}: leave compiled=True out, or leave {not_in_c} out.", path="compiled"
        )
    if compiled is None and not not_in_c:
        compiled = trials * samples >= WORTH_COMPILING and compiler() is not None
    run_trials = _in_c if compiled else _in_casadi
    with shown_progress(progress, trials, "trials") as note:
        parts = run_trials(observer, outputs, inputs, note)
    received = ~np.isnan(outputs)
    return named_estimates(
        observer,
        states=parts["posterior"],
        faults=parts["theta"],
        residuals=parts["residual"],
        fault_covariances=parts["spread"],
        innovations=np.where(received, parts["innovation"], np.nan),
        nis=parts["nis"][..., 0],
        nis_degrees=received.sum(axis=2).astype(np.float64),
        received=received,
    )


def _of_trial(inputs: FloatArray, trials: slice | int) -> FloatArray:
    return inputs if inputs.ndim == 2 else inputs[trials]


def _in_c(observer: DAEObserver, y: FloatArray, u: FloatArray, note: Callable[[int], object]) -> dict[str, FloatArray]:
    """Return the records of all trials, run by the compiled library in chunks."""
    library, begin = observer.library, 0
    chunks: list[dict[str, FloatArray]] = []
    while begin < len(y):
        trials = slice(begin, min(begin + max(1, BATCH_SAMPLES_PER_CALL // y.shape[1]), len(y)))
        taken, parts = library.batch(y[trials], _of_trial(u, trials))
        chunks.append({name: part[:taken] for name, part in parts.items()})
        begin += taken
        if begin < trials.stop:
            # The C code stopped at this trial: run step by step it ends the same way, with a message.
            chunks.append({name: part[None] for name, part in _trial_alone(observer, y, u, begin).items()})
            begin += 1
        note(begin)
    return {name: np.concatenate([parts[name] for parts in chunks]) for name in BATCH_PARTS}


def _in_casadi(
    observer: DAEObserver, y: FloatArray, u: FloatArray, note: Callable[[int], object]
) -> dict[str, FloatArray]:
    trials_of_parts = []
    for trial in range(len(y)):
        trials_of_parts.append(_trial_alone(observer, y, u, trial))
        note(trial + 1)
    return {name: np.array([parts[name] for parts in trials_of_parts]) for name in BATCH_PARTS}


def _trial_alone(observer: DAEObserver, y: FloatArray, u: FloatArray, trial: int) -> dict[str, FloatArray]:
    """Return the record of one trial, run step by step; a `SolverError` names the trial."""
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


@arguments_worded(observer="the observer of a design (design.observer), not a guaranteed test's")
def run_batch(
    observer: LinearObserver | RecursiveObserver | DAEObserver,
    y: ArrayLike,
    u: ArrayLike | None = None,
    **options: Any,
) -> Estimates:
    """Run many trials with one observer.

    The gains of a recursive observer do not depend on data, so that a step is one product for all trials.  An observer
    of a DAE runs as C if that is faster and there is a compiler.

    Parameters
    ----------
    observer : LinearObserver, RecursiveObserver or DAEObserver
        At rest.
    y : array_like
        ``(trials, samples, ny)``.  NaN marks a missing sample for an observer of a DAE; records of the others must be
        complete.
    u : array_like, optional
        ``(trials, samples, nu)``, or ``(samples, nu)`` for all trials; may be left out when there are none.
    **options
        For an observer of a DAE: ``compiled``, whether it runs as C (always, never, or by default in large batches),
        and ``progress``, as in `DAEObserver.run`; a function is called with the number of trials that are done.

    Returns
    -------
    Estimates
        With an axis of trials before the samples; the same numbers as ``observer.run`` gives for each trial, up to
        rounding.  States, faults and innovations; of a DAE also covariances of the faults, NIS and residuals.

    Raises
    ------
    SpecError
        It is no such observer (but a whole design, say), shapes do not fit, an input is not finite, the record is
        longer than the horizon, or the observer resets.
    SolverError
        A step of a DAE has no solution; the trial, k and the worst equation are named.

    Examples
    --------
    >>> import obsynth
    >>> import numpy as np
    >>> plant = obsynth.DescriptorSystem(
    ...     A=[[0.9, 0.1], [0.0, 0.8]], C=[[1, 0], [0, 1]], Bf=[[1], [0]], Bd=[[0], [1]], dt=1.0
    ... )
    >>> design = obsynth.fault_estimation_filter(plant)
    >>> estimates = obsynth.run_batch(design.observer, np.zeros((5, 100, 2)))  # 5 records of 100 samples
    >>> estimates.faults.shape
    (5, 100, 1)
    """
    if isinstance(observer, LinearObserver):
        if options:
            raise SpecError(f"A linear observer has no {', '.join(options)}: leave it out.", path=min(options))
        return _one_by_one(observer, y, u)
    # The gains of a recursive observer that judges its samples depend on them.
    judges = isinstance(observer, RecursiveObserver) and observer.outliers != "none"
    if judges or not observer.is_plain:
        return _one_by_one(observer, y, u)
    if isinstance(observer, DAEObserver):
        return run_dae_batch(observer, y, u, **options)
    return run_recursive_batch(observer, y, u, **options)


def _one_by_one(
    observer: LinearObserver | RecursiveObserver | DAEObserver, y: ArrayLike, u: ArrayLike | None
) -> Estimates:
    """Run trials one after another: linear observers, sensors of their own times, bounds on states and judged samples
    need it."""
    signals: Any = observer if isinstance(observer, LinearObserver) else observer.plant
    is_linear = signals is observer
    outputs, inputs = batch_record(y, u, len(signals.output_names), signals.input_names)
    runs = [observer.run(outputs[i], _of_trial(inputs, i)) for i in range(len(outputs))]
    deviating = ("fault_covariances", "state_deviations", "nis", "nis_degrees")
    names = ("states", "faults", "residuals", *(() if is_linear else deviating))
    stacked: dict[str, Any] = {name: read_only(np.stack([getattr(run, name) for run in runs])) for name in names}
    if is_linear:
        return replace(runs[0], **stacked)
    width = max(run.innovations.shape[1] for run in runs)
    wide = [
        np.pad(run.innovations, ((0, 0), (0, width - run.innovations.shape[1])), constant_values=np.nan) for run in runs
    ]
    return replace(runs[0], **stacked, innovations=read_only(np.stack(wide)))
