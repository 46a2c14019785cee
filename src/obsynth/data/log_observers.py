"""A linear observer on a log, row by row: gaps, bad rows, warm-up; and which observer a design has on a log.

Tests whose weights change with k, on a log; the first row is k = 0.

Observers that take missing outputs themselves, on a log: held inputs, new starts, status.

An observer on rows of a log: what it says of each, and what every kind of observer has there; and the clock.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Iterable, Mapping, Sequence
from functools import lru_cache, partial
from types import MappingProxyType
from typing import Any, ClassVar, NamedTuple, TypeVar

import numpy as np

from obsynth.errors import ObsynthError, PreconditionError, SolverError, SpecError
from obsynth.experiments.monitors.learned import innovation_names
from obsynth.experiments.monitors.monitor import Evidence, LinearSample
from obsynth.numerics.arguments import FloatArray, real_number
from obsynth.numerics.continuous import first_order_hold
from obsynth.observers.dae.observer import DAEObserver
from obsynth.observers.linear.observer import (
    LinearObserver,
    WindowObserver,
    checked_warm_up,
    noise_variances,
    transient,
)
from obsynth.observers.records import no_inputs, over_samples, taken_inputs
from obsynth.observers.recursive.observer import RecursiveObserver
from obsynth.observers.running import as_run, state_as_data, state_from_data
from obsynth.observers.smoothing import Chain
from obsynth.plants.descriptor import DescriptorSystem
from obsynth.results.design import ObserverDesign

#: What a row of estimates is.
OK, WARM_UP, PARTIAL, GAP, RECOVERING = "ok", "warm-up", "partial", "gap", "recovering"
#: Rows whose stamps do not rise: they are left out, and say nothing.
REPEATED_STAMP, OUT_OF_ORDER = "repeated stamp", "out of order"
STALE = (REPEATED_STAMP, OUT_OF_ORDER)
#: Rows in which a decision may be taken.
DECIDING = (OK, PARTIAL)
#: Gaps longer than this many samples are not bridged: the observer starts again.
LONGEST_BRIDGE = 10_000
#: A sampled design takes a stamp as the sample that it is nearest to: it is off by up to this share of dt.
STAMP_SHARE = 0.45
#: Continuous designs: a gap of so little more than a number of intervals has no further row in it.
COUNTING_SHARE = 0.01
#: What remains of a deviation from the samples in the next one: a clock that is a little fast is followed.
FOLLOWING_SHARE = 0.9
#: Stamps that are this far from the samples on average are of another sampling time; the average takes this share of
#: each new row, and begins with nothing.
OTHER_SHARE, AVERAGED_SHARE = 0.25, 0.05
#: So many rows in a row whose stamps do not rise are no slip of a clock.
MOST_STALE = 10
#: One that differs by this share of dt is one of dt for certain.
SURE_SHARE = 0.009
#: Without another word, an interval is a gap when it is longer than this many times the longest one before.
GAP_FACTOR = 10.0
#: Waiting ends with a sample that rounding, of this share of dt, calls earlier; without dt, of so many roundings.
SETTLING_SLACK, SETTLING_ULPS = 1e-6, 4.0
#: A gap of more samples than this cannot be counted in double precision.
MOST_COUNTED_SAMPLES = 2.0**53


class Row(NamedTuple):
    """A row of a log, and the estimates at it."""

    status: str  # ``ok``, ``warm-up``, ``partial``, ``gap`` or ``recovering``
    values: FloatArray  # one for each column of the observer; deviations, NaN where nothing is known
    skipped: int = 0  # how many rows were missing before this one that nothing stands for
    evidence: Evidence | LinearSample | None = None  # what was learnt from this row, for decisions
    settled: bool = True  # whether nothing is left of gaps: bounds that are never passed hold
    # What a gap has left in each value of a row that is recovering, where the model missed by no more all through it
    # than at its end; infinite where that is not known.
    excess: FloatArray | None = None
    bridged: bool = False  # whether the plant's model stood in for all that was missing since the warm-up
    # By how many times fault estimates are less certain than before samples were missing ``(nf,)``; ``None``: no less.
    unsure: FloatArray | None = None
    time: float = math.nan  # in seconds
    deviations: FloatArray | None = None  # ``(nu + ny,)`` as read
    at: float = math.nan  # the time of its sample since the first one; of continuous designs that of its stamp
    # Rows of a sampled design that were missing before this one: as the observer went through them, without signals.
    missed: tuple[Row, ...] = ()


class Clock:
    """Checks one time stamp after the other; ``dt`` is 0 in continuous time, with gaps longer than ``gap`` seconds."""

    def __init__(self, dt: float, gap: float | None) -> None:
        self.dt, self.gap = dt, gap
        # Sampled designs: the time of the last sample, near which its stamp lies.
        self.last: float | None = None
        self.longest = 0.0
        self.stamp, self.away, self.left_out = -math.inf, 0.0, 0
        # Of sampled designs: the number of the last sample, from that of the first row.
        self.count = 0
        self.is_resumed = False  # and no row has been taken since

    def as_dict(self) -> dict[str, Any]:
        """Return what goes from row to row, as data."""
        return {name: getattr(self, name) for name in ("last", "longest", "stamp", "away", "left_out", "count")}

    def resume(self, data: Mapping[str, Any]) -> None:
        """Go on from what `as_dict` returned."""
        vars(self).update(data)
        self.is_resumed = True

    def at(self, time: float, before: int = 0) -> float:
        """Return the time of the last sample, with this stamp, or of one so many before it: sampled designs count
        samples, whatever their stamps are off by."""
        return (self.count - before) * self.dt if self.dt > 0.0 else time

    def advance(self, time: float, row: int) -> tuple[float, int]:
        """Take the stamp of the next row."""
        if not math.isfinite(time):
            raise SpecError(f"Row {row} has no time: each row needs a finite number of seconds.", path=f"row {row}")
        last = self.last
        if last is None:
            self.last = self.stamp = time
            return 0.0, 0
        if time == last:
            raise SpecError(f"Row {row} repeats the time {time:.17g} s of the row before.", path=f"row {row}")
        if time < last:
            raise SpecError(f"Row {row}: the time falls from {last:.17g} to {time:.17g} s.", path=f"row {row}")
        step = interval(last, time)
        missing = self._sampled(step, row) if self.dt > 0.0 else self._continuous(step, row)
        self.last = time
        self.count += missing + 1
        if self.dt > 0.0:
            away = step - (missing + 1) * self.dt
            # Regular stamps are taken as they are, and not as they are summed up.
            self.last = time if abs(away) <= SURE_SHARE * self.dt else time - FOLLOWING_SHARE * away
        self.stamp, self.left_out, self.is_resumed = time, 0, False
        if not missing:
            self.longest = max(self.longest, step)
        return step, missing

    def stale(self, time: float) -> str:
        """Return the status of a row whose stamp does not rise, which is left out; empty for others. A run that goes on
        from a saved state may begin with the rows that the state has, however many they are."""
        last = self.last
        if last is None or not math.isfinite(time) or (self.left_out >= MOST_STALE and not self.is_resumed):
            return ""
        # Of a sampled design the last sample may be told a little later than its stamp.
        before = max(self.stamp, last - STAMP_SHARE * self.dt) if self.dt > 0.0 else last
        if time > before and time != last:
            return ""
        self.left_out += 1
        return REPEATED_STAMP if time in (self.stamp, last) else OUT_OF_ORDER

    def regular(self, times: Sequence[float]) -> list[float]:
        """Return the intervals to the first of these stamps that certainly follow each other without a gap; nothing is
        taken."""
        found: list[float] = []
        if self.last is None or not self.longest > 0.0:
            return found
        before, longest = self.last, GAP_FACTOR * self.longest if self.gap is None else self.gap
        lowest, highest = 0.0, longest
        if self.dt > 0.0:
            # Narrower than what fits, so that no rounding of an interval counts.
            lowest, highest = (1.0 - SURE_SHARE) * self.dt, (1.0 + SURE_SHARE) * self.dt
        for time in times:
            step = interval(before, time) if time > before and time < math.inf else 0.0
            if not lowest <= step <= highest or step <= 0.0:
                break
            found.append(step)
            before = time
        return found

    def take(self, times: Sequence[float], steps: Sequence[float]) -> None:
        """Take stamps that `regular` found to follow each other, with their intervals."""
        self.last, self.longest = times[-1], max(self.longest, *steps)
        self.stamp, self.left_out, self.away = times[-1], 0, 0.0
        self.count += len(times)

    def _sampled(self, step: float, row: int) -> int:
        count = _counted(step / self.dt, step, row)
        away = abs(step - count * self.dt) / self.dt
        average = (1.0 - AVERAGED_SHARE) * self.away + AVERAGED_SHARE * away
        if count < 1 or away > STAMP_SHARE or average > OTHER_SHARE:
            raise SpecError(
                f"Row {row} comes {step:.10g} s after the row before, but the design has dt = {self.dt:.10g} s: "
                "a time stamp may be off by 45 % of dt, and all of them by 25 % on average; irregular time stamps "
                "need a continuous-time design.",
                path=f"row {row}",
            )
        # One gap may be the first interval of a log.
        if count > 1 and self.longest == 0.0 and self.count > 0:
            raise SpecError(
                f"Row {row}: the data begin with intervals of {step:.10g} s and the like, but the design has dt = "
                f"{self.dt:.10g} s: the sampling time does not fit.",
                path=f"row {row}",
            )
        self.away = average
        return count - 1

    def _continuous(self, step: float, row: int) -> int:
        typical = self.longest or step
        if step <= (GAP_FACTOR * typical if self.gap is None else self.gap):
            return 0
        unit = typical if self.longest else min(step, self.gap or step)
        _counted(step / unit, step, row)
        return max(math.ceil(step / unit * (1.0 - COUNTING_SHARE)) - 1, 1)


def _counted(samples: float, step: float, row: int) -> int:
    """Return a whole number of samples; more than can be counted are no gap but a mistake."""
    if not samples < MOST_COUNTED_SAMPLES:
        raise SpecError(
            f"Row {row} comes {step:.10g} s after the row before, {samples:.3g} samples: are the times in seconds?",
            path=f"row {row}",
        )
    return round(samples)


def interval(before: float, after: float) -> float:
    """Return ``after - before``, rounded to what the two stamps can resolve, so that equal intervals are equal."""
    resolution = 2.0 * max(math.ulp(before), math.ulp(after))
    digits = -math.ceil(math.log10(resolution))
    rounded = round(after - before, digits)
    return rounded if rounded > 0.0 else after - before


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
        found = list(zip(self.estimated, (*self.state_delays, *self.fault_delays), strict=True))
        if len(set(self.state_delays)) == 1:
            found[: len(self.state_names)] = [("xhat", self.state_delays[0])]
        return [(name, delay) for name, delay in found if delay]

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
            told = " or ".join(name.replace("_", "-") for name in sorted(self.options))
            raise SpecError(f"The saved state is of a run with another {told}: use the same options.", path="state")
        self.settled_at, self.phase = data["settled_at"], data["phase"]
        for key, name in self.saved.items():
            own = getattr(self, name)
            setattr(self, name, state_from_data(own, data[key]) if hasattr(own, "_asdict") else data[key])


class WindowLogObserver(LogObserver):
    """A test on a log: there is no verdict until its window is complete."""

    saved: ClassVar = {"observer": "state", "complete": "complete"}

    def __init__(self, design: ObserverDesign, observer: WindowObserver, *, warm_up: float | None = None) -> None:
        if warm_up is not None:
            raise SpecError(
                "warm_up is for observers with an initial-condition response: this test uses the samples of its "
                "window alone.",
                path="warm_up",
            )
        super().__init__(observer, None, 0.0)
        plant: Any = design.plant
        self.observer, self.columns = observer, observer.row_names
        self.input_names, self.output_names = observer.input_names, observer.output_names
        self.point, self.scales, self.input_delay = plant.operating_point, plant.scales, design.input_delay
        self.state, self.complete = observer.init(), 0

    def take(self, time: float, values: FloatArray, *, seconds: float, missing: int, longest: float) -> Row:
        """Take one row."""
        if missing:
            self.state, self.complete = self.observer.skip(self.state, missing), 0
            self.phase = RECOVERING if self.phase == OK else self.phase
        nu, k = len(self.input_names), self.state.k
        found = np.where(np.isfinite(values), values, np.nan)
        with np.errstate(over="ignore", invalid="ignore"):
            self.state, value = self.observer.advance(self.state, found[nu:], found[:nu])
        known = bool(np.isfinite(values).all())
        self.complete = min(self.complete + 1, self.observer.samples) if known else 0
        status = GAP
        if known:
            full = self.complete == self.observer.samples and k >= self.observer.samples
            self.phase = OK if full else RECOVERING if self.phase in (OK, RECOVERING) else WARM_UP
            status = self.phase
        row_values = np.array([value])
        return Row(status, row_values, missing, LinearSample(row_values, found[:nu], found[nu:], 0))


#: How many lengths of an interval are kept discretised.
KEPT_INTERVALS = 64
#: A gap is over when what it can have left in fault estimates and residuals is below this share of their usual changes
#: from row to row, which so many rows must have shown, or below what the stated noise of the sensors makes of them.
GAP_LEFT_SHARE, LEAST_SHOWN = 1.0, 20
#: What is guaranteed waits until what a gap has left is below this share of that, for so many initial-condition
#: responses at most.
GUARANTEED_SHARE, MOST_TRANSIENTS = 1e-3, 10
SAMPLED_GAP = "gap is for continuous-time designs: for a sampled one missing rows follow from the time stamps."
#: What goes from row to row.
SAVED = (
    *("z", "v", "row", "model", "fault", "inputs", "measured", "seen"),
    *("moves", "reach"),
    *("clear_at", "begun", "changes", "counted", "left", "held", "excess", "carried", "known_from", "bridged"),
)
_Part = TypeVar("_Part")


class GapModel:
    """The plant model that stands in for the sensors during a gap: faults held, unknown inputs zero, ``E = I``.
    ``into (nx, nx_source)``: the dynamic states in an estimate of all states."""

    def __init__(self, plant: DescriptorSystem, into: FloatArray) -> None:
        self.plant, self.into = plant, into
        self._hold = lru_cache(KEPT_INTERVALS)(partial(first_order_hold, plant.A, np.hstack([plant.B, plant.Bf])))

    @classmethod
    def of(cls, plant: DescriptorSystem) -> GapModel | None:
        """Return the model of a plant; ``None`` where the plant cannot be propagated (index 2 or more)."""
        if np.array_equal(plant.E, np.eye(plant.nx)):
            return cls(plant, np.eye(plant.nx))
        from obsynth.analysis.transformations.linear_plants import eliminate_algebraic_states

        try:
            done = eliminate_algebraic_states(plant)
        except PreconditionError:
            return None
        moving = plant.E @ done.recovery.from_state
        return cls(done.plant, np.asarray(np.linalg.pinv(moving) @ plant.E))

    def start(self, estimate: FloatArray, inputs: Iterable[FloatArray], fault: FloatArray) -> FloatArray:
        """Return the dynamic states now from an estimate ``(nx_source,)`` and the inputs of the samples since."""
        state = self.into @ estimate
        for u in inputs:
            state = self.after(state, 0.0, u, u, fault)
        return np.asarray(state)

    def after(
        self, state: FloatArray, seconds: float, before: FloatArray, u: FloatArray, fault: FloatArray
    ) -> FloatArray:
        """Return the state a sample later, or after an interval along which inputs go from ``before`` to ``u``."""
        plant = self.plant
        if plant.dt > 0.0:
            return np.asarray(plant.A @ state + plant.B @ before + plant.Bf @ fault)
        if seconds <= 0.0:
            return state
        transition, constant, ramp = self._hold(seconds)
        rise = np.concatenate([u - before, np.zeros(len(fault))])
        return np.asarray(transition @ state + constant @ np.concatenate([before, fault]) + ramp @ rise)

    def outputs(self, state: FloatArray, u: FloatArray, fault: FloatArray) -> FloatArray:
        """Return the outputs ``(ny,)`` of a state."""
        return np.asarray(self.plant.C @ state + self.plant.D @ u + self.plant.Df @ fault)

    def miss(self, v: FloatArray, state: FloatArray | None = None, fault: FloatArray | None = None) -> float:
        """Return the distance between measured outputs and those of a state; of rest and no fault by default."""
        plant = self.plant
        at = np.zeros(plant.nx) if state is None else state
        f = np.zeros(plant.nf) if fault is None else fault
        return float(np.linalg.norm(v[plant.nu :] - self.outputs(at, v[: plant.nu], f)))


def _state_solver(design: ObserverDesign) -> FloatArray | None:
    """Return what gives states from an observer that estimates none, as filters of faults do: the smallest that explain
    its own state ``z = T E x`` and the outputs, ``(nx, nz + ny)``; ``None`` where faults are not all estimated."""
    from obsynth.methods.registry import error_model

    plant, observer = design.linear
    if observer.fault_names != plant.fault_names:
        # The model needs every fault of the plant: an observer of some of them begins again after a gap.
        return None
    try:
        own = error_model(design).own
    except SpecError:
        return None
    return np.asarray(np.linalg.pinv(np.vstack([own[:, : plant.nx] @ plant.E, plant.C])))


def _running(part: _Part | None) -> _Part:
    """Return a part that is there while the observer runs."""
    if part is None:
        raise ObsynthError(
            "The saved state is incomplete: its observer or plant model is missing. Start the run again."
        )
    return part


class LinearLogObserver(LogObserver):
    """A linear observer on a log; ``gap`` and ``warm_up`` in seconds, see `run_on_data`."""

    plant: DescriptorSystem
    saved: ClassVar = dict(zip(SAVED, SAVED, strict=True))

    def __init__(self, design: ObserverDesign, *, gap: float | None = None, warm_up: float | None = None) -> None:
        self.plant, self.observer = design.linear
        if gap is not None:
            real_number(gap, "gap", "seconds, a positive number", above=0.0)
        if gap is not None and self.observer.dt > 0.0:
            raise SpecError(SAMPLED_GAP, path="gap")
        super().__init__(self.observer, warm_up, transient(self.observer))
        self.options["gap"], self.input_delay = gap, design.input_delay
        self.input_names, self.output_names = self.observer.input_names, self.observer.output_names
        self.point, self.scales = self.plant.operating_point, self.plant.scales
        self.columns = self.observer.row_names
        lags = set(self.observer.state_delays) or {0}
        states = len(self.observer.state_names) == self.plant.nx
        self.solver = None if states else _state_solver(design)
        known = states or self.solver is not None
        self.gap_model = None if len(lags) > 1 or not known else GapModel.of(self.plant)
        self.nu = len(self.input_names)
        self.b = np.hstack([self.observer.Bu, self.observer.By])
        self.d = np.hstack([self.observer.Du, self.observer.Dy])
        self._hold = lru_cache(KEPT_INTERVALS)(partial(first_order_hold, self.observer.Az, self.b))
        self.z: FloatArray | None = None
        self.v = np.zeros(self.b.shape[1])
        self.row = np.full(len(self.observer.Cz), np.nan)
        self.model: FloatArray | None = None
        # What is known of the plant's states at the last measured row, from which the model starts.
        width = len(self.observer.state_names) if self.solver is None else self.plant.nx
        self.seen = np.full(width, np.nan)
        # Since when nothing is left of a gap: bounds that are never passed hold from there on.
        self.clear_at, self.begun = -math.inf, False
        # Since when the initial-condition response has settled, and whether the model has stood in for all that was
        # missing from there on.
        self.known_from, self.bridged = math.inf, False
        # Squares of changes of fault estimates and residuals from row to row, summed up, and how many there are.
        self.shown = slice(len(self.observer.state_names), None)
        self.changes, self.counted = np.zeros(len(self.observer.Cz[self.shown])), 0
        # Variances that the stated noise of the sensors gives them.
        noisy = self.observer.dt > 0.0 and self.observer.By.shape[1] == self.plant.ny
        self.noise = noise_variances(self.observer, self.plant.Dw)[self.shown] if noisy else np.zeros_like(self.changes)
        # What a unit error of each input that was held, and of each output that the model told, has left in z.
        self.left, self.held = np.zeros(self.b.shape), np.zeros(self.nu)
        # How inputs have moved, and how far those that are missing may have moved since they were known.
        self.moves, self.reach = no_inputs(self.nu), np.zeros(self.nu)
        # What the errors of the last gap have left in z, and what those of the gaps before it had in the columns.
        self.excess, self.carried = np.zeros(self.b.shape), np.zeros(len(self.columns))
        self.transient = transient(self.observer)
        # Of every fault of the plant; those of which nothing is estimated are held to be absent.
        self.fault = np.zeros(self.plant.nf)
        self.told_faults = [self.plant.fault_names.index(name) for name in self.observer.fault_names]
        self.measured = self.v
        # The last of them: from the moment on of which the estimates are.
        self.kept_inputs = max(lags) + 1
        self.inputs = np.zeros((0, self.nu))

    def _usual(self) -> FloatArray | None:
        """Return what a gap may have left in fault estimates and residuals; nothing where that is not known yet."""
        shown = self.counted >= LEAST_SHOWN
        if not shown and not self.noise.all():
            return None
        changes = self.changes / self.counted if shown else np.zeros_like(self.changes)
        return np.asarray(np.sqrt(np.maximum(GAP_LEFT_SHARE**2 * changes, self.noise)))

    def take(self, time: float, values: FloatArray, *, seconds: float, missing: int, longest: float) -> Row:
        """Take one row."""
        since = seconds
        good = bool(np.isfinite(values).all())
        previous = self.row if self.model is None and self.z is not None else None
        u = values[: self.nu]
        u = np.where(np.isfinite(u), u, self.v[: self.nu])
        # A number that overflows in what follows is a bad sample like any other: the state is looked at below.
        with np.errstate(over="ignore", invalid="ignore"):
            if missing:
                self._bridge_interval(seconds, missing, u)
                seconds = 0.0 if self.observer.dt == 0.0 else seconds
            recovered = unsure = self.warm_up
            if good and self.model is not None:
                self._propagate(seconds, u)
                recovered, unsure = self._recovering(seconds, values, longest)
                # What has become usual before a new start would have settled needs none.
                if recovered >= self.warm_up and self._lost(values):
                    self._restart()
            first = self.z is None
            if good and first:
                self.z, self.phase = np.zeros(self.observer.order), WARM_UP
                self.settled_at = self._after(time, self.warm_up)
                self.known_from = self._after(time, max(self.warm_up, self.transient))
                if self.begun:
                    self.clear_at = self.known_from
                self.begun = True
                self.inputs = self.inputs[:0]
                seconds = 0.0
            if good:
                if self.model is None:
                    self._advance_excess(seconds)
                self.moves = taken_inputs(self.moves, self.v[: self.nu], u, is_first=first).history
                found = self._measured(seconds, values)
                if self.model is not None:
                    self.model, self.left, self.reach = None, np.zeros_like(self.left), np.zeros(self.nu)
                    # The initial-condition response settles in as many measured rows as without a gap: what the gap
                    # adds is no larger than what is left of the start then, and goes with it.
                    self.settled_at += since * missing / (missing + 1)
                    if self.phase != WARM_UP or time >= self.settled_at:
                        self.settled_at, self.phase = self._after(time, recovered), RECOVERING
                    self.clear_at = self._after(time, max(self.warm_up, self.transient, unsure))
                status = OK if time >= self.settled_at else self.phase
            else:
                found, status = self._unmeasured(seconds, u, values), GAP
        if status == GAP:
            self.settled_at += since if self.phase == WARM_UP else 0.0
            return Row(GAP, found, missing, bridged=self.bridged)
        if self.z is None or not (np.isfinite(self.z).all() and np.isfinite(found).all()):
            self._restart()
            return Row(GAP, self._held(), missing)
        self.fault = self._faults_in(found)
        # Until enough is known of what is usual, rows after a gap tell it, too: others may never come.
        counts = status == OK or (status == RECOVERING and self.counted < LEAST_SHOWN)
        if previous is not None and counts and not missing:
            self._count((found - previous)[None])
        sample = LinearSample(found, values[: self.nu], values[self.nu :], len(self.state_names))
        return self._complete_row(status, found, missing, sample, time)

    def _complete_row(
        self, status: str, found: FloatArray, missing: int, sample: LinearSample, time: float, *, clear: bool = False
    ) -> Row:
        """Return a complete row; ``clear`` where it is known that gaps have left nothing."""
        settled = time >= self.clear_at
        self.bridged |= settled and time >= self.known_from
        return Row(status, found, missing, sample, settled, None if clear else self._excess_in(status), self.bridged)

    def _excess_in(self, status: str) -> FloatArray | None:
        """Return what gaps can have left in the columns of a complete row, of one that is recovering."""
        if status != RECOVERING:
            self.excess, self.carried = np.zeros_like(self.excess), np.zeros_like(self.carried)
            return None
        found = self._shown_excess()
        if self.observer.dt > 0.0:
            self.excess = self.observer.Az @ self.excess
        return found

    def _shown_excess(self) -> FloatArray:
        return np.asarray(self.carried + np.abs(self.observer.Cz @ self.excess).sum(axis=1))

    def _advance_excess(self, seconds: float) -> None:
        """Bring what a gap has left in a continuous observer to this row; in a sampled one it is there already."""
        if self.observer.dt == 0.0 and seconds > 0.0 and self.excess.any():
            self.excess = self._hold(seconds)[0] @ self.excess

    @property
    def takes_pieces(self) -> bool:
        """Whether the observer runs, and no model stands in for missing samples."""
        return self.z is not None and self.model is None

    def take_piece(self, times: Sequence[float], values: FloatArray, intervals: Sequence[float]) -> list[Row]:
        """Take complete rows that follow each other without a gap; end before a number overflows."""
        count, observer = len(intervals), self.observer
        z, before, sampled = _running(self.z), self.v, observer.dt > 0.0
        states, rows = np.empty((count, observer.order)), np.empty((count, len(observer.Cz)))
        # The products of `step`, in the same order: results do not depend on where a piece ends.
        with np.errstate(over="ignore", invalid="ignore"):
            for k, v in enumerate(values[:count]):
                if not sampled:
                    transition, constant, ramp = self._hold(intervals[k])
                    z = transition @ z + constant @ before + ramp @ (v - before)
                    before = v
                states[k] = z
                rows[k] = observer.Cz @ z + self.d @ v + observer.added
                if sampled:
                    z = observer.Az @ z + self.b @ v
        after = np.vstack([states[1:], z]) if sampled else states
        known = np.isfinite(after).all(axis=1) & np.isfinite(rows).all(axis=1)
        if not known.all():
            count = int(np.argmin(known))
            if not count:
                return []
        last = count - 1
        counts = np.array(times[:count]) >= self.settled_at
        if self.phase == RECOVERING:
            counts |= self.counted + np.cumsum(~counts) <= LEAST_SHOWN
        self._count(np.diff(np.vstack([self.row, rows[:count]]), axis=0)[counts])
        self.moves = over_samples(self.moves, self.v[: self.nu], values[:count, : self.nu])
        self.z, self.v, self.row, self.measured = np.array(after[last]), values[last], rows[last], values[last]
        self.fault = self._faults_in(rows[last])
        self.seen = self._states(states[last], values[last], rows[last], self.fault)
        self.inputs = np.vstack([self.inputs, values[:count, : self.nu]])[-self.kept_inputs :]
        settled, phase = self.settled_at, self.phase
        nu, nx, found, clear = self.nu, len(self.state_names), list[Row](), False
        for time, seconds, row, v in zip(times[:count], intervals[:count], rows[:count], values[:count], strict=True):
            if not clear:
                self._advance_excess(seconds)
            status, said = OK if time >= settled else phase, LinearSample(row, v[:nu], v[nu:], nx)
            found.append(self._complete_row(status, row, 0, said, time, clear=clear))
            clear = status != RECOVERING
        return found

    def _measured(self, seconds: float, v: FloatArray) -> FloatArray:
        if self.observer.dt == 0.0:
            self._flow(seconds, v)
        z = _running(self.z)
        self.row = np.asarray(self.observer.Cz @ z + self.d @ v + self.observer.added)
        self.measured = v
        faults = self._faults_in(self.row)
        self.seen = self._states(z, v, self.row, faults)
        self._taken(v)
        return self.row

    def _states(self, z: FloatArray, v: FloatArray, row: FloatArray, fault: FloatArray) -> FloatArray:
        """Return the estimates of states at a sample with inputs and outputs ``v``."""
        if self.solver is None:
            return row[self.observer.state_rows]
        outputs = v[self.nu :] - self.plant.D @ v[: self.nu] - self.plant.Df @ fault
        return np.asarray(self.solver @ np.concatenate([z, outputs]))

    def _faults_in(self, row: FloatArray) -> FloatArray:
        """Return every fault of the plant ``(nf,)`` as a row of estimates says."""
        faults = np.zeros(len(self.fault))
        faults[self.told_faults] = row[self.observer.fault_rows]
        return faults

    def _count(self, changes: FloatArray) -> None:
        """Sum up changes ``(n, rows)``, one after the other, so that results do not depend on pieces."""
        with np.errstate(over="ignore"):
            squares = np.nan_to_num(changes[:, self.shown] ** 2, nan=0.0, posinf=0.0)
        self.changes = np.cumsum(np.vstack([self.changes, squares]), axis=0)[-1]
        self.counted += len(changes)

    def _recovering(self, seconds: float, v: FloatArray, longest: float) -> tuple[float, float]:
        """Return the seconds after a gap in which nothing may be decided, and those in which nothing is guaranteed; the
        model stands at this row already.

        The outputs of the model missed those of the plant by no more during the gap than they do now, as errors of a
        model grow: what that can have left in fault estimates and residuals is followed until it is usual.
        """
        gap_model, nu = _running(self.gap_model), self.nu
        missed = np.abs(v[nu:] - gap_model.outputs(_running(self.model), v[:nu], self.fault))
        # An input that was held was off by no more than it has changed since, or may have by how it moved before.
        missed = np.concatenate([np.maximum(np.abs(v[:nu] - self.held), self.reach), missed])
        usual, step = self._usual(), self.observer.dt or longest
        if not (np.isfinite(self.left).all() and step > 0.0):
            self.carried = np.full_like(self.carried, np.inf)
            return self.warm_up, self.warm_up
        a, left = self.observer.Az, self.left
        if self.observer.dt == 0.0:
            transition, constant, _ = self._hold(seconds or step)
            told = left.any(axis=0) & np.repeat([False, True], [nu, len(self.output_names)])
            a, left = self._hold(step)[0], transition @ left + constant * told
        self.excess = left * missed
        if usual is None:
            return self.warm_up, self.warm_up
        rows, waited, recovered = self.observer.Cz[self.shown], 0.0, self.warm_up
        longest_wait = MOST_TRANSIENTS * self.transient
        # The first row after a gap always counts as recovering.
        while waited < max(self.warm_up, longest_wait if np.isfinite(longest_wait) else 0.0):
            left, waited = a @ left, waited + step
            kept = np.abs(rows @ left) @ missed
            if np.all(kept <= usual):
                recovered = min(recovered, waited)
            if np.all(kept <= GUARANTEED_SHARE * usual):
                break
        return recovered, waited

    def _lost(self, v: FloatArray) -> bool:
        """Whether the model, after a gap in which it stood in for outputs, misses them by more than their whole size
        before and after it."""
        gap_model = _running(self.gap_model)
        if not self.left[:, self.nu :].any():
            return False
        # The outputs and the model may both be huge; a miss that is not finite is lost as well.
        return not gap_model.miss(v, self.model, self.fault) <= gap_model.miss(self.measured) + gap_model.miss(v)

    def _taken(self, v: FloatArray) -> None:
        if self.observer.dt > 0.0:
            self.z = np.asarray(self.observer.Az @ _running(self.z) + self.b @ v)
        self.v = v
        self.inputs = np.vstack([self.inputs, v[: self.nu]])[-self.kept_inputs :]

    def _flow(self, seconds: float, v: FloatArray) -> None:
        """Bring z of a continuous observer to the time of ``v``, which is reached along a straight line."""
        if seconds > 0.0:
            transition, constant, ramp = self._hold(seconds)
            self.z = np.asarray(transition @ _running(self.z) + constant @ self.v + ramp @ (v - self.v))

    def _bridge_interval(self, seconds: float, missing: int, u: FloatArray) -> None:
        """Cross the rows that are not there, in continuous time up to and including this row's time; start again where
        they are too many."""
        if self.z is None:
            return
        if missing > LONGEST_BRIDGE:
            self._restart()
            return
        nothing = np.full_like(self.v, np.nan)
        begin, part = self.v[: self.nu].copy(), seconds / (missing + 1)
        for i in range(missing + 1):
            share = (i + 1) / (missing + 1)
            self._unmeasured(part, begin + (u - begin) * share, nothing)

    def _unmeasured(self, seconds: float, u: FloatArray, values: FloatArray) -> FloatArray:
        """Let the plant model stand in for what is missing in ``values (nu + ny,)`` of one sample; return the
        estimates, faults held. ``u (nu,)``: the inputs, held where they are not known."""
        if self.z is None:
            return self._held()
        if self.gap_model is None:
            self._restart()
            return self._held()
        if self.model is None:
            self.carried, self.excess = self._shown_excess(), np.zeros_like(self.excess)
            known = self.inputs if self.observer.dt > 0.0 else ()
            self.model, self.held = self.gap_model.start(self.seen, known, self.fault), self.v[: self.nu]
            if self.observer.dt == 0.0:
                self._propagate(seconds, u)
        else:
            self._propagate(seconds, u)
        # What is measured is taken; what is not, the model says.
        told = ~np.isfinite(values)
        self.bridged &= not told[: self.nu].any()
        v = np.where(told, np.concatenate([u, self.gap_model.outputs(self.model, u, self.fault)]), values)
        self._unknown_inputs(np.where(told, np.nan, values)[: self.nu])
        if self.observer.dt == 0.0:
            self._flow(seconds, v)
            transition, constant, _ = self._hold(seconds)
            self.left = transition @ self.left + constant * told
        else:
            self.left = self.observer.Az @ self.left + self.b * told
        row = np.asarray(self.observer.Cz @ self.z + self.d @ v + self.observer.added)
        self._taken(v)
        row[self.observer.fault_rows] = self.fault[self.told_faults]
        row[self.observer.residual_rows] = np.nan
        if not np.isfinite(self.z).all():
            self._restart()
            return self._held()
        return row

    def _unknown_inputs(self, u: FloatArray) -> None:
        """Follow how far inputs may have moved that are missing (NaN in ``u (nu,)``)."""
        before, known = self.v[: self.nu], taken_inputs(self.moves, self.v[: self.nu], u, is_first=False)
        lowest, highest, change, count, _ = known.history
        returned = np.where((count == 0.0) & (self.moves[3] > 0.0), np.abs(known.u - before), 0.0)
        # In one sample an input is off by what it has changed since; in several it may have come and gone.
        moved = np.where(count > 1.0, np.minimum(count * change, highest - lowest), returned)
        self.moves, self.reach = known.history, np.maximum(self.reach, moved)

    def _propagate(self, seconds: float, u: FloatArray) -> None:
        before, model = self.v[: self.nu], _running(self.model)
        self.model = _running(self.gap_model).after(model, seconds, before, u, self.fault)

    def _restart(self) -> None:
        self.z = self.model = None
        self.v, self.left, self.reach = np.zeros_like(self.v), np.zeros_like(self.left), np.zeros_like(self.reach)
        self.inputs = self.inputs[:0]
        self.excess, self.carried = np.zeros_like(self.excess), np.zeros_like(self.carried)
        self.settled_at, self.phase = math.inf, WARM_UP
        self.known_from, self.bridged = math.inf, False

    def _held(self) -> FloatArray:
        row = np.full(len(self.observer.Cz), np.nan)
        row[self.observer.fault_rows] = self.fault[self.told_faults]
        return row


def log_observer(
    design: ObserverDesign, *, gap: float | None = None, warm_up: float | None = None, outliers: str | None = None
) -> LogObserver:
    """Return the observer of a design on a log, at its start; ``outliers`` replace what the design says."""
    if isinstance(design.observer, LinearObserver):
        if outliers not in (None, "none"):
            raise SpecError(
                "outliers is for recursive and nonlinear designs, which know how far a sample may be from "
                "its prediction.",
                path="outliers",
            )
        return LinearLogObserver(design, gap=gap, warm_up=warm_up)
    if gap is not None:
        raise SpecError(SAMPLED_GAP, path="gap")
    if isinstance(design.observer, WindowObserver):
        if outliers not in (None, "none"):
            raise SpecError("outliers is for recursive and nonlinear designs: leave it out.", path="outliers")
        return WindowLogObserver(design, design.observer, warm_up=warm_up)
    return SteppingLogObserver(design, warm_up=warm_up, outliers=outliers)


class SteppingLogObserver(LogObserver):
    """An observer with deviations on a log (nonlinear plants: absolute values); the first row is k = 0.
    By default no warm-up, as covariances of the start say how uncertain the estimates are, and a gate for outliers
    where the observer says nothing of them."""

    saved: ClassVar = {"observer": "state", "u": "u", "spread": "spread", "usual": "usual"}

    def __init__(self, design: ObserverDesign, *, warm_up: float | None = None, outliers: str | None = None) -> None:
        observer: Any = design.observer
        self.observer: RecursiveObserver | DAEObserver = as_run(observer, outliers)
        plant = design.plant
        super().__init__(self.observer, warm_up, 0.0)
        self.input_names, self.output_names = plant.input_names, plant.output_names
        self.input_delay = design.input_delay
        self.is_recursive, self.may_restart = isinstance(self.observer, RecursiveObserver), True
        residuals = innovation_names(self.observer)
        if isinstance(self.observer, RecursiveObserver):
            model, Q, R = self.observer.plant, self.observer.Q, self.observer.R
            self.point, self.scales = model.operating_point, model.scales
            constant = model.is_time_invariant and Q.is_constant and R.is_constant
            self.may_restart = constant and model.horizon is None
        self.columns = (
            *self.estimated,
            *(f"sd {name}" for name in self.estimated),
            *(f"r[{name}]" for name in residuals),
        )
        self.directions = len(residuals)
        late = ", ".join(name for name, entry in (self.observer.sensors or {}).items() if entry["delay"])
        if late:
            self.notes = (
                f"Values of {late} are delayed: no row holds their innovations, and monitors use them through the "
                "estimates alone.",
            )
        #: Of a smoother: the samples since the observer last started.
        self.chain: Chain | None = None
        self.state: Any = self.observer.init()
        self.u: FloatArray | None = None
        # Deviations of the faults at the last row, and before samples were missing: zero where nothing is left of that.
        self.spread = self.usual = np.zeros(len(self.fault_names))

    def follows(self, missing: int) -> bool:
        """Whether rows that are missing are taken one by one: always where the plant changes with k."""
        return super().follows(missing) or not self.may_restart

    def _begin(self) -> None:
        """Start the observer again."""
        self.state = self.observer.init()
        if self.chain is not None:
            self.chain = Chain(self.chain.links)

    @property
    def gates(self) -> bool:
        """Whether a gate judges each sample in its own row."""
        return self.observer.outliers == "gate" and not self.observer.timing.longest

    @property
    def outliers(self) -> dict[str, int]:
        """How many samples of each output were outliers, since the observer last started."""
        counts = self.state.refused[1]
        return {name: int(count) for name, count in zip(self.output_names, counts, strict=True) if count}

    def _begun(self, u: FloatArray) -> FloatArray:
        """Return inputs ``(nu,)`` with those of the row before where they are missing: an observer begins with known
        ones."""
        return np.where(np.isnan(u), 0.0 if self.u is None else self.u, u)

    def _taken(self, y: FloatArray, u: FloatArray) -> Evidence | None:
        """Take one sample, or none of it: `None` where numbers are no finite ones any more."""
        before = self.state
        u = u if self.state.k else self._begun(u)
        found: Evidence
        try:
            with np.errstate(all="ignore"):
                kept = None if self.chain is None else self.chain.add
                self.state, found = self.observer.accept(self.state, y, u, kept)
        except (np.linalg.LinAlgError, ValueError):
            return None
        if found.is_finite:
            return found
        self.state = before
        return None

    def _values(self, found: Evidence) -> FloatArray:
        """Return a row: estimates, standard deviations, innovation at the parameters of one sample before."""
        residual = np.full(self.directions, np.nan)
        # The correction of the start by early constraints has no more directions, but may have fewer.
        residual[: min(len(found.gap), self.directions)] = found.gap[: self.directions]
        deviations = np.sqrt(np.diag(found.parameter_covariance))
        return np.concatenate([found.x, found.theta, found.state_deviations, deviations, residual])

    def take(self, time: float, values: FloatArray, *, seconds: float, missing: int, longest: float) -> Row:
        """Take one row."""
        nu, fresh = len(self.input_names), self.u is None
        known = np.isfinite(values)
        if self.u is None and not self.is_recursive and not known[:nu].all():
            # A nonlinear model has no zero to begin with: it begins when all inputs are known.
            return Row(GAP, np.full(len(self.columns), np.nan), missing)
        u, y = (np.where(known, values, np.nan)[part] for part in (slice(nu), slice(nu, None)))
        if missing:
            self._begin()
            fresh = True
        total = self.state.refused[1]
        found, spoiled, restarted = self._found(y, u, may_restart=self.may_restart and not fresh)
        self.u, fresh = self._begun(u), fresh or restarted
        if fresh:
            self.settled_at, self.phase = self._after(time, self.warm_up), WARM_UP
        elif nu and not known[:nu].all():
            # A step took inputs that nobody measured.
            self.settled_at = self._after(time, self.warm_up)
            self.phase = WARM_UP if self.phase == WARM_UP else RECOVERING
        # A filter that begins with y(1) does not miss y(0).
        received = (known[nu:] & ~self._refused(total)) | ~self.observer.timing.expected(self.state.k - 1)
        if fresh and self.is_recursive:
            received = np.ones_like(received)
        status = self._status(time, known[:nu], received, spoiled=spoiled)
        whole = not spoiled and bool(known[:nu].all() and received.all())
        return Row(status, self._values(found), missing, found, unsure=self._unsure(found, whole=whole, fresh=fresh))

    def _unsure(self, found: Evidence, *, whole: bool, fresh: bool) -> FloatArray | None:
        """Return by how many times the deviations of faults are above those before samples were missing, after a row
        that is ``whole`` or lacks some; ``None`` where none is."""
        before, self.spread = self.spread, np.sqrt(np.diag(found.parameter_covariance))
        if fresh:
            self.usual = np.zeros_like(before)
        elif not whole:
            self.usual = np.where(self.usual > 0.0, self.usual, before)
        self.usual = np.where(self.spread > self.usual, self.usual, 0.0)
        if not self.usual.any():
            return None
        return np.divide(self.spread, self.usual, out=np.ones_like(before), where=self.usual > 0.0)

    def _refused(self, total: FloatArray) -> np.ndarray:
        """Return which outputs of the last sample were left out as outliers: of which more are than before it."""
        return np.asarray(self.state.refused[1] > total) & (self.observer.outliers == "gate")

    def _found(self, y: FloatArray, u: FloatArray, *, may_restart: bool) -> tuple[Evidence, bool, bool]:
        """Take one sample; return also whether its outputs were left out, and whether the observer started again."""
        found = self._safe(y, u)
        if found is not None:
            return found, False, False
        try:
            return self._required(u), True, False
        except ObsynthError:
            # An outlier may have led where the model cannot go on.
            if not may_restart:
                raise
        self._begin()
        found = self._safe(y, u)
        return (self._required(u), True, True) if found is None else (found, False, True)

    def _status(self, time: float, inputs: np.ndarray, outputs: np.ndarray, *, spoiled: bool) -> str:
        if spoiled or not inputs.all() or not outputs.any():
            return GAP
        if time < self.settled_at:
            return self.phase
        self.phase = OK
        return OK if outputs.all() else PARTIAL

    def _safe(self, y: FloatArray, u: FloatArray) -> Evidence | None:
        """Take one sample, or none of it where there is no solution either."""
        try:
            return self._taken(y, u)
        except SolverError:
            return None

    def _required(self, u: FloatArray) -> Evidence:
        """Take one sample without outputs."""
        found = self._taken(np.full(len(self.output_names), np.nan), u)
        if found is None:
            raise SpecError(
                "the estimates are no finite numbers any more: the model is unstable, or the inputs are too large.",
                path="inputs",
            )
        return found
