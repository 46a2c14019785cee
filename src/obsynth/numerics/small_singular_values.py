"""The smallest singular values of a large matrix, with their vectors: one QR factorisation and inverse iteration.

A full singular value decomposition of 600 columns takes ten times as long, and a decision about a rank at a known
point needs only the smallest values.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from obsynth.numerics.arrays import FloatArray

#: Matrices with fewer columns are decomposed as a whole.
FEW_COLUMNS = 80
#: Steps of inverse iteration: values that decide are smaller than the next by many digits, and each step squares that.
STEPS = 4


class SmallestSingular(NamedTuple):
    """``values (count,)``, smallest first, and ``right (n, count)``; ``largest`` is a bound on the largest value."""

    values: FloatArray
    right: NDArray[Any]
    largest: float


def smallest_singular(matrix: NDArray[Any], count: int = 1) -> SmallestSingular:
    """Return the smallest singular values of a matrix ``(m, n)``, ``m >= n``, with right singular vectors.

    What is returned for a value is the length of the matrix times a unit vector: never less than the smallest one.
    """
    if matrix.shape[1] < FEW_COLUMNS:
        _, values, right = np.linalg.svd(matrix)
        order = slice(None, -count - 1, -1)
        return SmallestSingular(values[order], right[order].conj().T, float(values[0]))
    from scipy.linalg import qr

    return iterated(np.asarray(qr(matrix, mode="r", check_finite=False)[0][: matrix.shape[1]]), count)


def iterated(triangle: NDArray[Any], count: int) -> SmallestSingular:
    """Return the smallest singular values of an upper triangular matrix by inverse iteration."""
    from scipy.linalg import solve_triangular

    size = triangle.shape[0]
    norm = float(np.sqrt(np.linalg.norm(triangle, 1) * np.linalg.norm(triangle, np.inf)))
    if norm == 0.0:
        return SmallestSingular(np.zeros(count), np.eye(size, count), 0.0)
    work = np.array(triangle)
    diagonal = np.einsum("ii->i", work)
    # An exact zero would be divided by: as small as rounding, it does as well.
    small = np.abs(diagonal) < np.finfo(float).eps * norm
    diagonal[small] = np.finfo(float).eps * norm
    basis = np.random.default_rng(0).normal(size=(size, count)).astype(work.dtype)
    with np.errstate(over="ignore", invalid="ignore"):
        for _ in range(STEPS):
            inner = solve_triangular(work, basis, trans="C", check_finite=False)
            inner /= np.max(np.abs(inner), axis=0, initial=0.0) + np.finfo(float).tiny
            basis = np.linalg.qr(solve_triangular(work, inner, check_finite=False))[0]
    _, values, turned = np.linalg.svd(triangle @ basis, full_matrices=False)
    return SmallestSingular(values[::-1], basis @ turned[::-1].conj().T, norm)
