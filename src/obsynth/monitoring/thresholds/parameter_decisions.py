"""Deciding that a parameter has changed: four statistics with analytic thresholds for a whole run.

Under the hypothesis that theta is nominal, ``eps_k = v_k - G_k theta`` is white, N(0, I).  Thresholds are chosen such
that a run of N samples raises a false alarm with at most about the stated probability.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Literal, TypeAlias, cast

import numpy as np
from numpy.typing import ArrayLike, NDArray

from obsynth.errors import SpecError
from obsynth.monitoring.thresholds.change_statistics import alone, tail, weighted_squares
from obsynth.monitoring.thresholds.jump_likelihood import initial_parameter_response, likelihood_ratio
from obsynth.monitoring.thresholds.parameter_rule import (
    WALKING_FORMS,
    ParameterObserver,
    ParameterRule,
    ParameterRuleState,
)
from obsynth.numerics.arguments import arguments_worded, check_fields, real_array, real_number, real_vector
from obsynth.numerics.arrays import FloatArray, read_only
from obsynth.numerics.suggestions import fields_suggested
from obsynth.observers.detection import Alarm, Decision
from obsynth.observers.estimates import Estimates
from obsynth.observers.nonlinear.observer import DAEObserver
from obsynth.observers.recursive.observer import RecursiveObserver

Statistic: TypeAlias = Literal["chi-square", "cusum", "glr", "nis"]


@arguments_worded(
    observer="the recursive or nonlinear observer of a design (design.observer). Linear designs and guaranteed tests "
    "are monitored by their residual: obsynth.monitor(design, scenario) for a record, obsynth.online_monitor(design, "
    "...) for data of any length"
)
def decide(
    observer: ParameterObserver,
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
    false_alarms = float(false_alarms)
    if (estimates.state_names, estimates.parameter_names) != (observer.state_names, observer.fault_names):
        raise SpecError(
            "The estimates are of other states or parameters than this observer's: give the run of this very observer.",
            path="estimates",
        )
    if not len(estimates.states):
        return Decision(statistic, read_only(np.zeros(0)), read_only(np.zeros(0)), None)
    if statistic == "glr":
        gaps = estimates.innovations - estimates.regressors @ theta
        return likelihood_ratio(cast(RecursiveObserver, observer), estimates, gaps, false_alarms)
    rule = ParameterRule(statistic, theta, size, false_alarms, samples=len(estimates.states))
    judged = {"chi-square": _chi_square, "cusum": _cusum, "nis": _nis}[statistic]
    return judged(rule, observer, estimates)


def _nominal_and_change(
    observer: ParameterObserver,
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


@fields_suggested
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

    def watch(self, observer: ParameterObserver, estimates: Estimates) -> Decision:
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


def _chi_square(rule: ParameterRule, observer: ParameterObserver, estimates: Estimates) -> Decision:
    """Decide by the distance of the parameters from their nominal values, in the metric of their covariance."""
    gaps, nq = estimates.parameters - rule.nominal, len(rule.nominal)
    start = observer.initial_parameters - rule.nominal
    if start.any():
        # Where the observer starts is no evidence: only what data have said since may raise an alarm.
        if isinstance(observer, DAEObserver):
            raise SpecError(
                "chi-square of a nonlinear observer asks about the parameters that it starts from: design "
                "it with initial_parameters at what is nominal.",
                path="nominal",
            )
        gaps = gaps - initial_parameter_response(observer, estimates, start)
    values = weighted_squares(gaps, estimates.parameter_covariances)
    decision, k = _passed("chi-square", values, np.full(len(values), rule.limit(rule.init())))
    if k is None:
        return decision
    # The last sample at which the statistic was what it is without a change, on average or less.
    quiet = np.flatnonzero(values[:k] <= nq)
    onset = int(quiet[-1]) + 1 if quiet.size else 0
    confidence = 1.0 - min(1.0, rule.looks_of_record * float(tail(np.array(float(nq)), values[k])))
    name = estimates.parameter_names[rule.moved(gaps[k], estimates.parameter_covariances[k])]
    return replace(decision, alarm=Alarm(k, name, onset, confidence, float(values[k])))


def _nis(rule: ParameterRule, observer: ParameterObserver, estimates: Estimates) -> Decision:
    """Decide by the squared innovations of the latest samples."""
    states, values = _scanned(rule, observer, estimates)
    decision, k = _passed("nis", values, np.array([rule.limit(state) for state in states]))
    if k is None:
        return decision
    state = states[k]
    confidence = 1.0 - min(1.0, rule.looks_of_record * float(tail(np.array(float(sum(state.degrees))), values[k])))
    # The split of the window after which the squares are largest against their degrees of freedom.
    excess = np.cumsum((np.array(state.squares) - state.degrees)[::-1])[::-1]
    onset = k + 1 - len(state.squares) + int(np.argmax(excess))
    return replace(decision, alarm=Alarm(k, "", onset, confidence, float(values[k])))


def _cusum(rule: ParameterRule, observer: ParameterObserver, estimates: Estimates) -> Decision:
    """Decide by sums of log likelihood ratios, from scores at the nominal parameters and their variances."""
    states, values = _scanned(rule, observer, estimates)
    decision, k = _passed("cusum", values, np.full(len(values), rule.limit(rule.init())))
    if k is None:
        return decision
    levels = np.stack([state.levels for state in states[: k + 1]])
    largest = int(np.argmax(levels[k]))
    onset = int(np.max(np.flatnonzero(levels[:, largest] == 0.0), initial=-1)) + 1
    confidence = 1.0 - min(1.0, levels.shape[1] * rule.looks_of_record * float(np.exp(-values[k])))
    rows = [RecordedRow(observer, estimates, i) for i in range(onset, k + 1)]
    along = sum((row.score - row.information @ rule.nominal for row in rows), np.zeros(len(rule.nominal)))
    squares = sum((np.diag(row.information) for row in rows), np.zeros(len(rule.nominal)))
    name = estimates.parameter_names[alone(along, squares)]
    return replace(decision, alarm=Alarm(k, name, onset, confidence, float(values[k])))


def _scanned(
    rule: ParameterRule, observer: ParameterObserver, estimates: Estimates
) -> tuple[list[ParameterRuleState], FloatArray]:
    """Return the states of a rule after each sample of a record, and its statistic ``(samples,)``."""
    states, values, state = list[ParameterRuleState](), np.zeros(len(estimates.states)), rule.init()
    for k in range(len(values)):
        state, (values[k], _) = rule.fold(state, RecordedRow(observer, estimates, k))
        states.append(state)
    return states, values


def _passed(statistic: str, values: FloatArray, thresholds: FloatArray) -> tuple[Decision, int | None]:
    """Return a decision without its alarm, and the first sample at which the threshold is passed."""
    hits = np.flatnonzero(values > thresholds)
    decision = Decision(statistic, read_only(values), read_only(thresholds), None)
    return decision, int(hits[0]) if hits.size else None


@dataclass(frozen=True, eq=False)
class RecordedRow:
    """A sample of recorded estimates, as `ParameterRule` takes what an observer says of it."""

    observer: ParameterObserver
    estimates: Estimates
    k: int

    @property
    def theta(self) -> FloatArray:
        """The estimates of the parameters ``(nq,)``."""
        return np.asarray(self.estimates.parameters[self.k])

    @property
    def parameter_covariance(self) -> FloatArray:
        """Their covariance ``(nq, nq)``."""
        return np.asarray(self.estimates.parameter_covariances[self.k])

    @cached_property
    def _known(self) -> NDArray[np.bool_]:
        """Which innovations of a recursive observer are there."""
        return np.asarray(~np.isnan(self.estimates.innovations[self.k]))

    @property
    def whitened(self) -> FloatArray:
        """The innovation in units of its standard deviations; of a nonlinear observer one of the same length."""
        if isinstance(self.observer, DAEObserver):
            white = np.zeros(int(self.estimates.nis_degrees[self.k]))
            white[:1] = np.sqrt(self.estimates.nis[self.k])
            return white
        return np.asarray(self.estimates.innovations[self.k][self._known])

    @property
    def regressor(self) -> FloatArray:
        """How the parameters enter it ``(m, nq)``; ``(m, 0)`` where they are in the model."""
        if isinstance(self.observer, DAEObserver) or self.observer.form == "random-walk":
            return np.zeros((len(self.whitened), 0))
        return np.asarray(self.estimates.regressors[self.k][self._known])

    @property
    def score(self) -> FloatArray:
        """What the sample says of the parameters ``(nq,)``."""
        if isinstance(self.observer, DAEObserver):
            return np.asarray(self.estimates.scores[self.k])
        return np.asarray(self.regressor.T @ self.whitened)

    @property
    def information(self) -> FloatArray:
        """How much it says of them ``(nq, nq)``."""
        if isinstance(self.observer, DAEObserver):
            return np.asarray(self.estimates.informations[self.k])
        return np.asarray(self.regressor.T @ self.regressor)
