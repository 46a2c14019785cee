"""What the user of a fault-estimation filter should know."""

from __future__ import annotations

import numpy as np

from obsynth.analysis.transformations.sampling import SLOW_ZERO_RADIUS, sampling_zero_warnings
from obsynth.methods.fault_estimation_filter.detectability_indexes import WARN_CONDITION, FaultDetectability
from obsynth.numerics.norms import spectral_radius
from obsynth.observers.linear.observer import LinearObserver
from obsynth.plants.descriptor import DescriptorSystem

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
