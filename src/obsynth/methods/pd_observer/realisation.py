r"""The derivative-free realisation of a PD observer, and the gains that a realisation stands for.

With the augmented plant ``A, B, C, D`` and ``T = I + L C``, the PD observer

    xi' = A xi + B u + J (y - D u - C xi) + L d/dt (y - D u - C xi)

has the state ``nu = T xi - L (y - D u)``, in which no derivative is left:

    nu' = (A - K C) nu + B u + K (y - D u),   xi = nu + S (y - D u - C nu),   S = T^-1 L,   K = J + (A - J C) S

So a PD observer is a Luenberger observer with gain K whose estimate is corrected by S times its own residual, and any
K and any S with ``I - S C`` nonsingular come from gains: ``L = (I - S C)^-1 S`` and ``J = K - (A - K C) L``.

The plant that a PD observer works on: states and faults in one vector, the faults constant but for their rate.

Source: Filasova, Krokavec, Serbak, eqs. (29)-(32), with feedthrough carried: ``C_o = [C Df]``.
"""

from __future__ import annotations

import numpy as np

from obsynth.numerics.arrays import FloatArray
from obsynth.observers.linear.observer import LinearObserver
from obsynth.plants.descriptor import DescriptorSystem


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
    """Return the plant with state ``[x; phi]``, f = G phi, ``phi' = v``: what drives it is the rate v of the fault.

    Shapes: ``gain (nf, nf)``.
    """
    nx, nf = plant.nx, plant.nf
    g = np.eye(nf) if gain is None else gain
    a = np.zeros((nx + nf, nx + nf))
    a[:nx, :nx], a[:nx, nx:] = plant.A, plant.Bf @ g
    faultless = np.zeros((nf, plant.nu)), np.zeros((nf, plant.nd)), np.zeros((nf, plant.nw))
    inputs = [np.vstack(pair) for pair in zip((plant.B, plant.Bd, plant.Bw), faultless, strict=True)]
    return DescriptorSystem(
        None,
        a,
        inputs[0],
        np.hstack([plant.C, plant.Df @ g]),
        Bf=np.vstack([np.zeros((nx, nf)), np.eye(nf)]),
        Bd=inputs[1],
        Bw=inputs[2],
        D=plant.D,
        Dd=plant.Dd,
        Dw=plant.Dw,
        state_names=[
            *(f"state:{name}" for name in plant.state_names),
            *(f"fault:{name}" for name in plant.fault_names),
        ],
        input_names=plant.input_names,
        output_names=plant.output_names,
        fault_names=[f"rate:{name}" for name in plant.fault_names],
    )


def with_sensor_noise(plant: DescriptorSystem) -> DescriptorSystem:
    """Return the plant itself where it states noise, else the plant with unit noise on every output."""
    if plant.nw:
        return plant
    return plant.replace(Bw=np.zeros((plant.nx, plant.ny)), Dw=np.eye(plant.ny), noise_names=None)
