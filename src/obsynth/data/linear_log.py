"""A linear observer on a log, row by row: irregular stamps, gaps, bad rows, warm-up."""

from __future__ import annotations

import math
from collections import deque
from functools import partial
from typing import Any, TypeVar

import numpy as np

from obsynth.data.gap_model import GapModel, KeptHolds
from obsynth.data.log_estimator import GAP, LONGEST_BRIDGE, OK, RECOVERING, WARM_UP, Engine, Row, estimate_columns
from obsynth.data.signals import LinearSignalNames
from obsynth.data.stamps import Clock
from obsynth.errors import ObsynthError, SpecError
from obsynth.experiments.monitors.online import LinearSample
from obsynth.numerics.arguments import is_finite_number
from obsynth.numerics.arrays import FloatArray
from obsynth.numerics.holds import first_order_hold
from obsynth.observers.linear.observer import LinearObserver
from obsynth.observers.linear.warm_up import checked_warm_up, transient
from obsynth.results.design import ObserverDesign

_Part = TypeVar("_Part")


def _running(part: _Part | None) -> _Part:
    """Return a part that is there while the observer runs."""
    if part is None:
        raise ObsynthError("The run is in an impossible state: its observer or plant model is missing. Start it again.")
    return part


class DataObserver(LinearSignalNames):
    """A running linear observer on measured data. Fields: design: A linear design; gap: Continuous time: intervals
    longer than this are gaps, in seconds; warm_up: Seconds that are marked after a start and after a gap; by default
    until the slowest mode has shrunk to 2 %."""

    def __init__(self, design: ObserverDesign, *, gap: float | None = None, warm_up: float | None = None) -> None:
        super().__init__(design)
        if gap is not None and not (is_finite_number(gap) and gap > 0.0):
            raise SpecError(f"gap is {gap!r}: give seconds, a positive number.", path="gap")
        if gap is not None and self.observer.dt > 0.0:
            raise SpecError(
                "gap is for continuous-time designs: a sampled one knows which rows are missing.", path="gap"
            )
        self.warm_up = checked_warm_up(warm_up, transient(self.observer))
        self.columns = estimate_columns(self.state_names, self.fault_names, self.observer.residual_names)
        self.notes: tuple[str, ...] = ()
        self.clock = Clock(self.observer.dt, gap)
        self.gap_model = GapModel.of(self.plant)
        lags = set(self.observer.state_delays) or {0}
        if len(lags) > 1:
            self.gap_model = None
        self.nu = len(self.observer.input_names)
        self.b = np.hstack([self.observer.Bu, self.observer.By])
        self.observer_hold = KeptHolds(partial(first_order_hold, self.observer.Az, self.b))
        self.plant_hold = None if self.gap_model is None else KeptHolds(self.gap_model.held)
        self.d = np.hstack([self.observer.Du, self.observer.Dy])
        self.z: FloatArray | None = None
        self.v = np.zeros(self.b.shape[1])
        self.row = np.full(len(self.observer.Cz), np.nan)
        self.model: FloatArray | None = None
        self.fault = np.zeros(len(self.observer.fault_names))
        self.measured = self.v
        self.settled_at, self.phase = math.inf, WARM_UP
        self.inputs: deque[FloatArray] = deque(maxlen=max(lags) + 1)

    def step(self, time: float, values: FloatArray, row: int) -> Row:
        """Take one row of data."""
        seconds, missing = self.clock.advance(time, row)
        good = bool(np.isfinite(values).all())
        u = values[: self.nu]
        u = np.where(np.isfinite(u), u, self.v[: self.nu])
        # A number that overflows in what follows is a bad sample like any other: the state is looked at below.
        with np.errstate(over="ignore", invalid="ignore"):
            if missing:
                self._bridge_interval(seconds, missing, u)
                seconds = 0.0 if self.observer.dt == 0.0 else seconds
            if good and self.model is not None and self._lost(seconds, values):
                self._restart()
            if good and self.z is None:
                self.z, self.settled_at, self.phase = np.zeros(self.observer.order), time + self.warm_up, WARM_UP
                self.inputs.clear()
                seconds = 0.0
            if good:
                found = self._measured(seconds, values)
                if self.model is not None:
                    self.model, self.settled_at, self.phase = None, time + self.warm_up, RECOVERING
                status = OK if time >= self.settled_at else self.phase
            else:
                found, status = self._unmeasured(seconds, u), GAP
        if status == GAP:
            return Row(GAP, found, missing)
        if self.z is None or not (np.isfinite(self.z).all() and np.isfinite(found).all()):
            self._restart()
            return Row(GAP, self._held(), missing)
        self.fault = found[self.observer.fault_rows].copy()
        sample = LinearSample(found, values[: self.nu], values[self.nu :])
        return Row(status, found, missing, sample)

    def _measured(self, seconds: float, v: FloatArray) -> FloatArray:
        if self.observer.dt == 0.0:
            self._flow(seconds, v)
        self.row = np.asarray(self.observer.Cz @ _running(self.z) + self.d @ v)
        self.measured = v
        self._taken(v)
        return self.row

    def _lost(self, seconds: float, v: FloatArray) -> bool:
        """Whether the model, after a gap, misses the outputs by more than their whole size before and after it."""
        self._propagate(seconds, v[: self.nu])
        gap_model = _running(self.gap_model)
        # The outputs and the model may both be huge; a miss that is not finite is lost as well.
        return not gap_model.miss(v, self.model, self.fault) <= gap_model.miss(self.measured) + gap_model.miss(v)

    def _taken(self, v: FloatArray) -> None:
        if self.observer.dt > 0.0:
            self.z = np.asarray(self.observer.Az @ _running(self.z) + self.b @ v)
        self.v = v
        self.inputs.append(self.v[: self.nu])

    def _flow(self, seconds: float, v: FloatArray) -> None:
        """Bring z of a continuous observer to the time of ``v``, which is reached along a straight line."""
        if seconds > 0.0:
            transition, constant, ramp = self.observer_hold.at(seconds)
            self.z = np.asarray(transition @ _running(self.z) + constant @ self.v + ramp @ (v - self.v))

    def _bridge_interval(self, seconds: float, missing: int, u: FloatArray) -> None:
        """Cross the rows that are not there; in continuous time, up to and including this row's time."""
        if self.z is None:
            return
        if missing > LONGEST_BRIDGE:
            self._restart()
            return
        if self.observer.dt > 0.0:
            for _ in range(missing):
                self._unmeasured(0.0, self.v[: self.nu])
            return
        begin, part = self.v[: self.nu].copy(), seconds / (missing + 1)
        for i in range(missing + 1):
            self._unmeasured(part, begin + (u - begin) * ((i + 1) / (missing + 1)))

    def _unmeasured(self, seconds: float, u: FloatArray) -> FloatArray:
        """Let the plant model stand in for the sensors at one sample; return the estimates, faults held."""
        if self.z is None:
            return self._held()
        if self.gap_model is None:
            self._restart()
            return self._held()
        if self.model is None:
            known = list(self.inputs) if self.observer.dt > 0.0 else []
            self.model = self.gap_model.start(self.row[self.observer.state_rows], known, self.fault)
            if self.observer.dt == 0.0:
                self._propagate(seconds, u)
        else:
            self._propagate(seconds, u)
        v = np.concatenate([u, self.gap_model.outputs(self.model, u, self.fault)])
        if self.observer.dt == 0.0:
            self._flow(seconds, v)
        row = np.asarray(self.observer.Cz @ self.z + self.d @ v)
        self._taken(v)
        row[self.observer.fault_rows] = self.fault
        row[self.observer.residual_rows] = np.nan
        if not np.isfinite(self.z).all():
            self._restart()
            return self._held()
        return row

    def _propagate(self, seconds: float, u: FloatArray) -> None:
        before, model = self.v[: self.nu], _running(self.model)
        if self.observer.dt > 0.0:
            self.model = _running(self.gap_model).sampled(model, before, self.fault)
        elif seconds > 0.0:
            transition, constant, ramp = _running(self.plant_hold).at(seconds)
            rise = np.concatenate([u - before, np.zeros(len(self.fault))])
            start = np.concatenate([before, self.fault])
            self.model = np.asarray(transition @ model + constant @ start + ramp @ rise)

    def _restart(self) -> None:
        self.z = self.model = None
        self.v = np.zeros_like(self.v)
        self.inputs.clear()
        self.settled_at, self.phase = math.inf, WARM_UP

    def _held(self) -> FloatArray:
        row = np.full(len(self.observer.Cz), np.nan)
        row[self.observer.fault_rows] = self.fault
        return row

    def as_dict(self) -> dict[str, Any]:
        """Return the state that goes from row to row, as data."""
        return {
            "last": self.clock.last, "longest": self.clock.longest, "z": self.z, "v": self.v, "row": self.row,
            "model": self.model, "fault": self.fault, "settled_at": self.settled_at, "phase": self.phase,
            "inputs": np.array(list(self.inputs)).reshape(len(self.inputs), self.nu), "measured": self.measured,
            "warm_up": self.warm_up, "gap": self.clock.gap,
        }  # fmt: skip

    def resume(self, data: dict[str, Any]) -> None:
        """Go on from what `as_dict` returned."""
        if (data["warm_up"], data["gap"]) != (self.warm_up, self.clock.gap):
            raise SpecError(
                "The saved state is of a run with another gap or warm-up: use the same options.", path="state"
            )
        self.clock.last, self.clock.longest = data["last"], data["longest"]
        self.z, self.v, self.row, self.model = data["z"], data["v"], data["row"], data["model"]
        self.fault, self.settled_at, self.phase = data["fault"], data["settled_at"], data["phase"]
        self.measured = data["measured"]
        self.inputs.clear()
        self.inputs.extend(data["inputs"])


def engine_of(
    design: ObserverDesign, *, gap: float | None = None, warm_up: float | None = None, outliers: str | None = None
) -> Engine:
    """Return a running design, at its start; ``outliers`` takes the place of what the design says of them."""
    if isinstance(design.observer, LinearObserver):
        if outliers not in (None, "none"):
            raise SpecError("outliers is for recursive and nonlinear designs, which know how far a sample may be from "
                            "its prediction.", path="outliers")  # fmt: skip
        return DataObserver(design, gap=gap, warm_up=warm_up)
    if gap is not None:
        raise SpecError("gap is for continuous-time designs: a sampled one knows which rows are missing.", path="gap")
    # What most logs do not need is loaded only where it is used: a run starts in a fraction of a second.
    from obsynth.data.step_log import SteppingEngine

    return SteppingEngine(design, warm_up=warm_up, outliers=outliers)
