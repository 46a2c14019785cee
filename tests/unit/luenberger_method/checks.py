"""The checks, from the plant and the shipped realisation alone."""

from collections.abc import Iterator

import numpy as np

from obsynth.results.checks import Check, upper_bound_check
from obsynth.results.design import ObserverDesign


def checks(design: ObserverDesign, printed_digits: int | None) -> Iterator[Check]:
    plant, observer = design.linear
    gap = observer.Az + observer.By @ plant.C - plant.A
    yield upper_bound_check(
        "error dynamics", "Az + By C = A", float(np.abs(gap).max()), 1e-12, source="Luenberger", kind="equality"
    )
    radius = float(np.abs(np.linalg.eigvals(observer.Az)).max())
    claimed = float(design.certificate.claims["radius"])
    yield upper_bound_check(
        "radius", "spectral radius as claimed", radius, claimed * (1.0 + 1e-9), source="Luenberger", detail=""
    )
    yield upper_bound_check("stability", "the error dies out", radius, 1.0, source="Luenberger")
