"""Detect and reset: when innovations are too large for what is known of the parameters, less is known."""

from __future__ import annotations

from collections import deque

import numpy as np

from obsynth.numerics.arrays import FloatArray
from obsynth.numerics.recursive_least_squares import ParameterState

#: Samples whose squared innovations are summed up.
RESET_WINDOW = 20


class ParameterReset:
    """Sums up normalised innovations, and starts S and the covariance again when they are too large.

    Fields: probability: That the threshold is passed at a sample although nothing has changed; start: Whose triangle
    and spread are taken back.
    """

    def __init__(self, probability: float, start: ParameterState) -> None:
        self.probability, self.start = probability, start
        self.window: deque[tuple[float, int]] = deque(maxlen=RESET_WINDOW)
        self.thresholds: dict[int, float] = {}
        self.resets = 0

    def watched(self, state: ParameterState, v: FloatArray, G: FloatArray) -> ParameterState:
        """Return the state to go on with: the same, or one that knows no more than at the start.

        Shapes: ``v (m,)``, ``G (m, nq)``.
        """
        gap, seen = v - G @ state.theta, G @ state.spread
        covariance = np.eye(len(v)) + seen @ seen.T
        self.window.append((float(gap @ np.linalg.solve(covariance, gap)), len(v)))
        total, degrees = sum(value for value, _ in self.window), sum(count for _, count in self.window)
        if degrees == 0 or total <= self._threshold(degrees):
            return state
        self.window.clear()
        self.resets += 1
        return ParameterState(state.theta, self.start.triangle, self.start.spread)

    def _threshold(self, degrees: int) -> float:
        from scipy.special import chdtri

        if degrees not in self.thresholds:
            self.thresholds[degrees] = float(chdtri(degrees, self.probability))
        return self.thresholds[degrees]
