"""Sparse matrices of scipy as checked, read-only data."""

from __future__ import annotations

from typing import Any, TypeGuard

import numpy as np
import scipy
from numpy.typing import NDArray

from obsynth.errors import SpecError, counted
from obsynth.numerics.arrays import FloatArray, kind_of_entries, read_only

Indices = NDArray[np.int64]


def is_sparse(value: Any) -> TypeGuard[Any]:
    """Whether ``value`` is a sparse matrix or array of scipy; scipy is not imported for that."""
    return type(value).__module__.startswith("scipy.sparse") and hasattr(value, "tocsr")


def as_sparse_matrix(value: Any, name: str) -> Any:
    """Return a private, finite, read-only float copy of a sparse matrix in CSR form, or in CSC where that was given."""
    if value.dtype.kind not in "fiu":
        raise SpecError(f"{name} holds {kind_of_entries(value.dtype)}: every entry must be a real number.", path=name)
    if value.ndim != 2:
        raise SpecError(f"{name} has {counted(value.ndim, 'dimension')}: give a matrix.", path=name)
    copy = (value.copy() if value.format in ("csr", "csc") else value.tocsr(copy=True)).astype(np.float64)
    copy.sum_duplicates()
    bad = np.flatnonzero(~np.isfinite(copy.data))
    if bad.size:
        entries = copy.tocoo()
        where = np.flatnonzero(~np.isfinite(entries.data))[0]
        row, column = int(entries.row[where]) + 1, int(entries.col[where]) + 1
        raise SpecError(
            f"{name} has {entries.data[where]} in row {row}, column {column}: every entry must be finite.", path=name
        )
    copy.eliminate_zeros()
    for part in (copy.data, copy.indices, copy.indptr):
        part.setflags(write=False)
    return copy


def dense(matrix: Any) -> FloatArray:
    """Return a matrix as a read-only array; arrays are returned as they are."""
    return read_only(matrix.toarray()) if is_sparse(matrix) else matrix


def same_matrix(first: Any, second: Any) -> bool:
    """Return whether two matrices, each sparse or an array, hold the same numbers."""
    if first is second:
        return True
    if not (is_sparse(first) or is_sparse(second)):
        return np.array_equal(first, second)
    return bool(first.shape == second.shape and (csr(first) != csr(second)).nnz == 0)


def csr(matrix: Any) -> Any:
    """Return a sparse or dense matrix as a new ``scipy.sparse.csr_array``."""
    return scipy.sparse.csr_array(matrix)


def selection(rows: Any, count: int) -> Any:
    """Return the sparse matrix ``(len(rows), count)`` with a one in each row."""
    places = np.asarray(rows, dtype=np.int64)
    return scipy.sparse.csr_array((np.ones(len(places)), (np.arange(len(places)), places)), shape=(len(places), count))
