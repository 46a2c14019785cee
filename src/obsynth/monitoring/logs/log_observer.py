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

#: Statuses of rows that may be decided.
DECIDING = (OK, PARTIAL)

#: In continuous time a waiting period ends with a row that is earlier than its end by at most so many roundings.
SETTLING_ULPS = 4.0


class Row(NamedTuple):
    """A row of a log, and the estimates at it."""

    status: str  # ``ok``, ``warm-up``, ``partial``, ``gap``, ``recovering`` or ``out``
    values: FloatArray  # one for each column of the observer; deviations, NaN where nothing is known
    skipped: int = 0  # rows missing before this one for which the observer has no row of its own
    evidence: Evidence | LinearSample | None = None  # the observer's own row, for decisions
    settled: bool = True  # whether the effects of gaps have decayed, so that guaranteed bounds hold
    # Bound on the effect of a gap on each value of a recovering row, if the model's error in the gap was never larger
    # than at its end; infinite where it is unknown.
    excess: FloatArray | None = None
    bridged: bool = False  # whether the plant's model replaced every missing sample since the warm-up
    # Factor of the standard deviations of fault estimates by missing samples ``(nf,)``; ``None``: one.
    unsure: FloatArray | None = None
    time: float = math.nan  # in seconds
    deviations: FloatArray | None = None  # ``(nu + ny,)`` as read
    at: float = math.nan  # time of its sample since the first one; for continuous designs that of its stamp
    # Number of equal consecutive samples of each output ``(ny,)``, if a monitor has learned the usual number.
    repeated: FloatArray | None = None
    # The missing rows of a sampled design before this one, as the observer processed them, without signals.
    missed: tuple[Row, ...] = ()


class LogObserver(ABC):
    """The observer of a design on the rows of a log, with its signals, its estimates and its state between rows.

    It handles missing samples; the run handles time stamps.
    """

    input_names: tuple[str, ...]  # the signals that are read from each row, in order
    output_names: tuple[str, ...]
    columns: tuple[str, ...]  # of estimates: states and faults first
    point: Mapping[str, float] = MappingProxyType({})  # operating point by name of the signal
    scales: Mapping[str, float] = MappingProxyType({})  # factor of inputs and outputs by name
    notes: tuple[str, ...] = ()  # notes for the user before a run
    plant: DescriptorSystem | None = None  # of a linear design
    takes_any_interval: bool = False  # whether a sampled design can step over any interval, by its continuous plant
    own_intervals_only: str = ""  # the reason why a recursive design cannot do so
    input_delay: int = 0  # rows of a log by which inputs act later than in the design
    saved: ClassVar[Mapping[str, str]] = {}  # attributes that form the state, by their names in a saved state

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
        """Names and delays in samples of lagging estimates: the states (together if their delays are equal), and each
        fault."""
        delays = list(zip(self.estimated, (*self.state_delays, *self.fault_delays), strict=True))
        if len(set(self.state_delays)) == 1:
            delays[: len(self.state_names)] = [("xhat", self.state_delays[0])]
        return [(name, delay) for name, delay in delays if delay]

    @abstractmethod
    def take(self, time: float, values: FloatArray, *, seconds: float, missing: int, longest: float) -> Row:
        """Process one row, and return its estimates.

        Parameters
        ----------
        time : float, seconds
            Time of the row; for a sampled design that of its sample.
        values : FloatArray
            Deviations ``(nu + ny,)`` from the operating point.
        seconds : float
            Time since the row before.
        missing : int
            Number of missing rows since the row before.
        longest : float, seconds
            Longest interval between rows so far.
        """

    def follows(self, missing: int) -> bool:
        """Whether missing rows are processed one by one, as rows of the log without signals."""
        return self.dt > 0.0 and missing <= LONGEST_BRIDGE

    def _after(self, time: float, seconds: float) -> float:
        """Return the time at which ``seconds`` after a time have passed, less a tolerance for rounding."""
        slack = SETTLING_SLACK * self.dt if self.dt > 0.0 else SETTLING_ULPS * math.ulp(abs(time) + seconds)
        return time + seconds - slack

    def warnings(self) -> tuple[str, ...]:
        """Return the warnings of a run on the observer, at its end."""
        return ()

    @property
    def takes_pieces(self) -> bool:
        """Whether `take_piece` can process the next rows."""
        return False

    def take_piece(self, times: Sequence[float], values: FloatArray, intervals: Sequence[float]) -> list[Row]:
        """Process rows without gaps between them, ``values (rows, nu + ny)``, or only the first of these rows."""
        raise NotImplementedError

    def as_dict(self) -> dict[str, Any]:
        """Return the state between rows as data."""
        own = {key: getattr(self, name) for key, name in self.saved.items()}
        plain = {key: state_as_data(value) if hasattr(value, "_asdict") else value for key, value in own.items()}
        return {"settled_at": self.settled_at, "phase": self.phase, **self.options, **plain}

    def resume(self, data: Mapping[str, Any]) -> None:
        """Restore the state from the data that `as_dict` returned."""
        if any(data[name] != value for name, value in self.options.items()):
            listed = " or ".join(name.replace("_", "-") for name in sorted(self.options))
            raise SpecError(f"The saved state is of a run with another {listed}: use the same options.", path="state")
        self.settled_at, self.phase = data["settled_at"], data["phase"]
        for key, name in self.saved.items():
            own = getattr(self, name)
            setattr(self, name, state_from_data(own, data[key]) if hasattr(own, "_asdict") else data[key])
