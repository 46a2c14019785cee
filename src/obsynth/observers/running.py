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
    """An observer: values alone, so that one serves any number of runs; a state is a tuple of plain arrays. `advance`
    is `step` without checks of the sample, and returns the row of numbers that the estimates are made of."""

    @abstractmethod
    def init(self) -> State:
        """Return the state before the first sample."""

    @abstractmethod
    def advance(self, state: State, y: FloatArray, u: FloatArray) -> tuple[State, Row]:
        """Return the state after a sample, and what is known at it."""

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
    """An observer of states and parameters, which takes missing samples itself and states deviations."""

    plant: Any  # what it runs on
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
        """Return what makes it again in another process: what follows from it is made there anew."""
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
        """What follows from the observer alone, made once for all runs: a state `first`, and `advance`."""

    def _allow(self, state: Any) -> None:
        """Raise where no sample can follow."""

    def _trust(self, row: Any) -> None:
        """Raise where a step cannot be trusted, and does not say so itself."""

    @abstractmethod
    def _sample(self, state: Any, y: ArrayLike, u: ArrayLike) -> tuple[FloatArray, FloatArray]:
        """Return a sample, checked."""

    @abstractmethod
    def _estimates(self, state: Any, row: Any) -> Estimates:
        """Return the estimates of one sample."""

    def within_bounds(self, row: Any) -> Any:
        """Return a row as it is shown, within the bounds of the states."""
        return row

    def init(self) -> Any:
        """Return the state before the first sample, k = 0."""
        return self.timing.begun(self._steps.first)

    def advance(self, state: Any, y: FloatArray, u: FloatArray) -> tuple[Any, Any]:
        """Return the next state and what is known at a sample, without checking it (``y (ny,)``, ``u (nu,)``)."""
        after, row = self.timing.advance(self._steps.advance, state, y, u)
        return after, self.within_bounds(row)

    def accept(self, state: Any, y: FloatArray, u: FloatArray, after_step: AfterStep | None = None) -> tuple[Any, Any]:
        """Return the same as `advance`, where the step is one that can be trusted (``y (ny,)``, ``u (nu,)``).

        ``after_step`` is called for each sample whose values are all of its own time: see `AfterStep`."""
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
        What runs.
    state : NamedTuple, optional
        Where to begin; ``observer.init()`` by default.

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
            Known inputs ``(nu,)``.  Recursive and nonlinear observers take NaN for one that is missing after the first
            sample: it counts as it last was, and deviations grow by what its past changes let it be off by.

        Raises
        ------
        SpecError
            A sample has the wrong length or is not finite, or the plant's horizon is passed.
        PreconditionError
            Rank H_k is lost at this k although no sample is missing (recursive observers).
        SolverError
            The step has no solution (nonlinear observers).

        Whatever is raised, the state is left as it was.
        """
        self.state, estimates = self.observer.step(self.state, y, u)
        return estimates

    def raw_step(self, y: FloatArray, u: FloatArray) -> Row:
        """Take one sample without checking it; return what is known at it.

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
