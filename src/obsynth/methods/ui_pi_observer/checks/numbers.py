"""Numbers of a shipped observer, recomputed: stability, poles, rates, digits, noise."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from obsynth.methods.ui_pi_observer.pencils import numbers
from obsynth.numerics.arrays import FloatArray
from obsynth.numerics.spectra import (
    abscissa,
    certain_noise_covariance,
    eigenvalues,
    farthest_pole,
    spectrum_error,
)
from obsynth.proofs.extended_balls import enclosed_eigenvalues, middle_of
from obsynth.results.checks import Check, information, upper_bound_check
from obsynth.results.design import ObserverDesign
from obsynth.verification.certificates import decay_row, prove_stable
from obsynth.verification.claims import UNCERTAIN

#: Recomputed poles may miss the claimed ones by this, relative to their size; claimed rates and norms likewise.
SPECTRUM_TOLERANCE = 1e-4
CLAIM_TOLERANCE = 1e-4
#: Significant digits with which gains are commonly printed in full: the observer must stay stable with them.
PRINTED_DIGITS = 9


def stability_rows(design: ObserverDesign, poles: FloatArray, factor: FloatArray) -> Iterator[Check]:
    """Yield the proof of stability, and what the eigenvalues say about the claims."""
    (plant, observer), claims = design.linear, design.certificate.claims
    dt = plant.dt
    proof = prove_stable(observer.Az, factor, dt)
    yield Check(
        "stability",
        "every error dies out: the Lyapunov inequality is positive definite",
        proof.lower_bound,
        0.0,
        proof.lower_bound,
        proof.proved,
        "Share Pasand, eq. (7)",
        "proved",
        proof.text,
    )
    claimed = [complex(*row) for row in poles]
    yield upper_bound_check(
        "poles",
        "the eigenvalues of Ahat are the claimed ones, each within this share of its size",
        _missed(observer.Az, claimed, dt),
        SPECTRUM_TOLERANCE,
        source="Share Pasand, procedure 1, step 7",
        detail=_some(claimed),
    )
    if "decay" in claims:
        yield decay_row(observer.Az, dt, claims["decay"])
    rounded = _rounded(observer.Az, PRINTED_DIGITS)
    bound = 1.0 if dt > 0.0 else 0.0
    found = abscissa(rounded, dt)
    yield Check(
        f"stable with {PRINTED_DIGITS} digits",
        f"Ahat rounded to {PRINTED_DIGITS} significant digits is still stable (strictly below the bound)",
        found,
        bound,
        bound - found,
        bool(found < bound),
        "ours: gains of high-order placements do not survive short printing",
    )
    yield information(
        "digits needed",
        "significant digits of Ahat with which every mode stays stable",
        float(_least_digits(observer.Az, dt)),
        source="recomputed eigenvalues",
        detail=f"with {PRINTED_DIGITS} digits poles move by {spectrum_error(rounded, claimed, dt):.1e} of their size",
    )


def _missed(a: FloatArray, claimed: list[complex], dt: float) -> float:
    """Return by how much the claimed poles are missed, groups by their means where no pole is missed itself.

    Of ill-conditioned poles more digits tell.
    """
    missed = farthest_pole(eigenvalues(a), claimed, dt)
    if missed > SPECTRUM_TOLERANCE and len(claimed) == len(a) and (enclosed := enclosed_eigenvalues(a)) is not None:
        return farthest_pole([middle_of(ball) for ball in enclosed], claimed, dt)
    return missed if missed > SPECTRUM_TOLERANCE else spectrum_error(a, claimed, dt)


def _some(poles: list[complex], most: int = 8) -> str:
    shown = numbers(sorted(poles, key=lambda pole: -pole.real))
    return "slowest " + ", ".join(shown[:most]) if shown else "none"


def _rounded(matrix: FloatArray, digits: int) -> FloatArray:
    """Return each entry as it is when printed with so many significant digits."""
    text = np.char.mod(f"%.{digits - 1}e", matrix)
    return np.asarray(text.astype(np.float64))


def _least_digits(matrix: FloatArray, dt: float) -> int:
    bound = 1.0 if dt > 0.0 else 0.0
    stable = [abscissa(_rounded(matrix, digits), dt) < bound for digits in range(1, 17)]
    return next((digits for digits in range(1, 17) if all(stable[digits - 1 :])), 17)


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
            claims["noise_amplification"] * (1.0 + CLAIM_TOLERANCE),
            source="recomputed, Lyapunov equation",
            detail="outputs in their own units" + ("" if plant.dt else "; times the root of the sample time in s")
            + (f"; besides, y enters fhat directly by {float(np.linalg.norm(direct, 2)):.3g}" if direct.any() else ""),
        )  # fmt: skip
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
