"""Least order of a residual that shows a fault: the least degree in y and u of a parity equation (free of states).

The plant is ``z+ = A z + F f + K w``, ``0 = C z + G f + L w`` with w = [u; y].  Its equations of degree m in w are
spanned by ``s^k e``, k <= m, where e runs over the equations of degree 0: the rows themselves, and the derivatives of
equations that do not contain w.  The least order is the least degree among the rows of a minimal polynomial basis
(Forney 1975) that show the fault.
"""

from __future__ import annotations

from itertools import dropwhile
from typing import NamedTuple

import numpy as np
from flint import fmpq, fmpq_mat
from numpy.typing import NDArray

from obsynth.numerics.arrays import FloatArray, largest_singular_value
from obsynth.numerics.ranks import RANK_TOLERANCE, TRACE_TOLERANCE
from obsynth.numerics.staircase import full_svd
from obsynth.proofs.rational_matrices import blocks, picked_columns, zeros_matrix


def exact_residual_order(A: fmpq_mat, C: fmpq_mat, F: fmpq_mat, G: fmpq_mat, K: fmpq_mat, L: fmpq_mat) -> int | None:
    """Return the least order for one fault, over the rational numbers; ``None`` where no equation shows it."""
    n, known, free = A.nrows(), K.ncols(), -1
    # Rows [w | z | f, f', ...] in echelon form: those without w come last, then those without z.
    rows = blocks([[L, C, G]])
    while True:
        # Equations of the fault alone, which a plant that is not regular may have.
        if _from_column(rows, known + n).nrows():
            return 0
        rows = _independent_rows(rows, known + n)
        without = _from_column(rows, known)
        if without.nrows() <= free:
            break
        free = without.nrows()
        z, f = _split(without, known, n)
        rows = blocks([[rows, zeros_matrix(rows.nrows(), 1)], [z * K, z * A, z * F, f]])
    equations = picked_columns(rows, range(known, rows.ncols()))
    base = equations
    for order in range(n + 1):
        if _from_column(equations, n).nrows():
            return order
        z, f = _split(_independent_rows(equations, n), 0, n)
        if not z.nrows():
            break
        equations = blocks([[z * A, z * F, f]])
        padding = zeros_matrix(base.nrows(), equations.ncols() - base.ncols())
        equations = blocks([[base, padding], [equations]])
    return None


def _split(rows: fmpq_mat, known: int, n: int) -> tuple[fmpq_mat, fmpq_mat]:
    return picked_columns(rows, range(known, known + n)), picked_columns(rows, range(known + n, rows.ncols()))


def _echelon(rows: fmpq_mat) -> list[list[fmpq]]:
    reduced, rank = rows.rref()
    return reduced.tolist()[:rank]


def _independent_rows(rows: fmpq_mat, columns: int) -> fmpq_mat:
    """Return a basis of the rows in echelon form, without the rows that are zero in the first columns."""
    listed = [row for row in _echelon(rows) if any(value != 0 for value in row[:columns])]
    return fmpq_mat(len(listed), rows.ncols(), [value for row in listed for value in row])


def _from_column(rows: fmpq_mat, columns: int) -> fmpq_mat:
    """Return a basis of those combinations of rows that are zero in the first columns."""
    listed = list(dropwhile(lambda row: any(value != 0 for value in row[:columns]), _echelon(rows)))
    return fmpq_mat(len(listed), rows.ncols(), [value for row in listed for value in row])


class _Rows(NamedTuple):
    """Equations ``0 = z_rows z + sum_k f_rows[:, k] s^k f``, one column of `f` for each fault."""

    z: FloatArray  # ``(r, n)``
    f: FloatArray  # ``(r, degree + 1, count)``

    def joined(self, more: _Rows) -> _Rows:
        degree = max(self.f.shape[1], more.f.shape[1])
        f = [np.pad(part.f, ((0, 0), (0, degree - part.f.shape[1]), (0, 0))) for part in (self, more)]
        return _Rows(np.vstack([self.z, more.z]), np.concatenate(f))

    def differentiated(self, A: FloatArray, F: FloatArray) -> _Rows:
        return _Rows(self.z @ A, np.concatenate([(self.z @ F)[:, None], self.f], axis=1))

    def combined(self, factors: FloatArray) -> _Rows:
        return _Rows(factors @ self.z, np.tensordot(factors, self.f, axes=1))


