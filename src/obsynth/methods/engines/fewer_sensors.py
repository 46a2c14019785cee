"""Designs with fewer sensors as further candidates, so that an additional sensor never increases the noise.

An observer of fewer outputs is one of all with gains of zero.  An objective that does not see the noise, such as the
size of gains or the conditioning of poles, may give it less noise than the design with all of them.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from itertools import combinations
from typing import TypeVar

import numpy as np

from obsynth.errors import ObsynthError
from obsynth.numerics.arrays import FloatArray, read_only
from obsynth.plants.descriptor import DescriptorSystem
from obsynth.plants.transformations.redundant_outputs import MergedOutputs

#: Up to so many outputs every choice of them is tried; of more, those that leave one out, then one more while it helps.
MOST_OUTPUTS = 3

#: No sensor is left out for less noise than this factor: it is there for more than the noise.
AS_QUIET = 1.01

Candidate = TypeVar("Candidate")


def some_outputs(plant: DescriptorSystem, places: tuple[int, ...]) -> MergedOutputs:
    """Return the plant with some outputs alone."""
    rows = {name: getattr(plant, name)[list(places)] for name in ("C", "D", "Df", "Dd", "Dw")}
    alone = plant.replace(**rows, output_names=[plant.output_names[i] for i in places])
    return MergedOutputs(alone, read_only(np.eye(plant.ny)[list(places)]), False)


def with_fewer_sensors(
    plant: DescriptorSystem, designed: Callable[[MergedOutputs], Candidate], noise: Callable[[Candidate], float]
) -> Iterator[Candidate]:
    """Yield designs for fewer outputs of a plant that states their noise; of none where it states none."""
    if plant.ny < 2 or not plant.Dw.any():
        return

    def candidate(places: tuple[int, ...]) -> Candidate | None:
        try:
            with np.errstate(all="ignore"):
                return designed(some_outputs(plant, places))
        except (ObsynthError, np.linalg.LinAlgError):
            return None  # those that are left out are needed

    if plant.ny <= MOST_OUTPUTS:
        choices = (places for count in range(1, plant.ny) for places in combinations(range(plant.ny), count))
        yield from (one for places in choices if (one := candidate(places)) is not None)
        return
    left, best = tuple(range(plant.ny)), np.inf
    while len(left) > 1:
        fewer = [tuple(j for j in left if j != i) for i in left]
        tried = [(others, one) for others in fewer if (one := candidate(others)) is not None]
        yield from (one for _, one in tried)
        quietest = min(tried, key=lambda pair: noise(pair[1]), default=None)
        if quietest is None or not noise(quietest[1]) < best:
            return
        left, best = quietest[0], noise(quietest[1])


def left_out(plant: DescriptorSystem, *gains: FloatArray) -> str:
    """Return the outputs that show something and have gains of zero alone, in words; nothing where there are none."""
    shows = np.any(np.hstack([plant.C, plant.Df]) != 0.0, axis=1)
    unused = shows & ~np.any(np.vstack(gains) != 0.0, axis=0)
    return ", ".join(name for name, is_unused in zip(plant.output_names, unused, strict=True) if is_unused)
