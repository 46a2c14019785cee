"""A plant with weighted noise or faults: signals of unit size drive the weights, whose outputs drive the plant.

Each weighted signal v is an algebraic variable of the new plant, ``0 = -v + Cw xw + Dw n``: no number is rounded, so
that what is proved of the new plant is proved of plant and weights as given.
"""

from __future__ import annotations

import numpy as np
from scipy.linalg import block_diag

from obsynth.numerics.arrays import FloatArray
from obsynth.plants.descriptor import DescriptorSystem

Model = tuple[FloatArray, FloatArray, FloatArray, FloatArray]


def weighted_plant(plant: DescriptorSystem, *, noise: Model | None, faults: Model | None) -> DescriptorSystem:
    """Return the plant with square models before its noise and before its faults; ``None`` for none."""
    for which, model in (("w", noise), ("f", faults)):
        if model is not None:
            plant = _behind(plant, which, model)
    return plant


def _behind(plant: DescriptorSystem, which: str, model: Model) -> DescriptorSystem:
    a, b, c, d = model
    driven, through = getattr(plant, f"B{which}"), getattr(plant, f"D{which}")
    own, k, count = plant.nx, len(a), driven.shape[1]
    states = [f"weighted {which}{i + 1}" for i in range(count)] + [f"weight of {which} {i + 1}" for i in range(k)]

    def below(part: FloatArray) -> FloatArray:
        return np.vstack([part, np.zeros((count + k, part.shape[1]))])

    parts = {f"B{name}": below(getattr(plant, f"B{name}")) for name in ("f", "d", "w") if name != which}
    return plant.replace(
        E=block_diag(plant.E, np.zeros((count, count)), np.eye(k)),
        A=np.block(
            [
                [plant.A, driven, np.zeros((own, k))],
                [np.zeros((count, own)), -np.eye(count), c],
                [np.zeros((k, own + count)), a],
            ]
        ),
        B=below(plant.B),
        C=np.hstack([plant.C, through, np.zeros((plant.ny, k))]),
        state_names=[*plant.state_names, *states],
        **parts,
        **{f"B{which}": np.vstack([np.zeros((own, count)), d, b]), f"D{which}": 0.0 * through},
    )
