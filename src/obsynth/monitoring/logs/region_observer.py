"""Observers of nonlinear plants over a region on a log.

A row in which an input, a measurement or the estimate leaves the region is outside.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from obsynth.monitoring.logs.claimed_observer import ClaimedLogObserver
from obsynth.numerics.arrays import FloatArray
from obsynth.results.design import ObserverDesign


class RegionLogObserver(ClaimedLogObserver):
    """An observer over a region on a log, whose values are absolute."""

    def __init__(self, design: ObserverDesign, *, warm_up: float | None = None) -> None:
        _, observer = design.over_region
        super().__init__(observer, warm_up, design.input_delay)

    @property
    def _needed(self) -> NDArray[np.bool_]:
        return np.ones(len(self.held), dtype=bool)

    def _advance(self, values: FloatArray, seconds: float) -> FloatArray:
        nu = len(self.input_names)
        self.held = np.where(np.isfinite(values), values, self.held)
        self.state, row = self.observer.advance(self.state, self.held[nu:], self.held[:nu])
        return np.asarray(row)
