"""What every observer is: a first state, and a step from a state and a sample to the next state and the estimates.

What it says: estimates with their names and delays, and how far they may be off where it knows.

Sensors that are sampled every so many rows, and whose values are delayed.

A delayed value is put where it belongs: the observer keeps its states of the latest samples, and takes those samples
again from the one that the value is about.  What it then knows is what it would know if everything had come in order.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from functools import cached_property, partial
from typing import Any, Generic, NamedTuple, Self, TypeAlias, TypeVar

import numpy as np
from numpy.typing import ArrayLike, NDArray

from obsynth.errors import SpecError
from obsynth.numerics.arguments import FloatArray, check_fields, is_whole, read_only, require_kind
from obsynth.observers.outliers import Outliers, checked_limit, checked_sizes, checked_state_bounds
from obsynth.plants.descriptor import index_of

#: Rows that may be waited for: a delay in another unit is larger.
LONGEST_DELAY = 10_000
Inner = Callable[[Any, FloatArray, FloatArray], tuple[Any, Any]]


def checked_sensors(value: Any, names: Sequence[str]) -> dict[str, dict[str, int]] | None:
    """Return ``{sensor: {every, delay}}`` of the sensors that are not sampled at each row at once, or ``None``."""
    if value is None:
        return None
    if not isinstance(value, Mapping):
        raise SpecError("sensors must be a mapping by name, such as {y1: {every: 5, delay: 2}}.", path="sensors")
    found: dict[str, dict[str, int]] = {}
    for name, entry in value.items():
        index_of(name, names, what="sensors")
        if not isinstance(entry, Mapping) or not set(entry) <= {"every", "delay"}:
            raise SpecError(
                f"sensors.{name} is {entry!r}: give every (rows) and delay (rows), or one of them.",
                path=f"sensors.{name}",
            )
        timing = {"every": entry.get("every", 1), "delay": entry.get("delay", 0)}
        for key, least in (("every", 1), ("delay", 0)):
            count = timing[key]
            if not is_whole(count) or not least <= count <= LONGEST_DELAY:
                raise SpecError(
                    f"sensors.{name}.{key} is {count!r}: give a whole number of rows from {least} to {LONGEST_DELAY}.",
                    path=f"sensors.{name}.{key}",
                )
            timing[key] = int(count)
        if timing != {"every": 1, "delay": 0}:
            found[str(name)] = timing
    return found or None


class WaitingState(NamedTuple):
    """The state of an observer with delayed sensors."""

    before: tuple[Any, ...]  # its states before each of the latest samples
    latest: Any  # after the last one
    outputs: FloatArray  # outputs, inputs: of these samples, as far as they have arrived
    inputs: FloatArray

    @property
    def k(self) -> int:
        """The next sample."""
        return int(self.latest.k)

    @property
    def refused(self) -> FloatArray:
        """Outliers in a row, and at all, ``(2, ny)``."""
        return np.asarray(self.latest.refused)

    def from_data(self, data: Mapping[str, Any], restored: Callable[[Any, Any], Any]) -> WaitingState:
        """Return the state that data describe, by what restores that of an observer without delayed sensors."""
        return WaitingState(
            tuple(restored(self.latest, part) for part in data["before"]),
            restored(self.latest, data["latest"]),
            np.array(data["outputs"]),
            np.array(data["inputs"]),
        )


@dataclass(frozen=True, eq=False)
class SensorTiming:
    """When each sensor is sampled, and by how much its values are delayed."""

    every: NDArray[np.int64]  # every, delays: ``(ny,)``, in rows
    delays: NDArray[np.int64]
    inputs: int  # how many there are. A sensor is sampled at k = 0, every, 2 every,

    @classmethod
    def of(cls, sensors: Mapping[str, Mapping[str, int]] | None, names: Sequence[str], inputs: int) -> SensorTiming:
        """Return the timing of outputs by name."""
        entries = [(sensors or {}).get(name, {}) for name in names]
        return cls(
            np.array([entry.get("every", 1) for entry in entries], dtype=np.int64),
            np.array([entry.get("delay", 0) for entry in entries], dtype=np.int64),
            inputs,
        )

    @cached_property
    def is_plain(self) -> bool:
        """Whether every sensor is sampled at each row, at once."""
        return bool((self.every == 1).all()) and not self.longest

    @property
    def longest(self) -> int:
        """The longest delay in rows."""
        return int(self.delays.max(initial=0))

    def expected(self, k: int) -> NDArray[np.bool_]:
        """Return which outputs ``(ny,)`` have a value in row k."""
        taken = k - self.delays
        return np.asarray((taken >= 0) & (taken % self.every == 0))

    def arriving(self, y: FloatArray) -> FloatArray:
        """Return rows as they arrive from outputs ``(..., samples, ny)`` at their own times; NaN where nothing does."""
        found = np.full_like(y, np.nan)
        for i, (every, delay) in enumerate(zip(self.every, self.delays, strict=True)):
            taken = y[..., : max(y.shape[-2] - delay, 0) : every, i]
            found[..., delay::every, i] = taken
        return found

    def in_order(self, y: FloatArray) -> FloatArray:
        """Return outputs ``(samples, ny)`` at their own times from rows as they arrive."""
        found = np.full_like(y, np.nan)
        for i, (every, delay) in enumerate(zip(self.every, self.delays, strict=True)):
            taken = y[delay::every, i]
            found[: len(taken) * every : every, i] = taken
        return found

    def begun(self, first: Any) -> Any:
        """Return the state before the first sample."""
        if not self.longest:
            return first
        return WaitingState((), first, np.zeros((0, len(self.every))), np.zeros((0, self.inputs)))

    def advance(self, inner: Inner, state: Any, y: FloatArray, u: FloatArray) -> tuple[Any, Any]:
        """Take a row as it arrives by the steps of an observer without delays (``y (ny,)``, ``u (nu,)``)."""
        if self.is_plain:
            return inner(state, y, u)
        received = np.where(self.expected(state.k), y, np.nan)
        if not self.longest:
            return inner(state, received, u)
        k, states = state.k, [*state.before, state.latest]
        oldest = k - len(state.before)
        outputs = np.vstack((state.outputs, np.where(self.delays == 0, received, np.nan)))
        inputs, earliest = np.vstack((state.inputs, u)), k
        for i in np.flatnonzero(self.delays):
            taken = k - int(self.delays[i])
            if taken >= oldest and not np.isnan(received[i]):
                outputs[taken - oldest, i] = received[i]
                earliest = min(earliest, taken)
        row = None
        for t in range(earliest - oldest, len(states)):
            after, row = inner(states[t], outputs[t], inputs[t])
            if t + 1 < len(states):
                states[t + 1] = after
        kept = slice(max(len(states) - self.longest, 0), None)
        return WaitingState(tuple(states[kept]), after, outputs[kept], inputs[kept]), row


def require_plain(observer: Any, what: str) -> None:
    """Raise `SpecError` where an observer has sensors of their own times, or bounds on states."""
    for option in ("sensors", "state_bounds"):
        if getattr(observer, option) is not None:
            raise SpecError(
                f"{what} has no {option}: leave the option out of the design, or run it by obsynth run.", path=option
            )


State = TypeVar("State")
Row = TypeVar("Row")
SavedState = TypeVar("SavedState", bound=tuple[Any, ...])
Robust = TypeVar("Robust", bound=Any)
#: Takes the states before and after a sample, what is known at it, and its inputs.
Kept: TypeAlias = Callable[[Any, Any, Any, FloatArray], None]
#: Marks an array whose columns are contiguous: sums are rounded in another order there.
BY_COLUMNS = "by columns"


NO_NUMBERS = read_only(np.zeros(0))
#: Standard deviations within which 95 % of a normal number lie: the width of bands, drawn or counted.
BAND_WIDTH = 1.96
#: The residual of an observer of a nonlinear plant: of its equations in each step.
STEP_RESIDUAL = ("equations",)


def nothing() -> FloatArray:
    """Return an empty array: what an observer does not say."""
    return NO_NUMBERS


@dataclass(frozen=True, eq=False)
class Estimates:
    """What an observer says, one row per sample; of a batch there is an axis of trials before the samples.

    Every observer gives the first eight; recursive and nonlinear ones say besides how far their estimates may be off,
    and what their innovations are.  Arrays that an observer does not know are empty, and deviations NaN.

    Parameters
    ----------
    states : FloatArray
        ``(samples, nx)``; column i estimates state i at ``k - state_delays[i]``.
    faults : FloatArray
        ``(samples, nf)``; column i estimates fault i at ``k - fault_delays[i]``.  The faults of a plant with parameters
        are these: `parameters` is another name.
    residuals : FloatArray
        ``(samples, nr)``; of a nonlinear observer one column, the scaled residual of the equations in each step.
    state_names, fault_names, residual_names : tuple of str
        Names of the columns.
    state_delays, fault_delays : tuple of int
        Delays in samples.
    state_deviations : FloatArray
        ``(samples, nx)``: standard deviations; infinite where missing samples leave a state undetermined.
    fault_covariances : FloatArray
        ``(samples, nf, nf)``: the covariance of the estimates while the parameters are constant (or walk as stated).
        S is none: with forgetting it says how much is still remembered.
    state_covariances, cross_covariances : FloatArray
        ``(samples, nx, nx)`` and ``(samples, nx, nf)``: of the states, and of states with faults, see
        `joint_covariances`; recursive observers (but for the compiled kernel) and nonlinear ones (but for batches).
    innovations : FloatArray
        ``(samples, m)``.  Recursive observers: whitened parity innovations of the model without parameters; NaN where
        there are fewer.  Nonlinear ones: in units of the outputs; NaN where a sample is missing.
    regressors : FloatArray
        ``(samples, m, nq)``, recursive observers: innovations minus regressors times the true parameters are white,
        N(0, I).
    scores, informations : FloatArray
        ``(samples, nq)`` and ``(samples, nq, nq)``, nonlinear observers with a forgetting factor: what each sample says
        of the parameters; to first order scores minus informations times the true parameters are white, N(0,
        informations).
    innovation_covariances : FloatArray
        ``(samples, ny, ny)``, nonlinear observers: what is expected of the innovations; rows and columns of missing
        samples are those of the identity.
    nis, nis_degrees : FloatArray
        ``(samples,)``: squared innovations in units of their covariance, at the parameters estimated one sample before,
        and degrees of freedom, not counting the parameters.
    excitation : FloatArray
        ``(samples,)``: least eigenvalue of the information on the parameters in the last `window` samples, in parameter
        units to the power -2 (nonlinear observers: in units of ``S_0^-1``, so that below one a window says less than
        was known before); (26) asks that it stays above some alpha > 0.  Zero while the window fills; NaN for the
        random walk of a recursive observer, which has no regressors (`certificate.claims` hold the least level).
    conditions : FloatArray
        ``(samples,)``, nonlinear observers: condition of (7).
    contraction : FloatArray
        ``(samples,)``, nonlinear observers: spectral radius of F (I - K H); an error of the state filter decays in
        about ``-1 / log`` of it steps, which should not be longer than the window ``1 / (1 - lambda)``.
    projection : FloatArray
        ``(nx,)``, nonlinear observers: how far the initial state was moved onto its constraint.
    received : numpy.ndarray
        ``(samples, ny)``, of bool: which outputs were there; recursive and nonlinear observers.
    """

    states: FloatArray
    faults: FloatArray
    residuals: FloatArray
    state_names: tuple[str, ...]
    fault_names: tuple[str, ...]
    residual_names: tuple[str, ...]
    state_delays: tuple[int, ...]
    fault_delays: tuple[int, ...]
    state_deviations: FloatArray = field(default_factory=nothing)
    fault_covariances: FloatArray = field(default_factory=nothing)
    state_covariances: FloatArray = field(default_factory=nothing)
    cross_covariances: FloatArray = field(default_factory=nothing)
    innovations: FloatArray = field(default_factory=nothing)
    regressors: FloatArray = field(default_factory=nothing)
    scores: FloatArray = field(default_factory=nothing)
    informations: FloatArray = field(default_factory=nothing)
    innovation_covariances: FloatArray = field(default_factory=nothing)
    nis: FloatArray = field(default_factory=nothing)
    nis_degrees: FloatArray = field(default_factory=nothing)
    excitation: FloatArray = field(default_factory=nothing)
    conditions: FloatArray = field(default_factory=nothing)
    contraction: FloatArray = field(default_factory=nothing)
    projection: FloatArray = field(default_factory=nothing)
    received: NDArray[np.bool_] = field(default_factory=lambda: NO_NUMBERS.astype(bool))

    def __post_init__(self) -> None:
        nf = len(self.fault_names)
        unknown = {"state_deviations": self.states.shape, "fault_covariances": (*self.faults.shape, nf)}
        for name, shape in unknown.items():
            if getattr(self, name) is NO_NUMBERS:
                object.__setattr__(self, name, np.broadcast_to(np.nan, shape))

    @property
    def has_deviations(self) -> bool:
        """Whether the observer says how far its estimates may be off."""
        return not (np.isnan(self.state_deviations).all() and np.isnan(self.fault_covariances).all())

    @property
    def fault_deviations(self) -> FloatArray:
        """Standard deviations of the fault estimates ``(samples, nf)``; NaN where the observer knows none."""
        return np.asarray(np.sqrt(np.einsum("...ii->...i", self.fault_covariances)))

    @property
    def joint_covariances(self) -> FloatArray:
        """Covariances of states and faults together ``(samples, nx + nf, nx + nf)``; empty where they are not known."""
        if not self.state_covariances.size:
            return NO_NUMBERS
        across = self.cross_covariances
        return np.concatenate(
            [
                np.concatenate([self.state_covariances, across], axis=-1),
                np.concatenate([np.swapaxes(across, -1, -2), self.fault_covariances], axis=-1),
            ],
            axis=-2,
        )

    @property
    def parameters(self) -> FloatArray:
        """The estimates of the parameters ``(samples, nq)``: the same as `faults`."""
        return self.faults

    @property
    def parameter_names(self) -> tuple[str, ...]:
        """The same as `fault_names`."""
        return self.fault_names

    @property
    def parameter_covariances(self) -> FloatArray:
        """The same as `fault_covariances`, ``(samples, nq, nq)``."""
        return self.fault_covariances

    @property
    def parameter_deviations(self) -> FloatArray:
        """The same as `fault_deviations`, ``(samples, nq)``."""
        return self.fault_deviations


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

    def shown(self, row: Any) -> Any:
        """Return a row as it is shown, within the bounds of the states."""
        return row

    def init(self) -> Any:
        """Return the state before the first sample, k = 0."""
        return self.timing.begun(self._steps.first)

    def advance(self, state: Any, y: FloatArray, u: FloatArray) -> tuple[Any, Any]:
        """Return the next state and what is known at a sample, without checking it (``y (ny,)``, ``u (nu,)``)."""
        after, row = self.timing.advance(self._steps.advance, state, y, u)
        return after, self.shown(row)

    def accept(self, state: Any, y: FloatArray, u: FloatArray, kept: Kept | None = None) -> tuple[Any, Any]:
        """Return the same as `advance`, where the step is one that can be trusted (``y (ny,)``, ``u (nu,)``); ``kept``
        is called with what each sample, whose values are all of its own time, led from and to: see `Kept`."""
        after, row = self.timing.advance(partial(self._in_order, kept), state, y, u)
        return after, self.shown(row)

    def _in_order(self, kept: Kept | None, state: Any, y: FloatArray, u: FloatArray) -> tuple[Any, Any]:
        self._allow(state)
        after, row = self._steps.advance(state, y, u)
        self._trust(row)
        if kept is not None:
            kept(state, after, row, u)
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
        self.state, found = self.observer.step(self.state, y, u)
        return found

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


def changed(observer: Robust, **options: Any) -> Robust:
    """Return the observer with other options; the steps of a nonlinear one are built once."""
    found = replace(observer, **options)
    if "steps" in vars(observer):
        # What these options do stands outside of the compiled steps.
        vars(found)["steps"] = type(observer.steps)(found, observer.steps.graph)
    return found


def as_run(observer: Robust, outliers: str | None = None) -> Robust:
    """Return the observer as a run on data has it: outliers are left out where nothing else is said of them."""
    wanted = outliers or ("gate" if observer.outliers == "none" else observer.outliers)
    return observer if wanted == observer.outliers else changed(observer, outliers=wanted)


def plain_recursion(observer: Robust) -> Robust:
    """Return the recursion itself: every sensor at each row, at once, taken as it is, and no bounds on states."""
    return changed(observer, outliers="none", sensors=None, state_bounds=None)


def state_as_data(state: tuple[Any, ...]) -> dict[str, Any]:
    """Return a state as numbers, arrays, lists and mappings, to be written to a file."""
    return {name: _as_data(value) for name, value in state._asdict().items()}  # type: ignore[attr-defined]


def state_from_data(like: SavedState, data: dict[str, Any]) -> SavedState:
    """Return the state of the same kind as ``like`` that `state_as_data` described."""
    if hasattr(like, "from_data"):
        restored: SavedState = like.from_data(data, state_from_data)
        return restored
    values = {name: _from_data(own, data[name]) for name, own in like._asdict().items()}  # type: ignore[attr-defined]
    return type(like)(**values)


def _as_data(value: Any) -> Any:
    if isinstance(value, np.ndarray):
        by_columns = value.ndim == 2 and value.strides[0] < value.strides[1]
        return {BY_COLUMNS: np.array(value, order="F")} if by_columns else np.array(value, order="C")
    if hasattr(value, "_asdict"):
        return state_as_data(value)
    return [_as_data(part) for part in value] if isinstance(value, tuple) else value


def _from_data(like: Any, value: Any) -> Any:
    if hasattr(like, "_asdict"):
        return state_from_data(like, value)
    if isinstance(like, tuple):
        return tuple(_array(part) for part in value)
    return _array(value) if isinstance(like, np.ndarray) else value


def _array(value: Any) -> Any:
    if isinstance(value, (int, float)):
        return value
    return np.asfortranarray(value[BY_COLUMNS]) if isinstance(value, dict) else np.array(value)
