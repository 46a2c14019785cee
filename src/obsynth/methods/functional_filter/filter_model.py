"""The model that a Kalman filter is designed for: a plant without unknown inputs, and fault models on it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from obsynth.analysis.diagnosis.decoupled import DecoupledPlant, decoupled
from obsynth.numerics.arrays import FloatArray
from obsynth.numerics.ranks import rank_from
from obsynth.plants.descriptor import DescriptorSystem
from obsynth.plants.exosystems import Exosystem


@dataclass(frozen=True, eq=False)
class FilterModel:
    r"""``xi+ = A xi + B v + N w``, ``0 = C xi - L v + M w`` with ``v = [u; y]``; some faults are ``estimate @ xi``.

    Fields: A ``(n, n)``; C ``(p, n)``; B, L ``(n, nu + ny)``, ``(p, nu + ny)``; N, M ``(n, nw)``, ``(p, nw)``; estimate
    ``(faults, n)``; drive ``(n, model states)``: where the fault models are driven; T, T0 ``(n, nx)``, ``(p, nx)``:
    xi follows ``T E x`` and the states of the fault models, and ``L v - C xi`` is T0 times the plant's equations;
    faults: columns of the plant; order: states without those of the fault models; dt.
    """

    A: FloatArray
    C: FloatArray
    B: FloatArray
    L: FloatArray
    N: FloatArray
    M: FloatArray
    estimate: FloatArray
    drive: FloatArray
    T: FloatArray
    T0: FloatArray
    faults: tuple[int, ...]
    order: int
    fault_sizes: FloatArray
    dt: float


def filter_model(
    plant: DescriptorSystem, model: Exosystem, *, removed: Sequence[int], faults: Sequence[int]
) -> FilterModel:
    """Return the model for some faults, free of the unknown inputs and of the faults removed."""
    found = decoupled(plant, removed, faults)
    used = _model_states(model, faults)
    return _with_fault_models(found, model.Phi[np.ix_(used, used)], model.Cw[np.ix_(list(faults), used)], tuple(faults))


def _model_states(model: Exosystem, faults: Sequence[int]) -> list[int]:
    """Return the states of the exosystem that some faults are made of."""
    reached = np.any(model.Cw[list(faults)] != 0.0, axis=0) if len(faults) else np.zeros(model.order, dtype=bool)
    for _ in range(model.order):
        reached = reached | np.any(model.Phi[reached] != 0.0, axis=0)
    return [int(i) for i in np.flatnonzero(reached)]


def _with_fault_models(found: DecoupledPlant, phi: FloatArray, cw: FloatArray, faults: tuple[int, ...]) -> FilterModel:
    k, count, plant = found.order, len(phi), found.source
    inverse = np.linalg.inv(found.E) if k else np.zeros((0, 0))
    zeros = np.zeros((count, k))
    known = np.hstack([found.Bu, found.By])
    rows = _telling_rows(np.hstack([found.C, found.G @ cw, -found.Du, found.H, found.M]))
    return FilterModel(
        A=np.block([[inverse @ found.A, inverse @ found.F @ cw], [zeros, phi]]),
        C=rows @ np.hstack([found.C, found.G @ cw]),
        B=np.vstack([inverse @ known, np.zeros((count, plant.nu + plant.ny))]),
        L=rows @ np.hstack([-found.Du, found.H]),
        N=np.vstack([inverse @ found.N, np.zeros((count, plant.nw))]),
        M=rows @ found.M,
        estimate=np.hstack([np.zeros((len(faults), k)), cw]),
        drive=np.vstack([np.zeros((k, count)), np.eye(count)]),
        T=np.vstack([inverse @ found.rows[:k, : plant.nx], np.zeros((count, plant.nx))]),
        T0=-rows @ found.rows[k:, : plant.nx],
        faults=faults,
        order=k,
        fault_sizes=found.fault_sizes,
        dt=plant.dt,
    )


def _telling_rows(whole: FloatArray) -> FloatArray:
    """Return combinations ``(q, p)`` of the rows ``whole (p, columns)`` that say something: some are empty."""
    if not whole.size:
        return np.eye(len(whole))
    sizes = np.max(np.abs(whole), axis=0)
    left, values, _ = np.linalg.svd(whole / np.where(sizes > 0.0, sizes, 1.0))
    rank = rank_from(values, expected=len(whole)).rank
    return np.eye(len(whole)) if rank == len(whole) else np.asarray(left[:, :rank].T)
