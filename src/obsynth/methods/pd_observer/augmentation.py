"""The plant that a PD observer works on: states and faults in one vector, the faults constant but for their rate.

Source: Filasova, Krokavec, Serbak, eqs. (29)-(32), with feedthrough carried: ``C_o = [C Df]``.
"""

from __future__ import annotations

import numpy as np

from obsynth.numerics.arrays import FloatArray
from obsynth.plants.descriptor import DescriptorSystem


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
