"""The letters of the gain set beside the realisation: what is listed must be what is shipped.

Source: Share Pasand, Aliyari, Taghirad, eqs. (4), (12), (19), (20).
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping

import numpy as np

from obsynth.methods.ui_pi_observer.augmented_plant import AugmentedPlant
from obsynth.numerics.arrays import FloatArray
from obsynth.observers.linear.observer import LinearObserver
from obsynth.plants.descriptor import DescriptorSystem
from obsynth.plants.exosystems import Exosystem
from obsynth.results.checks import Check
from obsynth.verification.identities import Residual, equality, residual, worst


def gain_rows(
    gains: Mapping[str, FloatArray], plant: DescriptorSystem, observer: LinearObserver, model: Exosystem,
    tracking: FloatArray, tolerance: float,
) -> Iterator[Check]:  # fmt: skip
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
        "U_a": (nz, nz), "D_a": (nz, ny), "K_a": (nz, ny), "Ahat": (nz, nz), "Bhat": (nz, ny), "Jhat": (nz, plant.nu),
        "U": (nx, nx), "D": (nx, ny), "K": (nx, ny), "F": (count, ny), "Hhat": (nx, plant.nf), "Phi": (count, count),
        "Cw": (plant.nf, count),
    }  # fmt: skip


def _residuals(
    gains: Mapping[str, FloatArray], plant: DescriptorSystem, observer: LinearObserver, model: Exosystem,
    tracking: FloatArray,
) -> Iterator[Residual]:  # fmt: skip
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
