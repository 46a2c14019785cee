"""Parameters against nominal values, or innovations against what noise explains: the rule of rows and of records."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any, NamedTuple, Protocol, TypeAlias, cast

import numpy as np

from obsynth.errors import SpecError
from obsynth.monitoring.thresholds.change_statistics import alone, quantile, two_sided_sums, weighted_squares
from obsynth.monitoring.thresholds.monitor import Monitor, Rule, RuleOutput, Sample
from obsynth.monitoring.thresholds.rules import ANY_LENGTH, NOT_DECIDED, share_of_look
from obsynth.numerics.arguments import real_number
from obsynth.numerics.arrays import FloatArray
from obsynth.observers.nonlinear.observer import DAEObserver
from obsynth.observers.recursive.observer import RecursiveObserver
from obsynth.plants.signal_names import index_of

#: Forms whose parameters are states: their samples say nothing of parameters that stay as they are.
WALKING_FORMS = ("random-walk", "augmented-kalman")

#: Samples that the NIS sums up: the choice that its threshold was tried with.
NIS_WINDOW = 20

#: Correlated looks of a record count as this share of independent ones: measured rates of false alarms stay below what
#: is asked.
LOOKS = {"chi-square": 1.0, "cusum": 1.0, "nis": 1.0 / 2.0}

PARAMETER_KINDS = ("chi-square", "cusum", "nis")

_STATEMENTS = {
    "chi-square": "distance of the parameters from their nominal values in the metric of their covariance: passed in a "
    "run without a change with a probability of {} at most, for Gaussian noise as stated",
    "cusum": "cumulative sum of the whitened innovation for a change of the stated size: passed in a run without a "
    "change with a probability of {} at most, for Gaussian noise as stated",
    "nis": "squared innovations of 20 samples: passed in a run of the plant as modelled with a probability of {} at "
    "most, for Gaussian noise as stated",
}

ParameterObserver: TypeAlias = RecursiveObserver | DAEObserver


class ParameterEvidence(Protocol):
    """What a row of an observer says of its parameters."""

    @property
    def theta(self) -> FloatArray:
        """Their estimates ``(nq,)``."""

    @property
    def parameter_covariance(self) -> FloatArray:
        """Covariance of `theta` ``(nq, nq)``."""

    @property
    def score(self) -> FloatArray:
        """What the sample says of them ``(nq,)``."""

    @property
    def information(self) -> FloatArray:
        """How much it says of them ``(nq, nq)``."""

    @property
    def whitened(self) -> FloatArray:
        """The innovation in units of its standard deviations ``(m,)``."""

    @property
    def regressor(self) -> FloatArray:
        """How the parameters enter it, ``(m, nq)``; ``(m, 0)`` where they are in the model."""


class ParameterRuleState(NamedTuple):
    """The state of `ParameterRule`."""

    levels: FloatArray  # ``(2 nq,)``: cumulative sums
    looks: int = 0
    squares: tuple[float, ...] = ()  # of the latest innovations, and how many numbers each has
    degrees: tuple[int, ...] = ()


class ParameterRule(Rule):
    """Parameters against nominal values, or innovations against what noise explains; ``samples``: of a record, without
    which a run may have any length. ``chi-square`` of theta by its covariance; ``cusum`` of the innovations for a
    ``change (nq,)``; ``nis``, squares of the innovations over 20 samples, for all that the model does not explain."""

    def __init__(
        self, kind: str, nominal: FloatArray, change: FloatArray, false_alarms: float, samples: int | None = None
    ) -> None:
        self.nominal, self._kind, self._change, self._probability = nominal, kind, change, false_alarms
        self.looks_of_record = math.inf if samples is None else max(samples * LOOKS[kind], 1.0)

    def init(self) -> ParameterRuleState:
        """Return the state before the first sample."""
        return ParameterRuleState(np.zeros(2 * len(self.nominal)))

    def fold(self, state: ParameterRuleState, observation: Any) -> tuple[ParameterRuleState, tuple[float, int | None]]:
        """Return the state after what an observer says at a sample, the statistic, and the number of the parameter."""
        evidence: ParameterEvidence = observation
        if self._kind == "cusum":
            along = evidence.score - evidence.information @ self.nominal
            levels = two_sided_sums(state.levels, along, np.diag(evidence.information), self._change)
            largest = int(np.argmax(levels))
            return state._replace(levels=levels), (float(levels[largest]), largest % len(self.nominal))
        if self._kind == "chi-square":
            away, covariance = evidence.theta - self.nominal, evidence.parameter_covariance
            return state, (float(weighted_squares(away, covariance)), self.moved(away, covariance))
        gap = evidence.whitened
        if evidence.regressor.size:
            gap = gap - evidence.regressor @ self.nominal
        squares, degrees = (*state.squares, float(gap @ gap))[-NIS_WINDOW:], (*state.degrees, len(gap))[-NIS_WINDOW:]
        return state._replace(squares=squares, degrees=degrees), (sum(squares), None)

    def moved(self, away: FloatArray, covariance: FloatArray) -> int:
        """Return the parameter whose change alone explains a distance ``(nq,)`` best."""
        weights = np.linalg.pinv(covariance, hermitian=True)
        return alone(weights @ away, np.diag(weights))

    def limit(self, state: ParameterRuleState) -> float:
        """Return the threshold after a look; infinite where the window has no innovation."""
        looks = self.looks_of_record
        share = self._probability * (share_of_look(state.looks) if math.isinf(looks) else 1.0 / looks)
        if self._kind == "cusum":
            return math.log(len(state.levels) / share)
        degrees = len(self.nominal) if self._kind == "chi-square" else sum(state.degrees)
        return float(quantile(np.array(float(degrees)), min(share, 1.0)))

    def step(self, state: ParameterRuleState, sample: Sample) -> tuple[ParameterRuleState, RuleOutput]:
        """Return the state after a sample, statistic, threshold, and the number of the parameter if it is known."""
        if not sample.deciding:
            return state, NOT_DECIDED
        state, (value, parameter) = self.fold(state, cast(Any, sample.observation))
        if self._kind == "nis" and not sum(state.degrees):
            return state, NOT_DECIDED
        state = state._replace(looks=state.looks + 1)
        return state, RuleOutput(value, self.limit(state), parameter)

    def restart(self, state: ParameterRuleState, skipped: int = 0) -> ParameterRuleState:
        """Clear the sums; the covariance of the filter accounts for missing rows."""
        return self.init()._replace(looks=state.looks)

    def options(self) -> list[Any]:
        """Return kind, probability, nominal values and change."""
        return [self._kind, self._probability, self.nominal.tolist(), self._change.tolist()]


def parameter_monitor(
    observer: ParameterObserver,
    kind: str,
    nominal: Mapping[str, float],
    change: float,
    false_alarms: float,
) -> Monitor:
    """Return the monitor of parameters, or of innovations, for data of any length."""
    if kind not in PARAMETER_KINDS:
        hint = _whole_record(observer) if kind == "glr" else ""
        raise SpecError(
            f"The monitor {kind!r} is not for a recursive or nonlinear design: use one of "
            f"{', '.join(PARAMETER_KINDS)}, learned.{hint}",
            path="kind",
        )
    names = observer.fault_names
    theta = np.array(observer.initial_parameters, dtype=np.float64)
    for name, value in nominal.items():
        place = index_of(name, names, what="nominal")
        theta[place] = real_number(value, f"The nominal value of {name!r}", "a finite number", path="nominal")
    if kind != "nis" and not len(theta):
        raise SpecError(f"{kind} monitors parameters, and this design estimates none: use nis.", path="kind")
    if kind == "cusum" and observer.form in WALKING_FORMS:
        raise SpecError(
            f"cusum needs regressors, which a {observer.form} design does not have: use chi-square or nis.", path="kind"
        )
    rule = ParameterRule(kind, theta, np.full(len(theta), float(change)), false_alarms)
    return Monitor(
        kind,
        _STATEMENTS[kind].format(f"{false_alarms:g}") + ANY_LENGTH,
        rule,
        residuals=observer.innovation_count,
        fault_names=names,
        fault_scales=np.ones(len(names)),
    )


def _whole_record(observer: ParameterObserver) -> str:
    """Return why a likelihood ratio is not among the monitors, and what to use instead."""
    why = " glr compares every time at which a change may have begun, which takes a whole record"
    if isinstance(observer, DAEObserver):
        return f"{why}, and regressors, which a nonlinear design does not have: chi-square, cusum or nis serve here."
    if observer.form in ("", "random-walk"):
        return f"{why}, and regressors, which this design does not have: chi-square or nis serve here."
    return f"{why}: obsynth.decide(..., statistic='glr') has it for recorded estimates; row by row, use cusum."
