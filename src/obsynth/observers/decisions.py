"""Deciding that a parameter has changed: four statistics with analytic thresholds for a whole run.

Under the hypothesis that theta is nominal, ``eps_k = v_k - G_k theta`` is white, N(0, I).  Thresholds are chosen such
that a run of N samples raises a false alarm with at most about the stated probability.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Literal, TypeAlias

import numpy as np
from numpy.typing import ArrayLike

from obsynth.errors import SpecError
from obsynth.numerics.arguments import arguments_worded, check_fields, real_array, real_number, real_vector
from obsynth.numerics.arrays import FloatArray, read_only
from obsynth.observers.estimates import Estimates
from obsynth.observers.nonlinear.observer import DAEObserver
from obsynth.observers.parameter_alarms import (
    Alarm,
    Decision,
    alone,
    initial_parameter_response,
    likelihood_ratio,
    quantile,
    tail,
    two_sided_sums,
)
from obsynth.observers.recursive.observer import RecursiveObserver

Statistic: TypeAlias = Literal["chi-square", "cusum", "glr", "nis"]

#: Forms whose parameters are states: their samples say nothing of parameters that stay as they are.
WALKING_FORMS = ("random-walk", "augmented-kalman")

#: Samples that the NIS sums up: the choice that its threshold was tried with.
NIS_WINDOW = 20

#: Correlated looks count as this share of independent ones: measured false-alarm rates stay below what is asked.
NIS_LOOKS = 1.0 / 2.0


@arguments_worded(
    observer="the recursive or nonlinear observer of a design (design.observer). Linear designs and guaranteed tests "
    "are monitored by their residual: obsynth.monitor(design, scenario) for a record, obsynth.online_monitor(design, "
    "...) for data of any length"
)
def decide(
    observer: RecursiveObserver | DAEObserver,
    estimates: Estimates,
    *,
    statistic: Statistic = "chi-square",
    nominal: ArrayLike | None = None,
    false_alarms: float = 0.01,
    change: ArrayLike = 0.1,
) -> Decision:
    r"""Decide whether a parameter has left its nominal value.

    Parameters
    ----------
    observer : RecursiveObserver or DAEObserver
        That gave the estimates, with parameters (a filter without any knows the ``nis`` alone).  Of a nonlinear one
        thresholds hold to first order in the errors.
    estimates : Estimates
        Of a whole run.
    statistic : {"chi-square", "cusum", "glr", "nis"}, optional
        ``chi-square`` on theta against its nominal value, with its covariance (default); ``cusum`` for small
        changes; ``glr`` with restarted signatures for abrupt ones (recursive observers); ``nis`` for all that the model
        does not explain.
    nominal : array_like, optional
        ``(nq,)``: nominal parameters; the observer's initial ones by default.
    false_alarms : float, optional, dimensionless
        Probability of a false alarm in the whole run.
    change : array_like, optional
        Change that ``cusum`` is tuned for, in parameter units; one number or ``(nq,)``.

    Returns
    -------
    Decision
        The statistic at every sample, its threshold, and the first alarm with parameter, onset and confidence.

    Raises
    ------
    SpecError
        It is no such observer, the statistic is unknown or does not go with the observer's form, an option is out of
        range, or the estimates are of another observer.

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
    >>> design = obsynth.adaptive_observer(plant, Q=1e-4, R=1e-2, forgetting=0.95)
    >>> scenario = obsynth.Scenario(horizon=99, faults={"leak": obsynth.Step(size=0.5, start=40)}, noise=1.0)
    >>> run = obsynth.simulate(design, scenario)
    >>> decision = obsynth.decide(design.observer, run.estimates, nominal=[0.0], false_alarms=0.01)
    >>> decision.alarm.parameter
    'leak'
    """
    theta, size = _nominal_and_change(observer, statistic, nominal, false_alarms, change)
    nq, false_alarms = len(theta), float(false_alarms)
    if (estimates.state_names, estimates.parameter_names) != (observer.state_names, observer.fault_names):
        raise SpecError(
            "The estimates are of other states or parameters than this observer's: give the run of this very observer.",
            path="estimates",
        )
    if not len(estimates.states):
        return Decision(statistic, read_only(np.zeros(0)), read_only(np.zeros(0)), None)
    if statistic == "chi-square":
        return _chi_square(observer, estimates, theta, false_alarms)
    if isinstance(observer, DAEObserver):
        if statistic == "nis":
            return _nis(estimates, np.array(estimates.nis), false_alarms)
        along = estimates.scores - estimates.informations @ theta
        return _cusum(estimates, along, np.einsum("kqq->kq", estimates.informations), size, false_alarms)
    gaps = estimates.innovations
    if nq and observer.form != "random-walk":
        gaps = gaps - estimates.regressors @ theta
    if statistic == "nis":
        return _nis(estimates, np.nansum(gaps**2, axis=1), false_alarms)
    if statistic == "cusum":
        regressors = np.nan_to_num(estimates.regressors)
        along = np.einsum("kmq,km->kq", regressors, np.nan_to_num(gaps))
        return _cusum(estimates, along, np.einsum("kmq,kmq->kq", regressors, regressors), size, false_alarms)
    return likelihood_ratio(observer, estimates, gaps, false_alarms)


def _nominal_and_change(
    observer: RecursiveObserver | DAEObserver,
    statistic: str,
    nominal: ArrayLike | None,
    false_alarms: float,
    change: ArrayLike,
) -> tuple[FloatArray, FloatArray]:
    """Return nominal parameters and the change looked for, ``(nq,)``; refuse what the observer cannot answer."""
    start, form = observer.initial_parameters, observer.form
    if not len(start) and statistic != "nis":
        raise SpecError(
            "A decision on parameters needs an observer that estimates them; of a filter alone, statistic "
            "'nis' tests whether the model still fits the data.",
            path="observer",
        )
    real_number(false_alarms, "false_alarms", "a probability between 0 and 1", above=0.0, below=1.0)
    if form in WALKING_FORMS and statistic in ("cusum", "glr"):
        raise SpecError(
            f"{statistic} needs regressors, which form {form!r} does not have: use a form with a forgetting factor.",
            path="statistic",
        )
    if isinstance(observer, DAEObserver) and statistic == "glr":
        raise SpecError(
            "glr restarts signatures, which nonlinear observers do not carry: use chi-square, cusum or nis.",
            path="statistic",
        )
    nq = len(start)
    theta = start if nominal is None else real_vector(nominal, nq, "nominal")
    size = real_array(change, "change")
    size = np.broadcast_to(size, (nq,)) if size.ndim == 0 else size
    if size.shape != (nq,) or not ((size > 0.0) & (size < np.inf)).all():
        raise SpecError(f"change must be one positive number, or {nq}.", path="change")
    return theta, size


@dataclass(frozen=True)
class ParameterMonitor:
    """How decisions on parameters are made in every run: the options of `obsynth.decide`.

    Parameters
    ----------
    statistic : {"chi-square", "cusum", "glr", "nis"}, optional
        As for `obsynth.decide`.
    nominal : tuple of float, optional
        ``(nq,)``: nominal parameters; the observer's initial ones by default.
    false_alarms : float, optional, dimensionless
        Probability of a false alarm in a whole run.
    change : float or tuple of float, optional
        Change that ``cusum`` is tuned for, in parameter units; 0.1 by default.

    Raises
    ------
    SpecError
        The statistic is unknown, or a change is given for another one than ``cusum``.
    """

    statistic: Statistic = "chi-square"
    nominal: tuple[float, ...] | None = None
    false_alarms: float = 0.01
    change: float | tuple[float, ...] | None = None

    def __post_init__(self) -> None:
        check_fields(self, ParameterMonitor)
        if self.change is not None and self.statistic != "cusum":
            raise SpecError(f"change is for cusum, not for {self.statistic}: leave it out.", path="change")

    def watch(self, observer: RecursiveObserver | DAEObserver, estimates: Estimates) -> Decision:
        """Return the decision on one run.

        Parameters
        ----------
        observer : RecursiveObserver or DAEObserver
            That gave the estimates.
        estimates : Estimates
            Of a whole run.

        Raises
        ------
        SpecError
            As for `obsynth.decide`.
        """
        return decide(observer, estimates, **{name: value for name, value in vars(self).items() if value is not None})


def _chi_square(
    observer: RecursiveObserver | DAEObserver, estimates: Estimates, nominal: FloatArray, false_alarms: float
) -> Decision:
    gaps, nq = estimates.parameters - nominal, len(nominal)
    start = observer.initial_parameters - nominal
    if start.any():
        # Where the observer starts is no evidence: only what data have said since may raise an alarm.
        if isinstance(observer, DAEObserver):
            raise SpecError(
                "chi-square of a nonlinear observer asks about the parameters that it starts from: design "
                "it with initial_parameters at what is nominal.",
                path="nominal",
            )
        gaps = gaps - initial_parameter_response(observer, estimates, start)
    values = np.einsum("ki,kij,kj->k", gaps, np.linalg.pinv(estimates.parameter_covariances, hermitian=True), gaps)
    looks = len(values)
    thresholds = np.full(looks, float(quantile(np.array(float(nq)), false_alarms / looks)))
    found = Decision("chi-square", read_only(values), read_only(thresholds), None)
    hits = np.flatnonzero(values > thresholds)
    if not hits.size:
        return found
    k = int(hits[0])
    weights = np.linalg.pinv(estimates.parameter_covariances[k], hermitian=True)
    # The last sample at which the statistic was what it is without a change, on average or less.
    quiet = np.flatnonzero(values[:k] <= nq)
    onset = int(quiet[-1]) + 1 if quiet.size else 0
    confidence = 1.0 - min(1.0, looks * float(tail(np.array(float(nq)), values[k])))
    name = estimates.parameter_names[alone(weights @ gaps[k], np.diag(weights))]
    return replace(found, alarm=Alarm(k, name, onset, confidence, float(values[k])))


def _nis(estimates: Estimates, squares: FloatArray, false_alarms: float) -> Decision:
    samples = len(squares)
    window = np.ones(min(NIS_WINDOW, samples))
    values = np.convolve(squares, window)[:samples]
    degrees = np.convolve(estimates.nis_degrees, window)[:samples]
    looks = max(samples * NIS_LOOKS, 1.0)
    thresholds = quantile(degrees, min(false_alarms / looks, 1.0))
    hits = np.flatnonzero(values > thresholds)
    alarm = None
    if hits.size:
        k = int(hits[0])
        confidence = 1.0 - min(1.0, looks * float(tail(degrees[k], values[k])))
        first = max(k - NIS_WINDOW + 1, 0)
        # The split of the window after which the squares are largest against their degrees of freedom.
        excess = np.cumsum((squares - estimates.nis_degrees)[first : k + 1][::-1])[::-1]
        alarm = Alarm(k, "", first + int(np.argmax(excess)), confidence, float(values[k]))
    return Decision("nis", read_only(values), read_only(thresholds), alarm)


def _cusum(
    estimates: Estimates, along: FloatArray, squares: FloatArray, change: FloatArray, false_alarms: float
) -> Decision:
    """Decide by sums of log likelihood ratios, from scores at the nominal parameters and their variances."""
    samples, nq = along.shape
    threshold = float(np.log(2.0 * nq * samples / false_alarms))
    level, started, values, alarm = np.zeros(2 * nq), np.zeros(2 * nq, dtype=np.int64), np.zeros(samples), None
    for k in range(samples):
        level = two_sided_sums(level, along[k], squares[k], change)
        started[level == 0.0] = k + 1
        values[k] = level.max()
        if alarm is None and values[k] > threshold:
            which = int(np.argmax(level))
            confidence = 1.0 - min(1.0, 2.0 * nq * samples * float(np.exp(-values[k])))
            since = slice(int(started[which]), k + 1)
            name = estimates.parameter_names[alone(along[since].sum(axis=0), squares[since].sum(axis=0))]
            alarm = Alarm(k, name, int(started[which]), confidence, float(values[k]))
    return Decision("cusum", read_only(values), read_only(np.full(samples, threshold)), alarm)
