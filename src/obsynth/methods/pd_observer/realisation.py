r"""The derivative-free realisation of a PD observer, and the gains that a realisation stands for.

With the augmented plant ``A, B, C, D`` and ``T = I + L C``, the PD observer

    xi' = A xi + B u + J (y - D u - C xi) + L d/dt (y - D u - C xi)

has the state ``nu = T xi - L (y - D u)``, in which no derivative is left:

    nu' = (A - K C) nu + B u + K (y - D u),   xi = nu + S (y - D u - C nu),   S = T^-1 L,   K = J + (A - J C) S

So a PD observer is a Luenberger observer with gain K whose estimate is corrected by S times its own residual, and any
K and any S with ``I - S C`` nonsingular come from gains: ``L = (I - S C)^-1 S`` and ``J = K - (A - K C) L``.
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
