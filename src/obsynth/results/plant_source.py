"""The plant as written behind the plant that a design is for, and the steps between them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from obsynth.numerics.arrays import FloatArray, require_entries_once, whole_numbers
from obsynth.plants.descriptor import MOST_STORED_STATES, DescriptorSystem
from obsynth.plants.transformations.delays import absorb_delays
from obsynth.plants.transformations.elimination import eliminate_algebraic_states
from obsynth.plants.transformations.recovery import Transformation
from obsynth.plants.transformations.sampling import discretise


@dataclass(frozen=True, eq=False)
class PlantSource:
    """A plant as it was written; its algebraic states were eliminated, and it was sampled if there is a sample time."""

    plant: DescriptorSystem
    sample_time: float | None = None

    @cached_property
    def derived(self) -> Transformation:
        """The elimination, and the sampling where there was one, done again; once for all checks."""
        if self.sample_time is None:
            return absorb_delays(self.plant) if self.plant.delays else eliminate_algebraic_states(self.plant)
        return discretise(self.plant, self.sample_time)

    @cached_property
    def smooth(self) -> DescriptorSystem:
        """The plant without its algebraic states, before it is sampled; made once for all checks."""
        return eliminate_algebraic_states(self.plant).plant

    def as_dict(self) -> dict[str, Any]:
        """Return the source as data: matrices by their entries that are not zero."""
        values = self.plant.as_dict()
        values.pop("uncertainty", None)
        matrices = {name: _entries(value) for name, value in values.items() if isinstance(value, np.ndarray)}
        signals = {name: value for name, value in values.items() if name not in matrices}
        return {"matrices": matrices, "signals": signals, "sample_time": self.sample_time}

    @classmethod
    def from_dict(cls, data: Mapping[str, Any]) -> PlantSource:
        """Return the source that `as_dict` described."""
        matrices: dict[str, Any] = {name: _matrix(entries) for name, entries in data["matrices"].items()}
        time = data["sample_time"]
        return cls(DescriptorSystem(**matrices, **data["signals"]), None if time is None else float(time))


def _entries(matrix: FloatArray) -> dict[str, Any]:
    rows, columns = np.nonzero(matrix)
    return {
        "size": list(matrix.shape),
        "rows": rows.tolist(),
        "columns": columns.tolist(),
        "values": matrix[rows, columns].tolist(),
    }


def _matrix(entries: Mapping[str, Any]) -> FloatArray:
    rows, columns = whole_numbers(entries["size"], "size").tolist()
    places = (
        whole_numbers(entries["rows"], "rows", below=rows),
        whole_numbers(entries["columns"], "columns", below=columns),
    )
    values = np.asarray(entries["values"], dtype=np.float64)
    require_entries_once(*places, values, columns)
    matrix = np.zeros((rows, columns))
    matrix[places] = values
    return matrix


def source_of(plant: Any) -> PlantSource | None:
    """Return what a plant was made from by elimination and sampling, where that is known and can be stored."""
    made = getattr(plant, "_made_from", None)
    if made is None or type(made[0]) is not DescriptorSystem or made[0].nx > MOST_STORED_STATES:
        return None
    return PlantSource(made[0], made[1])
