"""Checks of an unknown-input PI observer, from the plant and the shipped realisation alone.

Source of the claims: Share Pasand, Aliyari, Taghirad, eqs. (7), (19); (D1)-(D3) and the checks of numbers are ours.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from obsynth.analysis.existence.augmented_pencils import AugmentedPlant, shipped_model
from obsynth.analysis.existence.sharepasand import existence_conditions
from obsynth.methods.ui_pi_observer.decoupling import decoupling_norm
from obsynth.methods.ui_pi_observer.fault_response import tracking_rows
from obsynth.methods.ui_pi_observer.number_checks import gain_rows, noise_rows, stability_rows
from obsynth.numerics.arrays import FloatArray
from obsynth.observers.linear.observer import LinearObserver
from obsynth.plants.descriptor import DescriptorSystem
from obsynth.plants.faults import Exosystem
from obsynth.plants.plant_units import PlantUnits
from obsynth.results.checks import Check, fitting_check, information, upper_bound_check
from obsynth.results.design import ObserverDesign
from obsynth.verification.identities import ALIKE, Residual, equality, relative_tolerance, residual
from obsynth.verification.plant import condition_rows, plant_information

#: Estimates at a frequency may miss by this much, relative to terms that pass through the inverse of ``sI - Az``.
DECOUPLING_TOLERANCE = 1e-8

_PAPER = "Share Pasand, eq. (19)"

_UI_PI_MATRICES = ("tracking", "Phi", "Cw", "poles", "stability")


def checks(design: ObserverDesign, printed_digits: int | None) -> Iterator[Check]:
    """Yield every check of ``design``; see `obsynth.verify`."""
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
    model = shipped_model(certificate.matrices, plant.nf)
    *conditions, last = existence_conditions(plant, model)
    yield from condition_rows(conditions)
    if last.name == "fixed modes":
        yield information(last.name, "poles that no gain moves", last.value, source=last.source, detail=last.detail)
    else:
        yield from condition_rows([last])
    tolerance = relative_tolerance(printed_digits, plant.nx + len(phi) + plant.ny)
    for name, claim, found, source in _identities(plant, observer, model, tracking):
        yield equality(name, claim, found, source, bound=tolerance)
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
    )


def _identities(
    plant: DescriptorSystem, observer: LinearObserver, model: Exosystem, tracking: FloatArray
) -> Iterator[tuple[str, str, Residual, str]]:
    """Yield the identities (19) of the shipped realisation: name, claim, residual, source."""
    augmented = AugmentedPlant.of(plant, model)
    az, bu, by, cz, du, dy = observer.Az, observer.Bu, observer.By, observer.Cz, observer.Du, observer.Dy
    ve = tracking @ augmented.E
    # A row that is nothing but rounding is judged in the units of what it stands for, not against itself.
    scaling = PlantUnits.of(plant, model)
    units = scaling.augmented_states
    own_u = np.outer(units, scaling.augmented_equations)
    own_dy = np.outer(np.max(np.abs(cz) * units, axis=1, initial=0.0), scaling.outputs)
    # Bhat = Ahat D + K may cancel: what it is formed of says how well it can be known.
    formed = (az[:, : plant.nx], dy[observer.state_rows], augmented.C)
    yield (
        "Sylvester",
        "Ahat U_a E_a + Bhat C_a = U_a A_a",
        residual(
            az @ ve,
            by @ augmented.C,
            -tracking @ augmented.A,
            factors=((az, tracking, augmented.E), (by, augmented.C), (tracking, augmented.A), formed),
            units=units,
        ),
        _PAPER,
    )
    yield (
        "inputs",
        "Jhat = U_a B_a (and Bhat D, where u reaches y)",
        residual(bu, by @ plant.D, -tracking @ augmented.B, factors=((by, plant.D), (tracking, augmented.B))),
        _PAPER,
    )
    yield (
        "disturbance in the error",
        "U_a Bd_a = 0 (Bhat Dd, where d reaches y)",
        residual(
            tracking @ augmented.Bd,
            -by @ plant.Dd,
            factors=((tracking, augmented.Bd), (by, plant.Dd), (own_u, augmented.Bd)),
        ),
        _PAPER,
    )
    yield (
        "disturbance in the estimates",
        "D_a Dd = 0: d has no direct effect on any estimate",
        residual(dy @ plant.Dd, factors=((dy, plant.Dd), (own_dy, plant.Dd))),
        "our extension",
    )
    wanted = {
        "state": (observer.state_rows, np.eye(plant.nx, augmented.order), "U_a E_a + D_a C_a = I, rows of the state"),
        "fault": (
            observer.fault_rows,
            np.hstack([np.zeros((plant.nf, plant.nx)), model.Cw]),
            "Cw (U_a E_a + D_a C_a) = Cw: the fault estimate follows the fault model",
        ),
        "residual": (
            observer.residual_rows,
            np.zeros((len(observer.residual_names), augmented.order)),
            "neither the state nor a modelled fault has an effect on the residual",
        ),
    }
    for name, (rows, goal, claim) in wanted.items():
        factors = ((cz[rows], tracking, augmented.E), (dy[rows], augmented.C), (own_dy[rows], augmented.C))
        yield name, claim, residual(cz[rows] @ ve, dy[rows] @ augmented.C, -goal, factors=factors, units=units), _PAPER
    yield (
        "feedthrough",
        "the input has no direct effect on any estimate (Du + Dy D = 0)",
        residual(du, dy @ plant.D, factors=((dy, plant.D),)),
        "our extension",
    )
