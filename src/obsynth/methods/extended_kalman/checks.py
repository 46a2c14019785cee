"""Checks of the extended Kalman filter: those of the adaptive observer of a nonlinear plant, without parameters."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from obsynth.analysis.existence.moussaali_dae import known_parameters
from obsynth.methods.dae_adaptive_observer.checks import checks as adaptive_checks
from obsynth.methods.dae_adaptive_observer.method import DaeAdaptiveObserver
from obsynth.results.checks import Check
from obsynth.results.design import ObserverDesign
from obsynth.verification.plant import condition_rows


def checks(design: ObserverDesign, printed_digits: int | None) -> Iterator[Check]:
    """Yield every check of ``design``; see `obsynth.verify`."""
    plant, observer = design.nonlinear
    known = known_parameters(plant)
    yield from condition_rows((known,))
    if not known.holds:
        return
    options = {**DaeAdaptiveObserver(dt=observer.dt).as_given(), **design.options}
    gains = {**design.gains, "Upsilon": np.zeros((plant.nx, 0))}
    yield from adaptive_checks(design.replace(options=options, gains=gains), printed_digits)
