"""Preparation of a plant for the fault-estimation filter: sensor faults as states, units, ``T E + N C = I``.

Source: Wang 2015, eqs. (7), (16)-(17). Differences: ``S = [I, C']`` gives a singular T, which loses algebraic
equations, in 13 of 276 random systems: ours is nonsingular by construction. Feedthrough is exact in ``e = T E x - z``,
since ``N Dd d(k+1)`` drops out: ``e+ = (TA - L C) e + (T Bd - TA N Dd - L (I - C N) Dd) d``, ``r = W (C e + (I - C N)
Dd d)``.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np

from obsynth.analysis.existence.detectability_indexes import FaultDetectability, exact_indexes, fault_detectability
from obsynth.errors import SpecError
from obsynth.numerics.arguments import require_shape
from obsynth.numerics.arrays import FloatArray
from obsynth.numerics.ranks import RANK_TOLERANCE, decide_rank
from obsynth.numerics.scaling import Scaling, balance_system, power_of_two_below
from obsynth.plants.descriptor import DescriptorSystem
from obsynth.plants.plant_units import PlantUnits
from obsynth.plants.transformations.fault_states import augment_faults

#: Units are kept while the condition numbers of ``[E; C]`` and T are below this.
MOST_CONDITION = 256.0


def restricted_equivalent(e: FloatArray, c: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return ``T (nx, nx)``, nonsingular, and ``N (nx, ny)`` with ``T E + N C = I``.

    ``W = E'E + C'C``, ``T = W^-1 E' + K Q U'``, ``N = W^-1 C'``: U spans null E', K spans ``C'C ker E``, Q is the
    orthogonal polar factor of ``K'U``.
    """
    stacked = np.vstack([e, c])
    # W^-1 [E' C'] is the pseudo-inverse; by QR, and one refinement, it is accurate where forming W is not.
    q, r = np.linalg.qr(stacked)
    solved = np.linalg.solve(r, q.T)
    solved = solved + (np.eye(e.shape[1]) - solved @ stacked) @ solved
    t, n = solved[:, : e.shape[0]], solved[:, e.shape[0] :]
    left_vectors, values, right_vectors = np.linalg.svd(e)
    rank = int(np.sum(values > RANK_TOLERANCE * values[0])) if values[0] > 0.0 else 0
    if rank == e.shape[0]:
        return t, n
    left_null, null = left_vectors[:, rank:], right_vectors[rank:].T
    k = np.linalg.qr(c.T @ (c @ null))[0]
    u, _, v = np.linalg.svd(k.T @ left_null)
    return t + k @ (u @ v) @ left_null.T, n


