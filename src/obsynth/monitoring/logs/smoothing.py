"""Smoothing of recorded logs: estimates from what came later as well, on arrays and on logs."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from obsynth.errors import SpecError
from obsynth.monitoring.logs.clock import STALE
from obsynth.monitoring.logs.log_observer import LogObserver, Row
from obsynth.monitoring.logs.log_run import LogRun
from obsynth.monitoring.logs.signals import TIME_HEADER
from obsynth.monitoring.logs.sources import samples
from obsynth.monitoring.logs.step_observer import SteppingLogObserver
from obsynth.numerics.arguments import arguments_checked
from obsynth.numerics.arrays import read_only
from obsynth.observers.changed_options import changed
from obsynth.observers.estimates import Estimates
from obsynth.observers.linear.observer import LinearObserver
from obsynth.observers.nonlinear.region_observer import RegionObserver
from obsynth.observers.recursive.sample import deviations_in
from obsynth.observers.scheduled.observer import ScheduledObserver
from obsynth.observers.smoothing import (
    checked_lag,
    linearisation_of,
    parameters_of,
    smoothed_estimates,
    smoothed_record,
)
from obsynth.observers.smoothing_chain import Smoothed, SmootherHistory
from obsynth.results.design import ObserverDesign


class LaterRows:
    """Rows of a log that wait ``lag`` samples for those after them; ``None``: until the end."""

    def __init__(self, observer: LogObserver, lag: int | None) -> None:
        if not isinstance(observer, SteppingLogObserver):
            raise SpecError(
                "Smoothing is for recursive and nonlinear designs, whose covariances relate later samples to earlier "
                "ones: design a descriptor-kalman, adaptive-observer or dae-adaptive-observer.",
                path="smooth",
            )
        self.logged, self.lag = observer, checked_lag(lag)
        self.chain = observer.chain = SmootherHistory(linearisation_of(observer.observer))
        #: With the sample of the chain that each is.
        self.waiting = list[tuple[Row, int]]()

    def take(self, row: Row) -> Iterator[tuple[Row, Any, Smoothed]]:
        """Take a row after its step; yield those that are smoothed now, with what the observer said of them."""
        if self.logged.chain is not None and self.logged.chain is not self.chain:
            # The observer has started again: what comes says nothing of what was.
            yield from self.flush()
            self.chain = self.logged.chain
        chain = self.chain
        self.waiting.append((row, chain.last))
        if self.lag is None:
            return
        while (k := self.waiting[0][1]) + self.lag <= chain.last:
            yield self._smoothed_row(*self.waiting.pop(0), chain.smoothed(k, k + self.lag)[0])
        # A late value changes what is known since its own time.
        chain.drop_before(min(k, chain.last - self.logged.observer.timing.longest))

    def flush(self) -> Iterator[tuple[Row, Any, Smoothed]]:
        """Yield the rows that wait, smoothed by as many samples as there are."""
        waiting, self.waiting = self.waiting, []
        if not waiting:
            return
        first = waiting[0][1]
        smoothed = self.chain.smoothed(first, waiting[-1][1])
        for row, k in waiting:
            yield self._smoothed_row(row, k, smoothed[k - first])

    def _smoothed_row(self, row: Row, k: int, smoothed: Smoothed) -> tuple[Row, Any, Smoothed]:
        nx = len(self.logged.state_names)
        if row.status in STALE:
            return row, self.chain.row(k), smoothed
        theta, spread = parameters_of(smoothed, nx)
        own = (
            smoothed.x[:nx],
            theta,
            deviations_in(smoothed.factor, smoothed.diffuse)[:nx],
            np.sqrt(np.einsum("ij,ij->i", spread, spread)),
        )
        estimated = np.concatenate(own)
        values = np.concatenate((estimated, row.values[len(estimated) :]))
        return row._replace(values=values), self.chain.row(k), smoothed


@arguments_checked
def smooth(
    design: ObserverDesign,
    data: Any,
    u: ArrayLike | None = None,
    *,
    lag: int | None = None,
    columns: Mapping[str, str] | None = None,
    time_column: str | None = None,
    scales: Mapping[str, float] | None = None,
    outliers: str | None = None,
) -> Estimates:
    r"""Estimate each sample of a record from those after it as well.

    A filter knows the past; a log is mostly read afterwards.  With ``x_k = m_k + F_k c_k``, where ``F_k F_k'`` is the
    filter's covariance and ``c_k ~ N(0, I)``, the orthogonal factorisations of a step give ``c_k`` from ``c_{k+1}``:

    .. math::
        c_k = j_k + J_k c_{k+1} + N_k b, \quad b \sim N(0, I)

    so that what is known in the end is carried back by products alone.  Smoothed deviations are never above those of
    the filter.

    Parameters
    ----------
    design : ObserverDesign
        Of the methods ``descriptor-kalman``, ``adaptive-observer`` or ``dae-adaptive-observer``.
    data : array_like, tuple of two arrays, path, text stream or pandas.DataFrame
        Outputs ``(samples, ny)``, NaN where a sample is missing, or outputs and inputs; or a log as `run_on_data`
        takes it, in the signals' units.
    u : array_like, optional
        Known inputs ``(samples, nu)`` beside an array of outputs.
    lag : int, optional
        Samples that are waited for: the estimate at k is the one from samples up to ``k + lag`` (as many as there are,
        at the end).  By default the whole record.
    columns, time_column, scales : optional
        Of a log, as `run_on_data` takes them.
    outliers : {"gate", "huber", "none"}, optional
        What is done with a sample that its prediction excludes; by default what the design says, and for logs a gate
        where it says nothing.  The smoother takes what the filter took.

    Returns
    -------
    Estimates
        One row per sample (of a log: per row of it, with the operating point added back).  States, parameters and their
        deviations are smoothed; innovations and what belongs to them are the filter's.

    Raises
    ------
    SpecError
        The design is of another method, shapes do not fit, ``lag`` is no positive number, or the whole record of a
        stream is asked for; a log has irregular time stamps (the row is named).
    PreconditionError
        Form ``literal``, whose residuals are correlated in time; rank H_k is lost at some k.

    Notes
    -----
    Rauch, Tung and Striebel need the inverse of the predicted covariance; here nothing is inverted but triangles, so
    that E, Q, R and P_0 may be singular.  States that missing samples leave undetermined keep infinite deviations only
    if nothing later determines them.

    Parameters: as states where they walk.  Forms with a forgetting factor lambda weigh samples before and after k by
    ``lambda ** |j - k|``, with the covariance that this estimate has while the parameters are constant; for
    ``lambda = 1`` it is the least-squares estimate from the whole record.  Behind a reset nothing is carried.

    Nonlinear designs are linearised along the filter's estimates (the extended smoother), which is exact for linear
    plants; forms ``random-walk`` and ``augmented-kalman`` take states and parameters together.  Bounds of parameters
    cut the estimates, bounds of states project them, and both leave covariances as they are.

    References
    ----------
    .. [RauchTungStriebel1965] Maximum likelihood estimates of linear dynamic systems, AIAA Journal 3 (8), 1445-1450.
    .. [Paige1977] Paige, Saunders, Least squares estimation of discrete linear dynamic systems using orthogonal
       transformations, SIAM Journal on Numerical Analysis 14 (2), 180-193: the square-root form; ours keeps the way
       back of each step instead of one large factorisation, and lets E be singular.

    Examples
    --------
    >>> import obsynth
    >>> plant = obsynth.TimeVaryingDescriptorSystem(
    ...     E=None,
    ...     A=[["0.9 + 0.05 * sin(k)"]],
    ...     C=[[1.0]],
    ...     Phi=[[1.0]],
    ...     dt=1.0,
    ...     horizon=100,
    ...     parameter_names=["leak"],
    ... )
    >>> design = obsynth.adaptive_observer(plant, Q=1e-4, R=1e-2, form="random-walk", random_walk=[[1e-4]])
    >>> run = obsynth.simulate(design, obsynth.Scenario(horizon=99, noise=1.0))
    >>> smoothed = obsynth.smooth(design, run.outputs)
    >>> bool((smoothed.parameter_deviations[50] < run.estimates.parameter_deviations[50]).all())
    True
    """
    waited = checked_lag(lag)
    if isinstance(design.observer, (LinearObserver, RegionObserver, ScheduledObserver)):
        # The same refusal as on logs.
        LaterRows(LogRun(design).observer, waited)
    if isinstance(data, str) or any(hasattr(data, name) for name in ("__fspath__", "readline", "columns")):
        if u is not None:
            raise SpecError("u is for arrays: a log has the inputs in its columns.", path="u")
        if waited is None and hasattr(data, "readline"):
            raise SpecError("A stream has no end: give a lag, or the whole log as a file.", path="lag")
        if time_column is not None:
            columns = {**(columns or {}), TIME_HEADER: time_column}
        return _smoothed_log(LogRun(design, columns, scales, outliers=outliers), data, waited)
    if columns or scales or time_column:
        raise SpecError(
            "columns, time_column and scales are for logs: arrays have their signals in order.", path="columns"
        )
    observer: Any = design.observer
    if outliers is not None:
        observer = changed(observer, outliers=outliers)
    if isinstance(data, tuple) and len(data) == 2 and u is None and np.ndim(data[0]) == 2:
        data, u = data
    return smoothed_record(observer, data, u, waited)


def _smoothed_log(run: LogRun, data: Any, lag: int | None) -> Estimates:
    later = LaterRows(run.observer, lag)
    smoothed_rows: list[tuple[Row, Any, Smoothed]] = []
    for time, deviations in samples(data, run.signals):
        smoothed_rows.extend(later.take(run.estimates([time], deviations[None])[0]))
    smoothed_rows.extend(later.flush())
    estimates = smoothed_estimates(
        later.logged.observer, [row for _, row, _ in smoothed_rows], [sample for _, _, sample in smoothed_rows]
    )
    point = run.signals.estimates_point(run.observer)
    nx, nq = len(run.observer.state_names), len(run.observer.fault_names)
    return replace(
        estimates,
        states=read_only(estimates.states + point[:nx]),
        faults=read_only(estimates.faults + point[nx : nx + nq]),
    )
