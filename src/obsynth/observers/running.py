"""The interface of every observer: a first state, and a step from a sample to the next state and the estimates."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping
from dataclasses import fields
from functools import cached_property, partial
from typing import Any, Generic, Self, TypeAlias, TypeVar

import numpy as np
from numpy.typing import ArrayLike

from obsynth.numerics.arguments import check_fields, require_kind
from obsynth.numerics.arrays import FloatArray, read_only
from obsynth.observers.estimates import Estimates
from obsynth.observers.outliers import Outliers, checked_limit, checked_sizes, checked_state_bounds
from obsynth.observers.sensor_timing import SensorTiming, checked_sensors

#: The residual of an observer of a nonlinear plant: of its equations in each step.
STEP_RESIDUAL = ("equations",)

State = TypeVar("State")

Row = TypeVar("Row")


#: Takes the states before and after a sample, what is known at it, and its inputs.
AfterStep: TypeAlias = Callable[[Any, Any, Any, FloatArray], None]


class Observer(ABC, Generic[State, Row]):
    """An observer.  It is immutable, so that it serves any number of runs; its state is a tuple of plain arrays.

    `advance` is `step` without checks of the sample; it returns the row of numbers from which the estimates are made.
    """

    @abstractmethod
    def init(self) -> State:
        """Return the state before the first sample."""

    @abstractmethod
    def advance(self, state: State, y: FloatArray, u: FloatArray) -> tuple[State, Row]:
        """Return the state after a sample, and the row of numbers at it."""

    @abstractmethod
    def step(self, state: State, y: ArrayLike, u: ArrayLike = ()) -> tuple[State, Estimates]:
        """Check a sample; return the state after it, and the estimates at it."""

    def start(self) -> RunningObserver[State, Row]:
        """Return a running observer, at k = 0."""
        return RunningObserver(self)

    @classmethod
    def from_dict(cls, data: Mapping[str, Any]) -> Self:
        """Return the observer that its `as_dict` described.

        Parameters
        ----------
        data : mapping
            Every field by name; lists stand for tuples.
        """
        require_kind(data, Mapping, "data", "what as_dict() returns")
        return cls(**{key: tuple(value) if isinstance(value, list) else value for key, value in data.items()})


class StepObserver(Observer[Any, Any]):
    """An observer of states and parameters with standard deviations, which accepts missing samples."""

    plant: Any  # the plant whose states it estimates
    outliers: Outliers
    outlier_limit: float | None
    outlier_sizes: FloatArray | None
    sensors: Mapping[str, Mapping[str, int]] | None
    state_bounds: FloatArray | None

    def _check_options(self) -> None:
        check_fields(self, type(self))
        checked_limit(self.outliers, self.outlier_limit)
        object.__setattr__(self, "outlier_sizes", checked_sizes(self.outlier_sizes, self.plant.output_names))
        object.__setattr__(self, "sensors", checked_sensors(self.sensors, self.plant.output_names))
        object.__setattr__(self, "state_bounds", checked_state_bounds(self.state_bounds, self.state_names))

    def __getstate__(self) -> dict[str, Any]:
        """Return the fields alone for another process, where everything else is computed again."""
        return {field.name: getattr(self, field.name) for field in fields(self)}  # type: ignore[arg-type]

    @property
    def state_names(self) -> tuple[str, ...]:
        """The states that are estimated, in order."""
        names: tuple[str, ...] = self.plant.state_names
        return names

    @property
    @abstractmethod
    def fault_names(self) -> tuple[str, ...]:
        """The parameters that are estimated, in order."""

    @property
    def state_delays(self) -> tuple[int, ...]:
        """Samples by which each state estimate lags: none."""
        return (0,) * len(self.state_names)

    @property
    def fault_delays(self) -> tuple[int, ...]:
        """Samples by which each estimate of a parameter lags: none."""
        return (0,) * len(self.fault_names)

    @property
    def order(self) -> int:
        """Number of states and parameters in its state."""
        return len(self.state_names) + len(self.fault_names)

    @cached_property
    def timing(self) -> SensorTiming:
        """When each sensor is sampled, and by how much its values are delayed."""
        return SensorTiming.of(self.sensors, self.plant.output_names, self.plant.nu)

    @property
    def is_plain(self) -> bool:
        """Whether every sensor is sampled at each row, at once, and no state has bounds."""
        return self.timing.is_plain and self.state_bounds is None

    @property
    @abstractmethod
    def _steps(self) -> Any:
        """The part that is computed once for all runs: the initial state `first`, and `advance`."""

    def _allow(self, state: Any) -> None:
        """Raise an error if no further sample is possible after a state."""

    def _trust(self, row: Any) -> None:
        """Raise an error if the result of a step cannot be trusted."""

    @abstractmethod
    def _sample(self, state: Any, y: ArrayLike, u: ArrayLike) -> tuple[FloatArray, FloatArray]:
        """Return a sample, checked."""

    @abstractmethod
    def _estimates(self, state: Any, row: Any) -> Estimates:
        """Return the estimates of one sample."""

    def within_bounds(self, row: Any) -> Any:
        """Return a row with its states within their bounds, for output."""
        return row

    def init(self) -> Any:
        """Return the state before the first sample, k = 0."""
        return self.timing.begun(self._steps.first)

    def advance(self, state: Any, y: FloatArray, u: FloatArray) -> tuple[Any, Any]:
        """Return the state after a sample and the row at it, without checks (``y (ny,)``, ``u (nu,)``)."""
        after, row = self.timing.advance(self._steps.advance, state, y, u)
        return after, self.within_bounds(row)

    def accept(self, state: Any, y: FloatArray, u: FloatArray, after_step: AfterStep | None = None) -> tuple[Any, Any]:
        """Return the same as `advance`, but raise an error for a step that cannot be trusted.

        ``after_step`` (`AfterStep`) is called after each step, also after steps that are repeated when late values
        arrive.  All values of a step belong to the same time.
        """
        after, row = self.timing.advance(partial(self._in_order, after_step), state, y, u)
        return after, self.within_bounds(row)

    def _in_order(self, after_step: AfterStep | None, state: Any, y: FloatArray, u: FloatArray) -> tuple[Any, Any]:
        self._allow(state)
        after, row = self._steps.advance(state, y, u)
        self._trust(row)
        if after_step is not None:
            after_step(state, after, row, u)
        return after, row

    def step(self, state: Any, y: ArrayLike, u: ArrayLike = ()) -> tuple[Any, Estimates]:
        """Return the state after a sample, and the estimates at it (``y (ny,)``, ``u (nu,)``)."""
        require_kind(state, tuple, "state", "what init() or the step before returned")
        after, row = self.accept(state, *self._sample(state, y, u))
        return after, self._estimates(getattr(after, "latest", after), row)


class RunningObserver(Generic[State, Row]):
    """An observer with its state: `step` takes y(k) and u(k) and returns the estimates at k.

    Parameters
    ----------
    observer : LinearObserver, RecursiveObserver or DAEObserver
        The observer.
    state : NamedTuple, optional
        The initial state; ``observer.init()`` by default.

    Examples
    --------
    >>> import obsynth
    >>> plant = obsynth.DescriptorSystem(
    ...     A=[[0.9, 0.1], [0.0, 0.8]], C=[[1, 0], [0, 1]], Bf=[[1], [0]], Bd=[[0], [1]], dt=1.0
    ... )
    >>> design = obsynth.fault_estimation_filter(plant)
    >>> running = obsynth.types.RunningObserver(design.observer)
    >>> running.step([0.0, 0.0]).faults.tolist()
    [[0.0]]
    """

    def __init__(self, observer: Observer[State, Row], state: State | None = None) -> None:
        self.observer = observer
        self.state = observer.init() if state is None else state

    def step(self, y: ArrayLike, u: ArrayLike = ()) -> Estimates:
        """Take one sample and return the estimates at it.

        Parameters
        ----------
        y : array_like
            Outputs ``(ny,)``.  Recursive and nonlinear observers take NaN for a missing one.
        u : array_like, optional
            Known inputs ``(nu,)``.  Recursive and nonlinear observers accept NaN for a missing one after the first
            sample: its last value is used, and deviations grow according to its past changes.

        Raises
        ------
        SpecError
            A sample has the wrong length or is not finite, or the plant's horizon is passed.
        PreconditionError
            Rank H_k is lost at this k although no sample is missing (recursive observers).
        SolverError
            The step has no solution (nonlinear observers).

        After an error the state is unchanged.
        """
        self.state, estimates = self.observer.step(self.state, y, u)
        return estimates

    def raw_step(self, y: FloatArray, u: FloatArray) -> Row:
        """Take one sample without checks, and return the row of numbers at it.

        Parameters
        ----------
        y, u : FloatArray
            ``(ny,)`` and ``(nu,)``.
        """
        self.state, row = self.observer.advance(self.state, y, u)
        return row


def named_estimates(observer: StepObserver, *, states: FloatArray, faults: FloatArray, **known: Any) -> Estimates:
    """Return the estimates of an observer without delays; arrays are made read-only, copied where they are not yet."""
    residuals = known.pop("residuals", np.zeros((*states.shape[:-1], 0)))
    arrays: dict[str, Any] = {
        name: value if value.dtype == bool or (value.flags.owndata and not value.flags.writeable) else read_only(value)
        for name, value in known.items()
    }
    return Estimates(
        read_only(states),
        read_only(faults),
        read_only(residuals),
        observer.state_names,
        observer.fault_names,
        STEP_RESIDUAL[: residuals.shape[-1]],
        observer.state_delays,
        observer.fault_delays,
        **arrays,
    )
