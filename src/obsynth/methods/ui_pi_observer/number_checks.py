"""Numbers of a shipped observer, recomputed: stability, poles, rates, digits, noise; and the letters of its gains."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence

import numpy as np

from obsynth.analysis.existence.augmented_pencils import AugmentedPlant, numbers
from obsynth.methods.ui_pi_observer.method import NOISE_AT_REST_ROW
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
from obsynth.observers.linear.modes import poles_of
from obsynth.observers.linear.observer import LinearObserver
from obsynth.plants.descriptor import DescriptorSystem
from obsynth.plants.faults import Exosystem
from obsynth.proofs.covariances import certain_noise_covariance
from obsynth.proofs.extended_balls import enclosed_eigenvalues, middle_of
from obsynth.results.checks import Check, information, upper_bound_check
from obsynth.results.design import ObserverDesign
from obsynth.verification.claims import UNCERTAIN, fault_noise_rows
from obsynth.verification.error_system import ErrorModel
from obsynth.verification.identities import Residual, equality, residual, worst
from obsynth.verification.inequalities import decay_row, stability_row

#: Recomputed poles may miss the claimed ones by this, relative to their size; claimed rates and norms likewise.
SPECTRUM_TOLERANCE = 1e-4

POLE_CLAIM_TOLERANCE = 1e-4

#: Letters that only an observer with a fault estimate apart from its state has: all of them, or none.
LETTERS_OF_PARTS = frozenset({"U", "D", "K", "F", "Hhat"})

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
    claimed_digits = claims.get("digits", PRINTED_DIGITS)
    digits = int(claimed_digits) if 1 <= claimed_digits <= DOUBLE_DIGITS else 1
    rounded = as_printed(observer.Az, digits)
    values, bound = eigenvalues(rounded), 1.0 if dt > 0.0 else 0.0
    largest = abscissa_of(values, dt)
    yield Check(
        "stable with the claimed digits" if "digits" in claims else f"stable with {PRINTED_DIGITS} digits",
        f"Ahat rounded to {digits} significant digits is still stable (strictly below the bound)",
        largest,
        bound,
        bound - largest,
        bool(largest < bound),
        "ours: gains of high-order placements do not keep their poles when they are printed with few digits",
    )
    yield information(
        "digits needed",
        "significant digits of Ahat with which every mode stays stable",
        float(digits_needed(observer.Az, dt)),
        source="recomputed eigenvalues",
        detail=f"with {digits} digits poles move by {mean_miss(values, claimed, dt):.1e} of their size",
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
    yield from fault_noise_rows(ErrorModel(plant, observer, design.certificate.matrices["tracking"][:, : plant.nx]))


def noise_at_rest_row(observers: Sequence[LinearObserver]) -> Check:
    """Return how much noise reaches a fault estimate at the vertex where that is most, while parameters rest there."""
    deviations = []
    for observer in observers:
        rows, direct = observer.Cz[observer.fault_rows], observer.Dy[observer.fault_rows]
        unit = certain_noise_covariance(observer.Az, observer.By, rows, float(observer.dt > 0.0) * direct, observer.dt)
        deviations.append(np.sqrt(np.maximum(np.diag(unit), 0.0)).max(initial=0.0))
    largest = float(np.max(deviations))  # NaN where one has no digits
    units = "outputs in their own units" + ("" if observers[0].dt else "; times the root of the sample time in s")
    return information(
        NOISE_AT_REST_ROW,
        "the largest H2 norm from white noise on every output to a fault estimate, at a vertex at which the parameters "
        "rest",
        largest,
        source="Lyapunov equation at every vertex",
        detail=UNCERTAIN if np.isnan(largest) else units,
    )


def gain_rows(
    gains: Mapping[str, FloatArray],
    plant: DescriptorSystem,
    observer: LinearObserver,
    model: Exosystem,
    tracking: FloatArray,
    tolerance: float,
    *,
    letters: frozenset[str] | None = None,
) -> Iterator[Check]:
    """Yield the row on the listed gains; nothing where none are listed, as the realisation stands for itself.

    ``letters`` are those that have to be listed: by default all of an observer of a linear plant.
    """
    if not gains:
        return
    shapes, residuals = _shapes(plant, observer, model), []
    expected = set(shapes) if set(gains) & LETTERS_OF_PARTS else set(shapes) - LETTERS_OF_PARTS
    expected = expected if letters is None else set(letters)
    wrong = sorted(set(gains) ^ expected)
    for letter, shape in shapes.items():
        if letter in gains and (gains[letter].shape != shape or not np.all(np.isfinite(gains[letter]))):
            wrong.append(letter)
    if not wrong:
        residuals = list(_residuals(gains, plant, observer, model, tracking))
    missed = worst(residuals) if residuals else Residual(1.0 if wrong else 0.0, 1.0)
    claim = "all letters are listed, and are those of the realisation, the fault model and the certificate"
    row = equality("gains", claim, missed, "Share Pasand, eqs. (4), (12), (19), (20)", bound=tolerance)
    yield row if not wrong else Check(**{**row.__dict__, "detail": f"wrong: {', '.join(wrong)}"})


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
    blocks = {"U": ("U_a", slice(0, nx), slice(0, nx)), "D": ("D_a", slice(0, nx), slice(None))}
    blocks |= {"K": ("K_a", slice(0, nx), slice(None)), "F": ("K_a", slice(nx, count), slice(None))}
    for letter, matrix in same.items():
        if letter in gains:
            yield _difference(gains[letter], matrix)
    for letter, (name, rows, columns) in blocks.items():
        if letter in gains and name in gains:
            yield _difference(gains[letter], gains[name][rows, columns])
    if "Hhat" in gains and "U" in gains:
        yield residual(gains["Hhat"], -gains["U"] @ plant.Bf, factors=((gains["U"], plant.Bf),))
    if "Jhat" in gains:
        yield residual(gains["Jhat"], -observer.Bu, -observer.By @ plant.D, factors=((observer.By, plant.D),))
    if "D_a" in gains:
        # The estimates are read from z + D_a y.
        estimates = slice(0, nx + plant.nf)
        estimate_map = np.vstack([np.eye(nx, count), np.hstack([np.zeros((plant.nf, nx)), model.Cw])])
        yield residual(observer.Dy[estimates], -estimate_map @ gains["D_a"], factors=((estimate_map, gains["D_a"]),))
        yield from _injection(gains, augmented, observer)


def _injection(
    gains: Mapping[str, FloatArray], augmented: AugmentedPlant, observer: LinearObserver
) -> Iterator[Residual]:
    if "K_a" not in gains:
        return
    terms = ((observer.Az, gains["D_a"]), (augmented.A, gains["D_a"]))
    yield residual(observer.By, -observer.Az @ gains["D_a"], -gains["K_a"], factors=terms)


def _difference(listed: FloatArray, matrix: FloatArray) -> Residual:
    if not listed.size:
        return Residual(0.0, 1.0)
    missed = np.abs(listed - matrix)
    size = np.maximum(np.abs(listed), np.abs(matrix))
    place = np.unravel_index(
        int(np.argmax(np.where(missed > 0.0, missed / np.where(size > 0.0, size, 1.0), 0.0))), missed.shape
    )
    return Residual(float(missed[place]), float(size[place]) or 1.0)
