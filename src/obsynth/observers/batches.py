"""Batches of trials, for every observer that has one."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from obsynth.errors import SpecError
from obsynth.numerics.arrays import read_only
from obsynth.observers.dae.batch import run_dae_batch
from obsynth.observers.dae.observer import DAEObserver
from obsynth.observers.estimates import Estimates
from obsynth.observers.recursive import gain_schedule
from obsynth.observers.recursive.observer import RecursiveObserver


def run_batch(
    observer: RecursiveObserver | DAEObserver, y: ArrayLike, u: ArrayLike | None = None, **options: Any
) -> Estimates:
    """Run many trials with one observer.

    The gains of a recursive observer do not depend on data, so that a step is one product for all trials.  An observer
    of a DAE runs as C where that pays and a compiler is there.

    Parameters
    ----------
    observer : RecursiveObserver or DAEObserver
        At rest.
    y : array_like
        ``(trials, samples, ny)``.  NaN marks a missing sample for an observer of a DAE; records of a recursive one must
        be complete.
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
        Shapes do not fit, an input is not finite, the record is longer than the horizon, or the observer resets.
    SolverError
        A step of a DAE has no solution; the trial, k and the worst equation are named.
    """
    # The gains of a recursive observer that judges its samples depend on them.
    judges = isinstance(observer, RecursiveObserver) and observer.outliers != "none"
    if judges or not observer.is_plain:
        return _one_by_one(observer, y, u)
    if isinstance(observer, DAEObserver):
        return run_dae_batch(observer, y, u, **options)
    return gain_schedule.run_batch(observer, y, u, **options)


def _one_by_one(observer: RecursiveObserver | DAEObserver, y: ArrayLike, u: ArrayLike | None) -> Estimates:
    """Run trials one after another: sensors of their own times, bounds on states and judged samples need it."""
    outputs, inputs = np.asarray(y, dtype=np.float64), None if u is None else np.asarray(u, dtype=np.float64)
    if outputs.ndim != 3 or not len(outputs):
        raise SpecError(f"y has shape {outputs.shape}, but (trials, samples, ny) is needed.", path="y")
    if inputs is not None and inputs.ndim == 3 and len(inputs) != len(outputs):
        raise SpecError(f"u has {len(inputs)} trials and y has {len(outputs)}: give the same number.", path="u")
    found = [
        observer.run(outputs[i], inputs if inputs is None or inputs.ndim == 2 else inputs[i])
        for i in range(len(outputs))
    ]
    names = ("states", "faults", "fault_covariances", "state_deviations", "nis", "nis_degrees", "residuals")
    stacked = {name: read_only(np.stack([getattr(each, name) for each in found])) for name in names}
    width = max(each.innovations.shape[1] for each in found)
    wide = [np.pad(each.innovations, ((0, 0), (0, width - each.innovations.shape[1])), constant_values=np.nan)
            for each in found]  # fmt: skip
    changes: dict[str, Any] = {**stacked, "innovations": read_only(np.stack(wide))}
    return replace(found[0], **changes)
