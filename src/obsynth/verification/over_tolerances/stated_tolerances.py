"""Tolerances that are stated for a design afterwards: the design and its plant with a box of constants."""

from __future__ import annotations

from typing import Any

import numpy as np

from obsynth.errors import SpecError
from obsynth.plants.descriptor import DescriptorSystem
from obsynth.plants.uncertain_system import uncertain_system
from obsynth.plants.uncertainty import Uncertainty, as_written
from obsynth.results.design import ObserverDesign

#: The note on a design whose plant has no tolerances.
EXACT_MODEL = "assumes an exact model"

#: Two plants count as the same if their entries agree to this share, or to this absolute difference.
SAME_ENTRY, SAME_PLANT_ZERO = 1e-9, 1e-12


def with_tolerances(design: ObserverDesign, constants: Any) -> tuple[ObserverDesign, DescriptorSystem]:
    """Return a linear design and its plant with the tolerances of ``constants``.

    ``constants`` is a plant with tolerances, an `Uncertainty`, or a box; ``None`` keeps those of the design.
    """
    plant, _ = design.linear
    if constants is None:
        return design, plant
    if isinstance(constants, DescriptorSystem):
        changed = _with_tolerances_of(plant, constants)
    else:
        changed = uncertain_system(plant, constants.box if isinstance(constants, Uncertainty) else constants)
    return design.replace(plant=changed), changed


def _with_tolerances_of(plant: DescriptorSystem, source: DescriptorSystem) -> DescriptorSystem:
    """Return a plant with the tolerances of another one that has the same nominal matrices."""
    same = all(
        getattr(plant, name).shape == getattr(source, name).shape
        and np.allclose(getattr(plant, name), getattr(source, name), rtol=SAME_ENTRY, atol=SAME_PLANT_ZERO)
        for name in ("E", "A", "B", "C", "D", "Bd", "Dd", "Bf", "Df")
    )
    own, other = plant.uncertainty, source.uncertainty
    if not same and own is not None and other is not None and own.written is not None:
        # The design's plant was made from the given one, by elimination or sampling.
        before = as_written(source, other)
        if dict(own.entries) == dict(other.entries) and all(
            np.array_equal(own.written[name], before[name]) for name in own.written
        ):
            return plant.replace(uncertainty=own.with_box(other.box))
    if not same or plant.dt != source.dt:
        raise SpecError("constants is another plant than the design's: its nominal matrices differ.", path="constants")
    return plant.replace(uncertainty=source.uncertainty)
