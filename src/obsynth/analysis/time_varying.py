"""Properties of a time-varying plant before a design: its step matrices, and the rank and condition of H_k."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple, TypeAlias

import numpy as np
from numpy.typing import NDArray

from obsynth.numerics.arguments import require_kind
from obsynth.numerics.arrays import FloatArray, remembered
from obsynth.numerics.ranks import RankDecision, decide_rank
from obsynth.plants.descriptor import DescriptorSystem
from obsynth.plants.time_varying import TimeVaryingDescriptorSystem
from obsynth.plants.transformations.delays import without_delays
from obsynth.plants.transformations.recovery import Transformation

#: Steps that are looked at where the plant has no horizon.
STEPS_WITHOUT_HORIZON = 1000

#: Condition numbers of H_k above this are worth a note: half the digits of double precision are left.
WARN_MARKOV_CONDITION = 1e6

IntArray: TypeAlias = NDArray[np.intp]


class StepBlocks(NamedTuple):
    """The matrices of one step as a filter uses them: equations ``(rows, ...)`` of x(k + 1), and outputs."""

    E: FloatArray
    A: FloatArray
    Phi: FloatArray
    C: FloatArray
    Psi: FloatArray


def step_blocks(plant: TimeVaryingDescriptorSystem, k: int, late: IntArray) -> StepBlocks:
    """Return the matrices of the step from k to k + 1."""
    E, A, C = plant.E.at(k + 1), plant.A.at(k), plant.C.at(k + 1)
    Phi, Psi = plant.Phi.at(k), plant.Psi.at(k)
    if not late.size:
        return StepBlocks(E, A, Phi, C, Psi)
    on_time = np.setdiff1d(np.arange(plant.ne), late)
    return StepBlocks(
        E[on_time],
        A[on_time],
        Phi[on_time],
        np.vstack([C, plant.A.at(k + 1)[late]]),
        np.vstack([Psi, plant.Phi.at(k + 1)[late]]),
    )


@dataclass(frozen=True, eq=False)
class HorizonRanks:
    """Where rank and condition of ``H_k = [E_k; C_k]``, and the residual directions of (18), are worst on a horizon.
    With early constraints H_k holds them among the outputs."""

    steps: int
    worst: RankDecision
    worst_k: int
    condition: float  # as given, in the units of the data
    condition_k: int
    directions: int  # the least ``rank E_k + ny - nx``
    directions_k: int


def early_rows(plant: TimeVaryingDescriptorSystem, *, early: bool) -> IntArray:
    """Return the equations that are used one step early: the algebraic ones, or none where this is not asked for."""
    steps = plant.horizon or STEPS_WITHOUT_HORIZON
    return algebraic_rows(plant, steps) if early else np.zeros(0, dtype=np.intp)


@remembered
def horizon_ranks(plant: TimeVaryingDescriptorSystem, *, early: bool = False) -> HorizonRanks:
    """Return rank and condition of H_k along the horizon."""
    late = early_rows(plant, early=early)
    steps = plant.horizon or STEPS_WITHOUT_HORIZON
    if plant.E.is_constant and plant.C.is_constant and (plant.A.is_constant or not late.size):
        steps = 1
    elif late.size:
        steps = max(steps - 1, 1)
    looked_at = []
    for k in range(1, steps + 1):
        E, C = plant.E.at(k), plant.C.at(k)
        if late.size:
            E, _, _, C, _ = step_blocks(plant, k - 1, late)
        H = np.vstack([E, C])
        values = np.linalg.svd(H, compute_uv=False)
        condition = float(values[0] / values[-1]) if len(H) >= plant.nx and values[-1] > 0.0 else float("inf")
        looked_at.append((k, decide_rank(H, expected=plant.nx), condition, decide_rank(E).rank + len(C) - plant.nx))
    worst = min(looked_at, key=lambda step: (step[1].rank, step[1].smallest_kept))
    hardest, fewest = max(looked_at, key=lambda step: step[2]), min(looked_at, key=lambda step: step[3])
    return HorizonRanks(steps, worst[1], worst[0], hardest[2], hardest[0], fewest[3], fewest[0])


def as_time_varying(
    plant: DescriptorSystem | TimeVaryingDescriptorSystem | Transformation,
) -> TimeVaryingDescriptorSystem:
    """Return a plant as the recursive methods take it."""
    plant = without_delays(plant)
    plant = plant.plant if isinstance(plant, Transformation) else plant
    if isinstance(plant, TimeVaryingDescriptorSystem):
        return plant
    kinds = "an obsynth.DescriptorSystem or TimeVaryingDescriptorSystem"
    require_kind(plant, DescriptorSystem, "The plant", kinds, path="plant")
    return TimeVaryingDescriptorSystem.from_descriptor(plant)


def algebraic_rows(plant: TimeVaryingDescriptorSystem, steps: int) -> IntArray:
    """Return the indexes of the equations in which x(k + 1) never appears, counted from zero."""
    looked_at = 1 if plant.E.is_constant else steps
    zero = np.ones(plant.ne, dtype=bool)
    for k in range(1, looked_at + 1):
        zero &= ~plant.E.at(k).any(axis=1)
    return np.flatnonzero(zero)
