"""Unknown inputs that are multiples or combinations of others up to rounding: they are removed.

``[Bd; Dd]`` with a column that is three times another one has rank one more than it means to: rounding of the product
makes them independent, and an observer that must decouple both has a sensor less than it needs.
"""

from __future__ import annotations

import numpy as np

from obsynth.numerics.arrays import remembered
from obsynth.numerics.ranks import first_independent
from obsynth.numerics.sparse import is_sparse
from obsynth.plants.descriptor import DescriptorSystem
from obsynth.plants.plant_units import PlantUnits


@remembered
def without_repeated_disturbances(plant: DescriptorSystem) -> DescriptorSystem | None:
    """Return the plant with the first unknown inputs that are independent of each other beyond rounding; ``None`` where
    all are.

    What decouples these decouples the others to the rounding of their entries.
    """
    if plant.nd < 2 or is_sparse(plant.Bd) or is_sparse(plant.Dd):
        return None
    units = PlantUnits.of(plant)
    columns = np.vstack([units.equations[:, None] * plant.Bd, units.outputs[:, None] * plant.Dd])
    lengths = np.linalg.norm(columns, axis=0)
    directions = columns / np.where(lengths > 0.0, lengths, 1.0)
    picked = first_independent(directions.T, plant.nd)
    if len(picked) in (0, plant.nd):
        return None
    names = [plant.disturbance_names[place] for place in picked]
    return plant.replace(Bd=plant.Bd[:, picked], Dd=plant.Dd[:, picked], disturbance_names=names)
