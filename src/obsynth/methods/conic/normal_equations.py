"""The normal equations of an interior-point method, which become ever more singular towards the solution."""

from __future__ import annotations

import numpy as np

from obsynth.numerics.arrays import FloatArray

#: Relative shifts of the diagonal, tried in turn, that let a matrix through which rounding has made indefinite.
SHIFTS = (0.0, 1e-15, 1e-14, 1e-13, 1e-12, 1e-11)
REFINEMENTS = 2


class NormalEquations:
    """``G'G x = r``, by a Cholesky factorisation in units of the diagonal.

    Fields: columns: The columns of G, as rows: ``(n, m)``.
    """

    def __init__(self, columns: FloatArray) -> None:
        from scipy.linalg import cho_factor

        self._columns = columns
        matrix = columns @ columns.T
        self._unit = 1.0 / np.sqrt(np.maximum(np.diag(matrix), np.finfo(np.float64).tiny))
        matrix *= np.outer(self._unit, self._unit)
        if not np.all(np.isfinite(matrix)):
            raise np.linalg.LinAlgError("the normal equations are not finite")
        for shift in SHIFTS:
            try:
                self._factor = cho_factor(matrix + shift * np.eye(len(matrix)), overwrite_a=True, check_finite=False)
                return
            except np.linalg.LinAlgError:
                continue
        raise np.linalg.LinAlgError("the normal equations are not positive definite")

    def solution(self, right: FloatArray) -> FloatArray:
        """Return the solution ``(n,)``, refined with the columns themselves."""
        found = np.zeros_like(right)
        for _ in range(1 + REFINEMENTS):
            found = found + self._solved(right - self._columns @ (self._columns.T @ found))
        return found

    def _solved(self, right: FloatArray) -> FloatArray:
        from scipy.linalg import cho_solve

        return np.asarray(self._unit * cho_solve(self._factor, self._unit * right, check_finite=False))
