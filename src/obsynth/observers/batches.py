"""Batches of trials, for every observer that has one."""

from __future__ import annotations

from typing import Any

from numpy.typing import ArrayLike

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
    if isinstance(observer, DAEObserver):
        return run_dae_batch(observer, y, u, **options)
    return gain_schedule.run_batch(observer, y, u, **options)
