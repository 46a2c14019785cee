"""What runs on rows of data: the same questions and answers for every kind of design."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any, NamedTuple, Protocol

from obsynth.experiments.monitors.online import Evidence, LinearSample
from obsynth.numerics.arrays import FloatArray

#: What a row of estimates is.
OK, WARM_UP, PARTIAL, GAP, RECOVERING = "ok", "warm-up", "partial", "gap", "recovering"
#: Rows in which a decision may be taken.
DECIDING = (OK, PARTIAL)
#: Gaps longer than this many samples are not bridged: the observer starts again.
LONGEST_BRIDGE = 10_000


class Row(NamedTuple):
    """Estimates at one row of data."""

    status: str  # ``ok``, ``warm-up``, ``partial``, ``gap`` or ``recovering``
    # one for each column of the engine, state estimates first, then fault estimates; deviations; NaN where nothing is
    # known
    values: FloatArray
    skipped: int = 0  # how many rows were missing before this one
    # what a recursive observer learnt from this row, for decisions; `None` for others
    evidence: Evidence | LinearSample | None = None


class Entry(NamedTuple):
    """A row of a log."""

    time: float  # in seconds
    deviations: FloatArray  # ``(nu + ny,)`` as read
    row: Row  # of the filter, and in time smoothed


class Later(Protocol):
    """Rows that wait for those after them: what leaves is an entry, what the observer said of it, and more."""

    def take(self, entry: Entry) -> Iterable[tuple[Entry, Any, Any]]:
        """Take a row after its step; return those that need not wait any more."""
        ...

    def flush(self) -> Iterable[tuple[Entry, Any, Any]]:
        """Return the rows that wait."""
        ...


class Engine(Protocol):
    """A running design on measured data. Fields: input_names, output_names: What is read from each row, in order;
    state_names, fault_names: What is estimated: the first columns; columns: Names of the columns of estimates;
    state_delays, fault_delays: Samples by which each estimate lags; dt: Seconds between samples; 0 for continuous time;
    point: Operating point by name of the signal; scales: Factor of inputs and outputs by name, where the plant states
    one; notes: What a user should know before anything is run."""

    @property
    def input_names(self) -> tuple[str, ...]:
        """Known inputs."""
        ...

    @property
    def output_names(self) -> tuple[str, ...]:
        """Outputs of the plant."""
        ...

    @property
    def state_names(self) -> tuple[str, ...]:
        """States that are estimated."""
        ...

    @property
    def fault_names(self) -> tuple[str, ...]:
        """Faults or parameters that are estimated."""
        ...

    @property
    def columns(self) -> tuple[str, ...]:
        """Names of the columns of estimates."""
        ...

    @property
    def state_delays(self) -> tuple[int, ...]:
        """Samples by which each state estimate lags."""
        ...

    @property
    def fault_delays(self) -> tuple[int, ...]:
        """Samples by which each fault estimate lags."""
        ...

    @property
    def dt(self) -> float:
        """Seconds between samples; 0 for continuous time."""
        ...

    @property
    def point(self) -> Mapping[str, float]:
        """Operating point by name of the signal."""
        ...

    @property
    def scales(self) -> Mapping[str, float]:
        """Factor of inputs and outputs by name, where the plant states one."""
        ...

    @property
    def notes(self) -> tuple[str, ...]:
        """What a user should know before anything is run."""
        ...

    def step(self, time: float, values: FloatArray, row: int) -> Row:
        """Take one row of data; see `obsynth.data.linear_log.DataObserver.step`."""
        ...

    def as_dict(self) -> dict[str, Any]:
        """Return the state that goes from row to row, as data."""
        ...

    def resume(self, data: dict[str, Any]) -> None:
        """Go on from what `as_dict` returned."""
        ...


def estimate_columns(
    states: tuple[str, ...], faults: tuple[str, ...], residuals: tuple[str, ...], *, deviations: bool = False
) -> tuple[str, ...]:
    """Return the names of columns."""
    estimated = (*(f"xhat[{name}]" for name in states), *(f"fhat[{name}]" for name in faults))
    spread = tuple(f"sd {name}" for name in estimated) if deviations else ()
    return (*estimated, *spread, *(f"r[{name}]" for name in residuals))


def delayed(engine: Engine) -> tuple[tuple[str, int], ...]:
    """Return name and delay in samples of what lags: the states (together where they lag alike), and each fault."""
    states = set(engine.state_delays)
    found = [(f"xhat[{name}]", delay) for name, delay in zip(engine.state_names, engine.state_delays, strict=True)]
    if len(states) == 1:
        found = [("xhat", engine.state_delays[0])]
    found += [(f"fhat[{name}]", delay) for name, delay in zip(engine.fault_names, engine.fault_delays, strict=True)]
    return tuple((name, delay) for name, delay in found if delay)
