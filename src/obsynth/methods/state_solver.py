"""Recovery of a plant's states from an observer that estimates only faults."""

from __future__ import annotations

import numpy as np

from obsynth.errors import SpecError
from obsynth.methods.registry import error_model
from obsynth.numerics.arrays import FloatArray
from obsynth.observers.linear.missing_samples import estimates_all_states
from obsynth.results.design import ObserverDesign


def state_solver(design: ObserverDesign) -> FloatArray | None:
    """Return what gives states from an observer that estimates none, as filters of faults do: the smallest that explain
    its own state ``z = T E x`` and the outputs, ``(nx, nz + ny)``; ``None`` where it
    estimates all states, or not all faults."""
    plant, observer = design.linear
    if estimates_all_states(plant, observer):
        return None
    if observer.fault_names != plant.fault_names:
        # The model needs every fault of the plant: an observer of some of them begins again after a gap.
        return None
    try:
        # Modes of the plant beside the observer's own state are not in it.
        own = error_model(design).own[: observer.order]
    except SpecError:
        return None
    return np.asarray(np.linalg.pinv(np.vstack([own[:, : plant.nx] @ plant.E, plant.C])))
