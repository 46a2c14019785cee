"""What is known of a time-varying plant before a design: rank and condition of H_k along the horizon."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from obsynth.analysis.conditions import Condition, rank_condition
from obsynth.errors import SpecError
from obsynth.models.descriptor import DescriptorSystem
from obsynth.models.time_varying import TimeVaryingDescriptorSystem
from obsynth.numerics.ranks import RankDecision, decide_rank

#: Steps that are looked at where the plant has no horizon.
STEPS_WITHOUT_HORIZON = 1000
#: Condition numbers of H_k above this are worth a note: half the digits of double precision are left.
WARN_CONDITION = 1e6

IntArray: TypeAlias = NDArray[np.intp]

_SOURCE = "Moussa Ali, Zhang 2013"


@dataclass(frozen=True, eq=False)
class HorizonRanks:
    """Rank and condition of ``H_k = [E_k; C_k]``, and the residual directions of (18), where they are worst.

    Parameters
    ----------
    steps : int
        How many steps were looked at.
    worst : RankDecision
        Of the H_k with the lowest rank, or the smallest singular values.
    worst_k : int
        Where that is.
    condition : float
        The largest condition number of H_k, as given (the units of equations and outputs matter).
    condition_k : int
        Where that is.
    directions : int
        The least ``rank E_k + ny - nx``.
    directions_k : int
        Where that is.
    """

    steps: int
    worst: RankDecision
    worst_k: int
    condition: float
    condition_k: int
    directions: int
    directions_k: int


def checked_steps(plant: TimeVaryingDescriptorSystem) -> int:
    """Return how many steps of a plant are looked at: its horizon, one where nothing changes, or a thousand.

    Parameters
    ----------
    plant : TimeVaryingDescriptorSystem
        The plant.
    """
    if plant.E.is_constant and plant.C.is_constant:
        return 1
    return plant.horizon or STEPS_WITHOUT_HORIZON


def horizon_ranks(plant: TimeVaryingDescriptorSystem) -> HorizonRanks:
    """Return rank and condition of H_k along the horizon.

    Parameters
    ----------
    plant : TimeVaryingDescriptorSystem
        The plant.
    """
    steps = checked_steps(plant)
    worst, worst_k, condition, condition_k, directions, directions_k = None, 1, 0.0, 1, None, 1
    for k in range(1, steps + 1):
        E = plant.E.at(k)
        H = np.vstack([E, plant.C.at(k)])
        decision = decide_rank(H, expected=plant.nx)
        if worst is None or (decision.rank, decision.smallest_kept) < (worst.rank, worst.smallest_kept):
            worst, worst_k = decision, k
        values = np.linalg.svd(H, compute_uv=False)
        found = float(values[0] / values[-1]) if len(H) >= plant.nx and values[-1] > 0.0 else float("inf")
        if found > condition:
            condition, condition_k = found, k
        here = decide_rank(E).rank + plant.ny - plant.nx
        if directions is None or here < directions:
            directions, directions_k = here, k
    if worst is None or directions is None:
        raise SpecError("The plant has no steps.", path="horizon")
    return HorizonRanks(steps, worst, worst_k, condition, condition_k, directions, directions_k)


def as_time_varying(plant: DescriptorSystem | TimeVaryingDescriptorSystem) -> TimeVaryingDescriptorSystem:
    """Return a plant as the recursive methods take it.

    Parameters
    ----------
    plant : DescriptorSystem or TimeVaryingDescriptorSystem
        Any plant.

    Raises
    ------
    SpecError
        It is continuous in time, or has feedthrough or disturbances.
    """
    return (
        plant if isinstance(plant, TimeVaryingDescriptorSystem) else TimeVaryingDescriptorSystem.from_descriptor(plant)
    )


def recursive_conditions(
    plant: DescriptorSystem | TimeVaryingDescriptorSystem, *, parameters: bool, literal: bool = False
) -> Iterator[Condition]:
    """Yield the existence conditions of the recursive methods; the list ends at the first failure.

    Parameters
    ----------
    plant : DescriptorSystem or TimeVaryingDescriptorSystem
        Any plant.
    parameters : bool
        Whether parameters are to be estimated.
    literal : bool, optional
        Whether by the form that is printed as (18).
    """
    try:
        varying = as_time_varying(plant)
    except SpecError as error:
        yield Condition("plant of this kind", "discrete time, no feedthrough, no unknown disturbance", False, 0.0, 1.0,
                        f"{_SOURCE}, eq. (4)", str(error))  # fmt: skip
        return
    ranks = horizon_ranks(varying)
    where = "for every k" if ranks.steps == 1 else f"for k = 1 ... {ranks.steps}, worst at k = {ranks.worst_k}"
    condition = rank_condition(
        "rank [E; C]", ranks.worst, f"at k = {ranks.worst_k} equations and outputs do not determine the state; measure "
        "more, or leave out states that nothing depends on", source=f"{_SOURCE}, A2", signals=varying.output_names,
    )  # fmt: skip
    yield replace(condition, claim=f"{condition.claim} {where}")
    if not ranks.worst.full or not parameters:
        return
    yield Condition("parameters", "the plant has parameters (Phi or Psi)", varying.nq > 0, float(varying.nq), 1.0,
                    f"{_SOURCE}, eq. (4)", f"{varying.nq} parameter(s)")  # fmt: skip
    if literal:
        yield residual_condition(ranks)


def residual_condition(ranks: HorizonRanks) -> Condition:
    """Return the condition that (18) can learn at all, which the paper never states.

    Parameters
    ----------
    ranks : HorizonRanks
        Of the plant.
    """
    return Condition(
        "residual directions", "rank E_k + ny - nx >= 1 for every k", ranks.directions >= 1, float(ranks.directions),
        1.0,         "our finding: missing in Moussa Ali, Zhang 2013",
        f"at k = {ranks.directions_k} (18) sees only rank E + ny - nx = {ranks.directions} residual directions"
        + ("" if ranks.directions >= 1 else ": y - C xhat is zero whatever the parameters are, so it never learns. Use "
           "form 'innovation', which sees all the parity directions."),
    )  # fmt: skip


def algebraic_rows(plant: TimeVaryingDescriptorSystem, steps: int) -> IntArray:
    """Return the indexes of the equations in which x(k + 1) never appears, counted from zero.

    Parameters
    ----------
    plant : TimeVaryingDescriptorSystem
        The plant.
    steps : int
        How many steps are looked at.
    """
    looked_at = 1 if plant.E.is_constant else steps
    zero = np.ones(plant.ne, dtype=bool)
    for k in range(1, looked_at + 1):
        zero &= ~plant.E.at(k).any(axis=1)
    return np.flatnonzero(zero)
