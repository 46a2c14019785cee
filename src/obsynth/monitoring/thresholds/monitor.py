"""Monitors: a statistic, a threshold and a statement of its guarantee, run by ``init`` and ``step``.

A record is a scan of it, many runs are an axis before the signals, and the horizon is a number of samples or none.
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

#: What a statement adds for a continuous design.
BOUNDS_BETWEEN_SAMPLES = "; disturbances move within their bounds between samples, which are {dt} s apart"

#: The assumption of a sampled design: what happens between its samples is not in its model.
HELD = "; inputs, disturbances are held between samples"

BOUNDS_AND_HELD_INPUTS = BOUNDS_BETWEEN_SAMPLES + "; known inputs are held between samples"

#: The other assumptions of every bound that is never passed.
ASSUMED = "; the plant starts from zero, known inputs are held or straight lines between samples"

#: How a statement begins, by what is watched: the residual may be made not to see the faults that are modelled.
WHAT_IS_WATCHED: Mapping[Watched, str] = {
    Watched.RESIDUALS: "",
    Watched.ESTIMATES: "of the fault estimates, as modelled faults have no lasting effect on the residual: ",
}

#: What a recursive or nonlinear observer learnt from a sample: a row of it.
Evidence: TypeAlias = RawEstimate | DAERow

#: In place of a fault's number: what is known does not distinguish the faults.
NOT_DISTINGUISHED = -1

RuleState: TypeAlias = Any


def statement_of(
    kind: str, model: ResidualModel, assumed: Assumptions | None, *, watched: Watched, **numbers: float
) -> str:
    """Return what a threshold promises and what it rests on; ``numbers``: window, false_alarms, change and dt."""
    ending = ""
    if kind in ("pointwise", "window"):
        # Of a sampled plant disturbances may move between samples where the continuous one behind it is known.
        held = HELD if model.sampled is None else BOUNDS_AND_HELD_INPUTS
        ending = held if model.continuous is None else BOUNDS_BETWEEN_SAMPLES + ASSUMED
    words_of_numbers = {name: shown(value) for name, value in numbers.items()}
    assumptions = "" if assumed is None else assumed.bounds_phrase
    words = (STATEMENTS[kind] + "{kept}" + ending).format(
        kept=f", with {assumptions}" if assumptions else "", **words_of_numbers
    )
    return WHAT_IS_WATCHED[watched] + words


class LinearSample(NamedTuple):
    """What a linear observer took and gave at one row: its own rows, known inputs, outputs; deviations."""

    rows: FloatArray
    inputs: FloatArray
    outputs: FloatArray
    states: int  # how many of the rows are state estimates

    @property
    def faults_and_residuals(self) -> FloatArray:
        """The rows after those of the states."""
        return self.rows[self.states :]


class Sample(NamedTuple):
    """What a monitor takes: a row of estimates, deviations."""

    time: float  # seconds
    residuals: FloatArray  # ``(nr,)``
    faults: FloatArray  # ``(nf,)``
    observation: Evidence | LinearSample | None  # by the observer; nothing in a gap
    deciding: bool = True  # whether a decision may be taken: not in gaps, and not during the warm-up
    skipped: int = 0  # rows that were missing before this one
    bridged: bool = False  # whether the plant's model stood in for all that was missing since the warm-up
    inputs: FloatArray | None = None  # ``(nu,)``: known inputs, deviations


class RuleOutput(NamedTuple):
    """What a rule says of a row: the fault by its number, `NOT_DISTINGUISHED`, or `None` where the rule does not look
    for it; and cells for columns of its own."""

    statistic: float
    threshold: float
    fault: int | None = None
    cells: tuple[float, ...] = ()
    ranking: Ranking | None = None  # of what an alarm may be, sensors among it, where that is known


class MonitorOutput(NamedTuple):
    """What a monitor says of one row: NaN where nothing is decided; without an alarm no fault is named."""

    statistic: float
    threshold: float
    alarm: bool
    fault: str
    more: tuple[float, ...] = ()
    ranking: Ranking | None = None  # of what an alarm may be, where that is known


class MonitorState(NamedTuple):
    """What goes from row to row."""

    decided: bool  # whether a decision might be taken at the row before
    rule: RuleState


class Rule(ABC):
    """A statistic and its threshold: values alone; a state is a tuple of numbers and arrays."""

    #: Whether its threshold is never passed without a fault, which needs an error at the start that is as stated.
    GUARANTEES: ClassVar[bool] = False
    #: Whether its threshold adapts to the signals: `table` is then only what is added to.
    adapts: ClassVar[bool] = False
    #: Thresholds ``(any,)`` by the sample since the start, where they are known beforehand.
    table: FloatArray | None = None
    #: Columns of a run besides statistic, threshold and alarm.
    columns: tuple[str, ...] = ()
    #: Whether it takes rows with missing samples (NaN) too.
    takes_gaps: bool = False
    #: Whether its threshold knows what outputs that were missing have left, and holds right after a gap.
    bridges: bool = False

    @abstractmethod
    def init(self) -> RuleState:
        """Return the state before the first sample."""

    @abstractmethod
    def step(self, state: RuleState, sample: Sample) -> tuple[RuleState, RuleOutput]:
        """Return the state after a sample, and statistic and threshold at it."""

    @abstractmethod
    def restart(self, state: RuleState, skipped: int = 0) -> RuleState:
        """Return the state without windows and sums: rows are missing, or nothing may be decided any more."""

    @abstractmethod
    def options(self) -> Any:
        """Return what a saved state must share with the monitor that it is for."""

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
        """Return where runs pass thresholds ``limits (steps,)``, ``(steps, runs)``; ``norm``: their statistic."""
        return np.asarray(norm > limits[:, None])


@dataclass(frozen=True, eq=False)
class Monitor:
    """A statistic with its threshold, for records of one length or for data of any; values alone, so that one serves
    any number of runs.  Made by `obsynth.monitor` and `obsynth.online_monitor`.

    Parameters
    ----------
    kind, statement : str
        Which one, and what its threshold means.
    rule : Rule
        Statistic and threshold.
    residuals : int
        Columns of the residual that it watches.
    fault_names : tuple of str
        What an alarm may name.
    fault_scales : FloatArray
        ``(nf,)``: what fault estimates are compared in.
    horizon : int, optional
        Samples of the records that it is for; without one, data may have any length.
    dt : float, optional, seconds
        Between samples of such records.
    floor : float, optional
        What rounding may add to the statistic.
    isolation_delay : int, optional
        Samples from the alarm to the comparison.
    watched : Watched, optional
        What it watches: the residuals, or fault estimates where the residuals do not see modelled faults.
    groups : tuple of tuple of str, optional
        By row that is watched: an alarm of it proves that one of these faults is there.

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
        """Return which monitor it is, and what its threshold means."""
        return f"<Monitor {self.kind}: {self.statement}>"

    @property
    def threshold(self) -> FloatArray:
        """Thresholds ``(horizon,)`` of a record; infinite where nothing is decided yet.

        Raises
        ------
        SpecError
            The threshold is computed row by row: for data of any length, or as it follows inputs and outputs (of those,
            `nominal_threshold` is the part that does not).
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
        """Thresholds ``(horizon,)`` of a record for the exact model: `threshold` itself; or, of an adaptive rule, what
        tolerances and the start add to, which alone is no bound."""
        if self.horizon is None or self.rule.table is None:
            raise SpecError(
                "This monitor is for data of any length: its threshold is computed by `step`.", path="monitor"
            )
        return read_only(self.rule.table)

    @property
    def guarantees(self) -> bool:
        """Whether the threshold is never passed without a fault: nothing is decided until the effect of a gap has
        settled."""
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
            What it estimates.

        Raises
        ------
        SpecError
            They differ from those that are watched.
        """
        if residuals != self.residuals or fault_names != self.fault_names:
            raise SpecError("The monitor was made for another design.", path="monitor")

    def init(self) -> MonitorState:
        """Return the state before the first sample."""
        return MonitorState(False, self.rule.init())

    def step(self, state: MonitorState, sample: Sample) -> tuple[MonitorState, MonitorOutput]:
        """Take one row of estimates; return the state after it, and what the monitor sees.

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
        # A statistic that has overflowed has passed any threshold.
        if math.isnan(statistic) or not math.isfinite(threshold):
            return after, MonitorOutput(math.nan, math.nan, False, "", more)
        if statistic <= threshold + self.floor:
            return after, MonitorOutput(statistic, threshold, False, "", more)
        if number is None and self.fault_names and np.isfinite(sample.faults).all():
            number = int(np.argmax(np.abs(sample.faults) / self.fault_scales))
        # Between faults of the plant the rule decides where it can; sensors, and none of these, are ranked beside them,
        # and so is what came after another change.
        decided = number is not None and number != NOT_DISTINGUISHED
        of_plant = ranking is None or (decided and math.isnan(ranking.ratio) and ranking.named in self.fault_names)
        fault = self._named(number) if of_plant or ranking is None else ranking.called(self.fault_names)
        return after, MonitorOutput(statistic, threshold, True, fault, more, ranking)

    def _named(self, number: int | None) -> str:
        """Return the fault of a number, or the group of faults one of which is there for certain."""
        if number is None or number == NOT_DISTINGUISHED:
            return ""
        return " or ".join(self.groups[number]) if self.groups else (self.fault_names or ("",))[number]

    def as_data(self, state: MonitorState) -> dict[str, Any]:
        """Return a state as plain data, with what it must share with the monitor that goes on from it.

        Parameters
        ----------
        state : MonitorState
            Of this monitor.
        """
        return {"kind": self.kind, "options": self.rule.options(), "state": state_as_data(state)}

    def from_data(self, data: Mapping[str, Any]) -> MonitorState:
        """Return the state that `as_data` described.

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
        """Return at which samples of which runs the threshold is passed, ``(steps, runs)``.

        Parameters
        ----------
        runs : Runs
            Everything that happened in them.
        onset : int, optional
            First sample at which something is wrong; with it, only whether a run passes before that, and where it
            passes first after that, need be right.
        """
        observer: Any = runs.observer
        norm = self.statistic(runs.rows[:, :, self.watched.rows(observer)])
        return self.rule.passed_in(runs, norm, self.nominal_threshold + self.floor, onset)

    def isolated(self, faults: FloatArray, k: int) -> int:
        """Return the number of the fault that an alarm points to, at ``k``; with `groups` it is proved.

        Parameters
        ----------
        faults : FloatArray
            Fault estimates ``(steps, nf)``; of tests with `groups` the rows that are watched, each in its threshold.
        k : int
            Sample of the alarm.
        """
        return int(np.argmax(np.abs(faults[min(k + self.isolation_delay, len(faults) - 1)]) / self.fault_scales))

    @arguments_checked
    def watch(self, estimates: Estimates) -> Detection:
        """Return what this monitor sees in a record.

        Parameters
        ----------
        estimates : Estimates
            Such as ``simulation.estimates``.

        Raises
        ------
        SpecError
            Another number of samples than the monitor was made for, or a threshold that follows inputs and outputs.
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
