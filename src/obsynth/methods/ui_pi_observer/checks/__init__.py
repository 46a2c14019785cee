"""Checks of an unknown-input PI observer, from the plant and the shipped realisation alone.

Source of the claims: Share Pasand, Aliyari, Taghirad, eqs. (7), (19); (D1)-(D3) and the checks of numbers are ours.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping

import numpy as np

from obsynth.analysis.plant_units import PlantUnits
from obsynth.methods.ui_pi_observer.augmented_plant import AugmentedPlant, shipped_model
from obsynth.methods.ui_pi_observer.checks.decoupling import decoupling_norm
from obsynth.methods.ui_pi_observer.checks.fault_response import tracking_rows
from obsynth.methods.ui_pi_observer.conditions import existence_conditions
from obsynth.methods.ui_pi_observer.pencils import numbers
from obsynth.numerics.arrays import FloatArray, largest_singular_value
from obsynth.numerics.spectra import (
    DOUBLE_DIGITS,
    PRINTED_DIGITS,
    abscissa_of,
    as_printed,
    digits_needed,
    eigenvalues,
    farthest_pole,
    mean_miss,
)
from obsynth.observers.linear.observer import LinearObserver, poles_of
from obsynth.plants.descriptor import DescriptorSystem
from obsynth.plants.fault_models import Exosystem
from obsynth.proofs.covariances import certain_noise_covariance
from obsynth.proofs.extended_balls import enclosed_eigenvalues, middle_of
from obsynth.results.checks import Check, fitting_check, information, upper_bound_check
from obsynth.results.design import ObserverDesign
from obsynth.verification.certificates import decay_row, stability_row
from obsynth.verification.claims import UNCERTAIN
from obsynth.verification.identities import ALIKE, Residual, equality, relative_tolerance, residual, worst
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


#: Recomputed poles may miss the claimed ones by this, relative to their size; claimed rates and norms likewise.
SPECTRUM_TOLERANCE = 1e-4
POLE_CLAIM_TOLERANCE = 1e-4
#: Poles that a row lists.
LISTED_POLES = 8


def stability_rows(design: ObserverDesign, poles: FloatArray, factor: FloatArray) -> Iterator[Check]:
    """Yield the proof of stability, and what the eigenvalues say about the claims."""
    (plant, observer), claims = design.linear, design.certificate.claims
    dt = plant.dt
    yield stability_row(observer.Az, factor, dt, "Share Pasand, eq. (7)")
    claimed = [complex(*row) for row in poles]
    slowest = numbers(sorted(claimed, key=lambda pole: -pole.real))[:LISTED_POLES]
    yield upper_bound_check(
        "poles",
        "the eigenvalues of Ahat are the claimed ones, each within this share of its size",
        _missed(observer, claimed),
        SPECTRUM_TOLERANCE,
        source="Share Pasand, procedure 1, step 7",
        detail="slowest " + ", ".join(slowest) if slowest else "none",
    )
    if "decay" in claims:
        yield decay_row(observer, claims["decay"])
    yield from _digits_rows(observer.Az, dt, claimed, claims)


def _digits_rows(ahat: FloatArray, dt: float, poles: list[complex], claims: Mapping[str, float]) -> Iterator[Check]:
    """Yield in how many digits Ahat has to be kept: as many as are commonly printed, or more where that is claimed."""
    wanted = claims.get("digits", PRINTED_DIGITS)
    digits = int(wanted) if 1 <= wanted <= DOUBLE_DIGITS else 1
    rounded = as_printed(ahat, digits)
    values, bound = eigenvalues(rounded), 1.0 if dt > 0.0 else 0.0
    found = abscissa_of(values, dt)
    yield Check(
        "stable with the claimed digits" if "digits" in claims else f"stable with {PRINTED_DIGITS} digits",
        f"Ahat rounded to {digits} significant digits is still stable (strictly below the bound)",
        found,
        bound,
        bound - found,
        bool(found < bound),
        "ours: gains of high-order placements do not keep their poles when they are printed with few digits",
    )
    yield information(
        "digits needed",
        "significant digits of Ahat with which every mode stays stable",
        float(digits_needed(ahat, dt)),
        source="recomputed eigenvalues",
        detail=f"with {digits} digits poles move by {mean_miss(values, poles, dt):.1e} of their size",
    )


def _missed(observer: LinearObserver, claimed: list[complex]) -> float:
    """Return by how much the claimed poles are missed, groups by their means; more digits tell ill-conditioned ones."""
    a, dt, values = observer.Az, observer.dt, poles_of(observer)
    missed = farthest_pole(values, claimed, dt)
    if missed > SPECTRUM_TOLERANCE and len(claimed) == len(a) and (enclosed := enclosed_eigenvalues(a)) is not None:
        return farthest_pole([middle_of(ball) for ball in enclosed], claimed, dt)
    return missed if missed > SPECTRUM_TOLERANCE else mean_miss(values, claimed, dt)


def noise_rows(design: ObserverDesign) -> Iterator[Check]:
    """Yield how much noise reaches the fault estimates."""
    (plant, observer), claims = design.linear, design.certificate.claims
    rows = observer.Cz[observer.fault_rows]
    direct = observer.Dy[observer.fault_rows]
    discrete = float(plant.dt > 0.0)
    unit = certain_noise_covariance(observer.Az, observer.By, rows, discrete * direct, plant.dt)
    if "noise_amplification" in claims:
        largest = float(np.sqrt(np.max(np.maximum(np.diag(unit), 0.0), initial=0.0)))
        yield upper_bound_check(
            "noise amplification",
            "H2 norm from white noise on every output to a fault estimate is at most the claimed one",
            largest,
            claims["noise_amplification"] * (1.0 + POLE_CLAIM_TOLERANCE),
            source="recomputed, Lyapunov equation",
            detail="outputs in their own units"
            + ("" if plant.dt else "; times the root of the sample time in s")
            + (f"; besides, y enters fhat directly by {largest_singular_value(direct):.3g}" if direct.any() else ""),
        )
    elif np.any(np.isnan(unit)):
        text = "H2 norm from white noise on every output to a fault estimate"
        yield information("noise amplification", text, np.nan, source="recomputed, Lyapunov equation", detail=UNCERTAIN)
    if not plant.nw:
        return
    tracking = design.certificate.matrices["tracking"][:, : plant.nx]
    entering = tracking @ plant.Bw - observer.By @ plant.Dw
    stated = certain_noise_covariance(observer.Az, entering, rows, discrete * (direct @ plant.Dw), plant.dt)
    for name, variance in zip(plant.fault_names, np.diag(stated), strict=True):
        yield information(
            f"noise in fhat[{name}]",
            "standard deviation of the fault estimate under the stated noise"
            + ("" if plant.dt else ", for a sample time of 1 s (times its root for others)"),
            float(np.sqrt(variance)),
            source="recomputed, Lyapunov equation",
            detail=UNCERTAIN if np.isnan(variance) else plant.units.get(name, ""),
        )


def gain_rows(
    gains: Mapping[str, FloatArray],
    plant: DescriptorSystem,
    observer: LinearObserver,
    model: Exosystem,
    tracking: FloatArray,
    tolerance: float,
) -> Iterator[Check]:
    """Yield the row on the listed gains; nothing where none are listed, as the realisation stands for itself."""
    if not gains:
        return
    found, unknown = [], sorted(set(gains) - set(_shapes(plant, observer, model)))
    for letter, shape in _shapes(plant, observer, model).items():
        if letter in gains and (gains[letter].shape != shape or not np.all(np.isfinite(gains[letter]))):
            unknown.append(letter)
    if not unknown:
        found = list(_residuals(gains, plant, observer, model, tracking))
    missed = worst(found) if found else Residual(1.0 if unknown else 0.0, 1.0)
    claim = "the letters are known, and those of the realisation, the fault model and the certificate"
    row = equality("gains", claim, missed, "Share Pasand, eqs. (4), (12), (19), (20)", bound=tolerance)
    yield row if not unknown else Check(**{**row.__dict__, "detail": f"wrong: {', '.join(unknown)}"})


def _shapes(plant: DescriptorSystem, observer: LinearObserver, model: Exosystem) -> dict[str, tuple[int, int]]:
    nx, ny, nz, count = plant.nx, plant.ny, observer.order, model.order
    return {
        "U_a": (nz, nz),
        "D_a": (nz, ny),
        "K_a": (nz, ny),
        "Ahat": (nz, nz),
        "Bhat": (nz, ny),
        "Jhat": (nz, plant.nu),
        "U": (nx, nx),
        "D": (nx, ny),
        "K": (nx, ny),
        "F": (count, ny),
        "Hhat": (nx, plant.nf),
        "Phi": (count, count),
        "Cw": (plant.nf, count),
    }


def _residuals(
    gains: Mapping[str, FloatArray],
    plant: DescriptorSystem,
    observer: LinearObserver,
    model: Exosystem,
    tracking: FloatArray,
) -> Iterator[Residual]:
    """Yield, for every letter that is listed, how far it is from what it stands for."""
    nx, count = plant.nx, observer.order
    augmented = AugmentedPlant.of(plant, model)
    same = {"U_a": tracking, "Ahat": observer.Az, "Bhat": observer.By, "Phi": model.Phi, "Cw": model.Cw}
    whole = {"U": ("U_a", slice(0, nx), slice(0, nx)), "D": ("D_a", slice(0, nx), slice(None))}
    whole |= {"K": ("K_a", slice(0, nx), slice(None)), "F": ("K_a", slice(nx, count), slice(None))}
    for letter, matrix in same.items():
        if letter in gains:
            yield _same(gains[letter], matrix)
    for letter, (name, rows, columns) in whole.items():
        if letter in gains and name in gains:
            yield _same(gains[letter], gains[name][rows, columns])
    if "Hhat" in gains and "U" in gains:
        yield residual(gains["Hhat"], -gains["U"] @ plant.Bf, factors=((gains["U"], plant.Bf),))
    if "Jhat" in gains:
        yield residual(gains["Jhat"], -observer.Bu, -observer.By @ plant.D, factors=((observer.By, plant.D),))
    if "D_a" in gains:
        # The estimates are read from z + D_a y.
        estimates = slice(0, nx + plant.nf)
        shown = np.vstack([np.eye(nx, count), np.hstack([np.zeros((plant.nf, nx)), model.Cw])])
        yield residual(observer.Dy[estimates], -shown @ gains["D_a"], factors=((shown, gains["D_a"]),))
        yield from _injection(gains, augmented, observer)


def _injection(
    gains: Mapping[str, FloatArray], augmented: AugmentedPlant, observer: LinearObserver
) -> Iterator[Residual]:
    if "K_a" not in gains:
        return
    terms = ((observer.Az, gains["D_a"]), (augmented.A, gains["D_a"]))
    yield residual(observer.By, -observer.Az @ gains["D_a"], -gains["K_a"], factors=terms)


def _same(listed: FloatArray, matrix: FloatArray) -> Residual:
    if not listed.size:
        return Residual(0.0, 1.0)
    missed = np.abs(listed - matrix)
    size = np.maximum(np.abs(listed), np.abs(matrix))
    place = np.unravel_index(
        int(np.argmax(np.where(missed > 0.0, missed / np.where(size > 0.0, size, 1.0), 0.0))), missed.shape
    )
    return Residual(float(missed[place]), float(size[place]) or 1.0)
