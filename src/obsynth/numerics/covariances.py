"""Square roots of covariance matrices, singular ones included."""

from __future__ import annotations

import numpy as np

from obsynth.errors import SpecError
from obsynth.numerics.arrays import FloatArray
from obsynth.numerics.ranks import DEFINITENESS_TOLERANCE, SYMMETRY_TOLERANCE, rounding_rank


def covariance_factor(covariance: FloatArray, name: str) -> FloatArray:
    """Return ``F (n, n)`` with ``F F' = covariance``; zero variances and singular matrices are allowed.

    The factor is taken of the correlation matrix, so that variances of 1e-30 beside 1 keep all their digits.
    """
    if covariance.ndim != 2 or covariance.shape[0] != covariance.shape[1]:
        raise SpecError(f"{name} has shape {covariance.shape}: a covariance must be square.", path=name)
    diagonal = np.diag(covariance)
    if not np.any(covariance - np.diag(diagonal)) and np.all(diagonal >= 0.0):
        return np.diag(np.sqrt(diagonal))
    deviations = np.sqrt(np.maximum(diagonal, 0.0))
    bounds = np.outer(deviations, deviations)
    worst = np.unravel_index(
        int(np.argmax(np.abs(covariance - covariance.T) - SYMMETRY_TOLERANCE * bounds)), bounds.shape
    )
    if abs(covariance[worst] - covariance.T[worst]) > SYMMETRY_TOLERANCE * bounds[worst]:
        i, j = int(worst[0]) + 1, int(worst[1]) + 1
        raise SpecError(
            f"{name} is not symmetric: entry ({i}, {j}) is {covariance[worst]:.6g}, entry ({j}, {i}) is "
            f"{covariance.T[worst]:.6g}.", path=name,
        )  # fmt: skip
    zero = bounds == 0.0
    if np.any(diagonal < 0.0) or np.any(covariance[zero]):
        raise SpecError(f"{name} is no covariance: it has a negative variance, or a covariance with a signal that has "
                        "none.", path=name)  # fmt: skip
    scale = np.where(deviations > 0.0, deviations, 1.0)
    correlation = 0.5 * (covariance + covariance.T) / np.outer(scale, scale)
    try:
        return np.asarray(deviations[:, None] * np.linalg.cholesky(correlation + np.diag(1.0 * (deviations == 0.0))))
    except np.linalg.LinAlgError:
        values, vectors = np.linalg.eigh(correlation)
    if values[0] < -DEFINITENESS_TOLERANCE * len(values):
        raise SpecError(
            f"{name} is not positive semidefinite: its correlation matrix has the eigenvalue {values[0]:.3g}.",
            path=name,
        )
    return np.asarray(scale[:, None] * vectors * np.sqrt(np.maximum(values, 0.0)))


def is_definite(covariance: FloatArray, factor: FloatArray) -> bool:
    """Return whether a covariance is positive definite, judged by its correlations so that units do not matter.

    Shapes: ``covariance (n, n)``.
    """
    variances = np.diag(covariance)
    if not np.all(variances > 0.0):
        return False
    return not len(factor) or bool(rounding_rank(factor / np.sqrt(variances)[:, None]) == len(factor))
