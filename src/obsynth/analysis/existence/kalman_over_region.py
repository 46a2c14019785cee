r"""When a Kalman filter with constant ``T E + N C = I`` exists over the region of a polytopic plant.

With rows that the unknown inputs do not enter, ``[T' E; C]`` of full column rank (the same at every point) and every
point detectable, ``e+ = (T A(mu) - L(mu) C) e + ...`` is a problem at the vertices; that one certificate serves all of
them is no condition of existence, but sought.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from obsynth.analysis.existence.condition import Condition
from obsynth.analysis.existence.kalman import kalman_conditions
from obsynth.analysis.existence.over_region import constant_outputs, frozen_points
from obsynth.numerics.arrays import FloatArray
from obsynth.numerics.ranks import decide_rank, numerical_rank
from obsynth.plants.polytopic import PolytopicSystem

_SOURCE = "over the region: Nikoukhah, Willsky, Levy 1992 with constant L, K"


def kalman_conditions_over_region(plant: PolytopicSystem) -> tuple[Condition, ...]:
    """Return the existence conditions over a region; the list ends at the first failure."""
    conditions = []
    for condition in _in_order(plant):
        conditions.append(condition)
        if not condition.holds:
            break
    return tuple(conditions)


def free_equations(plant: PolytopicSystem) -> FloatArray:
    """Return rows ``(ne, nx)``: combinations of the equations that no unknown input enters at any vertex."""
    entering = np.hstack([vertex.Bd for vertex in plant.vertices]) if plant.nd else np.zeros((plant.nx, 0))
    sizes = np.max(np.abs(entering), axis=0, initial=0.0)
    if not sizes.any():
        return np.eye(plant.nx)
    # Each unknown input has units of its own.
    left_vectors, values, _ = np.linalg.svd(entering[:, sizes > 0.0] / sizes[sizes > 0.0])
    return np.asarray(left_vectors[:, numerical_rank(values) :].T)


def _in_order(plant: PolytopicSystem) -> Iterator[Condition]:
    yield Condition(
        "discrete time",
        "the plant is discrete in time",
        plant.is_discrete,
        plant.dt,
        0.0,
        _SOURCE,
        ""
        if plant.is_discrete
        else "a continuous plant, whose samples over a region have no vertices. Take ui-pi-observer, which takes it "
        "as it is, and steps from row to row by implicit Euler.",
        of_the_method=True,
    )
    yield constant_outputs(plant, "L(mu) C(mu)", _SOURCE)
    is_measured = bool(plant.vertices[0].Dd.any())
    yield Condition(
        "unknown inputs in outputs",
        "no unknown input shows in an output at once: over a region none is estimated",
        not is_measured,
        float(is_measured),
        0.0,
        _SOURCE,
        "state it as noise (Bw, Dw), or take ui-pi-observer" if is_measured else "",
        of_the_method=True,
    )
    rows = free_equations(plant)
    rank = decide_rank(np.vstack([rows @ plant.E, plant.vertices[0].C]), expected=plant.nx).rank
    yield Condition(
        "rank over the region",
        "the equations that no unknown input enters, with the outputs, determine every state: rank [N E; C] = nx",
        rank == plant.nx,
        float(rank),
        float(plant.nx),
        _SOURCE,
        "" if rank == plant.nx else "with constant gains every direction of an unknown input is left out at once",
        of_the_method=not plant.is_constant("Bd"),
    )
    for point in frozen_points(plant):
        for condition in kalman_conditions(point.plant):
            if not condition.holds:
                yield point.failing(condition)
                return
    yield Condition(
        "filter at every vertex",
        "at every vertex the Kalman filter of the plant with constant matrices exists",
        True,
        float(plant.count),
        float(plant.count),
        "Nikoukhah, Willsky, Levy 1992, Lemma 2.3",
    )
