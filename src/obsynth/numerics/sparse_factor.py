"""Sparse LU factors (SuperLU) with a condition estimate, refinement in extended precision, and error bounds."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
import scipy

from obsynth.numerics.arrays import FloatArray
from obsynth.numerics.ranks import RANK_TOLERANCE
from obsynth.numerics.scaling import power_of_two_below
from obsynth.numerics.sparse import csr

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

#: Splits a double into halves whose products are exact.
SPLITTER = 2.0**27 + 1.0


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
        original = csr(matrix)
        self.rows: FloatArray = np.ones(original.shape[0])
        self.columns: FloatArray = np.ones(original.shape[1])
        if by_all:
            self.rows, self.columns = scales_by_all_entries(original)
        for _ in range(SCALING_SWEEPS):
            self.rows /= power_of_two_below(_peaks(_scaled(original, self.rows, self.columns), axis=1))
            self.columns /= power_of_two_below(_peaks(_scaled(original, self.rows, self.columns), axis=0))
        self.matrix = _scaled(original, self.rows, self.columns)
        self.size = original.shape[0]
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
        right_vector = np.random.default_rng(1).normal(size=self.size)
        left_vector, smallest = right_vector, np.inf
        norm = _norm_estimate(self.matrix)
        for _ in range(SMALLEST_VALUE_STEPS):
            left_vector = self._lu.solve(right_vector / np.linalg.norm(right_vector), trans="T")
            left_vector = left_vector / max(float(np.linalg.norm(left_vector)), np.finfo(float).tiny)
            right_vector = self._lu.solve(left_vector)
            length = float(np.linalg.norm(right_vector))
            smallest = 0.0 if not np.isfinite(length) or length == 0.0 else 1.0 / length
            if not np.isfinite(length):
                break
        right_vector = right_vector / max(float(np.linalg.norm(right_vector)), np.finfo(float).tiny)
        value = 0.0 if self.exactly_singular else smallest / norm
        return value, np.abs(left_vector), np.abs(right_vector)

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
        solution, worst = np.zeros((self.size, right.shape[1])), 0.0
        if not self.size:
            return solution, worst
        for part in _chunks(right.shape[1]):
            scaled = self.rows[:, None] * right[:, part]
            unknown = self._lu.solve(scaled)
            unknown = unknown + self._lu.solve(residual_in_twice_the_digits(self.matrix, unknown, scaled))
            residual = np.abs(residual_in_twice_the_digits(self.matrix, unknown, scaled))
            sizes = abs(self.matrix) @ np.abs(unknown) + np.abs(scaled)
            worst = max(worst, float(np.max(residual / np.where(sizes > 0.0, sizes, 1.0), initial=0.0)))
            solution[:, part] = self.columns[:, None] * unknown
        return solution, worst

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
        rows = np.asarray(places, dtype=np.int64)
        terms = abs(self.matrix) @ (np.abs(solution) / self.columns[:, None])
        sizes = np.zeros((len(rows), solution.shape[1]))
        for part in _chunks(len(rows)):
            units = np.zeros((self.size, len(rows[part])))
            units[rows[part], np.arange(units.shape[1])] = 1.0
            sizes[part] = np.abs(self._lu.solve(units, trans="T")).T @ terms
        return self.columns[rows][:, None] * sizes

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
    factor = SparseFactor(matrix)
    return SparseFactor(matrix, by_all=True) if factor.singular else factor


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
    exponents, _ = scipy.sparse.linalg.cg(system, -sums, rtol=SCALING_ACCURACY, maxiter=SCALING_STEPS, M=weights)
    scales = np.exp2(np.round(exponents))
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
    peaks = np.zeros(matrix.shape[1 - axis])
    places = np.repeat(np.arange(matrix.shape[0]), np.diff(matrix.indptr)) if axis else matrix.indices
    np.maximum.at(peaks, places, np.abs(matrix.data))
    return peaks


def _norm_estimate(matrix: Any) -> float:
    """Return a bound on the 2-norm within a small factor: the root of the product of 1-norm and infinity norm."""
    sizes = abs(matrix)
    one, infinity = (float(np.max(np.asarray(sizes.sum(axis=axis)), initial=0.0)) for axis in (0, 1))
    return float(np.sqrt(one * infinity)) or 1.0


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
