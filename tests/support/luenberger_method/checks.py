"""The checks, from the plant and the shipped realisation alone."""

from collections.abc import Iterator

import numpy as np

from obsynth.results.checks import Check, upper_bound_check
from obsynth.results.design import ObserverDesign


def checks(design: ObserverDesign, printed_digits: int | None) -> Iterator[Check]:
    plant, observer = design.linear
    A = np.linalg.solve(plant.E, plant.A)
    # Entry by entry against the terms of the sum, so that units do not matter.
    terms = np.abs(observer.Az) + np.abs(observer.By) @ np.abs(plant.C) + np.abs(A)
    gap = np.abs(observer.Az + observer.By @ plant.C - A) / np.where(terms > 0.0, terms, 1.0)
    yield upper_bound_check(
        "error dynamics", "E (Az + By C) = A", float(gap.max()), 1e-12, source="Luenberger", kind="equality"
    )
    radius = float(np.abs(np.linalg.eigvals(observer.Az)).max())
    claimed = float(design.certificate.claims["radius"])
    yield upper_bound_check(
        "radius", "spectral radius as claimed", radius, claimed * (1.0 + 1e-9), source="Luenberger", detail=""
    )
    yield upper_bound_check("stability", "the error decays", radius, 1.0, source="Luenberger")
