"""What observers with a step of their own have in common on a log: time stamps, held inputs, status, saved state."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Mapping
from typing import Any, Generic, TypeVar

import numpy as np

from obsynth.data.log_estimator import GAP, LONGEST_BRIDGE, OK, PARTIAL, RECOVERING, WARM_UP, Row, estimate_columns
from obsynth.data.stamps import Clock
from obsynth.errors import ObsynthError, SpecError
from obsynth.experiments.monitors.online import Evidence
from obsynth.numerics.arrays import FloatArray
from obsynth.observers.robustness import Robust, with_outliers
from obsynth.observers.running import RunningObserver, state_as_data, state_from_data

Found = TypeVar("Found")


def without_outliers(observer: Robust, outliers: str | None) -> Robust:
    """Return an observer for logs: with a gate, unless it or ``outliers`` says otherwise."""
    wanted = outliers or ("gate" if observer.outliers == "none" else observer.outliers)
    if wanted == observer.outliers:
        return observer
    return with_outliers(observer, wanted)


class SteppingEngine(ABC, Generic[Found]):
    """An observer that takes missing outputs itself; the first row is k = 0.

    Fields: signals: Inputs, outputs, states, faults or parameters, residuals; dt: Seconds between samples; warm_up:
    Seconds that are marked after a start, and after rows with unknown inputs; may_restart: Whether the observer may
    start again after a very long gap.
    """

    #: Whether the outputs of the first row are used.
    uses_first_outputs = True
    #: What runs: an observer, or one that keeps what it says.
    observer: Any

    def __init__(self, signals: tuple[tuple[str, ...], ...], *, dt: float, warm_up: float, may_restart: bool) -> None:
        self.input_names, self.output_names, self.state_names, self.fault_names, residuals = signals
        self.columns = estimate_columns(self.state_names, self.fault_names, residuals, deviations=True)
        self.state_delays, self.fault_delays = (0,) * len(self.state_names), (0,) * len(self.fault_names)
        self.dt, self.warm_up, self.may_restart = dt, warm_up, may_restart
        self.point: Mapping[str, float] = {}
        self.scales: Mapping[str, float] = {}
        self.notes: tuple[str, ...] = ()
        self.clock = Clock(dt, None)
        self.running: RunningObserver[Any, Any, Any] = self.started()
        self.u: FloatArray | None = None
        self.settled_at, self.phase = math.inf, WARM_UP

    @property
    def outliers(self) -> dict[str, int]:
        """How many samples of each output were outliers, since the observer last started."""
        counts = self.running.state.refused[1]
        return {name: int(count) for name, count in zip(self.output_names, counts, strict=True) if count}

    @abstractmethod
    def started(self) -> RunningObserver[Any, Any, Any]:
        """Return the running observer, at k = 0."""

    @abstractmethod
    def values(self, found: Found) -> FloatArray:
        """Return a row of estimates."""

    @abstractmethod
    def evidence(self, found: Found) -> Evidence:
        """Return what the sample says, for decisions."""

    @abstractmethod
    def taken(self, y: FloatArray, u: FloatArray, row: int) -> Found | Exception | None:
        """Take one sample, or return why the sample cannot be taken; `None` if numbers are not finite."""

    def first_inputs(self, values: FloatArray, row: int) -> FloatArray:
        """Return what stands for inputs that are not known in the first row."""
        return np.zeros_like(values)

    def step(self, time: float, values: FloatArray, row: int) -> Row:
        """Take one row of data."""
        before, stamps = self.running.state, (self.clock.last, self.clock.longest)
        try:
            return self._step(time, values, row)
        except ObsynthError:
            # A row that is refused leaves nothing behind: a run may go on after it.
            self.running.state = before
            self.clock.last, self.clock.longest = stamps
            raise

    def _step(self, time: float, values: FloatArray, row: int) -> Row:
        _, missing = self.clock.advance(time, row)
        nu, fresh = len(self.input_names), self.u is None
        known = np.isfinite(values)
        held = self.first_inputs(values[:nu], row) if self.u is None else self.u
        u, y = np.where(known[:nu], values[:nu], held), np.where(known[nu:], values[nu:], np.nan)
        if missing > LONGEST_BRIDGE and self.may_restart:
            self.running, fresh = self.started(), True
        else:
            fresh = self._bridged(missing, held, row) or fresh
        found, spoiled, restarted = self._found(y, u, row, may_restart=self.may_restart and not fresh)
        self.u, fresh = u, fresh or restarted
        if fresh:
            self.settled_at, self.phase = time + self.warm_up, WARM_UP
        elif nu and (missing or not known[:nu].all()):
            # A step took inputs that nobody measured.
            self.settled_at = time + self.warm_up
            self.phase = WARM_UP if self.phase == WARM_UP else RECOVERING
        # A filter that begins with y(1) does not miss y(0).
        heard = known[nu:] & ~self._refused()
        if fresh and not self.uses_first_outputs:
            heard = np.ones_like(heard)
        status = self._status(time, known[:nu], heard, spoiled=spoiled)
        return Row(status, self.values(found), missing, self.evidence(found))

    def _refused(self) -> np.ndarray:
        """Return which outputs of the last sample were left out as outliers, as truth values."""
        state = self.running.state
        gated = getattr(self.running.observer, "outliers", "none") == "gate"
        return np.asarray(state.refused[0] > 0.0) & gated

    def _bridged(self, missing: int, held: FloatArray, row: int) -> bool:
        """Take samples without outputs; return whether the observer had to start again."""
        for _ in range(missing):
            try:
                self._required(held, row)
            except ObsynthError:
                if not self.may_restart:
                    raise
                self.running = self.started()
                return True
        return False

    def _found(self, y: FloatArray, u: FloatArray, row: int, *, may_restart: bool) -> tuple[Found, bool, bool]:
        """Take one sample; return also whether its outputs were left out, and whether the observer started again."""
        found = self._safe(y, u, row)
        if found is not None:
            return found, False, False
        try:
            return self._required(u, row), True, False
        except ObsynthError:
            # An outlier may have led where the model cannot go on.
            if not may_restart:
                raise
        self.running = self.started()
        found = self._safe(y, u, row)
        return (self._required(u, row), True, True) if found is None else (found, False, True)

    def _status(self, time: float, inputs: np.ndarray, outputs: np.ndarray, *, spoiled: bool) -> str:
        if spoiled or not inputs.all() or not outputs.any():
            return GAP
        if time < self.settled_at:
            return self.phase
        self.phase = OK
        return OK if outputs.all() else PARTIAL

    def _safe(self, y: FloatArray, u: FloatArray, row: int) -> Found | None:
        """Take one sample, or none of it: what overflows leaves the state as it was."""
        before = self.running.state
        with np.errstate(all="ignore"):
            found = self.taken(y, u, row)
        if found is None or isinstance(found, Exception):
            self.running.state = before
            return None
        return found

    def _required(self, u: FloatArray, row: int) -> Found:
        """Take one sample without outputs."""
        with np.errstate(all="ignore"):
            found = self.taken(np.full(len(self.output_names), np.nan), u, row)
        if isinstance(found, Exception):
            raise found
        if found is None:
            raise SpecError(
                f"Row {row}: the estimates are no finite numbers any more: the model is unstable, or the inputs are "
                "too large.", path=f"row {row}",
            )  # fmt: skip
        return found

    def as_dict(self) -> dict[str, Any]:
        """Return the state that goes from row to row, as data."""
        return {
            "last": self.clock.last, "longest": self.clock.longest, "observer": state_as_data(self.running.state),
            "u": self.u, "settled_at": self.settled_at, "phase": self.phase, "warm_up": self.warm_up,
        }  # fmt: skip

    def resume(self, data: dict[str, Any]) -> None:
        """Go on from what `as_dict` returned."""
        if data["warm_up"] != self.warm_up:
            raise SpecError("The saved state is of a run with another warm-up: use the same option.", path="state")
        self.clock.last, self.clock.longest = data["last"], data["longest"]
        self.running.state = state_from_data(self.running.state, data["observer"])
        self.u, self.settled_at, self.phase = data["u"], data["settled_at"], data["phase"]
