"""The interface of an observer that runs on the rows of a log, and its result at each row."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from types import MappingProxyType
from typing import Any, ClassVar, NamedTuple

from obsynth.errors import SpecError
from obsynth.monitoring.logs.clock import LONGEST_BRIDGE
from obsynth.monitoring.thresholds.monitor import Evidence, LinearSample
from obsynth.numerics.arrays import FloatArray
from obsynth.observers.linear.modes import SETTLING_SLACK, checked_warm_up
from obsynth.observers.saved_states import state_as_data, state_from_data
from obsynth.plants.descriptor import DescriptorSystem

#: Statuses of a row of estimates.
OK, WARM_UP, PARTIAL, GAP, RECOVERING = "ok", "warm-up", "partial", "gap", "recovering"

#: A row in which a scheduling parameter is outside its region, or was so recently that nothing is claimed yet.
OUT = "out"

#: Rows in which a decision may be taken.
DECIDING = (OK, PARTIAL)

#: Waiting without dt ends with a row that so many roundings call earlier.
SETTLING_ULPS = 4.0


class Row(NamedTuple):
    """A row of a log, and the estimates at it."""

    status: str  # ``ok``, ``warm-up``, ``partial``, ``gap``, ``recovering`` or ``out``
    values: FloatArray  # one for each column of the observer; deviations, NaN where nothing is known
    skipped: int = 0  # rows missing before this one for which the observer has no row of its own
    evidence: Evidence | LinearSample | None = None  # what was learnt from this row, for decisions
    settled: bool = True  # whether the effects of gaps have decayed, so that guaranteed bounds hold
    # Bound on what a gap has left in each value of a row that is recovering, if the model's error in the gap was never
    # larger than at its end; infinite where that is not known.
    excess: FloatArray | None = None
    bridged: bool = False  # whether the plant's model replaced every missing sample since the warm-up
    # By how many times fault estimates are less certain than before samples were missing ``(nf,)``; ``None``: no less.
    unsure: FloatArray | None = None
    time: float = math.nan  # in seconds
    deviations: FloatArray | None = None  # ``(nu + ny,)`` as read
    at: float = math.nan  # the time of its sample since the first one; of continuous designs that of its stamp
    # How many samples in a row of each output have been equal ``(ny,)``, where a monitor has learned how many may be.
    repeated: FloatArray | None = None
    # Rows of a sampled design that were missing before this one: as the observer went through them, without signals.
    missed: tuple[Row, ...] = ()


class LogObserver(ABC):
    """The observer of a design on rows of a log: what it reads and estimates, and its state from row to row. Samples
    that are missing are its business, time stamps are that of the run."""

    input_names: tuple[str, ...]  # what is read from each row, in order
    output_names: tuple[str, ...]
    columns: tuple[str, ...]  # of estimates: states and faults first
    point: Mapping[str, float] = MappingProxyType({})  # operating point by name of the signal
    scales: Mapping[str, float] = MappingProxyType({})  # factor of inputs and outputs by name
    notes: tuple[str, ...] = ()  # what a user should know before anything is run
    plant: DescriptorSystem | None = None  # of a linear design
    takes_any_interval: bool = False  # of a sampled design: each step from the continuous plant, over its own interval
    own_intervals_only: str = ""  # of a recursive design that does not: why
    input_delay: int = 0  # rows of a log by which inputs act later than the design takes them
    saved: ClassVar[Mapping[str, str]] = {}  # attributes that go from row to row, by their names in a saved state

    def __init__(self, observer: Any, warm_up: float | None, default_warm_up: float) -> None:
        self.state_names, self.fault_names = observer.state_names, observer.fault_names
        self.state_delays, self.fault_delays = observer.state_delays, observer.fault_delays
        self.dt: float = observer.dt
        self.warm_up = checked_warm_up(warm_up, default_warm_up)
        self.settled_at, self.phase = math.inf, WARM_UP
        self.options: dict[str, float | None] = {"warm_up": self.warm_up}

    @property
    def estimated(self) -> tuple[str, ...]:
        """Columns of the estimates of states and faults."""
        return (*(f"xhat[{name}]" for name in self.state_names), *(f"fhat[{name}]" for name in self.fault_names))

    @property
    def lags(self) -> list[tuple[str, int]]:
        """Name and delay in samples of what lags: the states (together where they lag alike), and each fault."""
        delays = list(zip(self.estimated, (*self.state_delays, *self.fault_delays), strict=True))
        if len(set(self.state_delays)) == 1:
            delays[: len(self.state_names)] = [("xhat", self.state_delays[0])]
        return [(name, delay) for name, delay in delays if delay]

    @abstractmethod
    def take(self, time: float, values: FloatArray, *, seconds: float, missing: int, longest: float) -> Row:
        """Take one row: its time (of a sampled design that of its sample), deviations ``(nu + ny,)``, how many seconds
        and missing rows are between it and the row before, and the longest interval so far."""

    def follows(self, missing: int) -> bool:
        """Whether rows that are missing are taken one by one, as if they stood in the log without signals."""
        return self.dt > 0.0 and missing <= LONGEST_BRIDGE

    def _after(self, time: float, seconds: float) -> float:
        """Return from when on ``seconds`` after a time are over."""
        slack = SETTLING_SLACK * self.dt if self.dt > 0.0 else SETTLING_ULPS * math.ulp(abs(time) + seconds)
        return time + seconds - slack

    def warnings(self) -> tuple[str, ...]:
        """Return what a run should say of the observer once it has ended."""
        return ()

    @property
    def takes_pieces(self) -> bool:
        """Whether `take_piece` can go on from where the observer is."""
        return False

    def take_piece(self, times: Sequence[float], values: FloatArray, intervals: Sequence[float]) -> list[Row]:
        """Take rows that follow each other without a gap, ``values (rows, nu + ny)``, or the first of them."""
        raise NotImplementedError

    def as_dict(self) -> dict[str, Any]:
        """Return the state that goes from row to row, as data."""
        own = {key: getattr(self, name) for key, name in self.saved.items()}
        plain = {key: state_as_data(value) if hasattr(value, "_asdict") else value for key, value in own.items()}
        return {"settled_at": self.settled_at, "phase": self.phase, **self.options, **plain}

    def resume(self, data: Mapping[str, Any]) -> None:
        """Go on from what `as_dict` returned."""
        if any(data[name] != value for name, value in self.options.items()):
            listed = " or ".join(name.replace("_", "-") for name in sorted(self.options))
            raise SpecError(f"The saved state is of a run with another {listed}: use the same options.", path="state")
        self.settled_at, self.phase = data["settled_at"], data["phase"]
        for key, name in self.saved.items():
            own = getattr(self, name)
            setattr(self, name, state_from_data(own, data[key]) if hasattr(own, "_asdict") else data[key])
