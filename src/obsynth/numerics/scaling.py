"""Balancing by powers of two, exact in floating point."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from obsynth.numerics import lapack
from obsynth.numerics.arrays import FloatArray, read_only

#: Sweeps of the balancing; each one must improve on the last, so few are ever used.
MOST_SWEEPS = 10


@dataclass(frozen=True, eq=False)
class Scaling:
    """Powers of two for a plant: ``diag(equations) E diag(states)``, ``diag(outputs) C diag(states)`` and so on.

    ``equations (nx,)``, ``states (nx,)``, ``outputs (ny,)``; the plant's state is ``x = diag(states) z``.
    """

    equations: FloatArray
    states: FloatArray
    outputs: FloatArray

    def scale_dynamics(self, matrix: FloatArray) -> FloatArray:
        """Return ``E`` or ``A`` ``(nx, nx)`` of the scaled plant."""
        return self.equations[:, None] * matrix * self.states

    def scale_input(self, matrix: FloatArray) -> FloatArray:
        """Return an input-like matrix ``(nx, *)`` of the scaled plant."""
        return self.equations[:, None] * matrix

    def scale_output(self, matrix: FloatArray) -> FloatArray:
        """Return an output-like matrix ``(ny, nx)`` of the scaled plant."""
        return self.outputs[:, None] * matrix * self.states

    def scale_feedthrough(self, matrix: FloatArray) -> FloatArray:
        """Return a feedthrough matrix ``(ny, *)`` of the scaled plant."""
        return self.outputs[:, None] * matrix


@dataclass(frozen=True, eq=False)
class EquilibratedPencil:
    """The pencil ``diag(rows) (A - z E) diag(columns)``, its largest entries near one: ``E, A (m, n)``."""

    E: FloatArray
    A: FloatArray
    rows: FloatArray
    columns: FloatArray


def balancing_factors(matrix: FloatArray) -> FloatArray:
    """Return powers of two ``(n,)`` that balance a matrix ``(n, n)``: ``matrix * s / s[:, None]`` is balanced."""
    # Not by scipy's matrix_balance, which casts the factors to integers and warns where they are too large for that.
    if not matrix.size:
        return np.ones(len(matrix))
    return np.asarray(lapack.dgebal(np.asarray_chkfinite(matrix), scale=1, permute=0)[3], dtype=np.float64)


def balanced_matrix(matrix: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return a matrix balanced, and the factors ``s`` that did it, as `balancing_factors` has them."""
    factors = balancing_factors(matrix)
    return matrix * factors / factors[:, None], factors


def power_of_two_below(sizes: FloatArray) -> FloatArray:
    """Return the largest power of two not above each entry of ``sizes``; 1 where that is zero."""
    # frexp is exact where log2 is not, and floor leaves everything between 1 and 2 alone.
    _, exponents = np.frexp(sizes)
    return np.where(sizes > 0.0, np.ldexp(1.0, exponents - 1), 1.0)


def equilibrate_pencil(E: FloatArray, A: FloatArray) -> EquilibratedPencil:
    """Scale the rows, then the columns, of ``A - z E (m, n)`` by powers of two to largest entries in [1, 2).

    One pass is enough: scaling a column up cannot lift an entry above those that already rule their rows.
    """
    rows, columns = equilibrating_factors(np.maximum(np.abs(E), np.abs(A)))
    return EquilibratedPencil(
        read_only(rows[:, None] * E * columns),
        read_only(rows[:, None] * A * columns),
        read_only(rows),
        read_only(columns),
    )


def equilibrating_factors(sizes: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return the factors ``(..., m)`` and ``(..., n)`` of `equilibrate_pencil` for absolute values ``(..., m, n)``."""
    rows = 1.0 / power_of_two_below(np.max(sizes, axis=-1, initial=0.0))
    columns = 1.0 / power_of_two_below(np.max(rows[..., :, None] * sizes, axis=-2, initial=0.0))
    return rows, columns


def balance_system(
    E: FloatArray, A: FloatArray, inputs: Sequence[FloatArray] = (), outputs: Sequence[FloatArray] = ()
) -> Scaling:
    """Find power-of-two factors that bring the largest entries of rows and columns of a plant near one.

    Equations go by the row of ``[E A]`` (else of the inputs), outputs by their rows, states by the column of ``[E; C]``
    (else of A). A fast state cannot have both E and A near one: a sweep is kept only when it improves the columns.
    """
    nx = E.shape[0]
    e, a = np.abs(E), np.abs(A)
    b = np.abs(np.hstack([np.zeros((nx, 0)), *inputs]))
    c = np.abs(np.vstack([np.zeros((0, nx)), *outputs]))
    states = np.ones(nx)
    best = _scale_rows(e, a, b, c, states)
    peaks = _state_peaks(e, a, c, best)
    for _ in range(MOST_SWEEPS):
        states = states / power_of_two_below(peaks)
        trial = _scale_rows(e, a, b, c, states)
        new_peaks = _state_peaks(e, a, c, trial)
        if not _imbalance(new_peaks) < _imbalance(peaks):
            break
        best, peaks = trial, new_peaks
    return best


def _scale_rows(e: FloatArray, a: FloatArray, b: FloatArray, c: FloatArray, states: FloatArray) -> Scaling:
    own = _row_peaks(np.hstack([e, a]) * np.concatenate([states, states]))
    equations = np.where(own > 0.0, own, _row_peaks(b))
    outputs = _row_peaks(c * states)
    return Scaling(
        read_only(1.0 / power_of_two_below(equations)),
        read_only(states),
        read_only(1.0 / power_of_two_below(outputs)),
    )


def _state_peaks(e: FloatArray, a: FloatArray, c: FloatArray, scaling: Scaling) -> FloatArray:
    own = _row_peaks(np.vstack([scaling.scale_dynamics(e), scaling.scale_output(c)]).T)
    return np.where(own > 0.0, own, _row_peaks(scaling.scale_dynamics(a).T))


def _imbalance(peaks: FloatArray) -> float:
    return float(np.sum(np.abs(np.log2(power_of_two_below(peaks)))))


def _row_peaks(matrix: FloatArray) -> FloatArray:
    return np.asarray(np.max(matrix, axis=1, initial=0.0))
