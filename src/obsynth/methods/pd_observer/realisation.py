"""The derivative-free realisation of a PD observer, its gains, and its error system.

Filasova, Krokavec, Serbak, eqs. (29)-(32), with feedthrough, ``C_o = [C Df]``.  With ``T = I + L C``, ``S = T^-1 L``,
``K = J + (A - J C) S`` and the augmented ``A, B, C, D``, the state ``nu = T xi - L (y - D u)`` has no derivative:

    nu' = (A - K C) nu + B u + K (y - D u),   xi = nu + S (y - D u - C nu)

Any K and S with ``I - S C`` nonsingular come from gains: ``L = (I - S C)^-1 S``, ``J = K - (A - K C) L``.  With
``eps = [x; f] - nu`` and the estimates ``S nu + T (y - D u)``, ``S + T C = I``, no derivative of the noise is left:

    eps' = Az eps + [0; I] f' + (Bd - By Dd) d + (Bw - By Dw) w,   error = S eps - T (Dd d + Dw w)
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from obsynth.numerics.arrays import FloatArray
from obsynth.numerics.continuous import ContinuousNorms
from obsynth.numerics.norms import HinfNorm
from obsynth.observers.linear.observer import LinearObserver
from obsynth.plants.descriptor import DescriptorSystem
from obsynth.verification.error_system import ErrorModel


def realise_pd_observer(
    plant: DescriptorSystem, augmented: DescriptorSystem, J: FloatArray, L: FloatArray
) -> LinearObserver:
    """Return the observer with gains ``J, L (nx + nf, ny)`` of the augmented plant; ``I + L C`` is nonsingular."""
    n, a, c, d = augmented.nx, augmented.A, augmented.C, augmented.D
    correction = np.linalg.solve(np.eye(n) + L @ c, L)
    gain = J + (a - J @ c) @ correction
    estimate = np.eye(n) - correction @ c
    return LinearObserver(
        Az=a - gain @ c,
        Bu=augmented.B - gain @ d,
        By=gain,
        # The residual is y less what the estimates say about it.
        Cz=np.vstack([estimate, -c @ estimate]),
        Dy=np.vstack([correction, np.eye(plant.ny) - c @ correction]),
        Du=np.vstack([-correction @ d, -d + c @ correction @ d]),
        dt=0.0,
        input_names=plant.input_names,
        output_names=plant.output_names,
        state_names=plant.state_names,
        fault_names=plant.fault_names,
        residual_names=plant.output_names,
        state_delays=(0,) * plant.nx,
        fault_delays=(0,) * plant.nf,
    )


def with_faults_as_states(plant: DescriptorSystem, gain: FloatArray | None = None) -> DescriptorSystem:
    """Return the plant with state ``[x; phi]``, f = G phi, ``gain (nf, nf)``, driven by the rate ``phi' = v``."""
    nx, nf = plant.nx, plant.nf
    g = np.eye(nf) if gain is None else gain
    a = np.zeros((nx + nf, nx + nf))
    a[:nx, :nx], a[:nx, nx:] = plant.A, plant.Bf @ g
    b, bd, bw = (np.vstack([part, np.zeros((nf, part.shape[1]))]) for part in (plant.B, plant.Bd, plant.Bw))
    states = [*(f"state:{name}" for name in plant.state_names), *(f"fault:{name}" for name in plant.fault_names)]
    return DescriptorSystem(
        None,
        a,
        b,
        np.hstack([plant.C, plant.Df @ g]),
        Bf=np.eye(nx + nf)[:, nx:],
        Bd=bd,
        Bw=bw,
        D=plant.D,
        Dd=plant.Dd,
        Dw=plant.Dw,
        state_names=states,
        input_names=plant.input_names,
        output_names=plant.output_names,
        fault_names=[f"rate:{name}" for name in plant.fault_names],
    )


def with_sensor_noise(plant: DescriptorSystem) -> DescriptorSystem:
    """Return the plant itself where it states noise, else the plant with unit noise on every output."""
    if plant.nw:
        return plant
    return plant.replace(Bw=np.zeros((plant.nx, plant.ny)), Dw=np.eye(plant.ny), noise_names=None)


@dataclass(frozen=True, eq=False)
class PdErrorSystem:
    """The error system of a shipped PD observer; f', d and w by input matrix and feedthrough to the error."""

    Az: FloatArray  # (n, n), n = nx + nf
    estimate: FloatArray  # (nx + nf, n): error = ``estimate eps``
    rate: tuple[FloatArray, FloatArray]  # (n, *), (nx + nf, *)
    disturbance: tuple[FloatArray, FloatArray]
    noise: tuple[FloatArray, FloatArray]
    J: FloatArray  # (n, ny), recovered from the realisation, as L
    L: FloatArray
    nx: int

    @classmethod
    def of(cls, augmented: DescriptorSystem, observer: LinearObserver, nx: int) -> PdErrorSystem:
        """Return the error system of ``observer`` on a plant with its faults as states."""
        n = augmented.nx
        rows = slice(0, n)
        direct = observer.Dy[rows]
        errors = ErrorModel(augmented, observer, np.eye(n))
        gain_l = solved(observer.Cz[rows], direct)
        return cls(
            observer.Az,
            observer.Cz[rows],
            (errors.fault, -direct @ augmented.Df),
            (errors.disturbance, -direct @ augmented.Dd),
            (errors.noise, -direct @ augmented.Dw),
            observer.By - observer.Az @ gain_l,
            gain_l,
            nx,
        )

    @cached_property
    def _norms(self) -> ContinuousNorms:
        return ContinuousNorms(self.Az)

    def fault_norm(self, driven: tuple[FloatArray, FloatArray]) -> HinfNorm:
        """Return the H-infinity norm to the fault error from one of ``rate``, ``disturbance``, ``noise``."""
        return self._norms.between(driven[0], self.estimate[self.nx :], driven[1][self.nx :])

    def state_norm(self, driven: tuple[FloatArray, FloatArray]) -> HinfNorm:
        """Return the same to the error of the state estimate."""
        return self._norms.between(driven[0], self.estimate[: self.nx], driven[1][: self.nx])

    def separate_noise_norm(self, process: FloatArray, sensor: FloatArray) -> HinfNorm:
        """Return the H-infinity norm from ``[w; w']``, both free, with ``process (nx, nw)`` and ``sensor (ny, nw)``."""
        n = len(self.Az)
        padded = np.vstack([process, np.zeros((n - self.nx, process.shape[1]))])
        # (I + L C) e' = Ae e + Bw w - J Dw w - L Dw w', and eps = (I + L C) e.
        b = np.hstack([padded - self.J @ sensor, -self.L @ sensor])
        # The estimate is S of eps + L noise: in terms of the error itself no feedthrough is left.
        fault_rows = self.estimate[self.nx :]
        return self._norms.between(b, fault_rows, np.zeros((len(fault_rows), b.shape[1])))


def solved(matrix: FloatArray, right: FloatArray) -> FloatArray:
    """Return ``matrix^-1 right``; NaN when the matrix is singular."""
    try:
        return np.asarray(np.linalg.solve(matrix, right))
    except np.linalg.LinAlgError:
        return np.full_like(right, np.nan)
