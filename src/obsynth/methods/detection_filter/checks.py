"""Checks of a detection filter, from the plant and the shipped realisation alone."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from obsynth.analysis.existence.ding2000 import conditions, unknown_inputs
from obsynth.numerics.outward import upper_text
from obsynth.numerics.spectra import abscissa
from obsynth.plants.descriptor import DescriptorSystem
from obsynth.results.checks import Check, fitting_check, information
from obsynth.results.design import ObserverDesign
from obsynth.verification.claims import listed_gains
from obsynth.verification.error_system import ErrorModel
from obsynth.verification.identities import equality, relative_tolerance, tracking_identities
from obsynth.verification.norm_proofs import added_gain, error_transfer, gain_is_proved, sensitivity_is_proved
from obsynth.verification.plant import condition_rows, plant_information

#: The row on the plant together with the stored filter.
TOGETHER = "with stored numbers"

_SOURCE = "Ding et al. 2000; proofs ours"

#: What makes the error obey equations of its own.
_DETECTION_IDENTITIES = {
    "dynamics": ("state in the error", "Az = A - By C"),
    "inputs": ("inputs in the error", "Bu = B - By D"),
    "residual": ("state in the residuals", "Cz = -Dy C"),
    "input feedthrough": ("inputs in the residuals", "Du = -Dy D"),
}

_DETECTION_CLAIMS = ("disturbance_gain", "fault_sensitivity", "band_from", "band_to")


def checks(design: ObserverDesign, printed_digits: int | None) -> Iterator[Check]:
    """Yield every check of ``design``; see `obsynth.methods.verifying.verify`."""
    plant, observer = design.linear
    yield from plant_information(plant)
    fitting = _fits(design)
    yield fitting_check("observer, claims, options and plant have matching signals, shapes and bands", fits=fitting)
    if not fitting:
        return
    yield from condition_rows(conditions(plant))
    tolerance = relative_tolerance(printed_digits, plant.nx + plant.ny + observer.order)
    identities = tracking_identities(ErrorModel(plant, observer, np.eye(plant.nx)))
    for key, (name, claim) in _DETECTION_IDENTITIES.items():
        yield equality(name, claim, identities[key].residual(), _SOURCE, bound=tolerance)
    yield listed_gains(design, {"L": observer.By, "V": observer.Dy})
    yield from _norm_rows(design)


def _fits(design: ObserverDesign) -> bool:
    plant, observer = design.linear
    claims = design.certificate.claims
    if any(name not in claims or not np.isfinite(float(claims[name])) for name in _DETECTION_CLAIMS):
        return False
    band = [float(claims[name]) for name in ("band_from", "band_to")]
    witness = design.certificate.matrices.get("P")
    if witness is None or witness.shape != (observer.order, observer.order) or not np.all(np.isfinite(witness)):
        return False
    parts = observer.Az, observer.Bu, observer.By, observer.Cz, observer.Du, observer.Dy
    return bool(
        all(np.all(np.isfinite(part)) for part in parts)
        and np.array_equal(plant.E, np.eye(plant.nx))
        and observer.order == plant.nx
        and observer.input_names == plant.input_names
        and observer.output_names == plant.output_names
        and (observer.state_names, observer.fault_names) == ((), ())
        and len(observer.residual_names) == plant.ny
        and observer.dt == plant.dt == 0.0
        and 0.0 <= band[0] < band[1]
        and list(design.options.get("band", ())) == band
        and band[0] <= float(claims.get("frequency", band[0])) <= band[1]
        and float(claims["disturbance_gain"]) > 0.0
        and float(claims["fault_sensitivity"]) >= 0.0
    )


def _norm_rows(design: ObserverDesign) -> Iterator[Check]:
    """Yield the two norms on the error's own equations, and on the plant together with the stored filter."""
    (plant, observer), claims = design.linear, design.certificate.claims
    gain, sensitivity = float(claims["disturbance_gain"]), float(claims["fault_sensitivity"])
    band, witness = (float(claims["band_from"]), float(claims["band_to"])), design.certificate.matrices["P"]
    unknown, faults = unknown_inputs(plant), (plant.Bf, plant.Df)

    felt, sensed = error_transfer(plant, observer, *unknown), error_transfer(plant, observer, *faults)

    def shows(level: float) -> bool:
        return sensitivity == 0.0 or sensitivity_is_proved(sensed, level, *band)

    by_itself = gain_is_proved(felt, gain, witness), shows(sensitivity)
    yield Check(
        "disturbance gain",
        "the error decays, and the H-infinity norm from unknown inputs and noise to the "
        "residuals is at most the claimed one",
        gain,
        gain,
        0.0,
        by_itself[0],
        _SOURCE,
        "proved",
    )
    yield Check(
        "fault sensitivity",
        "the least singular value from the faults to the residuals is at least the claimed one "
        f"from {band[0]:g} to {band[1]:g} rad/s",
        sensitivity,
        sensitivity,
        0.0,
        by_itself[1],
        _SOURCE,
        "proved",
    )
    if not all(by_itself):
        return
    claim = "both norms hold for the plant together with the filter as it is stored, rounding included"
    added = [added_gain(plant, observer, *signal) for signal in (unknown, faults)]
    if not any(added):
        yield _together(claim, True, "the stored numbers meet the equations of the error exactly")
        return
    to_gain, from_sensitivity = (upper_text(share, 2) for share in added)
    detail = f"they add at most {to_gain} to the gain, and take {from_sensitivity} from the sensitivity"
    less, more = np.nextafter(gain - added[0], -np.inf), np.nextafter(sensitivity + added[1], np.inf)
    holds = bool(np.all(np.isfinite(added))) and less > 0.0 and gain_is_proved(felt, less, witness) and shows(more)
    yield _together(claim, holds, detail if holds else _why_not(plant))


def _together(claim: str, holds: bool, detail: str) -> Check:
    source = "plant and stored filter, outward rounded"
    return information(
        TOGETHER, claim, float(not holds), source=source, detail=detail, status="proved" if holds else "assumed"
    )


def _why_not(plant: DescriptorSystem) -> str:
    rate = abscissa(plant.A, 0.0)
    if rate >= 0.0:
        return (
            f"not proved: the plant is not stable (a pole at {rate:.3g} 1/s), and the stored numbers miss the "
            "equations of the error by rounding: together they have no finite gain. The row 'stored numbers: states' "
            "bounds the effect of the plant's states on the residuals"
        )
    return f"not proved: the plant decays at {-rate:.3g} 1/s only, too slowly for the rounding of the stored numbers"
