"""Checks of an unknown-input PI observer, from the plant and the shipped realisation alone.

Source of the claims: Share Pasand, Aliyari, Taghirad, eqs. (7), (19); (D1)-(D3) and the checks of numbers are ours.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from obsynth.analysis.existence.augmented_pencils import shipped_model
from obsynth.analysis.existence.sharepasand import existence_conditions
from obsynth.methods.ui_pi_observer.checks_over_region import checks_over_region
from obsynth.methods.ui_pi_observer.decoupling import decoupling_norm
from obsynth.methods.ui_pi_observer.identities import identities
from obsynth.methods.ui_pi_observer.number_checks import gain_rows, noise_rows, stability_rows
from obsynth.methods.ui_pi_observer.unmodelled_faults import tracking_rows
from obsynth.plants.polytopic import PolytopicSystem
from obsynth.results.checks import Check, fitting_check, information, upper_bound_check
from obsynth.results.design import ObserverDesign
from obsynth.verification.fault_models import fault_model_row
from obsynth.verification.identities import ALIKE, are_residual_names, equality, relative_tolerance
from obsynth.verification.plant import condition_rows, plant_information

#: Estimates at a frequency may miss by this much, relative to terms that pass through the inverse of ``sI - Az``.
DECOUPLING_TOLERANCE = 1e-8

_UI_PI_MATRICES = ("tracking", "Phi", "Cw", "poles", "stability")


def checks(design: ObserverDesign, printed_digits: int | None) -> Iterator[Check]:
    """Yield every check of ``design``; see `obsynth.verify`."""
    if isinstance(design.plant, PolytopicSystem):
        yield from checks_over_region(design)
        return
    good = True
    for row in _realisation_rows(design, printed_digits):
        good &= row.passed
        yield row
    if good:
        # Letters of a realisation that fails need no word of their own.
        (plant, observer), matrices = design.linear, design.certificate.matrices
        model = shipped_model(matrices, plant.nf)
        tolerance = relative_tolerance(printed_digits, plant.nx + model.order + plant.ny)
        yield from gain_rows(design.gains, plant, observer, model, matrices["tracking"], tolerance)


def _realisation_rows(design: ObserverDesign, printed_digits: int | None) -> Iterator[Check]:
    """Yield every check of plant, realisation and certificate."""
    (plant, observer), certificate = design.linear, design.certificate
    yield from plant_information(plant)
    fitting = _fits(design)
    yield fitting_check("observer, certificate and plant have matching signals and shapes", fits=fitting)
    if not fitting:
        return
    tracking, phi, cw, poles, factor = (certificate.matrices[name] for name in _UI_PI_MATRICES)
    yield fault_model_row(plant, design)
    model = shipped_model(certificate.matrices, plant.nf)
    *conditions, last = existence_conditions(plant, model)
    yield from condition_rows(conditions)
    if last.name == "fixed modes":
        yield information(last.name, "poles that no gain moves", last.value, source=last.source, detail=last.detail)
    else:
        yield from condition_rows([last])
    tolerance = relative_tolerance(printed_digits, plant.nx + len(phi) + plant.ny)
    for name, claim, miss, source in identities(plant, observer, model, tracking):
        yield equality(name, claim, miss, source, bound=tolerance)
    yield from stability_rows(design, poles, factor)
    norm = decoupling_norm(plant, observer)
    yield upper_bound_check(
        "decoupling",
        "the transfer functions from the unknown inputs to the errors of all estimates are zero",
        norm.relative,
        DECOUPLING_TOLERANCE if printed_digits is None else max(DECOUPLING_TOLERANCE, 10.0 * tolerance),
        source="computed from the transfer functions of plant and observer, without the tracking map",
        detail=f"relative to the terms; absolute gain to a fault estimate up to {norm.fault_gain:.1e}; "
        f"worst at {norm.frequency:.3g} rad/s",
    )
    yield from noise_rows(design)
    yield from tracking_rows(plant, observer, tracking, phi, cw)


def _fits(design: ObserverDesign) -> bool:
    (plant, observer), matrices = design.linear, design.certificate.matrices
    if any(name not in matrices for name in _UI_PI_MATRICES):
        return False
    order = matrices["Phi"].shape[0]
    shapes = {
        "tracking": (observer.order, plant.nx + order),
        "Phi": (order, order),
        "Cw": (plant.nf, order),
        "poles": (observer.order, 2),
        "stability": (observer.order, observer.order),
    }
    return bool(
        all(matrices[name].shape == shape and np.all(np.isfinite(matrices[name])) for name, shape in shapes.items())
        and observer.order == plant.nx + order
        and all(getattr(observer, name) == getattr(plant, name) for name in ALIKE)
        and all(delay == 0 for delay in (*observer.state_delays, *observer.fault_delays))
        and are_residual_names(observer.residual_names, plant.output_names)
    )
