r"""The error of a PD observer and what drives it, from the plant and the shipped realisation.

With ``eps = [x; f] - nu`` and the estimates ``S nu + T (y - D u)``, ``S + T C = I``:

    eps' = Az eps + [0; I] f' + (Bd - By Dd) d + (Bw - By Dw) w,   error = S eps - T (Dd d + Dw w)

No derivative of the noise is left in it: this is the whole transfer, high frequencies included.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from obsynth.numerics.arrays import FloatArray
from obsynth.numerics.continuous import ContinuousHinfNorm, continuous_hinf_norm
from obsynth.observers.linear.observer import LinearObserver
from obsynth.plants.descriptor import DescriptorSystem
from obsynth.verification.error_system import ErrorSystem


@dataclass(frozen=True, eq=False)
class PdErrorSystem:
    """The error system of a shipped PD observer; see the module's text.

    Fields: Az: ``(n, n)``, n = nx + nf; estimate: ``(nx + nf, n)``: error = ``estimate eps``; rate, disturbance, noise:
    Input matrix ``(n, *)`` and feedthrough to the error ``(nx + nf, *)`` of f', d and w; J, L: ``(n, ny)``, recovered
    from the realisation; nx: Number of states of the plant.
    """

    Az: FloatArray
    estimate: FloatArray
    rate: tuple[FloatArray, FloatArray]
    disturbance: tuple[FloatArray, FloatArray]
    noise: tuple[FloatArray, FloatArray]
    J: FloatArray
    L: FloatArray
    nx: int

    @classmethod
    def of(cls, augmented: DescriptorSystem, observer: LinearObserver, nx: int) -> PdErrorSystem:
        """Return the error system of ``observer`` on a plant with its faults as states."""
        n = augmented.nx
        rows = slice(0, n)
        direct = observer.Dy[rows]
        errors = ErrorSystem.of(augmented, observer, np.eye(n), 0)
        gain_l = _solved(observer.Cz[rows], direct)
        return cls(
            observer.Az, observer.Cz[rows],
            (errors.fault, -direct @ augmented.Df),
            (errors.disturbance, -direct @ augmented.Dd),
            (errors.noise, -direct @ augmented.Dw),
            observer.By - observer.Az @ gain_l, gain_l, nx,
        )  # fmt: skip

    def fault_norm(self, driven: tuple[FloatArray, FloatArray]) -> ContinuousHinfNorm:
        """Return the H-infinity norm to the fault error from one of ``rate``, ``disturbance``, ``noise``."""
        return continuous_hinf_norm(self.Az, driven[0], self.estimate[self.nx :], driven[1][self.nx :])

    def state_norm(self, driven: tuple[FloatArray, FloatArray]) -> ContinuousHinfNorm:
        """Return the same to the error of the state estimate."""
        return continuous_hinf_norm(self.Az, driven[0], self.estimate[: self.nx], driven[1][: self.nx])

    def separate_noise_norm(self, process: FloatArray, sensor: FloatArray) -> ContinuousHinfNorm:
        """Return the H-infinity norm to the fault error from ``[w; w']`` taken as two inputs that are free.

        ``process (nx, nw)`` and ``sensor (ny, nw)`` say where w enters.
        """
        n = len(self.Az)
        padded = np.vstack([process, np.zeros((n - self.nx, process.shape[1]))])
        # (I + L C) e' = Ae e + Bw w - J Dw w - L Dw w', and eps = (I + L C) e.
        b = np.hstack([padded - self.J @ sensor, -self.L @ sensor])
        # The estimate is S of eps + L noise: in terms of the error itself no feedthrough is left.
        inner = _similar(self.Az, self.estimate)
        shown = np.eye(n)[self.nx :]
        return continuous_hinf_norm(inner, self.estimate @ b, shown, np.zeros((len(shown), b.shape[1])))


def _solved(matrix: FloatArray, right: FloatArray) -> FloatArray:
    """Return ``matrix^-1 right``; NaN when the matrix is singular."""
    try:
        return np.asarray(np.linalg.solve(matrix, right))
    except np.linalg.LinAlgError:
        return np.full_like(right, np.nan)


def _similar(a: FloatArray, s: FloatArray) -> FloatArray:
    """Return ``s a s^-1``; NaN when s is singular."""
    return _solved(s.T, (s @ a).T).T
