"""Pencils and null vectors of plants with unknown inputs."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from obsynth.numerics.arrays import FloatArray
from obsynth.numerics.ranks import RANK_TOLERANCE, decide_rank
from obsynth.numerics.scaling import equilibrate_pencil
from obsynth.plants.descriptor import DescriptorSystem

#: At most this many signals of a kind are named in a failed condition.
MOST_NAMES = 4
#: An imaginary part below this share of an eigenvalue is not shown: it would not change its printed digits.
UNSEEN = 5e-7


def number(value: complex) -> str:
    """Return a real or complex eigenvalue as text, a pair by its upper half."""
    return f"{value.real:.6g}" if _looks_real(value) else f"{value.real:.6g} +- {abs(value.imag):.6g}j"


def numbers(values: Iterable[complex]) -> list[str]:
    """Return eigenvalues as text, each pair once: one that rounding has made of a double real one as two numbers."""
    listed = [complex(value) for value in values]
    return [number(value) for value in listed if value.imag >= 0.0 or _looks_real(value)]


def _looks_real(value: complex) -> bool:
    return abs(value.imag) <= UNSEEN * abs(value)


def instability(value: complex, dt: float) -> float:
    """Return how unstable an eigenvalue is: its modulus, or its real part for ``dt == 0``."""
    return abs(value) if dt > 0.0 else value.real


def independent_disturbances(plant: DescriptorSystem) -> tuple[FloatArray, FloatArray]:
    """Return ``[Bd; Dd]`` as a basis of its range: repeated disturbances would make every rank too low."""
    whole = np.vstack([plant.Bd, plant.Dd])
    rank = decide_rank(whole).rank
    if rank == plant.nd:
        return plant.Bd, plant.Dd
    left = np.linalg.svd(whole, full_matrices=False)[0][:, :rank]
    return left[: plant.nx], left[plant.nx :]


def in_disturbances(
    plant: DescriptorSystem, inputs: FloatArray, direct: FloatArray, direction: NDArray[Any]
) -> FloatArray:
    """Return the size of each disturbance in a combination of independent ones."""
    whole, basis = np.vstack([plant.Bd, plant.Dd]), np.vstack([inputs, direct])
    return np.abs(np.linalg.pinv(whole) @ (basis @ direction)) if whole.size else np.zeros(0)


def system_pencil(
    e: FloatArray, a: FloatArray, b: FloatArray, c: FloatArray, d: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Return the pencil ``[A - s E, B; C, D]`` as its two matrices."""
    padded = np.zeros((e.shape[0] + c.shape[0], e.shape[1] + b.shape[1]))
    padded[: e.shape[0], : e.shape[1]] = e
    return padded, np.block([[a, b], [c, d]])


def kernel(matrix: NDArray[Any]) -> NDArray[Any]:
    """Return an orthonormal basis of the null space."""
    _, values, right = np.linalg.svd(matrix)
    rank = int(np.sum(values > RANK_TOLERANCE * max(float(values[0]), 1.0))) if values.size else 0
    return np.asarray(right[rank:].conj().T)


def equilibrated(matrix: NDArray[Any]) -> tuple[NDArray[Any], FloatArray]:
    """Return a complex matrix with rows and columns scaled by powers of two, and the factors of the columns."""
    size = np.abs(matrix)
    pencil = equilibrate_pencil(np.zeros_like(size), size)
    return pencil.rows[:, None] * matrix * pencil.columns, pencil.columns
