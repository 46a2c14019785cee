"""Uncertain constants whose effect on a plant cannot be told from that of a fault."""

from __future__ import annotations

import numpy as np

from obsynth.numerics.arrays import FloatArray
from obsynth.numerics.ranks import DIRECTION_SHARE
from obsynth.plants.descriptor import DescriptorSystem
from obsynth.plants.uncertainty import as_written


def acting_like_faults(plant: DescriptorSystem) -> tuple[str, ...]:
    """Return the uncertain constants that change equations and outputs in a direction of the faults.

    The plant is taken as written, before elimination and sampling.
    """
    uncertain = plant.uncertainty
    if uncertain is None or not plant.nf:
        return ()
    numbers = as_written(plant, uncertain)
    affine = uncertain.affine(numbers, uncertain.box)
    faults = np.vstack([numbers["Bf"], numbers["Df"]])
    names = []
    for i, name in enumerate(uncertain.box.names):
        # One block column for each signal that a constant multiplies: derivative of the state, state, u, f, d.
        zero = np.zeros((plant.ny, len(numbers["A"])))
        above = [affine[key].parts[i] for key in ("E", "A", "B", "Bf", "Bd")]
        below = [zero, *(affine[key].parts[i] for key in ("C", "D", "Df", "Dd"))]
        directions = _range(np.vstack([np.hstack(above), np.hstack(below)]))
        both = np.hstack([faults / np.linalg.norm(faults, axis=0), directions])
        if np.linalg.matrix_rank(both, tol=DIRECTION_SHARE) < both.shape[1]:
            names.append(name)
    return tuple(names)


def _range(effects: FloatArray) -> FloatArray:
    """Return an orthonormal basis of the range of a constant's effects on equations and outputs."""
    left_vectors, values, _ = np.linalg.svd(effects)
    return np.asarray(
        left_vectors[:, : int(np.sum(values > DIRECTION_SHARE * max(values[0], np.finfo(np.float64).tiny)))]
    )
