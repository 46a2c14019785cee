r"""Existence of an exact correction for faults whose direction changes with the scheduling parameters.

With constant ``T E + N C = I`` the corrected error obeys ``eps+ = (I - K(mu) C) (T A(mu) eps + T Bd(mu) d)`` if

.. math::
    K_i C T B_{f,j} + K_j C T B_{f,i} = T (B_{f,i} + B_{f,j}), \qquad i \le j.

All solutions are ``[K_1, K_2] = K0 + R U'`` with one free R.  A constant W gives the faults from the outputs, if
``Delta(mu) = W C T Bf(mu)`` is nonsingular on the hull.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np

from obsynth.analysis.existence.condition import Condition
from obsynth.analysis.existence.effectiveness import effectiveness_condition, inverse_bound
from obsynth.analysis.existence.restricted_equivalent import prepare
from obsynth.numerics.arrays import FloatArray
from obsynth.numerics.ranks import decide_rank
from obsynth.plants.polytopic import PolytopicSystem

#: Number of vertices for which the equations are solved.
TURNING_VERTICES = 2
#: Name of the condition that only faults with a changing direction need.
TURNING_CONDITION = "correction that turns"
_SOURCE = "a correction that turns with the faults (obsynth.conditions.turning_faults)"


@dataclass(frozen=True, eq=False)
class TurningFilter:
    """The parts of a filter whose correction turns.

    ``T (nx, nx)``, ``N (nx, ny)``, ``W (nf, ny)``; ``K0`` and ``U``, at each vertex ``(nx, ny)`` and ``(ny, r)``: the
    corrections are ``K0 + R U'``; ``Delta`` ``(nf, nf)`` at each vertex; ``reach``: a proved bound on ``|Delta^-1|``.
    """

    T: FloatArray
    N: FloatArray
    W: FloatArray
    K0: tuple[FloatArray, ...]
    U: tuple[FloatArray, ...]
    Delta: tuple[FloatArray, ...]
    reach: float


def has_turning_form(plant: PolytopicSystem) -> bool:
    """Whether the plant has the form that this correction needs: two vertices, no Df and no Dd."""
    direct = any(np.any(getattr(vertex, name)) for vertex in plant.vertices for name in ("Df", "Dd"))
    return plant.count == TURNING_VERTICES and not direct


def pairs_of_vertices(count: int) -> list[tuple[int, int]]:
    """Return the pairs ``i <= j``: a quadratic function of the weights is a mean of its values at these."""
    return [(i, j) for i in range(count) for j in range(i, count)]


def turning_conditions(plant: PolytopicSystem, made: list[Any]) -> Iterator[Condition]:
    """Yield the conditions of a plant of that form; append the filter's matrices to ``made`` if all of them hold."""
    yield Condition(
        "directions of the faults",
        "the faults turn with the scheduling, between two vertices: a correction may turn with them",
        True,
        float(plant.count),
        float(TURNING_VERTICES),
        _SOURCE,
        of_the_method=True,
    )
    C, prepared = plant.vertices[0].C, prepare(plant.center, exactly=False)
    states = prepared.scaling.states[:, None]
    T = states * prepared.T * prepared.scaling.equations
    N = states * prepared.N * prepared.scaling.outputs
    driven = [T @ vertex.Bf for vertex in plant.vertices]
    after_one_sample = _after_one_sample(C, driven)
    yield after_one_sample
    if not after_one_sample.holds:
        return
    rows, target = correction_equations(C, driven)
    freedom = decide_rank(rows)
    solvable = decide_rank(np.vstack([rows, target])).rank == freedom.rank
    yield _correction_condition(plant, solvable)
    if not solvable:
        return
    # Unit directions, so that the larger vertex does not outweigh the other.
    mean = sum((C @ each / np.linalg.norm(C @ each, axis=0) for each in driven), np.zeros((plant.ny, plant.nf)))
    W = np.asarray(np.linalg.pinv(mean))
    Delta = tuple(W @ C @ each for each in driven)
    reach, _ = inverse_bound(Delta)
    yield effectiveness_condition(
        reach, "W C T Bf(mu) is nonsingular on the whole region: a fault stays apart from its opposite", _SOURCE
    )
    if reach is None:
        return
    m = plant.ny
    K0, U = _corrections(rows, target, freedom.rank)
    halves = [slice(i * m, (i + 1) * m) for i in range(plant.count)]
    made.append(
        TurningFilter(T, N, W, tuple(K0[:, half] for half in halves), tuple(U[half] for half in halves), Delta, reach)
    )


def _after_one_sample(C: FloatArray, driven: list[FloatArray]) -> Condition:
    """Return whether every fault reaches the outputs after one sample, for ``T Bf`` at each vertex."""
    late = sum(not decide_rank(C @ each, expected=each.shape[1]).full for each in driven)
    return Condition(
        "one sample to the outputs",
        "every fault reaches the outputs after one sample: C T Bf has full column rank at both vertices",
        not late,
        float(late),
        0.0,
        _SOURCE,
        "" if not late else "a filter for later ones over a region is not known here. ui-pi-observer does not need it",
        of_the_method=True,
    )


def _correction_condition(plant: PolytopicSystem, solvable: bool) -> Condition:
    """Return whether there is a correction that is affine in the weights and turns with the faults."""
    return Condition(
        TURNING_CONDITION,
        "K(mu) C T Bf(mu) = T Bf(mu) has a solution that is affine in the weights",
        solvable,
        float(solvable),
        1.0,
        _SOURCE,
        ""
        if solvable
        else "there are too few outputs to follow how the faults turn: measure more, or take ui-pi-observer, for which "
        "faults may turn",
        signals=() if solvable else plant.fault_names,
        of_the_method=True,
    )


def _corrections(rows: FloatArray, target: FloatArray, rank: int) -> tuple[FloatArray, FloatArray]:
    """Return the least K0 with ``K0 G = H``, and U with ``U' G = 0``, for G ``(N ny, pairs nf)`` of known rank.

    The equations are scaled to unit size; singular values beyond the rank are rounding.
    """
    units = np.linalg.norm(rows, axis=0)
    units = np.where(units > 0.0, units, 1.0)
    left_vectors, sizes, right_vectors = np.linalg.svd(rows / units)
    K0 = (target / units) @ (right_vectors[:rank].T / sizes[:rank]) @ left_vectors[:, :rank].T
    return np.asarray(K0), np.asarray(left_vectors[:, rank:])


def correction_equations(C: FloatArray, driven: list[FloatArray]) -> tuple[FloatArray, FloatArray]:
    """Return G ``(N ny, pairs nf)`` and H ``(nx, pairs nf)`` of ``[K_1, K_2] G = H``."""
    m, nf = C.shape[0], driven[0].shape[1]
    columns, right = [], []
    for i, j in pairs_of_vertices(len(driven)):
        column = np.zeros((len(driven) * m, nf))
        column[i * m : (i + 1) * m] += C @ driven[j]
        column[j * m : (j + 1) * m] += C @ driven[i]
        columns.append(column)
        right.append(driven[i] + driven[j])
    return np.hstack(columns), np.hstack(right)
