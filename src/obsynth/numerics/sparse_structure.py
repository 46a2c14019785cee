"""Structure of a sparse matrix by its pattern: matching, over- and underdetermined parts, blocks.

Source: A. L. Dulmage and N. S. Mendelsohn, *Coverings of bipartite graphs*, Canadian J. Math. 10, 1958.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import scipy

from obsynth.numerics.sparse import Indices, csr

#: What an entry that a row has beside the matrix costs in a matching, where any entry of the matrix costs one.
OWN_ENTRY = 2.0


@dataclass(frozen=True, eq=False)
class CoarseStructure:
    """The Dulmage-Mendelsohn parts of a pattern: more rows than columns (over), more columns than rows (under).

    ``row_of_column``: the row that a maximum matching gives to each column, -1 for none.
    """

    row_of_column: Indices
    over_rows: Indices
    over_columns: Indices
    under_rows: Indices
    under_columns: Indices

    @property
    def structural_rank(self) -> int:
        """Rank of almost every matrix of this pattern."""
        return int(np.sum(self.row_of_column >= 0))


def coarse_structure(pattern: Any) -> CoarseStructure:
    """Return the over- and underdetermined parts of a sparse matrix, by its pattern."""
    matrix = csr(pattern)
    row_of_column = _maximum_matching(matrix)
    column_of_row = np.full(matrix.shape[0], -1, dtype=np.int64)
    matched = np.flatnonzero(row_of_column >= 0)
    column_of_row[row_of_column[matched]] = matched
    free_rows = np.flatnonzero(column_of_row < 0)
    free_columns = np.flatnonzero(row_of_column < 0)
    over_rows, over_columns = _alternating(matrix, free_rows, row_of_column)
    under_columns, under_rows = _alternating(csr(matrix.T), free_columns, column_of_row)
    return CoarseStructure(row_of_column, over_rows, over_columns, under_rows, under_columns)


def _maximum_matching(matrix: Any) -> Indices:
    """Return the row of each column in a maximum matching, -1 for none.

    Every row may have an entry of its own beside the matrix, at a price: the cheapest full matching uses as few as
    possible.  scipy's matching without weights took minutes with rows and columns in some orders.
    """
    row_of_column = np.full(matrix.shape[1], -1, dtype=np.int64)
    if not matrix.nnz:
        return row_of_column
    # Most rows of E are empty.
    own_rows, own_columns = np.flatnonzero(np.diff(matrix.indptr)), np.unique(matrix.indices)
    part = csr(matrix[own_rows][:, own_columns])
    cheap = scipy.sparse.csr_array((np.ones(part.nnz), part.indices, part.indptr), shape=part.shape)
    row, column = scipy.sparse.csgraph.min_weight_full_bipartite_matching(
        csr(scipy.sparse.hstack([cheap, OWN_ENTRY * scipy.sparse.eye_array(len(own_rows))]))
    )
    inside = column < len(own_columns)
    row_of_column[own_columns[column[inside]]] = own_rows[row[inside]]
    return row_of_column


def unmatched_instead(pattern: Any, structure: CoarseStructure, rows: Indices) -> Indices | None:
    """Return as many of some rows, the first ones if possible, as a maximum matching leaves free; else ``None``."""
    row_of_column = structure.row_of_column.copy()
    unmatched = np.setdiff1d(np.arange(pattern.shape[0]), row_of_column)
    chosen = list[int]()
    for start in map(int, unmatched):
        came_from = {start: (-1, -1)}
        waiting = [start]
        while waiting:
            row = waiting.pop()
            for column in map(int, pattern.indices[pattern.indptr[row] : pattern.indptr[row + 1]]):
                other = int(row_of_column[column])
                if other not in came_from:
                    came_from[other] = (row, column)
                    waiting.append(other)
        end = next((row for row in map(int, rows) if row in came_from and row not in chosen), None)
        if end is None:
            return None
        chosen.append(end)
        # Each row on the way takes the column of the next one.
        while end != start:
            row, column = came_from[end]
            row_of_column[column] = row
            end = row
    return np.array(sorted(chosen), dtype=np.int64)


def _alternating(matrix: Any, start: Indices, back: Indices) -> tuple[Indices, Indices]:
    """Return rows and columns on paths from ``start`` (rows) along any entry to a column and back to its own row."""
    seen_rows, seen_columns = set(map(int, start)), set[int]()
    waiting = list(seen_rows)
    while waiting:
        row = waiting.pop()
        for column in map(int, matrix.indices[matrix.indptr[row] : matrix.indptr[row + 1]]):
            if column in seen_columns:
                continue
            seen_columns.add(column)
            other = int(back[column])
            if other >= 0 and other not in seen_rows:
                seen_rows.add(other)
                waiting.append(other)
    return np.array(sorted(seen_rows), dtype=np.int64), np.array(sorted(seen_columns), dtype=np.int64)


def blocks_of(pattern: Any, row_of_column: Indices) -> tuple[int, Indices]:
    """Return the number of diagonal blocks of the block triangular form, and the block of each column."""
    count, labels = scipy.sparse.csgraph.connected_components(
        csr(pattern)[row_of_column], directed=True, connection="strong"
    )
    return int(count), np.asarray(labels, dtype=np.int64)


def components_of(pattern: Any) -> tuple[Indices, Indices]:
    """Return the connected component of each row and each column; two that share an entry are in the same."""
    matrix = csr(pattern)
    rows = matrix.shape[0]
    bipartite = scipy.sparse.block_array([[None, abs(matrix)], [abs(matrix).T, None]], format="csr")
    _, labels = scipy.sparse.csgraph.connected_components(bipartite, directed=False)
    return np.asarray(labels[:rows], dtype=np.int64), np.asarray(labels[rows:], dtype=np.int64)
