"""Whether what a constant's error does can be told from the faults: the exact test of robust.md, section 5."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from obsynth.analysis.zeros import zeros_of_system
from obsynth.errors import ObsynthError
from obsynth.numerics.arrays import FloatArray
from obsynth.numerics.ranks import DIRECTION_SHARE
from obsynth.plants.descriptor import DescriptorSystem
from obsynth.plants.uncertainty import matrices_of
from obsynth.tolerances.exact_plant import is_sampled


@dataclass(frozen=True)
class Told:
    """Whether a constant acts where a fault does (``shares``), or an observer exists that its effect does not disturb."""

    shares: bool
    separable: bool
    reason: str = ""


def told_from_faults(plant: DescriptorSystem) -> dict[str, Told]:
    """Return the verdict for each constant with a tolerance, from the plant as written; empty without faults.

    Decoupling exists where the pencil from faults and directions to outputs has full normal rank and stable zeros.
    """
    uncertain = plant.uncertainty
    if uncertain is None or not plant.nf:
        return {}
    numbers = matrices_of(plant) if uncertain.written is None else uncertain.written
    affine = uncertain.affine(numbers, uncertain.box)
    dt = 0.0 if is_sampled(uncertain.steps) else plant.dt
    found = {}
    for i, name in enumerate(uncertain.box.names):
        # What multiplies the same signal stands in one column: derivative of the state, state, u, f, d.
        zero = np.zeros((plant.ny, len(numbers["A"])))
        above = [affine[key].parts[i] for key in ("E", "A", "B", "Bf", "Bd")]
        below = [zero, *(affine[key].parts[i] for key in ("C", "D", "Df", "Dd"))]
        found[name] = _told(numbers, _range(np.vstack([np.hstack(above), np.hstack(below)])), dt)
    return found


def _told(matrices: Mapping[str, FloatArray], directions: FloatArray, dt: float) -> Told:
    faults = np.vstack([matrices["Bf"], matrices["Df"]])
    both = np.hstack([faults / np.linalg.norm(faults, axis=0), directions])
    if np.linalg.matrix_rank(both, tol=DIRECTION_SHARE) < both.shape[1]:
        return Told(True, False, "it acts where a fault acts")
    n = len(matrices["A"])
    try:
        zeros, _, outside = zeros_of_system(
            matrices["E"], matrices["A"], np.hstack([matrices["Bf"], directions[:n]]), matrices["C"],
            np.hstack([matrices["Df"], directions[n:]]), dt=dt,
        )  # fmt: skip
    except ObsynthError as error:
        return Told(False, False, str(error))
    if zeros.normal_rank < n + both.shape[1]:
        return Told(False, False, "the outputs are too few to tell it from the faults")
    if outside:
        return Told(False, False, f"there is a zero at {complex(outside[0].value):.4g}, which is not stable")
    return Told(False, True)


def _range(effects: FloatArray) -> FloatArray:
    """Return unit columns that span what a constant does to equations and outputs."""
    left, values, _ = np.linalg.svd(effects)
    return np.asarray(left[:, : int(np.sum(values > DIRECTION_SHARE * max(values[0], np.finfo(np.float64).tiny)))])
