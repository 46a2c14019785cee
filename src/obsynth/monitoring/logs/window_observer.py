"""Tests whose weights change with k, on a log; the first row is k = 0."""

from __future__ import annotations

from typing import Any, ClassVar

import numpy as np

from obsynth.errors import SpecError
from obsynth.monitoring.logs.log_observer import GAP, OK, RECOVERING, WARM_UP, LogObserver, Row
from obsynth.monitoring.thresholds.monitor import LinearSample
from obsynth.numerics.arrays import FloatArray
from obsynth.observers.window.observer import WindowObserver
from obsynth.results.design import ObserverDesign


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
        signals = np.where(np.isfinite(values), values, np.nan)
        with np.errstate(over="ignore", invalid="ignore"):
            self.state, value = self.observer.advance(self.state, signals[nu:], signals[:nu])
        complete = bool(np.isfinite(values).all())
        self.complete = min(self.complete + 1, self.observer.samples) if complete else 0
        status = GAP
        if complete:
            full = self.complete == self.observer.samples and k >= self.observer.samples
            self.phase = OK if full else RECOVERING if self.phase in (OK, RECOVERING) else WARM_UP
            status = self.phase
        row_values = np.array([value])
        return Row(status, row_values, missing, LinearSample(row_values, signals[:nu], signals[nu:], 0))