def residual_orders(
    A: FloatArray, C: FloatArray, F: FloatArray, G: FloatArray, K: FloatArray, L: FloatArray
) -> list[int | None]:
    """Return the least order for each fault, in floating point; ``None`` where no equation shows it.

    The columns of ``[F; G]`` and of ``[K; L]`` have entries near one, as A and C; rows of zeros are equations as well.
    """
    n, count = A.shape[0], F.shape[1]
    basis, (new, alone) = _Rows(np.zeros((0, n)), np.zeros((0, 1, count))), _of_degree_zero(A, C, F, G, K, L)
    orders: list[int | None] = [0 if is_alone else None for is_alone in alone.tolist()]
    scale = largest_singular_value(C)
    for order in range(n + 1):
        new, hidden, terms = _added_directions(basis, new, scale)
        present = _present_faults(hidden, terms)
        orders = [
            order if shows and known is None else known for known, shows in zip(orders, present.tolist(), strict=True)
        ]
        if not len(new.z) or all(known is not None for known in orders):
            break
        basis, new, scale = basis.joined(new), new.differentiated(A, F), largest_singular_value(A)
    return orders


def _present_faults(hidden: FloatArray, terms: FloatArray) -> NDArray[np.bool_]:
    """Return which faults occur in equations, from their fault parts and the sizes of the terms that these sum up."""
    return np.asarray(np.any(np.linalg.norm(hidden, axis=1) > TRACE_TOLERANCE * np.maximum(terms, 1.0), axis=0))


def _of_degree_zero(
    A: FloatArray, C: FloatArray, F: FloatArray, G: FloatArray, K: FloatArray, L: FloatArray
) -> tuple[_Rows, NDArray[np.bool_]]:
    """Return the equations without derivatives of w, and which faults occur in equations without z and w.

    Only a plant that is not regular has equations of the second kind.
    """
    n, count = A.shape[0], F.shape[1]
    alone = np.zeros(count, dtype=bool)
    rows, w = _Rows(C, G[:, None]), L
    free = _Rows(np.zeros((0, n)), np.zeros((0, 1, count)))
    size = max(largest_singular_value(L), largest_singular_value(K))
    scale = largest_singular_value(C)
    for _ in range(n + 1):
        left_vectors, values, _ = full_svd(w)
        rank = int(np.count_nonzero(values > RANK_TOLERANCE * size))
        new, hidden, terms = _added_directions(free, rows.combined(left_vectors[:, rank:].T), scale)
        alone |= _present_faults(hidden, terms)
        rows, w = rows.combined(left_vectors[:, :rank].T), left_vectors[:, :rank].T @ w
        if not len(new.z):
            break
        # The derivatives of equations without w contain no derivative of w: they are of degree 0 as well.
        free, scale = free.joined(new), max(scale, largest_singular_value(A))
        rows, w = rows.joined(new.differentiated(A, F)), np.vstack([w, new.z @ K])
    return rows.joined(free), alone


def _added_directions(basis: _Rows, rows: _Rows, scale: float) -> tuple[_Rows, FloatArray, FloatArray]:
    """Return the new orthonormal directions that rows add to a basis, and the fault parts of the other combinations.

    The third value has the sizes of the terms that these fault parts are sums of, for judging their rounding.
    """
    z, f = rows
    terms = np.linalg.norm(f, axis=(0, 1))
    for _ in range(2):
        share = z @ basis.z.T
        reduced = _Rows(z, f).joined(basis.combined(-share))
        z, f = reduced.z[: len(z)] + reduced.z[len(z) :], reduced.f[: len(z)] + reduced.f[len(z) :]
        terms = terms + np.linalg.norm(np.tensordot(np.abs(share), np.abs(basis.f), axes=1), axis=(0, 1))
    left_vectors, values, right_vectors = np.linalg.svd(z, full_matrices=len(z) > z.shape[1])
    rank = int(np.count_nonzero(values > RANK_TOLERANCE * scale))
    new = _Rows(right_vectors[:rank], np.tensordot(left_vectors[:, :rank].T / values[:rank, None], f, axes=1))
    return new, np.tensordot(left_vectors[:, rank:].T, f, axes=1), np.asarray(terms)
