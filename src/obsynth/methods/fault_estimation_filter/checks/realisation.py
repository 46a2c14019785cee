"""The filter that a set of gains stands for, by running its equations on unit vectors.

Source: Wang 2015, eq. (23), with ``T A`` for the dynamics of the estimate ``x0 = z + N y``:

    z+ = T A x0 + L (y - C x0) + T B u,   r = W (y - C x0),

the input's feedthrough subtracted from y, and the state estimate corrected by the faults that r makes known: fault i
has moved the state of age a by ``(TA)^(rho_i - 1 - a) T f_i``.  A second route to what synthesis writes down in blocks.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from obsynth.numerics.arrays import FloatArray
from obsynth.observers.linear.observer import LinearObserver
from obsynth.plants.descriptor import DescriptorSystem

#: The observer's matrices.
MATRICES = ("Az", "Bu", "By", "Cz", "Du", "Dy")


@dataclass(frozen=True, eq=False)
class Equations:
    """The matrices from which the filter's equations are made.

    Fields: A, B, C, F: Of the plant with its sensor faults as states: ``(na, na)``, ``(na, nu)``, ``(ny, na)``, ``(na,
    nf)``; D: ``(ny, nu)``; nx: States of the plant itself; delays: ``rho_i``, 1 or more.
    """

    A: FloatArray
    B: FloatArray
    C: FloatArray
    F: FloatArray
    D: FloatArray
    nx: int
    delays: tuple[int, ...]

    @classmethod
    def of(cls, plant: DescriptorSystem, work: DescriptorSystem, delays: tuple[int, ...]) -> Equations:
        """Return the equations for ``plant``; ``work`` has its sensor faults as states."""
        return cls(work.A, work.B, work.C, work.Bf, plant.D, plant.nx, delays)

    @property
    def absolute(self) -> Equations:
        """The same with absolute values, for sizes."""
        a, b, c, f, d = (np.abs(part) for part in (self.A, self.B, self.C, self.F, self.D))
        return Equations(a, b, c, f, d, self.nx, self.delays)

    def detectability_matrix(self, gains: Mapping[str, FloatArray]) -> FloatArray:
        """Return Psi ``(na, nf)`` for the delays, columns ``(TA)^(rho_i - 1) T f_i``."""
        return self.moved(gains["T"], 0, rows=len(self.A))

    def moved(self, t: FloatArray, age: int, *, rows: int) -> FloatArray:
        """Return what each fault known now did to the first ``rows`` states of some age, per unit ``(rows, nf)``."""
        found = np.zeros((rows, len(self.delays)))
        for i, delay in enumerate(self.delays):
            if delay > age:
                column = t @ self.F[:, i]
                for _ in range(delay - 1 - age):
                    column = t @ (self.A @ column)
                found[:, i] = column[:rows]
        return found

    def realised(self, gains: Mapping[str, FloatArray], *, minus: float = -1.0) -> dict[str, FloatArray]:
        """Return Az, Bu, By, Cz, Du and Dy of the filter."""
        t, n, feedback, w = (gains[letter] for letter in "TNLW")
        na, nx, ny, lag = len(self.A), self.nx, len(self.C), max(self.delays, default=1) - 1
        nz = na + lag * nx
        core, stored, u, y = np.split(np.eye(nz + self.B.shape[1] + ny), [na, nz, nz + self.B.shape[1]])
        measured = y + minus * (self.D @ u)
        x0 = core + n @ measured
        innovation = measured + minus * (self.C @ x0)
        shown = w @ innovation
        known = [x0[:nx], *np.split(stored, lag)] if lag else [x0[:nx]]
        states = [state + self.moved(t, age, rows=nx) @ shown for age, state in enumerate(known)]
        following = np.vstack([t @ (self.A @ x0) + feedback @ innovation + t @ (self.B @ u), *states[:-1]])
        outputs = np.vstack([states[-1], shown, shown])
        columns = [nz, nz + self.B.shape[1]]
        return dict(
            zip(MATRICES, [*np.split(following, columns, axis=1), *np.split(outputs, columns, axis=1)], strict=True)
        )

    def tracking(self, t: FloatArray) -> FloatArray:
        """Return the map V ``(nz, nx (lag + 1))`` that the observer's states track."""
        lag = max(self.delays, default=1) - 1
        na, older = len(self.A), lag * self.nx
        found = np.zeros((na + older, self.nx + older))
        found[:na, : self.nx] = t[:, : self.nx]
        found[na:, self.nx :] = np.eye(older)
        return found


def filter_of(like: LinearObserver, matrices: Mapping[str, FloatArray]) -> LinearObserver:
    """Return an observer with these matrices and the signals of another one."""
    return LinearObserver(**{**like.as_dict(), **matrices})
