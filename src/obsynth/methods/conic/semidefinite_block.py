"""Semidefinite matrices as vectors, and the scaling of a pair of them that interior-point methods work in."""

from __future__ import annotations

import numpy as np

from obsynth.numerics.arrays import FloatArray

#: Vectors are scaled in parts of about so many numbers.
PART = 1 << 22


class SemidefiniteBlock:
    """Two semidefinite matrices with their Nesterov-Todd scaling R: ``R^-1 S R^-T = R'ZR = diag(values)``.

    Stored are lower triangles, row by row, off-diagonal entries times sqrt(2), so that inner products are kept.
    """

    def __init__(self, order: int, first: int) -> None:
        self.order, self.size = order, order * (order + 1) // 2
        self.part = slice(first, first + self.size)
        self._rows, self._columns = np.tril_indices(order)
        self._places = order * self._rows + self._columns
        self._entries = np.empty((order, order), dtype=np.intp)
        self._entries[self._rows, self._columns] = self._entries[self._columns, self._rows] = np.arange(self.size)
        self._weights = np.where(self._rows == self._columns, 1.0, np.sqrt(2.0))
        self._factor = self._inverse = np.eye(order)
        self._values = np.ones(order)

    def vector(self, matrix: FloatArray) -> FloatArray:
        """Return matrices ``(..., order, order)`` as vectors."""
        flat = matrix.reshape(*matrix.shape[:-2], self.order**2)
        return np.asarray(np.take(flat, self._places, axis=-1) * self._weights)

    def matrix(self, vector: FloatArray) -> FloatArray:
        """Return vectors ``(..., size)`` as matrices."""
        return np.take(vector / self._weights, self._entries, axis=-1)

    def scaled(self, s: FloatArray) -> FloatArray:
        """Return directions of s ``(count, size)`` in the scaling; unknowns of other blocks have none."""
        found, length = np.zeros_like(s), max(1, PART // self.order**2)
        there = np.flatnonzero(np.any(s, axis=1))
        for first in range(0, len(there), length):
            part = there[first : first + length]
            found[part] = self.vector(self._inverse @ (self.matrix(s[part]) @ self._inverse.T))
        return found

    def centre(self) -> FloatArray:
        """Return what s and z are in the scaling."""
        return self.vector(np.diag(self._values))

    def points(self) -> tuple[FloatArray, FloatArray]:
        """Return s and z."""
        s = (self._factor * self._values) @ self._factor.T
        return self.vector(s), self.vector((self._inverse.T * self._values) @ self._inverse)

    def least(self, point: FloatArray) -> float:
        """Return the smallest eigenvalue."""
        return float(np.linalg.eigvalsh(self.matrix(point))[0])

    def longest_step(self, direction: FloatArray) -> float:
        """Return how far one can go from the centre."""
        roots = np.sqrt(self._values)
        worst = float(np.linalg.eigvalsh(self.matrix(direction) / np.outer(roots, roots))[0])
        return -1.0 / worst if worst < 0.0 else np.inf

    def corrected(self, ds: FloatArray, dz: FloatArray, target: float) -> FloatArray:
        """Return q with ``centre o q = target I - ds o dz`` (o the symmetrised product)."""
        both = self.matrix(ds) @ self.matrix(dz)
        value = self.vector(target * np.eye(self.order) - 0.5 * (both + both.T))
        return np.asarray(value / (0.5 * (self._values[self._rows] + self._values[self._columns])))

    def move(self, s: FloatArray, z: FloatArray) -> None:
        """Go to a new pair, given in the present scaling."""
        # With L2'L1 = U diag(new) V' the next scaling is R L1 V diag(new)^-1/2: S and Z are not formed again, which
        # keeps their small eigenvalues.
        first, second = np.linalg.cholesky(self.matrix(s)), np.linalg.cholesky(self.matrix(z))
        left, values, right = np.linalg.svd(second.T @ first)
        roots = np.sqrt(values)
        self._factor = self._factor @ (first @ right.T / roots)
        self._inverse = (left / roots).T @ second.T @ self._inverse
        self._values = values
