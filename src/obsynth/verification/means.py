"""Designs whose fault estimates are means: the checks are about the observer before them, the mean itself is exact."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from obsynth.numerics.spectra import certain_noise_covariance
from obsynth.observers.linear.derived import unaveraged
from obsynth.results.checks import Check, information, upper_bound_check
from obsynth.results.design import Certificate, ObserverDesign


def before_the_mean(design: ObserverDesign) -> tuple[ObserverDesign, tuple[Check, ...]]:
    """Return the design without its mean, and the row that says that nothing else was done to it."""
    mean = design.options.get("mean", 1)
    if mean == 1:
        return design, ()
    _, observer = design.linear
    base = unaveraged(observer, mean) if isinstance(mean, int) and mean > 1 else None
    tracking = design.certificate.matrices.get("tracking")
    fitting = base is not None and tracking is not None and len(tracking) == observer.order
    row = upper_bound_check(
        "mean", f"each fault estimate is exactly the mean of the last {mean} of the filter that is checked below",
        float(not fitting), 0.0, source="shipped realisation",
    )  # fmt: skip
    if base is None or tracking is None or not fitting:
        return design, (row,)
    matrices = {**design.certificate.matrices, "tracking": tracking[: base.order]}
    return replace(
        design, observer=base, certificate=Certificate(matrices, design.certificate.claims)
    ), (row,)  # fmt: skip


def mean_noise_rows(design: ObserverDesign) -> Iterator[Check]:
    """Yield the deviation of each averaged estimate under the stated noise."""
    plant, observer = design.linear
    mean, tracking = design.options.get("mean", 1), design.certificate.matrices.get("tracking")
    if mean == 1 or not plant.nw or tracking is None or len(tracking) != observer.order:
        return
    rows = observer.fault_rows
    entering = observer.By @ plant.Dw - tracking[:, : plant.nx] @ plant.Bw
    found = certain_noise_covariance(observer.Az, entering, observer.Cz[rows], observer.Dy[rows] @ plant.Dw, plant.dt)
    for name, variance in zip(observer.fault_names, np.diag(found), strict=True):
        yield information(
            f"noise in the mean of fhat[{name}]",
            f"standard deviation under the stated noise of what is shipped, a mean of {mean}",
            float(np.sqrt(max(float(variance), 0.0))), source="recomputed, Lyapunov equation",
        )  # fmt: skip
