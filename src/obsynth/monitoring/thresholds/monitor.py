"""Monitors: a statistic, a threshold and a statement of its guarantee, run by ``init`` and ``step``.

A monitor is for records with a given number of samples, or for data of any length.  Many runs are evaluated together:
they are an array axis before that of the signals.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, ClassVar, NamedTuple, TypeAlias

import numpy as np
from numpy.typing import NDArray

from obsynth.errors import SpecError
from obsynth.monitoring.thresholds.alarm_ranking import Ranking
from obsynth.monitoring.thresholds.watched_rows import Watched
from obsynth.numerics.arguments import arguments_checked
from obsynth.numerics.arrays import FloatArray, read_only
from obsynth.observers.detection import Detection
from obsynth.observers.estimates import Estimates
from obsynth.observers.nonlinear.estimates import DAERow
from obsynth.observers.recursive.sample import RawEstimate
from obsynth.observers.saved_states import state_as_data, state_from_data
from obsynth.plants.constants import shown

if TYPE_CHECKING:
    from obsynth.monitoring.thresholds.residual_model import ResidualModel
    from obsynth.simulation.benches import Runs
    from obsynth.verification.assumptions import Assumptions


MONITOR_KINDS = ("paper", "pointwise", "window", "chi-square", "cusum")

STATEMENTS: Mapping[str, str] = {
    "paper": "eq. (66) of Wang et al. 2015 with the norm of the power: not a pointwise bound, it may be passed "
    "without a fault, and disregards sensor noise",
    "pointwise": "never passed without a fault",
    "window": "l2 norm of {window} samples: never passed without a fault",
    "chi-square": "{window} samples: passed in a run without a fault with a probability of {false_alarms} at most, for "
    "Gaussian noise, once the initial-condition response has settled",
    "cusum": "cumulative sum for a change of {change} deviations: passed in a run without a fault with a probability "
    "of {false_alarms} at most, for Gaussian noise, once the initial-condition response has settled",
}

#: Addition to the statement for a continuous design.
BOUNDS_BETWEEN_SAMPLES = "; disturbances move within their bounds between samples, which are {dt} s apart"

#: Assumption for a sampled design, whose model does not contain what happens between samples.
HELD = "; inputs, disturbances are held between samples"

BOUNDS_AND_HELD_INPUTS = BOUNDS_BETWEEN_SAMPLES + "; known inputs are held between samples"

#: Further assumptions of every guaranteed bound.
ASSUMED = "; the plant starts from zero, known inputs are held or straight lines between samples"

#: Beginning of a statement, by the watched signals.
WHAT_IS_WATCHED: Mapping[Watched, str] = {
    Watched.RESIDUALS: "",
    Watched.ESTIMATES: "of the fault estimates, as modelled faults have no lasting effect on the residual: ",
}

#: The row of a recursive or nonlinear observer at a sample, with innovations and covariances.
Evidence: TypeAlias = RawEstimate | DAERow

#: In place of a fault's number if the data do not distinguish the faults.
NOT_DISTINGUISHED = -1

RuleState: TypeAlias = Any


def statement_of(
    kind: str, model: ResidualModel, assumed: Assumptions | None, *, watched: Watched, **numbers: float
) -> str:
    """Return the guarantee of a threshold with its assumptions; ``numbers``: window, false_alarms, change and dt."""
    ending = ""
    if kind in ("pointwise", "window"):
        # Disturbances of a sampled plant may move between samples if its continuous model is known.
        held = HELD if model.sampled is None else BOUNDS_AND_HELD_INPUTS
        ending = held if model.continuous is None else BOUNDS_BETWEEN_SAMPLES + ASSUMED
    words_of_numbers = {name: shown(value) for name, value in numbers.items()}
    assumptions = "" if assumed is None else assumed.bounds_phrase
    words = (STATEMENTS[kind] + "{kept}" + ending).format(
        kept=f", with {assumptions}" if assumptions else "", **words_of_numbers
    )
    return WHAT_IS_WATCHED[watched] + words


class LinearSample(NamedTuple):
    """Outputs, inputs and measurements of a linear observer at one row, as deviations from the operating point."""

    rows: FloatArray  # the observer's outputs: states, faults, residuals
    inputs: FloatArray
    outputs: FloatArray  # the measurements
    states: int  # number of rows that are state estimates

    @property
    def faults_and_residuals(self) -> FloatArray:
        """The rows after those of the states."""
        return self.rows[self.states :]


class Sample(NamedTuple):
    """The input of a monitor: a row of estimates and residuals, as deviations from the operating point."""

    time: float  # seconds
    residuals: FloatArray  # ``(nr,)``
    faults: FloatArray  # ``(nf,)``
    observation: Evidence | LinearSample | None  # the observer's row; `None` in a gap
    deciding: bool = True  # whether the row may be decided: not in gaps, and not during the warm-up
    skipped: int = 0  # number of rows that are missing before this one
    bridged: bool = False  # whether all values missing since the warm-up were predicted by the plant's model
    inputs: FloatArray | None = None  # ``(nu,)``: known inputs, deviations


class RuleOutput(NamedTuple):
    """The output of a rule for one row."""

    statistic: float
    threshold: float
    fault: int | None = None  # its number, `NOT_DISTINGUISHED`, or `None` if the rule does not name faults
    cells: tuple[float, ...] = ()  # values of the rule's own columns
    ranking: Ranking | None = None  # of the possible causes of an alarm, including sensors, if it is known


class MonitorOutput(NamedTuple):
    """The output of a monitor for one row: NaN where nothing is decided; a fault is named only in an alarm."""

    statistic: float
    threshold: float
    alarm: bool
    fault: str
    more: tuple[float, ...] = ()  # values of the rule's own columns
    ranking: Ranking | None = None  # of the possible causes of an alarm, if it is known


class MonitorState(NamedTuple):
    """The state of a monitor between rows."""

    decided: bool  # whether the row before might be decided
    rule: RuleState


class Rule(ABC):
    """A statistic and its threshold.  A rule is immutable; its state is a tuple of numbers and arrays."""

    #: Whether its threshold is never exceeded without a fault, provided that the initial error is as stated.
    GUARANTEES: ClassVar[bool] = False
    #: Whether its threshold adapts to the signals; `table` is then only a part of it.
    adapts: ClassVar[bool] = False
    #: Thresholds ``(any,)`` by the sample since the start, if they are known in advance.
    table: FloatArray | None = None
    #: Columns of a run besides statistic, threshold and alarm.
    columns: tuple[str, ...] = ()
    #: Whether the rule accepts rows with missing samples (NaN).
    takes_gaps: bool = False
    #: Whether its threshold includes the effect of earlier missing outputs, so that it is valid right after a gap.
    bridges: bool = False

    @abstractmethod
    def init(self) -> RuleState:
        """Return the state before the first sample."""

    @abstractmethod
    def step(self, state: RuleState, sample: Sample) -> tuple[RuleState, RuleOutput]:
        """Return the state after a sample, and the statistic and the threshold at it."""

    @abstractmethod
    def restart(self, state: RuleState, skipped: int = 0) -> RuleState:
        """Return the state with empty windows and sums, after missing rows or where decisions are suspended."""

    @abstractmethod
    def options(self) -> Any:
        """Return the data by which a saved state is recognised as one of this rule."""

    def fold(self, state: RuleState, residuals: FloatArray) -> tuple[RuleState, Any]:
        """Return the state and the statistic ``(...)`` after residuals ``(..., nr)``, of one run or of many."""
        raise NotImplementedError

    def statistics(self, residuals: FloatArray) -> FloatArray:
        """Return the statistic ``(steps, runs)`` of records ``(steps, runs, nr)``: a scan of `fold`."""
        state, values = self.init(), np.empty(residuals.shape[:2])
        for k, row in enumerate(residuals):
            state, values[k] = self.fold(state, row)
        return values

    def passed_in(self, runs: Runs, norm: FloatArray, limits: FloatArray, onset: int | None) -> NDArray[np.bool_]:
        """Return where the statistic ``norm (steps, runs)`` of runs exceeds thresholds ``limits (steps,)``."""
        return np.asarray(norm > limits[:, None])


@dataclass(frozen=True, eq=False)
class Monitor:
    """A statistic with its threshold, for records of a given length or for data of any length.

    It is immutable, so that one monitor serves any number of runs.  `obsynth.monitor` and `obsynth.online_monitor`
    return monitors.

    Parameters
    ----------
    kind, statement : str
        The kind of the monitor, and the meaning of its threshold.
    rule : Rule
        Statistic and threshold.
    residuals : int
        Number of columns of the residual.
    fault_names : tuple of str
        Faults that an alarm may name.
    fault_scales : FloatArray
        ``(nf,)``: units in which fault estimates are compared to name a fault.
    horizon : int, optional
        Number of samples of the records; without it, data may have any length.
    dt : float, optional, seconds
        Time between samples of such records.
    floor : float, optional
        Bound on the effect of rounding on the statistic, which is added to the threshold.
    isolation_delay : int, optional
        Number of samples from the alarm to the comparison of the fault estimates.
    watched : Watched, optional
        The watched signals: residuals, or fault estimates if modelled faults do not affect the residuals.
    groups : tuple of tuple of str, optional
        For each watched row, the faults one of which is certainly present if this row is above its threshold.

    Examples
    --------
    >>> import obsynth
    >>> plant = obsynth.DescriptorSystem(
    ...     A=[[0.9, 0.1], [0.0, 0.8]], C=[[1, 0], [0, 1]], Bf=[[1], [0]], Bd=[[0], [1]], dt=1.0
    ... )
    >>> design = obsynth.fault_estimation_filter(plant)
    >>> monitor = obsynth.online_monitor(design, disturbance_bounds={"d1": 0.1}, initial_error=0.0)
    >>> monitor.kind
    'pointwise'
    """

    kind: str
    statement: str
    rule: Rule
    residuals: int
    fault_names: tuple[str, ...]
    fault_scales: FloatArray
    horizon: int | None = None
    dt: float = math.nan
    floor: float = 0.0
    isolation_delay: int = 0
    watched: Watched = Watched.RESIDUALS
    groups: tuple[tuple[str, ...], ...] = ()

    def __repr__(self) -> str:
        """Return the kind of the monitor, and the meaning of its threshold."""
        return f"<Monitor {self.kind}: {self.statement}>"

    @property
    def threshold(self) -> FloatArray:
        """Thresholds ``(horizon,)`` of a record; infinite in rows that are not decided.

        Raises
        ------
        SpecError
            The threshold is computed row by row, since data may have any length, or since it depends on inputs and
            outputs; `nominal_threshold` is the part that does not.
        """
        if self.rule.adapts and self.horizon is not None:
            raise SpecError(
                "An adaptive threshold follows inputs and outputs, and no table holds it: use obsynth.evaluate, or "
                "obsynth.online_monitor with obsynth.run_on_data, whose table holds it; nominal_threshold is what "
                "it adds to.",
                path="monitor",
            )
        return self.nominal_threshold

    @property
    def nominal_threshold(self) -> FloatArray:
        """Thresholds ``(horizon,)`` of a record for the exact model.

        For an adaptive rule the effects of tolerances and of the start are added to these, which alone are no bounds;
        for other rules they are `threshold`.
        """
        if self.horizon is None or self.rule.table is None:
            raise SpecError(
                "This monitor is for data of any length: its threshold is computed by `step`.", path="monitor"
            )
        return read_only(self.rule.table)

    @property
    def guarantees(self) -> bool:
        """Whether the threshold is never exceeded without a fault; after a gap, rows are not decided until its effect
        has settled."""
        return self.rule.GUARANTEES

    @property
    def columns(self) -> tuple[str, ...]:
        """Columns of a run besides statistic, threshold and alarm: those of an adaptive threshold."""
        return self.rule.columns

    def require_fit(self, residuals: int, fault_names: tuple[str, ...]) -> None:
        """Refuse a design that this monitor was not made for.

        Parameters
        ----------
        residuals : int
            Columns of its residual.
        fault_names : tuple of str
            Names of the faults that it estimates.

        Raises
        ------
        SpecError
            They differ from those of this monitor.
        """
        if residuals != self.residuals or fault_names != self.fault_names:
            raise SpecError("The monitor was made for another design.", path="monitor")

    def init(self) -> MonitorState:
        """Return the state before the first sample."""
        return MonitorState(False, self.rule.init())

    def step(self, state: MonitorState, sample: Sample) -> tuple[MonitorState, MonitorOutput]:
        """Return the state after one row of estimates, and the decision.

        Parameters
        ----------
        state : MonitorState
            From `init`, or from the row before.
        sample : Sample
            The row.
        """
        inner = state.rule
        bridged = self.rule.bridges and sample.bridged
        if not bridged and (sample.skipped or (state.decided and not sample.deciding)):
            inner = self.rule.restart(inner, sample.skipped)
        inner, (statistic, threshold, number, more, ranking) = self.rule.step(inner, sample)
        after = MonitorState(sample.deciding, inner)
        # A statistic that overflows (infinite) exceeds every threshold.
        if math.isnan(statistic) or not math.isfinite(threshold):
            return after, MonitorOutput(math.nan, math.nan, False, "", more)
        if statistic <= threshold + self.floor:
            return after, MonitorOutput(statistic, threshold, False, "", more)
        if number is None and self.fault_names and np.isfinite(sample.faults).all():
            number = int(np.argmax(np.abs(sample.faults) / self.fault_scales))
        # The rule names a fault of the plant if it can.  The ranking is used if it names a sensor or none of the
        # faults, and for changes that came after another one.
        decided = number is not None and number != NOT_DISTINGUISHED
        of_plant = ranking is None or (decided and math.isnan(ranking.ratio) and ranking.named in self.fault_names)
        fault = self._named(number) if of_plant or ranking is None else ranking.called(self.fault_names)
        if ranking is not None and fault in ranking.ties:
            ranking = ranking.named_by(fault)
        return after, MonitorOutput(statistic, threshold, True, fault, more, ranking)

    def _named(self, number: int | None) -> str:
        """Return the name of a fault by its number, or the group of faults one of which is certainly present."""
        if number is None or number == NOT_DISTINGUISHED:
            return ""
        return " or ".join(self.groups[number]) if self.groups else (self.fault_names or ("",))[number]

    def as_data(self, state: MonitorState) -> dict[str, Any]:
        """Return a state as plain data, with the kind and the options by which a monitor recognises it.

        Parameters
        ----------
        state : MonitorState
            Of this monitor.
        """
        return {"kind": self.kind, "options": self.rule.options(), "state": state_as_data(state)}

    def from_data(self, data: Mapping[str, Any]) -> MonitorState:
        """Return the state from the data that `as_data` returned.

        Parameters
        ----------
        data : mapping
            From a run with the same gain set and options.

        Raises
        ------
        SpecError
            The state is of another kind of monitor, or one with other options.
        """
        if data["kind"] != self.kind:
            raise SpecError(
                f"The saved state is of a run with the monitor {data['kind']!r}: use the same options.", path="state"
            )
        if data["options"] != self.rule.options():
            raise SpecError("The saved state is of a run whose monitor had other options: use the same.", path="state")
        return state_from_data(self.init(), data["state"])

    def statistic(self, residuals: FloatArray) -> FloatArray:
        """Return the statistic ``(steps, runs)`` of many runs at once.

        Parameters
        ----------
        residuals : FloatArray
            ``(steps, runs, nr)``.

        Raises
        ------
        SpecError
            Another number of samples than the monitor was made for.
        """
        steps = len(self.nominal_threshold)
        if len(residuals) != steps:
            raise SpecError(f"The record has {len(residuals)} samples, but the monitor is for {steps}.", path="steps")
        return self.rule.statistics(residuals)

    def passed_in(self, runs: Runs, *, onset: int | None = None) -> NDArray[np.bool_]:
        """Return at which samples of which runs the threshold is exceeded, ``(steps, runs)``.

        Parameters
        ----------
        runs : Runs
            The signals and estimates of the runs.
        onset : int, optional
            Sample of the first fault.  With it, the result is only exact in whether a run exceeds the threshold before
            this sample, and in the first sample from there on at which it does.
        """
        observer: Any = runs.observer
        norm = self.statistic(runs.rows[:, :, self.watched.rows(observer)])
        return self.rule.passed_in(runs, norm, self.nominal_threshold + self.floor, onset)

    def isolated(self, faults: FloatArray, k: int) -> int:
        """Return the number of the fault that an alarm at sample ``k`` points to; with `groups` it is proved.

        Parameters
        ----------
        faults : FloatArray
            Fault estimates ``(steps, nf)``; for tests with `groups` the watched rows, each in units of its threshold.
        k : int
            Sample of the alarm.
        """
        return int(np.argmax(np.abs(faults[min(k + self.isolation_delay, len(faults) - 1)]) / self.fault_scales))

    @arguments_checked
    def watch(self, estimates: Estimates) -> Detection:
        """Return the statistic, the threshold and the first alarm of a record.

        Parameters
        ----------
        estimates : Estimates
            Such as ``simulation.estimates``.

        Raises
        ------
        SpecError
            The number of samples is not that of the monitor, or the threshold depends on inputs and outputs.
        """
        if self.columns:
            raise SpecError(
                "An adaptive threshold follows inputs and outputs, which estimates do not hold: use obsynth.evaluate, "
                "or obsynth.online_monitor with obsynth.run_on_data.",
                path="monitor",
            )
        watched = self.watched.of(estimates)
        values = self.statistic(watched[:, None])[:, 0]
        hits = np.flatnonzero(values > self.threshold + self.floor)
        k = int(hits[0]) if hits.size else None
        compared = watched if self.groups else estimates.faults
        fault = "" if k is None or not compared.shape[1] else self._named(self.isolated(compared, k))
        time = None if k is None else k * self.dt
        return Detection(self.kind, self.statement, read_only(values), self.threshold, k, time, fault)
