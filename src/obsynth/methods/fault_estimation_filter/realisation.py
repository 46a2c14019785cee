"""The shipped realisation of a fault-estimation filter, from T, N, L and W, and its notes.

Source: Wang 2015, eq. (23).  Differences: ``D u`` is subtracted from the outputs; the paper's state estimate is
biased by exactly Psi under a constant fault, so what is shipped is corrected by the fault estimate.  With indexes
above one, the fault samples still missing at k arrive later, so the corrected state lags by ``max(rho) - 1``.
"""

from __future__ import annotations

import numpy as np

from obsynth.analysis.transformations.sampling import SLOW_ZERO_RADIUS, sampling_zero_warnings
from obsynth.methods.fault_estimation_filter.detectability_indexes import WARN_CONDITION, FaultDetectability
from obsynth.numerics.arrays import FloatArray
from obsynth.numerics.norms import spectral_radius
from obsynth.observers.linear.observer import LinearObserver
from obsynth.plants.descriptor import DescriptorSystem


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
    powers = [tf]
    for _ in range(lag):
        powers.append(ta @ powers[-1])

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


#: Amplifications of measurement errors above this are worth a note.
WARN_AMPLIFICATION = 50.0
#: Spectral radii above this are worth a note.
SLOW_FILTER = 0.98


def notes(
    plant: DescriptorSystem,
    detectability: FaultDetectability,
    observer: LinearObserver,
    *,
    largest_zero: float = np.inf,
) -> tuple[str, ...]:
    """Return what a user should know: slow zeros, ill-conditioned faults, amplified noise, slow filters.

    ``largest_zero`` is the largest modulus of a fault zero, where that is known already.
    """
    found = list(sampling_zero_warnings(plant)) if largest_zero > SLOW_ZERO_RADIUS else []
    if detectability.condition_number > WARN_CONDITION:
        found.append(
            f"Upsilon has condition number {detectability.condition_number:.3g}: some combination of faults is "
            "estimated with much more noise than others."
        )
    for name, row in zip(plant.fault_names, observer.Dy[observer.fault_rows], strict=True):
        amplification = float(np.linalg.norm(row))
        if amplification > WARN_AMPLIFICATION:
            found.append(
                f"The estimate of {name!r} multiplies errors of the newest measurement by up to {amplification:.3g}: "
                "the fault moves the outputs little within its delay."
            )
    radius = spectral_radius(observer.Az)
    if radius > SLOW_FILTER:
        found.append(
            f"The filter forgets its start slowly: spectral radius {radius:.6g}, time constant "
            f"{-plant.dt / np.log(radius):.3g} s."
        )
    return tuple(found)
