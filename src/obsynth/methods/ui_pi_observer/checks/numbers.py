"""Numbers of a shipped observer, recomputed: stability, poles, rates, digits, noise."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from obsynth.methods.ui_pi_observer.pencils import numbers
from obsynth.numerics.arrays import FloatArray
from obsynth.numerics.spectra import (
    MOST_SCATTER,
    SCATTER,
    abscissa,
    certain_noise_covariance,
    decay_rates,
    eigenvalues,
    lost_poles,
    spectrum_error,
)
from obsynth.proofs.contraction import prove_contraction
from obsynth.results.design import ObserverDesign
from obsynth.results.report import Check, information, upper_bound_check
from obsynth.verification.certificates import prove_stable
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
        "the eigenvalues of Ahat are the claimed ones",
        max(spectrum_error(observer.Az, claimed, dt), lost_poles(observer.Az, claimed, dt)),
        SPECTRUM_TOLERANCE,
        source="Share Pasand, procedure 1, step 7",
        detail="means are compared for multiple poles, and none may be further than rounding scatters such a group; "
        + _some(claimed),
    )
    if "decay" in claims:
        yield _decay_row(observer.Az, dt, claims["decay"])
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


def _decay_row(a: FloatArray, dt: float, claimed: float) -> Check:
    """Return the row on the claimed decay, proved for all but the last `CLAIM_TOLERANCE` of it where that can be."""
    rates = decay_rates(eigenvalues(a), dt)
    slowest = float(np.min(rates, initial=np.inf))
    wanted = claimed - CLAIM_TOLERANCE * abs(claimed)
    proof = None
    if wanted > 0.0 and np.isfinite(wanted):
        proof = prove_contraction(a, discrete=dt > 0.0, rate=float(np.exp(-wanted * dt)) if dt > 0.0 else wanted)
    proved = proof is not None or not len(a)
    bound = wanted if proved else wanted - _scatter(rates, slowest)
    slow = f"slowest time constant {1.0 / slowest:.3g} s" if slowest > 0.0 else ""
    shown = f"proved for {wanted:.6g} 1/s" if proved else "computed: a multiple pole, which rounding scatters"
    return Check(
        "decay", "every mode decays at the claimed rate (1/s) or faster", max(slowest, wanted) if proved else slowest,
        bound, max(slowest, wanted) - bound if proved else slowest - bound, bool(proved or slowest >= bound),
        "Lyapunov inequality, shifted by the rate" if proved else "recomputed eigenvalues",
        "proved" if proved else "computed", "; ".join(part for part in (slow, shown) if part),
    )  # fmt: skip


def _scatter(rates: FloatArray, slowest: float) -> float:
    """Return how far rounding scatters the slowest rate when that many of the rates that are there lie as close."""
    largest = 0.0
    for count in range(2, len(rates) + 1):
        reach = float(abs(slowest) * SCATTER ** (1.0 / count))
        if int(np.sum(np.abs(rates - slowest) <= 2.0 * reach)) >= count:
            largest = min(reach, MOST_SCATTER * abs(slowest))
    return largest


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
