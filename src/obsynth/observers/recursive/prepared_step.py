"""What a complete step needs of its matrices, kept from step to step while they stay the same."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from obsynth.numerics.arrays import FloatArray
from obsynth.numerics.least_squares_step import LeastSquaresStep, Projection, projected_step, projection_of
from obsynth.observers.recursive.step_model import StepMatrices


@dataclass(frozen=True, eq=False)
class PreparedStep:
    """One step with its factorisation.

    Fields: step: Which step it is; projection: Of H; ``None`` where its rank has to be decided; moved: ``(rows, n)``:
    rotated A, empty without a projection; known: ``(any, rows)``: the transpose of the rotated noise, empty without a
    projection.
    """

    step: StepMatrices
    projection: Projection | None
    moved: FloatArray
    known: FloatArray

    @classmethod
    def of(cls, step: StepMatrices, last: PreparedStep | None) -> PreparedStep:
        """Prepare a step."""
        same = last if last is not None and last.step.H is step.H else None
        projection = projection_of(step.H) if same is None else same.projection
        if projection is None:
            return cls(step, None, step.A[:0], step.noise[:0])
        rotation = projection.rotation
        moved = rotation[:, : len(step.A)] @ step.A
        still = same is not None and same.step.noise is step.noise
        return cls(step, projection, moved, same.known if same and still else (rotation @ step.noise).T)

    def taken(self, factor: FloatArray, right: FloatArray) -> LeastSquaresStep | None:
        """Take the step, or return ``None`` where a rank has to be decided.

        Shapes: ``factor (n, any)``, ``right (rows, columns)``.
        """
        if self.projection is None:
            return None
        width, known, rows = factor.shape[1], self.known, len(right)
        # As many rows as the projection has at least: what is missing (rectangular roots) are rows of zeros.
        noise = np.zeros((max(width + len(known), rows), rows), order="F")
        noise[:width] = (self.moved @ factor).T
        noise[width : width + len(known)] = known
        return projected_step(self.projection, noise, self.projection.rotation @ right)
