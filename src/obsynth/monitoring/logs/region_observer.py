"""Observers of nonlinear plants over a region on a log: rows outside the region, and rows after them.

A row is ``out`` from one in which an input, a measurement or the estimate leaves the region until a hundredth of the
error that this may have left is left: nothing is claimed there, and nothing is decided.  Signals that are missing count
as they last were; such a row is a gap, and those after it are recovering as long.
"""

from __future__ import annotations

from typing import ClassVar

import numpy as np

from obsynth.monitoring.logs.log_observer import GAP, OK, OUT, RECOVERING, WARM_UP, LogObserver, Row
from obsynth.monitoring.thresholds.monitor import LinearSample
from obsynth.numerics.arrays import FloatArray
from obsynth.results.design import ObserverDesign


class RegionLogObserver(LogObserver):
    """An observer over a region on a log, whose values are absolute."""

    saved: ClassVar = {"observer": "state", "held": "held", "begun": "begun"}

    def __init__(self, design: ObserverDesign, *, warm_up: float | None = None) -> None:
        _, observer = design.over_region
        super().__init__(observer, warm_up, observer.forgetting * observer.dt)
        self.observer, self.columns = observer, observer.row_names
        self.input_names, self.output_names = observer.input_names, observer.output_names
        self.input_delay = design.input_delay
        self.state = observer.init()
        self.held, self.begun = np.zeros(len(self.input_names) + len(self.output_names)), False

    def take(self, time: float, values: FloatArray, *, seconds: float, missing: int, longest: float) -> Row:
        """Take one row."""
        nu, known = len(self.input_names), np.isfinite(values)
        whole = bool(known.all())
        if not self.begun and not whole:
            return Row(GAP, np.full(len(self.columns), np.nan), missing)
        if missing or not self.begun:
            self.state, self.begun = self.observer.init(), True
            self.settled_at, self.phase = self._after(time, self.warm_up), WARM_UP
        self.held = np.where(known, values, self.held)
        self.state, row = self.observer.advance(self.state, self.held[nu:], self.held[:nu])
        if not whole:
            # Warm-up goes on where it had not ended: nothing was known before.
            settled = self._after(time, self.observer.forgetting * self.dt)
            self.phase = self.phase if self.phase == WARM_UP else RECOVERING
            self.settled_at = max(self.settled_at, settled)
        status = self._status(time, whole=whole)
        sample = LinearSample(row, values[:nu], values[nu:], len(self.state_names))
        return Row(status, row if whole else np.full(len(row), np.nan), missing, sample if status == OK else None)

    def _status(self, time: float, *, whole: bool) -> str:
        if not whole:
            return GAP
        if self.state.unclaimed:
            return OUT
        if time < self.settled_at:
            return self.phase
        self.phase = OK
        return OK
