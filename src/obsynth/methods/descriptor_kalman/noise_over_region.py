"""Process and sensor noise of a Kalman filter over a region: stated covariances, or the plant's at each vertex."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from obsynth.errors import SpecError
from obsynth.numerics.arguments import require_shape
from obsynth.numerics.arrays import FloatArray, dimensions_of, matrix_or_multiple_of_identity
from obsynth.numerics.ranks import covariance_factor, product_but_rounding
from obsynth.plants.polytopic import PolytopicSystem


@dataclass(frozen=True, eq=False)
class NoiseOverRegion:
    """Noise as factors of covariances: independent unit white noises drive the equations and the outputs by them.

    Parameters
    ----------
    process : tuple of FloatArray
        Noise inputs of the equations ``(nx, q)`` at each vertex.
    sensor : FloatArray
        Noise inputs of the outputs ``(ny, p)``.
    Q, R : FloatArray or None
        Stated covariances of process and sensor noise; ``None`` where the plant states its own noise.
    missing : tuple of str
        Which of ``Q`` and ``R`` are identities because neither the options nor the plant state any noise.
    """

    process: tuple[FloatArray, ...]
    sensor: FloatArray
    Q: FloatArray | None
    R: FloatArray | None
    missing: tuple[str, ...]

    @classmethod
    def of(cls, plant: PolytopicSystem, Q: Any, R: Any) -> NoiseOverRegion:
        """Return the noise that the options Q and R or else the plant state; raise `SpecError` where it is invalid."""
        first = plant.vertices[0]
        if (
            plant.nw
            and (Q is None or R is None)
            and any(np.any(product_but_rounding(v.Bw, v.Dw.T)) for v in plant.vertices)
        ):
            raise SpecError(
                "The plant's noise drives equations and outputs at once (Bw Dw' is not zero), which this method does "
                "not cover: state independent noises, or give Q and R.",
                path="Dw",
            )
        missing = tuple(name for name, covariance in (("Q", Q), ("R", R)) if covariance is None and not plant.nw)
        Q, R = (1.0 if name in missing else covariance for name, covariance in (("Q", Q), ("R", R)))
        process, sensor = _constant(Q, plant.nx, "Q"), _constant(R, plant.ny, "R")
        return cls(
            tuple(v.Bw for v in plant.vertices)
            if process is None
            else (covariance_factor(process, "Q"),) * plant.count,
            first.Dw if sensor is None else covariance_factor(sensor, "R"),
            process,
            sensor,
            missing,
        )

    @property
    def middle(self) -> FloatArray:
        """The mean of the noise inputs of the vertices, which drives the plant at the middle of the region."""
        return np.asarray(sum(self.process[1:], start=self.process[0]) / len(self.process))

    def stated(self) -> dict[str, Any]:
        """Return the covariances as options, for the gain set."""
        return {name: None if value is None else value.tolist() for name, value in (("Q", self.Q), ("R", self.R))}


def _constant(covariance: Any, size: int, name: str) -> FloatArray | None:
    """Return a covariance as a matrix, checked; ``None`` for the plant's own noise."""
    if covariance is None:
        return None
    if callable(covariance) or isinstance(covariance, str) or dimensions_of(covariance, name) not in (0, 2):
        raise SpecError(
            f"{name} changes with k, or is no matrix: over a region give a constant covariance ({size} x {size}), or a "
            "number.",
            path=name,
        )
    matrix = matrix_or_multiple_of_identity(covariance, size, name)
    require_shape(matrix.shape, (size, size), name)
    covariance_factor(matrix, name)  # raises SpecError where the matrix is no covariance
    return matrix
