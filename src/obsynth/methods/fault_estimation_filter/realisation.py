"""The shipped realisation of a fault-estimation filter from T, N, L and W, computed or given.

Source: Wang 2015, eqs. (19), (20), (23).  Differences: ``D u`` is subtracted from the outputs; the state estimate,
which the paper leaves biased by Psi under a constant fault, is corrected by the fault estimate: max(rho) - 1 late.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from obsynth.analysis.existence.condition import require_all
from obsynth.analysis.existence.detectability_indexes import (
    WARN_DETECTABILITY_CONDITION,
    FaultDetectability,
    fault_detectability,
)
from obsynth.analysis.existence.restricted_equivalent import prepare, with_sensor_faults_as_states
from obsynth.analysis.existence.wang2015 import fault_filter_conditions
from obsynth.analysis.zeros import sampling_zero_warnings
from obsynth.errors import SpecError
from obsynth.methods.fault_estimation_filter.certificate import bounded_real_certificate
from obsynth.methods.method import WARN_AMPLIFICATION, Synthesis
from obsynth.numerics.arguments import is_whole, require_shape
from obsynth.numerics.arrays import FloatArray, as_matrix
from obsynth.numerics.ranks import decide_rank
from obsynth.observers.linear.modes import poles_of
from obsynth.observers.linear.observer import LinearObserver
from obsynth.plants.descriptor import DescriptorSystem
from obsynth.results.design import Certificate

#: Spectral radii above this are worth a note.
SLOW_FILTER = 0.98


def realise_filter(
    plant: DescriptorSystem,
    work: DescriptorSystem,
    gains: dict[str, FloatArray],
    detectability: FaultDetectability,
) -> tuple[LinearObserver, FloatArray, int]:
    """Return the observer, its tracking map ``(nz, nx (lag + 1))`` and the lag of its state estimates."""
    t, n, feedback, w = (gains[letter] for letter in "TNLW")
    nx, na, nf = plant.nx, work.nx, plant.nf
    indexes = [int(index or 1) for index in detectability.indexes]
    lag = max(indexes) - 1
    ta, tf = t @ work.A, t @ work.Bf
    m = ta - feedback @ work.C
    core_y = m @ n + feedback
    residual_z, residual_y = -w @ work.C, w @ (np.eye(plant.ny) - work.C @ n)
    powers = detectability.chain(ta, tf)

    def correction(age: int) -> FloatArray:
        """Columns ``(TA)^(rho_i - 1 - age) T f_i`` of the faults that become known for the state of this age."""
        columns = np.zeros((nx, nf))
        for i, index in enumerate(indexes):
            if index - 1 - age >= 0:
                columns[:, i] = powers[index - 1 - age][:nx, i]
        return columns

    nz = na + lag * nx
    az, by = np.zeros((nz, nz)), np.zeros((nz, plant.ny))
    az[:na, :na], by[:na] = m, core_y
    # Row block of the state of age 0, then each older one: what was known, plus what the newest residual adds.
    shown_z = np.zeros((nx, nz))
    shown_z[:, :na] = np.eye(nx, na) + correction(0) @ residual_z
    shown_y = n[:nx] + correction(0) @ residual_y
    for age in range(1, lag + 1):
        block = slice(na + (age - 1) * nx, na + age * nx)
        az[block], by[block] = shown_z, shown_y
        shown_z = np.zeros((nx, nz))
        shown_z[:, block] = np.eye(nx)
        shown_z[:, :na] += correction(age) @ residual_z
        shown_y = correction(age) @ residual_y
    fault_z = np.hstack([residual_z, np.zeros((nf, nz - na))])
    cz, dy = np.vstack([shown_z, fault_z, fault_z]), np.vstack([shown_y, residual_y, residual_y])
    bu = -by @ plant.D
    bu[:na] += t @ work.B
    observer = LinearObserver(
        Az=az,
        Bu=bu,
        By=by,
        Cz=cz,
        Du=-dy @ plant.D,
        Dy=dy,
        dt=plant.dt,
        input_names=plant.input_names,
        output_names=plant.output_names,
        state_names=plant.state_names,
        fault_names=plant.fault_names,
        residual_names=plant.fault_names,
        state_delays=(lag,) * nx,
        fault_delays=tuple(indexes),
    )
    tracking = np.zeros((nz, nx * (lag + 1)))
    tracking[:na, :nx] = t[:, :nx]
    tracking[na:, nx:] = np.eye(lag * nx)
    return observer, tracking, lag


def notes(
    plant: DescriptorSystem,
    detectability: FaultDetectability,
    observer: LinearObserver,
    *,
    zeros: Sequence[complex] | None = None,
) -> tuple[str, ...]:
    """Return what a user should know; ``zeros`` are those from the faults, where they are known to be stable."""
    texts = list(sampling_zero_warnings(plant, zeros))
    if detectability.condition_number > WARN_DETECTABILITY_CONDITION:
        texts.append(
            f"Upsilon has condition number {detectability.condition_number:.3g}: some combination of faults is "
            "estimated with a much larger standard deviation than the others."
        )
    for name, row in zip(plant.fault_names, observer.Dy[observer.fault_rows], strict=True):
        amplification = float(np.linalg.norm(row))
        if amplification > WARN_AMPLIFICATION:
            texts.append(
                f"The estimate of {name!r} amplifies errors of the newest measurement by up to {amplification:.3g}: "
                "the outputs respond little to the fault within its delay."
            )
    radius = float(np.max(np.abs(poles_of(observer)), initial=0.0))
    if radius >= 1.0:
        texts.append(
            f"The filter's initial-condition response does not decay: its spectral radius is {radius:.6g}, not below 1."
        )
    elif radius > SLOW_FILTER:
        texts.append(
            f"The filter settles slowly: spectral radius {radius:.6g}, time constant "
            f"{-plant.dt / np.log(radius):.3g} s."
        )
    return tuple(texts)


def synthesis_from_gains(
    plant: DescriptorSystem, *, T: Any, N: Any, L: Any, W: Any, gamma: float | None, indexes: Sequence[int] | None
) -> Synthesis:
    """Return the realisation and certificate of given gains; see `obsynth.design_from_gains`."""
    require_all(fault_filter_conditions(plant))
    work = with_sensor_faults_as_states(plant)
    gains = {name: as_matrix(value, name) for name, value in (("T", T), ("N", N), ("L", L), ("W", W))}
    shapes = {"T": (work.nx, work.nx), "N": (work.nx, work.ny), "L": (work.nx, work.ny), "W": (work.nf, work.ny)}
    for name, shape in shapes.items():
        require_shape(gains[name].shape, shape, name)
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
    are_whole = all(is_whole(index) for index in listed)
    if len(listed) != work.nf or not are_whole or not all(1 <= index <= work.nx for index in listed):
        raise SpecError(
            f"indexes is {indexes!r}: give one whole number from 1 to {work.nx} for each of "
            f"{', '.join(map(repr, work.fault_names))}.",
            path="indexes",
        )
    return tuple(int(index) for index in listed)


def _detectability(work: DescriptorSystem, t: FloatArray, indexes: tuple[int, ...] | None) -> FaultDetectability:
    """Return the detectability matrices of given gains, with given indexes where there are any."""
    ta, tf = t @ work.A, t @ work.Bf
    detectability = fault_detectability(ta, work.C, tf, plant=work)
    if indexes is None:
        return detectability
    powers = replace(detectability, indexes=indexes).chain(ta, tf)
    psi = np.column_stack([powers[index - 1][:, i] for i, index in enumerate(indexes)])
    upsilon = work.C @ psi
    lengths = np.linalg.norm(upsilon, axis=0)
    if not lengths.all():
        hidden = work.fault_names[int(np.argmin(lengths))]
        raise SpecError(
            f"With this T and these indexes the fault {hidden!r} does not reach the outputs.", path="indexes"
        )
    unit = upsilon / lengths
    return FaultDetectability(indexes, psi, upsilon, decide_rank(unit, expected=work.nf), float(np.linalg.cond(unit)))


def _lost_indexes(plant: DescriptorSystem, detectability: FaultDetectability) -> tuple[str, ...]:
    """Return a note for faults that show earlier with the given T than the plant's own equations let them."""
    own = prepare(plant).detectability.indexes
    early = [
        (name, shipped_index, index)
        for name, shipped_index, index in zip(plant.fault_names, detectability.indexes, own, strict=True)
        if index is not None and shipped_index is not None and shipped_index < index
    ]
    if not early:
        return ()
    lower = ", ".join(f"{name!r} {shipped_index} instead of {index}" for name, shipped_index, index in early)
    return (
        f"With this T the detectability indexes are lower than the plant's own: {lower}. If T was rounded, C T f no "
        f"longer vanishes where it should: give indexes={list(own)}, or T with all of its digits.",
    )
