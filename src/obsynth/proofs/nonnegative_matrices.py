"""Proved bounds for nonnegative matrices: the spectral radius, a positive vector, and the inverse of ``I - M``.

A vector ``w > 0`` with ``M w <= rho w`` proves that the spectral radius is at most rho (Collatz and Wielandt).
"""

from __future__ import annotations

import numpy as np

from obsynth.numerics.arrays import FloatArray
from obsynth.numerics.scaling import balanced_matrix
from obsynth.proofs.balls import UNIT_ROUNDOFF, gamma, rounded_up

#: Added to a matrix, as a share of its largest entry, so that it has a positive eigenvector.
_SHIFTS = (1e-4, 1e-7, 1e-10, 1e-13)

#: An inverse with a larger residual gives no bound.
_LARGEST_INVERSE_RESIDUAL = 0.5


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
    if not values.any():
        return 0.0, np.ones(size)
    best, at = _positive_vector(values)
    if best < 1.0:
        return best, at
    # The shift of a matrix hides small entries; after balancing they are as large as the others.
    scaled, units = balanced_matrix(values)
    vector = units * _positive_vector(np.abs(scaled))[1]
    quotient = _largest_quotient(values, vector)
    return (quotient, vector) if quotient < best else (best, at)


def _positive_vector(values: FloatArray) -> tuple[float, FloatArray]:
    """Return ``rho`` and ``w`` for a nonnegative matrix in its own units, from eigenvectors of shifted matrices."""
    size, tiny, largest = len(values), np.finfo(np.float64).tiny, float(values.max())
    best, at = np.inf, np.ones(size)
    for shift in _SHIFTS:
        eigenvalues, vectors = np.linalg.eig(values + shift * largest)
        vector = np.abs(vectors[:, int(np.argmax(eigenvalues.real))].real) + tiny
        vector = vector / vector.max() + tiny
        quotient = _largest_quotient(values, vector)
        if quotient < best:
            best, at = quotient, vector
    return best, at


def _largest_quotient(values: FloatArray, vector: FloatArray) -> float:
    """Return an upper bound on the largest entry of ``values @ vector / vector``."""
    with np.errstate(over="ignore", invalid="ignore", divide="ignore"):
        quotients = rounded_up(values @ vector, len(values) + 3) / vector
    largest = float(np.max(quotients)) * (1.0 + 4.0 * UNIT_ROUNDOFF)
    return largest if np.isfinite(largest) and np.all(vector > 0.0) else np.inf


def inverse_bound(matrix: FloatArray) -> FloatArray | None:
    """Return an entrywise upper bound of ``(I - |matrix|)^-1``; `None` unless the spectral radius is proved below 1."""
    values = np.abs(np.asarray(matrix, dtype=np.float64))
    size = len(values)
    if not size:
        return np.zeros((0, 0))
    radius, weights = positive_vector(values)
    if not radius < 1.0:
        return None
    # In units in which the row sums are below one, the residual of a computed inverse has a norm below one.
    scaled = values * weights / weights[:, None]
    near = np.abs(np.linalg.inv(np.eye(size) - scaled))
    residual = np.abs(np.eye(size) - (near - scaled @ near))
    residual = residual + gamma(2 * size + 8) * (near + scaled @ near)
    norm = float(rounded_up(residual.sum(axis=1), size + 4).max())
    if not norm < _LARGEST_INVERSE_RESIDUAL:
        return None
    # inverse = near (I - residual)^-1 = near (I + residual + ...); no row sum of residual^k exceeds norm^k.
    more = norm / (1.0 - norm) * near.sum(axis=1, keepdims=True)
    bound = rounded_up(near + more, 2 * size + 8) * (1.0 + 8.0 * UNIT_ROUNDOFF)
    return np.asarray(bound * weights[:, None] / weights * (1.0 + 8.0 * UNIT_ROUNDOFF))
