"""A reader of Matrix Market files that ends in a `ValueError` for every damaged file.

The one of scipy (1.17) crashes the interpreter on some truncated numbers and damaged headers.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from obsynth.numerics.arrays import FloatArray

#: Smaller matrices become arrays: nothing is gained by sparsity.
SPARSE_FROM = 300
#: A sparse matrix needs memory for each row and column as well: this many entries' worth, generously.
ENTRIES_PER_LINE = 1000
#: Whole numbers with more digits are damage.
MOST_DIGITS = 15


def read_matrix_market(path: Path, *, maximum_entries: int, keep_sparse: bool = False) -> Any:
    """Return the matrix in a Matrix Market file: an array, or a CSR array of a large one that may stay sparse."""
    with path.open(encoding="utf-8") as stream:
        layout, field, symmetry = _checked_header(stream.readline(200))
        lines = (line for line in stream if line.strip() and not line.startswith("%"))
        size = next(lines, "").split()
        tokens = [token for line in lines for token in line.split()]
    counts = [_whole(token, "the sizes") for token in size]
    if len(counts) != (3 if layout == "coordinate" else 2) or min(counts) < 0:
        raise ValueError("the line with the sizes is damaged")
    rows, columns = counts[:2]
    sparse = keep_sparse and layout == "coordinate" and max(rows, columns) >= SPARSE_FROM
    entries = max(rows, columns) * ENTRIES_PER_LINE if sparse else rows * columns
    if max(entries, *counts) > maximum_entries:
        raise ValueError(f"it is too large ({max(rows * columns, *counts):.1e} entries)")
    if symmetry != "general" and rows != columns:
        raise ValueError(f"it is {symmetry}, but {rows} by {columns}")
    if layout == "array":
        return _from_array(tokens, rows, columns, symmetry)
    return _from_coordinates(tokens, (rows, columns, counts[2]), field, symmetry, sparse=sparse)


def _checked_header(line: str) -> tuple[str, str, str]:
    words = line.lower().split()
    if len(words) != 5 or words[:2] != ["%%matrixmarket", "matrix"]:
        raise ValueError("its first line is no Matrix Market header")
    _, _, layout, field, symmetry = words
    if field == "complex" or symmetry == "hermitian":
        raise ValueError("it holds complex numbers")
    known = (
        layout in ("coordinate", "array")
        and field in ("real", "double", "integer", "unsigned-integer", "pattern")
        and symmetry in ("general", "symmetric", "skew-symmetric")
        and (layout, field) != ("array", "pattern")
    )
    if not known:
        raise ValueError(f"'{' '.join(words[2:])}' is no known kind of Matrix Market file")
    return layout, field, symmetry


def _from_array(tokens: list[str], rows: int, columns: int, symmetry: str) -> FloatArray:
    values = _numbers(tokens)
    if symmetry == "general":
        _require_count(len(values), rows * columns)
        return values.reshape(columns, rows).T
    # The lower triangle, column by column.
    column, row = np.triu_indices(rows, 1 if symmetry == "skew-symmetric" else 0)
    _require_count(len(values), len(row))
    matrix = np.zeros((rows, columns))
    matrix[row, column] = values
    return _mirrored(matrix, symmetry)


def _from_coordinates(tokens: list[str], size: tuple[int, int, int], field: str, symmetry: str, *, sparse: bool) -> Any:
    rows, columns, stored = size
    width = 2 if field == "pattern" else 3
    _require_count(len(tokens), width * stored)
    positions = [_indices(tokens[k::width]) - 1 for k in (0, 1)]
    for position, limit in zip(positions, (rows, columns), strict=True):
        if np.any(position < 0) or np.any(position >= limit):
            raise ValueError("an index is outside the matrix")
    values = np.ones(stored) if field == "pattern" else _numbers(tokens[2::width])
    if symmetry != "general":
        positions, values = _both_triangles(positions, values, symmetry)
    # Entries that are given twice are added, as the format says.
    if sparse:
        from scipy.sparse import coo_array

        return coo_array((values, (positions[0], positions[1])), shape=(rows, columns)).tocsr()
    matrix = np.zeros((rows, columns))
    np.add.at(matrix, (positions[0], positions[1]), values)
    return matrix


def _both_triangles(positions: list[Any], values: FloatArray, symmetry: str) -> tuple[list[Any], FloatArray]:
    """Return the coordinates of a lower triangle and of what it stands for above the diagonal."""
    row, column = positions
    if np.any(column[values != 0.0] > row[values != 0.0]):
        raise ValueError(f"it is {symmetry}, but has entries above the diagonal")
    sign, below = (-1.0 if symmetry == "skew-symmetric" else 1.0), row > column
    mirrored = [np.concatenate([row, column[below]]), np.concatenate([column, row[below]])]
    return mirrored, np.concatenate([values, sign * values[below]])


def _mirrored(lower: FloatArray, symmetry: str) -> FloatArray:
    if np.any(np.triu(lower, 1)):
        raise ValueError(f"it is {symmetry}, but has entries above the diagonal")
    sign = -1.0 if symmetry == "skew-symmetric" else 1.0
    return lower + sign * np.tril(lower, -1).T


def _numbers(tokens: list[str]) -> FloatArray:
    return np.fromiter(map(float, tokens), dtype=np.float64, count=len(tokens))


def _indices(tokens: list[str]) -> Any:
    if not all(map(str.isdecimal, tokens)) or max(map(len, tokens), default=0) > MOST_DIGITS:
        return np.array([_whole(token, "an index") for token in tokens], dtype=np.int64)
    return np.fromiter(map(int, tokens), dtype=np.int64, count=len(tokens))


def _whole(token: str, what: str) -> int:
    if not token.isdecimal() or len(token) > MOST_DIGITS:
        raise ValueError(f"{what} must be whole numbers, not {token[:20]!r}")
    return int(token)


def _require_count(found: int, expected: int) -> None:
    if found != expected:
        raise ValueError(f"it has {found} numbers after the sizes, but {expected} are needed")
