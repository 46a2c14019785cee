"""Sparse matrices of scipy as checked, read-only data; their structure by pattern, and their factors with error bounds.

Matching, parts and blocks: A. L. Dulmage and N. S. Mendelsohn, *Coverings of bipartite graphs*, Canadian J. Math. 10,
1958.  LU factors are those of SuperLU, with a condition estimate and refinement in extended precision.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property
from typing import Any, TypeGuard

import numpy as np
import scipy
from numpy.typing import NDArray

from obsynth.errors import SpecError
from obsynth.numerics.arguments import FloatArray, kind_of_entries, read_only
from obsynth.numerics.ranks import RANK_TOLERANCE
from obsynth.numerics.scaling import power_of_two_below


def is_sparse(value: Any) -> TypeGuard[Any]:
    """Whether ``value`` is a sparse matrix or array of scipy; scipy is not imported for that."""
    return type(value).__module__.startswith("scipy.sparse") and hasattr(value, "tocsr")


def as_sparse_matrix(value: Any, name: str) -> Any:
    """Return a private, finite, read-only float copy of a sparse matrix in CSR form, or in CSC where that was given."""
    if value.dtype.kind not in "fiu":
        raise SpecError(f"{name} holds {kind_of_entries(value.dtype)}: every entry must be a real number.", path=name)
    if value.ndim != 2:
        raise SpecError(f"{name} has {value.ndim} dimension(s): give a matrix.", path=name)
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


Indices = NDArray[np.int64]

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
    found = np.full(matrix.shape[1], -1, dtype=np.int64)
    if not matrix.nnz:
        return found
    # Most rows of E are empty.
    own_rows, own_columns = np.flatnonzero(np.diff(matrix.indptr)), np.unique(matrix.indices)
    part = csr(matrix[own_rows][:, own_columns])
    cheap = scipy.sparse.csr_array((np.ones(part.nnz), part.indices, part.indptr), shape=part.shape)
    row, column = scipy.sparse.csgraph.min_weight_full_bipartite_matching(
        csr(scipy.sparse.hstack([cheap, OWN_ENTRY * scipy.sparse.eye_array(len(own_rows))]))
    )
    inside = column < len(own_columns)
    found[own_columns[column[inside]]] = own_rows[row[inside]]
    return found


def unmatched_instead(pattern: Any, found: CoarseStructure, rows: Indices) -> Indices | None:
    """Return as many of some rows, the first ones if possible, as a maximum matching leaves free; else ``None``."""
    row_of_column = found.row_of_column.copy()
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
    both = scipy.sparse.block_array([[None, abs(matrix)], [abs(matrix).T, None]], format="csr")
    _, labels = scipy.sparse.csgraph.connected_components(both, directed=False)
    return np.asarray(labels[:rows], dtype=np.int64), np.asarray(labels[rows:], dtype=np.int64)


#: Columns that are solved for at a time.
COLUMNS_AT_ONCE = 256
#: Sweeps of the scaling; two bring every largest entry near one.
SCALING_SWEEPS = 3
#: Steps and relative accuracy of the scaling by all entries, whose unknowns are exponents of two.
SCALING_STEPS, SCALING_ACCURACY = 400, 1e-4
#: Steps of inverse iteration for the smallest singular value: the gap to the next decides, and few are needed.
SMALLEST_VALUE_STEPS = 6
#: Relative size of what is added to the diagonal of a factor that SuperLU calls singular, to find its null vectors.
PERTURBATION = 1e-14
#: Samples of the usual size of terms, and how far their mean may be off.
SIZE_SAMPLES, MEAN_FACTOR = 8, 8.0


@dataclass(frozen=True, eq=False)
class SolutionBounds:
    """How well a sparse system was solved: estimated 1-norm condition, scaled, and componentwise backward error."""

    condition: float
    backward_error: float

    @property
    def forward_error(self) -> float:
        """Bound on the relative error of the solution (of each column, in the largest norm of scaled unknowns)."""
        return self.condition * self.backward_error


class SparseFactor:
    """LU factors of a square sparse matrix, with rows and columns scaled by powers of two by their largest entries.

    With ``by_all`` such that all entries are near one first, whatever units they are in.
    """

    def __init__(self, matrix: Any, *, by_all: bool = False) -> None:
        given = csr(matrix)
        self.rows: FloatArray = np.ones(given.shape[0])
        self.columns: FloatArray = np.ones(given.shape[1])
        if by_all:
            self.rows, self.columns = scales_by_all_entries(given)
        for _ in range(SCALING_SWEEPS):
            self.rows /= power_of_two_below(_peaks(_scaled(given, self.rows, self.columns), axis=1))
            self.columns /= power_of_two_below(_peaks(_scaled(given, self.rows, self.columns), axis=0))
        self.matrix = _scaled(given, self.rows, self.columns)
        self.size = given.shape[0]
        try:
            self._lu = scipy.sparse.linalg.splu(scipy.sparse.csc_array(self.matrix))
            self.exactly_singular = False
        except RuntimeError:
            # SuperLU met a zero pivot: a perturbed matrix shows by its null vectors where.
            noise = np.random.default_rng(0).uniform(1.0, 2.0, self.size)
            ridge = scipy.sparse.diags_array(PERTURBATION * noise) if self.size else scipy.sparse.eye_array(0)
            self._lu = scipy.sparse.linalg.splu(scipy.sparse.csc_array(self.matrix + ridge))
            self.exactly_singular = True

    def null_vectors(self) -> tuple[float, FloatArray, FloatArray]:
        """Return an estimate of the smallest singular value of the scaled matrix, relative to its norm, and where: the
        sizes of the null vectors of the rows and columns, for naming."""
        if not self.size:
            return 1.0, np.zeros(0), np.zeros(0)
        right = np.random.default_rng(1).normal(size=self.size)
        left, smallest = right, np.inf
        norm = _norm_estimate(self.matrix)
        for _ in range(SMALLEST_VALUE_STEPS):
            left = self._lu.solve(right / np.linalg.norm(right), trans="T")
            left = left / max(float(np.linalg.norm(left)), np.finfo(float).tiny)
            right = self._lu.solve(left)
            length = float(np.linalg.norm(right))
            smallest = 0.0 if not np.isfinite(length) or length == 0.0 else 1.0 / length
            if not np.isfinite(length):
                break
        right = right / max(float(np.linalg.norm(right)), np.finfo(float).tiny)
        value = 0.0 if self.exactly_singular else smallest / norm
        return value, np.abs(left), np.abs(right)

    @property
    def singular(self) -> bool:
        """Whether the matrix is singular to the tolerance of every rank."""
        return self.exactly_singular or self.null_vectors()[0] <= RANK_TOLERANCE

    @cached_property
    def condition(self) -> float:
        """An estimate of the 1-norm condition number of the scaled matrix."""
        if not self.size:
            return 1.0
        inverse = scipy.sparse.linalg.LinearOperator(
            (self.size, self.size),
            matvec=self._lu.solve,
            rmatvec=lambda x: self._lu.solve(x, trans="T"),
            matmat=self._lu.solve,
            dtype=np.float64,
        )
        peak = float(np.max(np.asarray(abs(self.matrix).sum(axis=0)), initial=0.0))
        return peak * float(scipy.sparse.linalg.onenormest(inverse))

    def solve(self, right: FloatArray) -> FloatArray:
        """Return ``matrix^-1 right`` for dense columns, refined once with residuals of twice the digits."""
        return self.solve_with_error(right)[0]

    def solve_with_error(self, right: FloatArray) -> tuple[FloatArray, float]:
        """Return the refined solution, and its largest componentwise backward error."""
        found, worst = np.zeros((self.size, right.shape[1])), 0.0
        if not self.size:
            return found, worst
        for part in _chunks(right.shape[1]):
            scaled = self.rows[:, None] * right[:, part]
            unknown = self._lu.solve(scaled)
            unknown = unknown + self._lu.solve(residual_in_twice_the_digits(self.matrix, unknown, scaled))
            residual = np.abs(residual_in_twice_the_digits(self.matrix, unknown, scaled))
            sizes = abs(self.matrix) @ np.abs(unknown) + np.abs(scaled)
            worst = max(worst, float(np.max(residual / np.where(sizes > 0.0, sizes, 1.0), initial=0.0)))
            found[:, part] = self.columns[:, None] * unknown
        return found, worst

    def solve_transposed(self, right: FloatArray) -> FloatArray:
        """Return ``matrix^-T right``, refined once."""
        if not self.size:
            return np.zeros((0, right.shape[1]))
        scaled = self.columns[:, None] * right
        unknown = self._lu.solve(scaled, trans="T")
        if not self.exactly_singular:
            unknown = unknown + self._lu.solve(scaled - self.matrix.T @ unknown, trans="T")
        return np.asarray(self.rows[:, None] * unknown)

    def size_of_terms(self, solution: FloatArray, places: Any) -> FloatArray:
        """Return chosen rows of ``|matrix^-1| (|matrix| |solution|)``: rounding is judged beside it."""
        wanted = np.asarray(places, dtype=np.int64)
        terms = abs(self.matrix) @ (np.abs(solution) / self.columns[:, None])
        found = np.zeros((len(wanted), solution.shape[1]))
        for part in _chunks(len(wanted)):
            units = np.zeros((self.size, len(wanted[part])))
            units[wanted[part], np.arange(units.shape[1])] = 1.0
            found[part] = np.abs(self._lu.solve(units, trans="T")).T @ terms
        return self.columns[wanted][:, None] * found

    def usual_size_of_terms(self, solution: FloatArray) -> FloatArray:
        """Return an estimate of `size_of_terms` of all rows, with sums of squares: terms of random signs.

        The sum is at most the root of ``size`` times it; eight samples are within `MEAN_FACTOR` of the truth.
        """
        terms = abs(self.matrix) @ (np.abs(solution) / self.columns[:, None])
        signs = np.random.default_rng(2).choice((-1.0, 1.0), (SIZE_SAMPLES, *terms.shape))
        squares = [self._lu.solve(part * terms) ** 2 for part in signs]
        return np.asarray(self.columns[:, None] * np.sqrt(np.mean(squares, axis=0)))


def sparse_factor(matrix: Any) -> SparseFactor:
    """Return the factors of a matrix; scaled by all of its entries where it looks singular scaled by the largest."""
    found = SparseFactor(matrix)
    return SparseFactor(matrix, by_all=True) if found.singular else found


def scales_by_all_entries(matrix: Any) -> tuple[FloatArray, FloatArray]:
    """Return powers of two for rows and columns by least squares on the logarithms of all entries: units do not matter.

    Source: A. R. Curtis, J. K. Reid, J. Inst. Maths Applics 10, 1972.
    """
    count = matrix.shape[0]
    entries = scipy.sparse.coo_array(matrix)
    entries.eliminate_zeros()
    sizes = np.log2(np.abs(entries.data))
    pattern = scipy.sparse.coo_array((np.ones(len(sizes)), (entries.row, entries.col)), shape=matrix.shape)
    sums = np.concatenate(
        [
            np.bincount(entries.row, weights=sizes, minlength=count),
            np.bincount(entries.col, weights=sizes, minlength=matrix.shape[1]),
        ]
    )
    numbers = np.asarray(pattern.sum(axis=1)).ravel(), np.asarray(pattern.sum(axis=0)).ravel()
    system = csr(
        scipy.sparse.block_array(
            [[scipy.sparse.diags_array(numbers[0]), pattern], [pattern.T, scipy.sparse.diags_array(numbers[1])]]
        )
    )
    weights = scipy.sparse.diags_array(1.0 / np.maximum(np.concatenate(numbers), 1.0))
    found, _ = scipy.sparse.linalg.cg(system, -sums, rtol=SCALING_ACCURACY, maxiter=SCALING_STEPS, M=weights)
    scales = np.exp2(np.round(found))
    return scales[:count], scales[count:]


def _chunks(count: int) -> Iterator[slice]:
    return (slice(start, min(start + COLUMNS_AT_ONCE, count)) for start in range(0, count, COLUMNS_AT_ONCE))


def _scaled(matrix: Any, rows: FloatArray, columns: FloatArray) -> Any:
    copy = matrix.copy()
    places = np.repeat(np.arange(matrix.shape[0]), np.diff(matrix.indptr))
    copy.data = matrix.data * rows[places] * columns[matrix.indices]
    return copy


def _peaks(matrix: Any, *, axis: int) -> FloatArray:
    """Return the largest absolute entry of each row (``axis=1``) or column."""
    found = np.zeros(matrix.shape[1 - axis])
    places = np.repeat(np.arange(matrix.shape[0]), np.diff(matrix.indptr)) if axis else matrix.indices
    np.maximum.at(found, places, np.abs(matrix.data))
    return found


def _norm_estimate(matrix: Any) -> float:
    """Return a bound on the 2-norm within a small factor: the root of the product of 1-norm and infinity norm."""
    sizes = abs(matrix)
    one, infinity = (float(np.max(np.asarray(sizes.sum(axis=axis)), initial=0.0)) for axis in (0, 1))
    return float(np.sqrt(one * infinity)) or 1.0


#: Splits a double into halves whose products are exact.
SPLITTER = 2.0**27 + 1.0


def residual_in_twice_the_digits(matrix: Any, unknown: FloatArray, right: FloatArray) -> FloatArray:
    """Return ``right - matrix @ unknown``, rounded once, of a sparse matrix by rows and columns ``(n, k)``.

    Products and sums with their rounding errors (Dekker; Ogita, Rump, Oishi, "Accurate sum and dot product", 2005): a
    long double has no more digits than a double on some machines.
    """
    total = np.array(right, dtype=np.float64)
    errors = np.zeros_like(total)
    counts = np.diff(matrix.indptr)
    for place in range(int(np.max(counts, initial=0))):
        rows = np.flatnonzero(counts > place)
        entries = matrix.indptr[rows] + place
        factor, values = -matrix.data[entries][:, None], unknown[matrix.indices[entries]]
        product = factor * values
        (high, low), (large, small) = _halves(factor), _halves(values)
        rounded = ((high * large - product) + high * small + low * large) + low * small
        before = total[rows]
        after = before + product
        part = after - before
        errors[rows] += ((before - (after - part)) + (product - part)) + rounded
        total[rows] = after
    return np.asarray(total + errors)


def _halves(values: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return two numbers of 26 digits each whose sum is ``values``."""
    spread = SPLITTER * values
    high = spread - (spread - values)
    return high, values - high
