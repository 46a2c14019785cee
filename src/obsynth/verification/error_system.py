r"""The error system of a shipped observer, from the plant and the realisation alone.

For the plant ``E x+ = A x + B u + b s``, ``y = C x + D u + d s`` (s a fault, disturbance or noise) and the observer
``z+ = Az z + Bu u + By y``, suppose a tracking map V satisfies

    Az V E + By C = V A,   Bu + By D = V B.

Then ``e = V E x - z`` obeys ``e+ = Az e + (V b - By d) s``, whatever x, u and s do.  An output ``Cz z + Du u + Dy y``
that satisfies ``Cz V E + Dy C = K`` and ``Du + Dy D = 0`` equals ``K x - Cz e + Dy d s``.  Estimates that lag by some
samples are covered by appending the past states to the plant.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from obsynth.numerics.arrays import FloatArray
from obsynth.observers.linear.observer import LinearObserver
from obsynth.plants.descriptor import DescriptorSystem


@dataclass(frozen=True, eq=False)
class LaggedPlant:
    """A plant whose state holds the last ``lag`` states as well: ``[x(k); x(k-1); ...; x(k-lag)]``."""

    E: FloatArray
    A: FloatArray
    B: FloatArray
    C: FloatArray
    lag: int
    nx: int

    @classmethod
    def of(cls, plant: DescriptorSystem, lag: int) -> LaggedPlant:
        """Return ``plant`` with its last ``lag`` states appended."""
        if lag == 0:
            return cls(plant.E, plant.A, plant.B, plant.C, 0, plant.nx)
        nx, total = plant.nx, plant.nx * (lag + 1)
        e, a = np.eye(total), np.zeros((total, total))
        e[:nx, :nx], a[:nx, :nx] = plant.E, plant.A
        a[nx:, :-nx] = np.eye(total - nx)
        b = np.vstack([plant.B, np.zeros((total - nx, plant.nu))])
        c = np.hstack([plant.C, np.zeros((plant.ny, total - nx))])
        return cls(e, a, b, c, lag, nx)

    def input(self, matrix: FloatArray) -> FloatArray:
        """Return an input matrix ``(nx, *)`` padded for the appended states."""
        return np.vstack([matrix, np.zeros((self.nx * self.lag, matrix.shape[1]))]) if self.lag else matrix

    @property
    def oldest(self) -> FloatArray:
        """Selector ``(nx, nx (lag + 1))`` of the oldest state."""
        return np.hstack([np.zeros((self.nx, self.nx * self.lag)), np.eye(self.nx)])


@dataclass(frozen=True, eq=False)
class ErrorSystem:
    """The observer's error ``e = V E x - z``, its inputs ``V b - By d``, and what it does to the estimates.

    Outputs ``(C, Df, Dd, Dw)``: fault estimate or residual = ``-C e + Df f + Dd d + Dw w``; minus that for states.
    """

    Az: FloatArray
    fault: FloatArray
    disturbance: FloatArray
    noise: FloatArray
    fault_output: tuple[FloatArray, FloatArray, FloatArray, FloatArray]
    residual_output: tuple[FloatArray, FloatArray, FloatArray, FloatArray]
    state_output: tuple[FloatArray, FloatArray, FloatArray, FloatArray]

    @classmethod
    def of(
        cls,
        plant: DescriptorSystem,
        observer: LinearObserver,
        tracking: FloatArray,
        lag: int,
        algebraic: FloatArray | None = None,
    ) -> ErrorSystem:
        """Return the error system of ``observer`` on ``plant``, given the tracking map ``(nz, nx (lag + 1))``.

        ``algebraic (rows, nx)``: equations that the outputs add, with ``Cz V E + Dy C = K + algebraic A``.
        """
        lagged = LaggedPlant.of(plant, lag)

        def driven(b: FloatArray, d: FloatArray) -> FloatArray:
            return np.asarray(tracking @ lagged.input(b) - observer.By @ d)

        def output(rows: slice) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
            direct = observer.Dy[rows]
            added = np.zeros((len(direct), plant.nx)) if algebraic is None else algebraic[rows]
            seen = ((plant.Bf, plant.Df), (plant.Bd, plant.Dd), (plant.Bw, plant.Dw))
            fault, disturbance, noise = (direct @ d - added @ b for b, d in seen)
            return observer.Cz[rows], fault, disturbance, noise

        return cls(
            observer.Az, driven(plant.Bf, plant.Df), driven(plant.Bd, plant.Dd), driven(plant.Bw, plant.Dw),
            output(observer.fault_rows), output(observer.residual_rows), output(observer.state_rows),
        )  # fmt: skip
