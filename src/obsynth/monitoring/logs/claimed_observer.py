"""Observers over a region on a log: where nothing is claimed, and how long after that.

A row is ``out`` from one that leaves the region until a hundredth of the error that this may have left is left: nothing
is claimed there, and nothing is decided.  Signals that are missing count as they last were; such a row is a gap, and
those after it are recovering as long.
"""

from __future__ import annotations

from abc import abstractmethod
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from obsynth.monitoring.logs.log_observer import GAP, OK, OUT, RECOVERING, WARM_UP, LogObserver, Row
from obsynth.monitoring.thresholds.monitor import LinearSample
from obsynth.numerics.arrays import FloatArray
from obsynth.observers.nonlinear.region_observer import RegionObserver
from obsynth.observers.scheduled.observer import ScheduledObserver


class ClaimedLogObserver(LogObserver):
    """An observer on a log whose state says for how long nothing is claimed."""

    saved: ClassVar = {"observer": "state", "held": "held", "begun": "begun"}
    observer: Any

    def __init__(self, observer: ScheduledObserver | RegionObserver, warm_up: float | None, input_delay: int) -> None:
        self._forgetting = observer.forgetting * (observer.dt or 1.0)
        super().__init__(observer, warm_up, self._forgetting)
        self.observer, self.columns = observer, observer.row_names
        self.input_names, self.output_names = observer.input_names, observer.output_names
        self.input_delay = input_delay
        self.state: Any = observer.init()
        self.held, self.begun = np.zeros(len(self.input_names) + len(self.output_names)), False

    @property
    @abstractmethod
    def _needed(self) -> NDArray[np.bool_]:
        """Which signals ``(nu + ny,)`` must be there for a row to be whole."""

    @abstractmethod
    def _advance(self, values: FloatArray, seconds: float) -> FloatArray:
        """Take the signals of a row; return the estimates."""

    def take(self, time: float, values: FloatArray, *, seconds: float, missing: int, longest: float) -> Row:
        """Take one row."""
        complete = bool(np.isfinite(values[self._needed]).all())
        if not self.begun and not complete:
            return Row(GAP, np.full(len(self.columns), np.nan), missing)
        if missing or not self.begun:
            self.state, self.begun, seconds = self.observer.init(), True, 0.0
            self.settled_at, self.phase = self._after(time, self.warm_up), WARM_UP
        row = self._advance(values, seconds)
        if not complete:
            # Warm-up goes on where it had not ended: nothing was known before.
            self.phase = self.phase if self.phase == WARM_UP else RECOVERING
            self.settled_at = max(self.settled_at, self._after(time, self._forgetting))
        status, nu = self._status(time, complete=complete), len(self.input_names)
        sample = LinearSample(row, values[:nu], values[nu:], len(self.state_names))
        return Row(status, row if complete else np.full(len(row), np.nan), missing, sample if status == OK else None)

    def _status(self, time: float, *, complete: bool) -> str:
        if not complete:
            return GAP
        if self.state.unclaimed:
            return OUT
        if time < self.settled_at:
            return self.phase
        self.phase = OK
        return OK
