"""Scheduled observers on a log: parameters in columns of their own.

A row with a parameter that is missing, outside its range or faster than its rate is outside the region.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from obsynth.monitoring.logs.claimed_observer import ClaimedLogObserver
from obsynth.numerics.arrays import FloatArray
from obsynth.results.design import ObserverDesign


class ScheduledLogObserver(ClaimedLogObserver):
    """A scheduled observer on a log."""

    def __init__(self, design: ObserverDesign, *, warm_up: float | None = None) -> None:
        plant, observer = design.scheduled
        super().__init__(observer, warm_up, design.input_delay)
        self.point, self.scales = plant.operating_point, plant.scales
        #: An input that is one in every row, and has no column.
        self.shift = plant.shift

    @property
    def _needed(self) -> NDArray[np.bool_]:
        needed = np.ones(len(self.held), dtype=bool)
        needed[self.observer.inputs : len(self.input_names)] = False
        return needed

    def _advance(self, values: FloatArray, seconds: float) -> FloatArray:
        nu, needed = len(self.input_names), self._needed
        taken = np.where(needed & ~np.isfinite(values), self.held, values)
        taken = np.where(np.isfinite(taken), taken, np.nan)
        self.held = np.where(needed, taken, 0.0)
        with np.errstate(over="ignore", invalid="ignore"):
            self.state, row = self.observer.advance(self.state, taken[nu:], taken[:nu], seconds)
        return np.asarray(row)
