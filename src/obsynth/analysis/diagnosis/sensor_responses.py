"""What sets of sensors show at generic points: small constant matrices, on which rank questions are cheap.

At a generic s0 every question of normal rank about a set of sensors is a rank question on its rows of
``[C, D] (s0 E - A)^-1 [Bd, Bf]``.  Many sets are asked at once.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from obsynth.analysis.diagnosis.additions import Sensor
from obsynth.analysis.diagnosis.reduction import PencilUnits
from obsynth.numerics.arrays import ComplexArray
from obsynth.numerics.ranks import RANK_TOLERANCE
from obsynth.plants.descriptor import DescriptorSystem

#: Points without meaning, in units of the plant's own time scale.
GENERIC_POINTS = (0.7391 + 0.2j, 0.31 + 1.3247j)
#: Part of a fault's column outside the span of the others, relative to it, below which it does not show.
SHOWN = 1e-9


@dataclass(frozen=True, eq=False)
class SensorResponses:
    """Rows: the plant's outputs, then candidates; columns: unknown inputs, then faults; one table per point.

    Fields: tables ``(points, rows, nd + nf)``; outputs: how many rows are outputs; nd.
    """

    tables: ComplexArray
    outputs: int
    nd: int

    @classmethod
    def of(cls, plant: DescriptorSystem, sensors: Sequence[Sensor]) -> SensorResponses | None:
        """Return the tables, or ``None`` where the pencil is singular at a generic point."""
        units = PencilUnits.of(plant.E, plant.A)
        inputs = np.hstack([plant.Bd, plant.Bf])
        c = np.vstack([plant.C, *(sensor.C[None, :] for sensor in sensors)])
        direct = np.vstack(
            [np.hstack([plant.Dd, plant.Df]), *(np.hstack([sensor.Dd, sensor.Df])[None, :] for sensor in sensors)]
        )
        tables = []
        for point in GENERIC_POINTS:
            pencil = units.rows[:, None] * (point * units.time * plant.E - plant.A) * units.columns
            values = np.linalg.svd(pencil, compute_uv=False) if pencil.size else np.ones(1)
            if values[-1] <= RANK_TOLERANCE * values[0]:
                return None
            states = units.columns[:, None] * np.linalg.solve(pencil, units.rows[:, None] * inputs)
            table = c @ states + direct
            for axis in (1, 0):
                sizes = np.linalg.norm(table, axis=axis, keepdims=True)
                table = table / np.where(sizes > 0.0, sizes, 1.0)
            tables.append(table)
        return cls(np.array(tables, dtype=np.complex128), plant.ny, plant.nd)

    def shows(self, sets: NDArray[np.int64], fault: int, beside: Sequence[int]) -> NDArray[np.float64]:
        """Return how much of a fault shows free of d and the faults ``beside``, for each set of candidates ``(N, k)``.

        The part of its column outside the span of theirs, relative to it, the larger of all points; zero for nothing.
        """
        count = len(sets)
        fixed = np.broadcast_to(np.arange(self.outputs), (count, self.outputs))
        rows = np.hstack([fixed, self.outputs + sets])
        columns = [*range(self.nd), *(self.nd + j for j in beside)]
        found = np.zeros(count)
        if rows.shape[1] == 0:
            return found
        for table in self.tables:
            goal = table[:, self.nd + fault][rows]
            rest = _outside(table[:, columns][rows], goal)
            size = np.linalg.norm(goal, axis=1)
            found = np.maximum(found, np.where(size > 0.0, rest / np.where(size > 0.0, size, 1.0), 0.0))
        return np.where(found > SHOWN, found, 0.0)


def _outside(span: ComplexArray, vector: ComplexArray) -> NDArray[np.float64]:
    """Return the norm of the part of each vector ``(N, m)`` outside the span of columns ``(N, m, c)``."""
    if span.shape[2] == 0:
        return np.asarray(np.linalg.norm(vector, axis=1))
    left, values, _ = np.linalg.svd(span, full_matrices=False)
    kept = left * (values > RANK_TOLERANCE * np.maximum(values[:, :1], 1e-300))[:, None, :]
    for _ in range(2):
        vector = vector - np.einsum("nij,nj->ni", kept, np.einsum("nij,ni->nj", kept.conj(), vector))
    return np.asarray(np.linalg.norm(vector, axis=1))
