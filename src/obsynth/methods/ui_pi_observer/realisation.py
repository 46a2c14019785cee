r"""The realisation of an unknown-input PI observer from its gains, and what certifies it.

Source: Share Pasand, Aliyari, Taghirad, eqs. (4), (12), (19), (20): ``Ahat = U A - K C``, ``Bhat = Ahat D + K``,
``Jhat = U B``, all for the augmented plant; the state and the fault are read from ``z + D y``.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from obsynth.analysis.plant_units import PlantUnits
from obsynth.methods.ui_pi_observer.augmented_plant import AugmentedPlant, direct_part
from obsynth.numerics.arrays import FloatArray
from obsynth.observers.linear.observer import LinearObserver
from obsynth.plants.descriptor import DescriptorSystem
from obsynth.plants.exosystems import Exosystem


@dataclass(frozen=True, eq=False)
class ObserverGains:
    """Gains for the augmented plant.

    Fields: U, D, K: ``(na, na)``, ``(na, ny)``, ``(na, ny)``.
    """

    U: FloatArray
    D: FloatArray
    K: FloatArray


def realise(
    plant: DescriptorSystem, model: Exosystem, gains: ObserverGains, seen: FloatArray
) -> tuple[LinearObserver, dict[str, FloatArray]]:
    """Return the observer, and its matrices by the paper's letters.

    Shapes: ``seen (nr, ny)``.
    """
    augmented = AugmentedPlant.of(plant, model)
    nx, na = plant.nx, augmented.order
    a_hat = gains.U @ augmented.A - gains.K @ augmented.C
    b_hat = a_hat @ gains.D + gains.K
    j_hat = gains.U @ augmented.B
    faults = np.hstack([np.zeros((plant.nf, nx)), model.Cw])
    rows = np.vstack([np.eye(nx, na), faults, -seen @ augmented.C])
    direct = rows @ gains.D
    direct[nx + plant.nf :] += seen
    names = (
        plant.output_names if np.array_equal(seen, np.eye(plant.ny)) else tuple(f"r{i + 1}" for i in range(len(seen)))
    )
    observer = LinearObserver(
        Az=a_hat, Bu=j_hat - b_hat @ plant.D, By=b_hat, Cz=rows, Du=-direct @ plant.D, Dy=direct, dt=plant.dt,
        input_names=plant.input_names, output_names=plant.output_names, state_names=plant.state_names,
        fault_names=plant.fault_names, residual_names=names, state_delays=(0,) * nx, fault_delays=(0,) * plant.nf,
    )  # fmt: skip
    letters = {"U_a": gains.U, "D_a": gains.D, "K_a": gains.K, "Ahat": a_hat, "Bhat": b_hat, "Jhat": j_hat}
    return observer, letters


def combinations_seen(plant: DescriptorSystem) -> FloatArray:
    """Return the combinations of outputs that no disturbance reaches directly, each of unit length."""
    if not plant.Dd.any():
        return np.eye(plant.ny)
    units = PlantUnits.of(plant)
    seen = direct_part(units.scaled_plant(plant))[0] * units.outputs
    return np.asarray(seen / np.linalg.norm(seen, axis=1, keepdims=True))