def restricted_equivalent_from(e: FloatArray, c: FloatArray, s: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return T and N by the paper's general solution (16)-(17) with its free matrix ``S (nx, nx + ny)``."""
    nx, ny = e.shape[0], c.shape[0]
    require_shape(s.shape, (nx, nx + ny), "S")
    stacked = np.vstack([e, c])
    # Of full column rank: its columns may be scaled, so that states in small units are not taken for zero.
    units = np.exp2(np.round(np.log2(np.linalg.norm(stacked, axis=0))))
    pseudo = np.linalg.pinv(stacked / units) / units[:, None]
    m = pseudo + s @ (np.eye(nx + ny) - stacked @ pseudo)
    t, n = m[:, :nx], m[:, nx:]
    rank = decide_rank(t, expected=nx)
    if not rank.full:
        raise SpecError(
            f"This S makes T singular ({rank.describe()}), which discards algebraic equations: choose another S, or "
            "leave it out for a T that is nonsingular by construction.",
            path="S",
        )
    return t, n


@dataclass(frozen=True, eq=False)
class PreparedPlant:
    """A plant in the form the theory works on: ``plant`` has sensor faults as states, and is not balanced.

    The rest is in the coordinates of ``scaling``: T, N, TA, C, and disturbance and noise as they enter the error
    system (``Bd``, ``Bw``) and the innovation (``Dd``, ``Dw``).
    """

    plant: DescriptorSystem
    scaling: Scaling
    T: FloatArray
    N: FloatArray
    TA: FloatArray
    C: FloatArray
    Bd: FloatArray
    Dd: FloatArray
    Bw: FloatArray
    Dw: FloatArray
    detectability: FaultDetectability


def with_sensor_faults_as_states(plant: DescriptorSystem) -> DescriptorSystem:
    """Return the plant with every fault that reaches an output directly appended as an algebraic state."""
    direct = tuple(name for name, column in zip(plant.fault_names, plant.Df.T, strict=True) if np.any(column != 0.0))
    return augment_faults(plant, direct).plant if direct else plant


def _units(work: DescriptorSystem) -> Iterator[Scaling]:
    """Yield units to try in turn: balanced, natural, and balanced with the rows of E of one size.

    The last where A is far larger than E: T would lose an equation scaled by A beside an output of the same state.
    """
    balanced = balance_system(work.E, work.A, inputs=[work.Bf], outputs=[work.C])
    yield balanced
    units = PlantUnits.of(work).rounded()
    yield Scaling(units.equations, units.states, units.outputs)
    sizes = np.linalg.norm(balanced.scale_dynamics(work.E), axis=1)
    yield replace(balanced, equations=balanced.equations / power_of_two_below(np.where(sizes > 0.0, sizes, 1.0)))


def _equivalent(work: DescriptorSystem) -> tuple[Scaling, FloatArray, FloatArray]:
    """Return units in which ``[E; C]`` and T are well conditioned, or as well as can be had, with T and N in them."""
    tried, least = list[tuple[float, tuple[Scaling, FloatArray, FloatArray]]](), np.inf
    for scaling in _units(work):
        if any(_are_same(scaling, known[0]) for _, known in tried):
            continue
        e, c = scaling.scale_dynamics(work.E), scaling.scale_output(work.C)
        condition = float(np.linalg.cond(np.vstack([e, c])))
        if condition >= least:
            continue  # whatever T is
        t, n = restricted_equivalent(e, c)
        condition = max(condition, float(np.linalg.cond(t)))
        tried.append((condition, (scaling, t, n)))
        least = min(least, condition)
        if condition <= MOST_CONDITION:
            break
    return min(tried, key=lambda entry: entry[0])[1]


def _are_same(first: Scaling, second: Scaling) -> bool:
    pairs = (first.equations, second.equations), (first.states, second.states), (first.outputs, second.outputs)
    return all(np.array_equal(*pair) for pair in pairs)


def prepare(plant: DescriptorSystem, s: FloatArray | None = None, *, exactly: bool = True) -> PreparedPlant:
    """Return the prepared plant, with T from ``s (na, na + ny)`` where given; the rank conditions must hold."""
    work = with_sensor_faults_as_states(plant)
    scaling, t, n = _equivalent(work)
    a, c = scaling.scale_dynamics(work.A), scaling.scale_output(work.C)
    if s is not None:
        # S is meant for the plant as given; what it makes is then moved to the balanced coordinates, exactly.
        t, n = restricted_equivalent_from(work.E, work.C, s)
        t, n = t / scaling.states[:, None] / scaling.equations, n / scaling.states[:, None] / scaling.outputs
    ta, tf = t @ a, t @ scaling.scale_input(work.Bf)
    projection = np.eye(work.ny) - c @ n

    def error_input(b: FloatArray, d: FloatArray) -> tuple[FloatArray, FloatArray]:
        direct = scaling.scale_feedthrough(d)
        return t @ scaling.scale_input(b) - ta @ (n @ direct), projection @ direct

    detectability = fault_detectability(
        ta, c, tf, plant=work, scaling=scaling, exact=exact_indexes(plant) if exactly else None
    )
    bd, dd = error_input(work.Bd, work.Dd)
    bw, dw = error_input(work.Bw, work.Dw)
    return PreparedPlant(
        plant=work, scaling=scaling, T=t, N=n, TA=ta, C=c, Bd=bd, Dd=dd, Bw=bw, Dw=dw, detectability=detectability
    )
