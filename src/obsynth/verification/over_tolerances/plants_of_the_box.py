"""Single plants of a box of constants: their matrices at given values, and random points of the box."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from obsynth.numerics.arrays import FloatArray
from obsynth.plants.constants import ConstantsBox
from obsynth.plants.descriptor import DescriptorSystem
from obsynth.plants.transformations.elimination import eliminate_algebraic_states
from obsynth.plants.transformations.sampling import discretise
from obsynth.plants.uncertainty import SAMPLED, UNCERTAIN_MATRICES, Uncertainty, as_written


def plant_at(plant: DescriptorSystem, values: Mapping[str, float]) -> DescriptorSystem:
    """Return the plant for values of its constants, without tolerances; its noise is that of the given plant."""
    uncertain = plant.uncertainty
    if uncertain is None:
        return plant
    if uncertain.written is None:
        single = plant.replace(**uncertain.filled(as_written(plant, uncertain), values), uncertainty=None)
    else:
        bare = plant_as_written_at(plant, uncertain, values)
        for kind, size in uncertain.steps:
            bare = discretise(bare, size).plant if kind == SAMPLED else eliminate_algebraic_states(bare).plant
        single = plant.replace(**{name: getattr(bare, name) for name in UNCERTAIN_MATRICES}, uncertainty=None)
    # The single plant has no tolerances, but still an input that is one in every row, if the plant has one.
    shift = uncertain.shift
    return single.replace(uncertainty=Uncertainty(ConstantsBox({}), {}, shift=shift)) if shift else single


def plant_as_written_at(
    plant: DescriptorSystem, uncertain: Uncertainty, values: Mapping[str, float]
) -> DescriptorSystem:
    """Return the plant before elimination and sampling, for values of its constants."""
    matrices: dict[str, Any] = uncertain.filled(as_written(plant, uncertain), values)
    return DescriptorSystem(**matrices, dt=0.0 if any(kind == SAMPLED for kind, _ in uncertain.steps) else plant.dt)


def drawn_points(count: int, runs: int, seed: int, *, vertices: float = 0.5) -> FloatArray:
    """Return random points ``(runs, count)`` of the box: a share ``vertices`` are vertices, the rest uniform inside."""
    generator = np.random.default_rng(seed)
    points = generator.uniform(-1.0, 1.0, (runs, count))
    chosen = generator.random(runs) < vertices
    points[chosen] = generator.choice([-1.0, 1.0], (int(chosen.sum()), count))
    return points
