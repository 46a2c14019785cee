"""Detect and reset: when innovations are too large for what is known of the parameters, less is known."""

from __future__ import annotations

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
        self.thresholds: dict[int, float] = {}

    def surprises(self, before: FloatArray, state: ParameterState, v: FloatArray, G: FloatArray) -> FloatArray:
        """Return the latest normalised squares with their degrees of freedom, that of this sample last.

        Shapes: ``before (any, 2)``, ``v (m,)``, ``G (m, nq)``.
        """
        gap, seen = v - G @ state.theta, G @ state.spread
        covariance = np.eye(len(v)) + seen @ seen.T
        latest = [float(gap @ np.linalg.solve(covariance, gap)), float(len(v))]
        return np.vstack([before, latest])[-RESET_WINDOW:]

    def is_due(self, surprises: FloatArray) -> bool:
        """Return whether the innovations are too large for what is known of the parameters."""
        total, degrees = float(sum(surprises[:, 0])), int(sum(surprises[:, 1]))
        return degrees > 0 and total > self._threshold(degrees)

    def forgetful(self, state: ParameterState) -> ParameterState:
        """Return the same estimate, known no better than at the start."""
        return ParameterState(state.theta, self.start.triangle, self.start.spread)

    def _threshold(self, degrees: int) -> float:
        from scipy.special import chdtri

        if degrees not in self.thresholds:
            self.thresholds[degrees] = float(chdtri(degrees, self.probability))
        return self.thresholds[degrees]
