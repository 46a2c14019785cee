"""Modes that no output shows: those of the numbers as written, and those that only rounding of the data shows."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from obsynth.analysis.existence.distance import drowned_zeros
from obsynth.analysis.existence.numbers import numbers_of
from obsynth.analysis.existence.verdicts import believed
from obsynth.analysis.plant_units import PlantUnits
from obsynth.analysis.zeros import are_outside
from obsynth.numerics.pencils import finite_zeros
from obsynth.numerics.ranks import RankDecision
from obsynth.plants.descriptor import DescriptorSystem


@dataclass(frozen=True, eq=False)
class HiddenModes:
    """Unobservable modes, the undetectable ones of them, the normal rank of ``[A - z E; C]``, and ranks on the way."""

    modes: tuple[complex, ...]
    undetectable: tuple[complex, ...]
    normal_rank: int
    decisions: tuple[RankDecision, ...]


def hidden_modes(plant: DescriptorSystem) -> HiddenModes:
    """Return the modes that no output shows, decided exactly where the plant is small enough."""
    plant = plant.dense()
    tall_e, tall_a = np.vstack([plant.E, np.zeros_like(plant.C)]), np.vstack([plant.A, plant.C])
    hidden = finite_zeros(tall_e, tall_a)
    found = [complex(value) for value in hidden.values]
    outside = are_outside(tall_e, tall_a, hidden, plant.dt)
    numbers = numbers_of(plant)
    if numbers is None:
        undetectable = tuple(value for value, out in zip(found, outside, strict=True) if out)
        return HiddenModes(tuple(found), undetectable, hidden.normal_rank, hidden.decisions)
    exact = numbers.system(numbers.zeros(plant.nx, 0), numbers.zeros(plant.ny, 0))
    exact = believed(exact, tall_e, tall_a, nx=plant.nx)
    scaled = PlantUnits.of(plant).rounded().scaled_pencil(tall_e, tall_a)
    drowned = drowned_zeros(*scaled, found, exact.zeros, nx=plant.nx)
    unstable = {value for value, out in zip(found, outside, strict=True) if out}
    modes = tuple(sorted((*exact.zeros, *drowned), key=lambda value: (value.real, value.imag)))
    undetectable = (*exact.outside, *(value for value in drowned if value in unstable))
    return HiddenModes(modes, undetectable, exact.normal_rank, ())
