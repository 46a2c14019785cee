"""The plant at one point of its box, transformed as the plant itself was."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from obsynth.analysis.transformations import discretise
from obsynth.analysis.transformations.elimination import eliminate_algebraic_states
from obsynth.numerics.arrays import FloatArray
from obsynth.plants.constants import ConstantsBox
from obsynth.plants.descriptor import DescriptorSystem
from obsynth.plants.uncertainty import SAMPLED, UNCERTAIN_MATRICES, Uncertainty, matrices_of


def plant_at(plant: DescriptorSystem, values: Mapping[str, float]) -> DescriptorSystem:
    """Return the plant for values of its constants: no family of matrices, and with the noise of the plant itself."""
    uncertain = plant.uncertainty
    if uncertain is None:
        return plant
    if uncertain.written is None:
        return _with_shift(plant.replace(**uncertain.filled(matrices_of(plant), values)), uncertain)
    matrices = uncertain.filled(uncertain.written, values)
    arguments: dict[str, Any] = {**matrices, "dt": 0.0 if is_sampled(uncertain.steps) else plant.dt}
    bare = DescriptorSystem(**arguments)
    for kind, size in uncertain.steps:
        bare = discretise(bare, size).plant if kind == SAMPLED else eliminate_algebraic_states(bare).plant
    return _with_shift(plant.replace(**{name: getattr(bare, name) for name in UNCERTAIN_MATRICES}), uncertain)


def _with_shift(plant: DescriptorSystem, uncertain: Uncertainty) -> DescriptorSystem:
    """Return a plant that is no family any more, but knows which of its inputs is one in every row, if one is."""
    return (
        plant.replace(uncertainty=Uncertainty(ConstantsBox({}), {}, shift=uncertain.shift))
        if uncertain.shift
        else plant
    )


def moving_at(plant: DescriptorSystem, values: Mapping[str, float]) -> FloatArray:
    """Return A of the plant for values of its constants, reduced, and before it was sampled."""
    uncertain = plant.uncertainty
    if uncertain is None:
        return eliminate_algebraic_states(plant).plant.A
    matrices = uncertain.filled(matrices_of(plant) if uncertain.written is None else uncertain.written, values)
    arguments: dict[str, Any] = {**matrices, "dt": 0.0 if is_sampled(uncertain.steps) else plant.dt}
    return eliminate_algebraic_states(DescriptorSystem(**arguments)).plant.A


def is_sampled(steps: tuple[tuple[str, float], ...]) -> bool:
    """Whether a plant was sampled since it was written."""
    return any(kind == SAMPLED for kind, _ in steps)


def drawn_points(count: int, runs: int, seed: int, *, vertices: float = 0.5) -> FloatArray:
    """Return points ``(runs, count)`` of the box: a share of them vertices, the others uniform inside."""
    generator = np.random.default_rng(seed)
    points = generator.uniform(-1.0, 1.0, (runs, count))
    chosen = generator.random(runs) < vertices
    points[chosen] = generator.choice([-1.0, 1.0], (int(chosen.sum()), count))
    return points
