"""Checks of a PD observer, from the plant and the shipped realisation alone.

Source of the claims: Filasova, Krokavec, Serbak, Theorems 1 and 2, eqs. (26)-(41); decay, disk, norms and the matrix G
in the loop are ours.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from obsynth.analysis.existence.filasova import pd_observer_conditions
from obsynth.methods.pd_observer.certificate_proofs import fitting_claims, proof_rows, stacked_gains
from obsynth.methods.pd_observer.realisation import PdErrorSystem, solved, with_faults_as_states, with_sensor_noise
from obsynth.numerics.arrays import ComplexArray, FloatArray, largest_singular_value
from obsynth.numerics.norms import HinfNorm
from obsynth.numerics.ranks import RANK_TOLERANCE, rounding_rank
from obsynth.numerics.scaling import balanced_matrix
from obsynth.numerics.spectra import abscissa, abscissa_of, eigenvalues, pole_text
from obsynth.observers.linear.observer import LinearObserver
from obsynth.plants.descriptor import DescriptorSystem
from obsynth.plants.signal_names import listed
from obsynth.results.checks import Check, fitting_check, information, lower_bound_check, upper_bound_check
from obsynth.results.design import ObserverDesign
from obsynth.verification.error_system import ErrorModel, natural_scaling
from obsynth.verification.identities import ALIKE, equality, relative_tolerance, residual, tracking_identities, worst
from obsynth.verification.plant import condition_rows, plant_information

#: Eigenvalues that a row lists; the others are counted.
LISTED_EIGENVALUES = 8

_PD_IDENTITIES = {
    "dynamics": ("unbiased: dynamics", "Az + By C = A, with the faults as states", "Filasova et al., eq. (29)"),
    "inputs": ("unbiased: inputs", "Bu + By D = B", "Filasova et al., eq. (4)"),
    "state estimate": (
        "unbiased: estimates",
        "the estimates equal states and faults when the error is zero",
        "Filasova et al., eqs. (22), (23)",
    ),
    "residual": ("unbiased: residual", "the residual is zero when the error is", "ours: y - D u - C xhat - Df fhat"),
    "input feedthrough": (
        "unbiased: feedthrough",
        "the input has no direct effect on any estimate (Du + Dy D = 0)",
        "ours",
    ),
}

#: Norms of ``[J L]`` above this many times the norm of A are out of proportion to the plant, and worth a warning.
LARGE_GAIN = 1e2


def checks(design: ObserverDesign, printed_digits: int | None) -> Iterator[Check]:
    """Yield every check of ``design``; see `obsynth.verify`."""
    plant, observer = design.linear
    yield from plant_information(plant)
    yield from condition_rows(pd_observer_conditions(plant))
    fitting = _fits(plant, observer) and fitting_claims(design)
    yield fitting_check("observer, gains, certificate and plant have matching signals and shapes", fits=fitting)
    if not fitting:
        return
    tolerance = relative_tolerance(printed_digits, plant.nx + plant.nf + plant.ny)
    noisy = with_sensor_noise(plant)
    augmented = with_faults_as_states(noisy)
    # The faults are states of the augmented plant, so that their estimates are state estimates of it.
    as_states = replace(
        observer, state_names=augmented.state_names, fault_names=(), state_delays=(0,) * augmented.nx, fault_delays=()
    )
    for key, identity in tracking_identities(ErrorModel(augmented, as_states, np.eye(augmented.nx))).items():
        if key in _PD_IDENTITIES:
            name, claim, source = _PD_IDENTITIES[key]
            yield equality(name, claim, identity.residual(), source, bound=tolerance)
    errors = PdErrorSystem.of(augmented, observer, plant.nx)
    yield _gains_row(design, augmented, tolerance)
    yield from _spectra(design, errors)
    gain_j, gain_l = stacked_gains(design)
    # E* = [I 0; 0 0], A* = [0 I; A - J C, -(I + L C)]: impulse-free where the lower right block is nonsingular.
    moved, descriptor = augmented.A - gain_j @ augmented.C, np.eye(augmented.nx) + gain_l @ augmented.C
    impulse_free = rounding_rank(_balanced(descriptor)) == augmented.nx
    slowest = abscissa(_balanced(solved(descriptor, moved)), 0.0) if impulse_free else float("nan")
    yield _negative(
        "descriptor pair",
        "(E*, A*) of the listed gains is admissible: regular, impulse-free, stable",
        slowest,
        source="Filasova et al., eqs. (38), (39), Definition 1",
        detail=f"{augmented.nx} finite modes of {2 * augmented.nx}" if impulse_free else "I + L C is singular",
    )
    yield from proof_rows(design)
    yield from norm_rows(design, errors, noisy)


def _fits(plant: DescriptorSystem, observer: LinearObserver) -> bool:
    return bool(
        np.array_equal(plant.E, np.eye(plant.nx))
        and not plant.is_discrete
        and observer.order == plant.nx + plant.nf
        and observer.residual_names == plant.output_names
        and all(getattr(observer, name) == getattr(plant, name) for name in ALIKE)
        and not any((*observer.state_delays, *observer.fault_delays))
    )


def _negative(name: str, claim: str, value: float, *, source: str, detail: str) -> Check:
    """Return a check that passes when ``value < 0``; NaN fails."""
    return Check(name, claim, value, 0.0, -value, bool(value < 0.0), source, "computed", detail)


def _gains_row(design: ObserverDesign, augmented: DescriptorSystem, tolerance: float) -> Check:
    """Check that the listed gains are those of the realisation: ``S L = T`` and ``By = J + Az L``."""
    observer, (gain_j, gain_l) = design.linear[1], stacked_gains(design)
    estimate, direct = observer.Cz[: observer.order], observer.Dy[: observer.order]
    # A gain on an output in small units must not hide behind one on an output in large units.
    units = 1.0 / natural_scaling(augmented).outputs
    # S = I - T C is stored to rounding of T C, so S L is known to rounding of T C L.
    residuals = [
        residual(estimate @ gain_l, -direct, factors=((estimate, gain_l), (direct, augmented.C, gain_l)), units=units),
        residual(
            gain_j,
            observer.Az @ gain_l,
            -observer.By,
            factors=(
                (observer.Az, gain_l),
                (augmented.A, gain_l),
                (observer.By, augmented.C, gain_l),
                (gain_j, augmented.C, gain_l),
            ),
            units=units,
        ),
    ]
    return equality(
        "gains",
        "the realisation is that of the listed J, L, M, N (and G)",
        worst(residuals),
        "Filasova et al., eqs. (4)-(6), (31)",
        bound=tolerance,
    )


def _spectra(design: ObserverDesign, errors: PdErrorSystem) -> Iterator[Check]:
    plant, claims = design.linear[0], design.certificate.claims
    # The matrix maps states to states: in units that balance it, the condition number is that of the observer.
    singular_values = np.linalg.svd(_balanced(errors.estimate), compute_uv=False)
    largest, smallest = float(singular_values[0]), float(singular_values[-1])
    yield lower_bound_check(
        "det(I + L C)",
        "I + L C is nonsingular, so that the observer exists without derivatives",
        smallest / largest if largest > 0.0 else 0.0,
        RANK_TOLERANCE,
        source="Filasova et al., Remark 1",
        detail=f"inverse of its condition number; the determinant is {1.0 / np.linalg.det(errors.estimate):.6g}",
    )
    poles = _poles(errors.Az)
    slowest = abscissa_of(poles, 0.0)
    yield _negative(
        "error system",
        "every eigenvalue of the error system has a negative real part",
        slowest,
        source="Filasova et al., eq. (33)",
        detail=f"eigenvalues {spectrum_text(poles)}; computed, their proof is the row 'LMI'",
    )
    decay = claims["decay"]
    if decay > 0.0:
        yield upper_bound_check(
            "decay rate",
            "errors decay at the claimed rate (largest real part of an eigenvalue, 1/s)",
            slowest,
            -decay,
            source="ours: the theorem for A + alpha I",
        )
    if "disk_radius" in claims:
        centre, radius = claims["disk_centre"], claims["disk_radius"]
        distance = float(np.max(np.abs(poles + centre)))
        yield upper_bound_check(
            "disk",
            f"every eigenvalue of the error system lies within {radius:.6g} of {-centre:.6g}",
            distance,
            radius,
            source="ours",
        )
    yield from _parts(plant, errors)


def _balanced(matrix: FloatArray) -> FloatArray:
    return np.asarray(balanced_matrix(matrix)[0])


def _parts(plant: DescriptorSystem, errors: PdErrorSystem) -> Iterator[Check]:
    """Yield the two spectra that the paper prints besides; neither theorem says anything about the second."""
    nx = plant.nx
    proportional = plant.A - errors.J[:nx] @ plant.C
    together = _poles(solved(np.eye(nx) + errors.L[:nx] @ plant.C, proportional))
    apart = _poles(proportional)
    yield information(
        "state error alone",
        "spectral abscissa of (I + L C)^-1 (A - J C), 1/s",
        abscissa_of(together, 0.0),
        source="Filasova et al., eq. (28)",
        detail=f"eigenvalues {spectrum_text(together)}",
    )
    yield information(
        "proportional part alone",
        "spectral abscissa of A - J C, 1/s: neither theorem guarantees that it is negative",
        abscissa_of(apart, 0.0),
        source="Filasova et al., eq. (27)",
        detail=f"eigenvalues {spectrum_text(apart)}",
    )


def _poles(matrix: FloatArray) -> ComplexArray:
    """Return the eigenvalues of a matrix, NaN for one that is not finite."""
    return eigenvalues(matrix) if np.all(np.isfinite(matrix)) else np.full(len(matrix), np.nan, dtype=np.complex128)


def spectrum_text(values: ComplexArray) -> str:
    """Return eigenvalues as text, slowest first, conjugate pairs once."""
    if np.any(np.isnan(values)):
        return "not finite"
    ordered = sorted((complex(value) for value in values), key=lambda v: (-v.real, v.imag))
    texts = [pole_text(value, pair=True) for value in ordered if value.imag >= 0.0]
    return listed(texts, most=LISTED_EIGENVALUES)


def norm_rows(design: ObserverDesign, errors: PdErrorSystem, noisy: DescriptorSystem) -> Iterator[Check]:
    """Yield norms and gains: checks where a bound is claimed, else information; ``noisy``: the plant with noise."""
    plant, claims = design.linear[0], design.certificate.claims
    unit = "" if plant.nw else "unit noise on every output, as the plant states none"
    yield _norm_row(
        "fault rate in the fault estimate",
        "H-infinity norm from f' to the fault error, seconds",
        errors.fault_norm(errors.rate),
        claims.get("fault_rate_gain"),
    )
    yield _norm_row(
        "noise and its derivative in the fault estimate",
        "H-infinity norm from noise and its derivative, as free inputs, to the fault error",
        errors.separate_noise_norm(noisy.Bw, noisy.Dw),
        claims.get("noise_gain"),
        unit,
    )
    yield _norm_row(
        "noise in the fault estimate",
        "H-infinity norm from the noise to the fault error",
        errors.fault_norm(errors.noise),
        None,
        unit,
    )
    yield information(
        "fast noise in the fault estimate",
        "gain from the noise to the fault error at high frequencies",
        _size(errors.noise[1][plant.nx :]),
        source="recomputed",
        detail=unit,
    )
    if plant.nd:
        yield _norm_row(
            "disturbance in the fault estimate",
            "H-infinity norm from d to the fault error: d is not decoupled",
            errors.fault_norm(errors.disturbance),
            None,
        )
        yield _norm_row(
            "disturbance in the state estimate",
            "H-infinity norm from d to the state error",
            errors.state_norm(errors.disturbance),
            None,
        )
    yield from _gain_rows(design, errors)


def _norm_row(name: str, claim: str, norm: HinfNorm, bound: float | None, note: str = "") -> Check:
    peak = f"peak at {norm.frequency:.4g} rad/s"
    detail = f"{peak}; {note}" if note else peak
    if bound is None:
        return information(name, claim, norm.upper, source="recomputed", detail=detail)
    return upper_bound_check(name, f"{claim}: at most as claimed", norm.upper, bound, source="ours", detail=detail)


def _gain_rows(design: ObserverDesign, errors: PdErrorSystem) -> Iterator[Check]:
    claims = design.certificate.claims
    gain = _size(np.hstack([errors.J, errors.L]))
    if "gain_bound" in claims:
        yield upper_bound_check(
            "gain bound",
            "norm of [J L], with the rows of M and N: at most as claimed",
            gain,
            claims["gain_bound"],
            source="ours",
        )
    large = not gain <= LARGE_GAIN * max(_size(design.linear[0].A), 1.0)
    warning = (
        "WARNING: the gain is very large for this plant: it multiplies every error of the model and the "
        "sensors. Ask for a slower decay."
    )
    claim = "spectral norm of [J L], with the rows of M and N"
    yield information("gain", claim, gain, source="recomputed", detail=warning if large else "")


def _size(matrix: FloatArray) -> float:
    if not np.all(np.isfinite(matrix)):
        return float("inf")
    return largest_singular_value(matrix)
