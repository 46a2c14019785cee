"""Deviations of the estimates, recomputed from the shipped realisation and the stated noise."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from obsynth.methods.functional_filter.deviations import estimate_deviations
from obsynth.results.design import ObserverDesign
from obsynth.results.report import Check, information, upper_bound_check

#: Claimed deviations may be missed by this share: two ways through a Lyapunov equation.
DEVIATION_TOLERANCE = 1e-4


def noise_rows(design: ObserverDesign) -> Iterator[Check]:
    """Yield, for each estimate, the deviation that noise causes, and that of its error with the stated walk."""
    (plant, observer), matrices = design.linear, design.certificate.matrices
    if not plant.nw or not observer.fault_names:
        return
    found = estimate_deviations(plant, observer, matrices)
    unit = "" if plant.dt > 0.0 else " (for a sample time of 1 s, times its root for others)"
    for name, (alone, total), (claimed, claimed_total) in zip(
        observer.fault_names, found, matrices["deviations"], strict=True
    ):
        if np.isnan(alone):
            yield information(
                f"noise in fhat[{name}]", "standard deviation under the stated noise", alone,
                source="recomputed, Lyapunov equation", detail="all digits are rounding",
            )  # fmt: skip
            continue
        yield upper_bound_check(
            f"noise in fhat[{name}]", f"standard deviation under the stated noise is at most the claimed one{unit}",
            float(alone), float(claimed) * (1.0 + DEVIATION_TOLERANCE), source="recomputed, Lyapunov equation",
        )  # fmt: skip
        if np.isfinite(total) and matrices["walks"].any():
            yield upper_bound_check(
                f"error of fhat[{name}]", f"standard deviation of the error with the walk of the fault{unit}",
                float(total), float(claimed_total) * (1.0 + DEVIATION_TOLERANCE),
                source="recomputed, Lyapunov equation",
            )  # fmt: skip
