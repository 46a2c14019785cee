r"""Existence conditions of an unknown-input PI observer over the region of a polytopic plant.

Share Pasand, Aliyari, Taghirad at a plant of which A, B, Bf, Bd change, with constant ``U E + Dhat C = I``: what the
unknown inputs of all vertices move is decoupled at once, ``U Bd(mu) = 0``, and what is left, ``[U A(mu), U Bf(mu) Cw;
0, Phi]``, is affine in the weights whatever the faults do.  (D1) of all directions together; (D2), (D3) at each vertex.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from obsynth.analysis.existence.condition import Condition
from obsynth.analysis.existence.over_region import constant_outputs, frozen_points
from obsynth.analysis.existence.sharepasand import existence
from obsynth.analysis.existence.sharepasand_decoupling import decoupling_condition
from obsynth.analysis.existence.statements import Evaluator
from obsynth.numerics.ranks import numerical_rank
from obsynth.plants.descriptor import DescriptorSystem
from obsynth.plants.faults import Exosystem
from obsynth.plants.polytopic import PolytopicSystem

_SOURCE = "over the region: Share Pasand with constant U, Dhat"


def pi_conditions_over_region(
    plant: PolytopicSystem, model: Exosystem, *, exactly: bool = True
) -> tuple[Condition, ...]:
    """Return the existence conditions of the observer over a region; the list ends at the first failure."""
    return tuple(_in_order(plant, model, exactly))


def _in_order(plant: PolytopicSystem, model: Exosystem, exactly: bool) -> Iterator[Condition]:
    constant = constant_outputs(plant, "K(mu) C(mu)", _SOURCE)
    yield constant
    if not constant.holds:
        return
    for point in frozen_points(plant):
        at_point = existence(point.plant, model, exactly=exactly)
        for condition in at_point.conditions:
            if not condition.holds:
                yield point.failing(condition)
                return
        if at_point.transformation is not None:
            yield Condition(
                f"(D1) decoupling at {point.where}",
                "(D1) holds with the algebraic states in place",
                False,
                0.0,
                1.0,
                _SOURCE,
                "it holds only without the algebraic states, which are others at each point: solve the algebraic "
                "equations for them, or measure one more of them",
            )
            return
    yield Condition(
        "observer at every vertex",
        "at every vertex the observer of the plant with constant matrices exists",
        True,
        float(plant.count),
        float(plant.count),
        "Share Pasand, (D1)-(D3)",
    )
    if plant.is_constant("Bd"):
        return
    stacked = with_all_directions(plant)
    condition = decoupling_condition(Evaluator(stacked, exactly), "", "")
    yield replace(condition, name="(D1) decoupling over the region", source=_SOURCE)
    if not condition.holds:
        return
    for place, vertex in enumerate(plant.vertices):
        # With a constant U every direction of an unknown input is decoupled at every point.
        vertex_plant = stacked.replace(A=vertex.A, B=vertex.B, Bf=vertex.Bf, exact=None)
        for condition in existence(vertex_plant, model, exactly=exactly).conditions:
            if not condition.holds:
                where = plant.scheduling.vertex_name(place)
                yield replace(condition, name=f"{condition.name} with all directions, at {where}", source=_SOURCE)
                return


def with_all_directions(plant: PolytopicSystem) -> DescriptorSystem:
    """Return the mean plant, with an unknown input for each direction that those of a vertex have."""
    center = plant.center
    if plant.is_constant("Bd"):
        return center
    _, values, right = np.linalg.svd(center.Dd)
    unseen = right[numerical_rank(values) if values.size else 0 :].T
    more = np.hstack([(vertex.Bd - center.Bd) @ unseen for vertex in plant.vertices])
    more = more[:, np.abs(more).max(axis=0, initial=0.0) > 0.0]
    names = (*center.disturbance_names, *(f"direction {i + 1}" for i in range(more.shape[1])))
    return center.replace(
        Bd=np.hstack([center.Bd, more]),
        Dd=np.hstack([center.Dd, np.zeros((center.ny, more.shape[1]))]),
        disturbance_names=names,
        exact=None,
    )
