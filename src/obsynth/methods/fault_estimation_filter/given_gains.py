"""A fault-estimation filter from gains that somebody else has found: its realisation and, where it has one, a proof.

Source: Wang, Rodrigues, Theilliol, Shen 2015, eqs. (19), (20), (23).  Difference: the detectability indexes may be
given, since an index above one cannot be found from a T that was rounded for print.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from obsynth.analysis.conditions import require_all
from obsynth.errors import SpecError
from obsynth.methods.fault_estimation_filter.certificate import bounded_real_certificate
from obsynth.methods.fault_estimation_filter.conditions import fault_filter_conditions
from obsynth.methods.fault_estimation_filter.detectability_indexes import FaultDetectability, fault_detectability
from obsynth.methods.fault_estimation_filter.prepared_plant import prepare, with_sensor_faults_as_states
from obsynth.methods.fault_estimation_filter.realisation import notes, realise_filter
from obsynth.methods.method_spec import Synthesis
from obsynth.numerics.arguments import is_whole
from obsynth.numerics.arrays import FloatArray, as_matrix
from obsynth.numerics.ranks import decide_rank
from obsynth.plants.descriptor import DescriptorSystem
from obsynth.results.design import Certificate


def synthesis_from_gains(
    plant: DescriptorSystem, *, T: Any, N: Any, L: Any, W: Any, gamma: float | None, indexes: Sequence[int] | None
) -> Synthesis:
    """Return the realisation and certificate of given gains; see `obsynth.fault_estimation_filter_from_gains`."""
    require_all(fault_filter_conditions(plant))
    work = with_sensor_faults_as_states(plant)
    gains = {name: as_matrix(value, name) for name, value in (("T", T), ("N", N), ("L", L), ("W", W))}
    shapes = {"T": (work.nx, work.nx), "N": (work.nx, work.ny), "L": (work.nx, work.ny), "W": (work.nf, work.ny)}
    for name, shape in shapes.items():
        if gains[name].shape != shape:
            raise SpecError(f"{name} is {gains[name].shape}, but {shape} is needed.", path=name)
    detectability = _detectability(work, gains["T"], _checked(indexes, work))
    if not detectability.finite:
        raise SpecError("With this T some fault never reaches the outputs.", path="T")
    gains |= {"Psi": detectability.Psi, "Upsilon": detectability.Upsilon}
    observer, tracking, lag = realise_filter(plant, work, gains, detectability)
    level = 1.0 if gamma is None else gamma
    factor, _ = bounded_real_certificate(plant, observer, tracking, level, core=work.nx, lag=lag)
    claims = {"state_lag": float(lag)} | ({"gamma": level} if plant.nd else {})
    doubts = () if indexes is not None else _lost_indexes(plant, detectability)
    return Synthesis(
        {"from_gains": True, "gamma": gamma, "indexes": None if indexes is None else list(detectability.indexes)},
        gains,
        observer,
        Certificate({"P_factor": factor, "tracking": tracking}, claims),
        {"runs": []},
        (*doubts, *notes(plant, detectability, observer)),
    )


def _checked(indexes: Sequence[int] | None, work: DescriptorSystem) -> tuple[int, ...] | None:
    if indexes is None:
        return None
    listed: list[Any] = list(indexes) if isinstance(indexes, (list, tuple, np.ndarray)) else []
    whole = all(is_whole(index) for index in listed)
    if len(listed) != work.nf or not whole or not all(1 <= index <= work.nx for index in listed):
        raise SpecError(
            f"indexes is {indexes!r}: give one whole number from 1 to {work.nx} for each of "
            f"{', '.join(map(repr, work.fault_names))}.", path="indexes",
        )  # fmt: skip
    return tuple(int(index) for index in listed)


def _detectability(work: DescriptorSystem, t: FloatArray, indexes: tuple[int, ...] | None) -> FaultDetectability:
    """Return the detectability matrices of given gains, with given indexes where there are any."""
    ta, tf = t @ work.A, t @ work.Bf
    found = fault_detectability(ta, work.C, tf)
    if indexes is None:
        return found
    powers = replace(found, indexes=indexes).chain(ta, tf)
    psi = np.column_stack([powers[index - 1][:, i] for i, index in enumerate(indexes)])
    upsilon = work.C @ psi
    lengths = np.linalg.norm(upsilon, axis=0)
    if not lengths.all():
        hidden = work.fault_names[int(np.argmin(lengths))]
        raise SpecError(f"With this T and these indexes the fault {hidden!r} does not reach the outputs.",
                        path="indexes")  # fmt: skip
    unit = upsilon / lengths
    return FaultDetectability(
        indexes, psi, upsilon, decide_rank(unit, expected=work.nf), float(np.linalg.cond(unit))
    )  # fmt: skip


def _lost_indexes(plant: DescriptorSystem, found: FaultDetectability) -> tuple[str, ...]:
    """Return a note for faults that show earlier with the given T than the plant's own equations let them."""
    own = prepare(plant).detectability.indexes
    early = [
        (name, given, index)
        for name, given, index in zip(plant.fault_names, found.indexes, own, strict=True)
        if index is not None and given is not None and given < index
    ]
    if not early:
        return ()
    told = ", ".join(f"{name!r} {given} instead of {index}" for name, given, index in early)
    return (
        f"With this T the detectability indexes are lower than the plant's own: {told}. If T was rounded, C T f no "
        f"longer vanishes where it should: give indexes={list(own)}, or T with all of its digits.",
    )
