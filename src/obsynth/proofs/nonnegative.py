"""Nonnegative matrices: proved bounds of the spectral radius, of ``(I - M)^-1``, and of sums of powers."""

from __future__ import annotations

import numpy as np

from obsynth.numerics.arrays import FloatArray
from obsynth.proofs.balls import UNIT_ROUNDOFF, gamma, rounded_up

#: What is added to a matrix, as a share of its largest entry, so that it has a positive eigenvector.
_SHIFTS = (1e-4, 1e-7, 1e-10, 1e-13)
#: The inverse is given up where its residual is larger.
_LARGEST_RESIDUAL = 0.5


def spectral_radius_bound(matrix: FloatArray) -> float:
    """Return an upper bound of the spectral radius of ``|matrix|``: a quotient of Collatz and Wielandt, rounded up."""
    return positive_vector(matrix)[0]


def positive_vector(matrix: FloatArray) -> tuple[float, FloatArray]:
    """Return ``rho`` and ``w > 0`` with ``|matrix| w <= rho w`` proved; rho is near the spectral radius."""
    values = np.abs(np.asarray(matrix, dtype=np.float64))
    size = len(values)
    if not size:
        return 0.0, np.zeros(0)
    if not np.isfinite(values).all():
        return np.inf, np.ones(size)
    best, at = np.inf, np.ones(size)
    largest = float(values.max())
    if largest == 0.0:
        return 0.0, at
    for shift in _SHIFTS:
        eigenvalues, vectors = np.linalg.eig(values + shift * largest)
        vector = np.abs(vectors[:, int(np.argmax(eigenvalues.real))].real) + np.finfo(np.float64).tiny
        vector = vector / vector.max() + np.finfo(np.float64).tiny
        quotient = float(np.max(rounded_up(values @ vector, size + 3) / vector)) * (1.0 + 4.0 * UNIT_ROUNDOFF)
        if quotient < best:
            best, at = quotient, vector
    return best, at


def inverse_bound(matrix: FloatArray) -> FloatArray | None:
    """Return an entrywise upper bound of ``(I - |matrix|)^-1``; `None` unless the spectral radius is proved below 1."""
    values = np.abs(np.asarray(matrix, dtype=np.float64))
    size = len(values)
    if not size:
        return np.zeros((0, 0))
    radius, weights = positive_vector(values)
    if not radius < 1.0:
        return None
    # In units in which row sums are below one, the residual of a computed inverse shrinks what it is multiplied by.
    scaled = values * weights / weights[:, None]
    near = np.abs(np.linalg.inv(np.eye(size) - scaled))
    residual = np.abs(np.eye(size) - (near - scaled @ near))
    residual = residual + gamma(2 * size + 8) * (near + scaled @ near)
    norm = float(rounded_up(residual.sum(axis=1), size + 4).max())
    if not norm < _LARGEST_RESIDUAL:
        return None
    # inverse = near (I - residual)^-1 = near (I + residual + ...); no entry of residual^k is larger than norm^k.
    more = norm / (1.0 - norm) * near.sum(axis=1, keepdims=True)
    found = rounded_up(near + more, 2 * size + 8) * (1.0 + 8.0 * UNIT_ROUNDOFF)
    return np.asarray(found * weights[:, None] / weights * (1.0 + 8.0 * UNIT_ROUNDOFF))
