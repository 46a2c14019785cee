"""Tests whose weights change with k, on a log: time stamps, gaps, saved state; the first row is k = 0."""

from __future__ import annotations

from typing import Any

import numpy as np

from obsynth.data.log_estimator import GAP, OK, RECOVERING, WARM_UP, Engine, Row
from obsynth.errors import ObsynthError, SpecError
from obsynth.experiments.monitors.monitor import LinearSample
from obsynth.numerics.arrays import FloatArray
from obsynth.observers.running import state_as_data, state_from_data
from obsynth.observers.windows import WindowObserver
from obsynth.results.design import ObserverDesign


class WindowEngine(Engine):
    """A running test on measured data: there is no verdict until its window is complete."""

    def __init__(self, design: ObserverDesign, observer: WindowObserver, *, warm_up: float | None = None) -> None:
        if warm_up is not None:
            raise SpecError(
                "warm_up is for designs that forget their start: this test knows nothing but its window.",
                path="warm_up",
            )
        super().__init__(observer, None, None, 0.0)
        plant: Any = design.plant
        self.observer, self.columns = observer, observer.row_names
        self.input_names, self.output_names = observer.input_names, observer.output_names
        self.point, self.scales, self.input_delay = plant.operating_point, plant.scales, design.input_delay
        self.state, self.complete = observer.init(), 0

    def step(self, time: float, values: FloatArray, row: int) -> Row:
        """Take one row of data."""
        before = self.state, self.complete, self.clock.last, self.clock.longest
        try:
            return self._step(time, values, row)
        except ObsynthError as error:
            # A row that is refused leaves nothing behind: a run may go on after it.
            self.state, self.complete, self.clock.last, self.clock.longest = before
            if isinstance(error, SpecError) and not str(error).startswith("Row"):
                raise SpecError(f"Row {row}: {error}", path=f"row {row}") from error
            raise

    def _step(self, time: float, values: FloatArray, row: int) -> Row:
        _, missing = self.clock.advance(time, row)
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

    def _own_data(self) -> dict[str, Any]:
        return {"observer": state_as_data(self.state), "complete": self.complete}

    def _resume_own(self, data: dict[str, Any]) -> None:
        self.state, self.complete = state_from_data(self.state, data["observer"]), int(data["complete"])
