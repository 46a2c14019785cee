"""The least interval of a fault for the very samples of one window, each end proved by multipliers of its own."""

from __future__ import annotations

from dataclasses import replace
from functools import lru_cache

import numpy as np

from obsynth.errors import SolverError
from obsynth.methods.guaranteed_test.problem import rounding_of
from obsynth.methods.guaranteed_test.programs import largest_hidden_fault
from obsynth.methods.guaranteed_test.proofs import proved_threshold, repaired_multipliers
from obsynth.methods.guaranteed_test.windows import Window, window_of
from obsynth.numerics.arrays import FloatArray

#: Windows that are kept without the equations whose inputs are not known yet.
KEPT_WINDOWS = 4


def least_interval(window: Window, delay: int, y: FloatArray, u: FloatArray) -> tuple[float, float]:
    """Return both ends for ``y, u (samples + delay, ...)``; infinite where nothing is proved.

    Whatever multipliers see the fault with weight one and nothing free: it lies within ``T(mu)`` of ``mu' b``.
    """
    if window.question.closing > delay:
        window = _until(window, delay)
    right = window.data(y[: window.question.samples], u)
    largest = np.abs(np.hstack([u, y])).max(axis=0, initial=0.0)
    ends = []
    for sign in (-1.0, 1.0):
        try:
            found = largest_hidden_fault(window, right, sign=sign)
        except SolverError:
            # What a solver says of a window proves nothing: the fixed test holds.
            ends.append(sign * np.inf)
            continue
        exact = None if found.multipliers is None else repaired_multipliers(window, found.multipliers, refine=True)
        if exact is None:
            ends.append(sign * np.inf)
            continue
        width = proved_threshold(window, exact) + float(rounding_of(window, exact.values, exact.radius) @ largest)
        ends.append(float(exact.values @ right) + sign * width)
    return ends[0], ends[1]


@lru_cache(KEPT_WINDOWS)
def _until(window: Window, delay: int) -> Window:
    """Return a window without the equations after its last known input."""
    return window_of(window.plant, window.bounds, replace(window.question, closing=delay))
