"""Balanced units by least squares on the logarithms of entries, rounded to powers of two.

The unknowns only shift with the units of the data: up to the rounding of exponents, the result does not depend on them.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from obsynth.numerics import lapack
from obsynth.numerics.arrays import FloatArray, read_only
from obsynth.numerics.scaling import Scaling

#: Ridge that makes the factors unique where groups of signals are not coupled; too small to change them otherwise.
SMALL_RIDGE = 1e-9

#: Ridge that makes the factors unique where the entries leave them open; too small to change them otherwise.
RIDGE = 1e-11

#: Largest rounding error of a weight, as a share of the ridge: each correction of the solution then gains two digits.
ROUNDED_RIDGE = 1.0 / 64.0

#: Weight of a wish in units of the ridge: it decides only what the entries leave open.
WISH_WEIGHT = 1e3

#: An entry this many bits below one has half the weight: much smaller entries are weak coupling, or rounding.
HALF_SAY = 10.0

#: Number of corrections by exact residuals, each of which gains four or five digits.
RESIDUAL_CORRECTIONS = 3

#: Whole exponents are settled when the last correction is below this share of the distance to the next rounding limit.
SETTLED_SHARE = 1e-2

#: Number of reweighting passes, in which small entries lose weight.
PASSES = 3

#: Bits after the binary point of the parts into which summands are split.  Of a million summands below 2^10 the sum of
#: the first parts has 46 bits, and those of the others have 50.
PART_BITS = (16, 46, 76)

#: From this order on, Cholesky factors are tried first: they take a third of the time.
MANY_UNKNOWNS = 500


def balance_by_least_squares(
    E: FloatArray, A: FloatArray, inputs: Sequence[FloatArray] = (), outputs: Sequence[FloatArray] = ()
) -> Scaling:
    """Find power-of-two factors that bring all entries of a plant, on the whole, near one.

    The squared logarithms of all nonzero entries are least; input columns are free. The result does not depend on
    units. Source: R. C. Ward, *Balancing the generalized eigenvalue problem*, SIAM J. Sci. Stat. Comput. 2, 1981.
    """
    ne, nx = E.shape
    b, c = np.hstack([np.zeros((ne, 0)), *inputs]), np.vstack([np.zeros((0, nx)), *outputs])
    ends = [0, ne, ne + nx, ne + nx + len(c), ne + nx + len(c) + b.shape[1]]
    equations, states, output_rows, input_columns = map(range, ends[:-1], ends[1:])
    problem = LogBalance(ends[-1])
    for matrix, rows, columns in ((E, equations, states), (A, equations, states), (c, output_rows, states)):
        problem.add(matrix, rows, columns)
    problem.add(b, equations, input_columns)
    exponents = problem.solve(passes=0, ridge=SMALL_RIDGE, whole=True).astype(np.int64)
    return Scaling(*(read_only(np.ldexp(1.0, exponents[part])) for part in (equations, states, output_rows)))


@dataclass(eq=False)
class LogBalance:
    """Minimise ``log2 abs(M[i, j]) + row[i] + column[j] + common`` over all nonzero entries of matrices."""

    count: int
    _terms: list[_Entries] = field(default_factory=list)
    _wishes: list[tuple[int, float]] = field(default_factory=list)

    def add(
        self,
        matrix: FloatArray,
        rows: range,
        columns: range,
        *,
        signs: tuple[int, int] = (1, 1),
        common: int | None = None,
        weight: float = 1.0,
    ) -> None:
        """Ask for entries of a matrix ``(m, n)`` near one."""
        row, column = np.nonzero(matrix)
        count = len(row)
        self._terms.append(
            _Entries(
                self.count,
                np.log2(np.abs(matrix[row, column])),
                np.full(count, weight),
                (rows.start + row, columns.start + column, np.full(count, self.count if common is None else common)),
                (np.full(count, signs[0]), np.full(count, signs[1]), np.ones(count)),
            )
        )

    def wish(self, unknown: int, exponent: float) -> None:
        """Ask for a value where the entries leave the unknown open."""
        self._wishes.append((unknown, exponent))

    def solve(self, *, passes: int = PASSES, ridge: float = RIDGE, whole: bool = False) -> FloatArray:
        """Return the exponents ``(count,)``, rounded to whole numbers where these are wanted."""
        entries = _Entries.joined(self._terms, self.count)
        weights = entries.weights
        # Of hundreds of states with a dense E the weights are so large that their rounding would be the ridge.
        largest = float(entries.diagonal(weights).max(initial=0.0))
        ridge = max(ridge, largest * float(np.finfo(np.float64).eps) / ROUNDED_RIDGE)
        solved, exponents = self._solved(entries, weights, ridge)
        for _ in range(passes):
            weights = entries.weights * entries.influence(exponents)
            solved, exponents = self._solved(entries, weights, ridge)
        # What the entries leave open would be rounding over the ridge: of exact residuals nothing is left of it.
        for _ in range(RESIDUAL_CORRECTIONS):
            before, exponents = exponents, exponents + solved(self._normal_residual(entries, weights, exponents, ridge))
            if np.array_equal(before, exponents):
                break
            to_a_half = np.abs(np.abs(exponents - np.round(exponents)) - 0.5)
            if whole and np.all(np.abs(exponents - before) <= SETTLED_SHARE * np.min(to_a_half, initial=1.0)):
                break
        return np.asarray(np.round(exponents) if whole else exponents, dtype=np.float64)

    def _normal_residual(
        self, entries: _Entries, weights: FloatArray, exponents: FloatArray, ridge: float
    ) -> FloatArray:
        """Return the residual of the normal equations."""
        parts = _whole_parts(weights * entries.logarithms(exponents))
        missed = -ridge * exponents - sum(map(entries.sums, parts[::-1]))
        for unknown, exponent in self._wishes:
            missed[unknown] += WISH_WEIGHT * ridge * (exponent - exponents[unknown])
        return missed

    def _solved(
        self, entries: _Entries, weights: FloatArray, ridge: float
    ) -> tuple[Callable[[FloatArray], FloatArray], FloatArray]:
        """Return what solves the normal equations for a right side, and the solution."""
        normal, right = entries.normal(weights), -entries.sums(weights * entries.sizes)
        diagonal = np.einsum("ii->i", normal)
        diagonal += ridge
        for unknown, exponent in self._wishes:
            diagonal[unknown] += WISH_WEIGHT * ridge
            right[unknown] += WISH_WEIGHT * ridge * exponent
        solved = _factored(normal)
        return solved, solved(right)


def _factored(matrix: FloatArray) -> Callable[[FloatArray], FloatArray]:
    """Return a solver for equations with a matrix ``(n, n)``, definite beyond rounding; the matrix is overwritten."""
    if not matrix.size:
        return lambda right: right
    matrix = np.asarray_chkfinite(matrix)
    if len(matrix) >= MANY_UNKNOWNS:
        # The factor overwrites one triangle; the other one restores the matrix if this fails.
        diagonal = matrix.diagonal().copy()
        factor, failed = lapack.dpotrf(matrix.T, lower=1, clean=0, overwrite_a=1)
        if not failed:
            return lambda right: np.asarray(lapack.dpotrs(factor, right, lower=1)[0], dtype=np.float64)
        below = np.tril(matrix, -1)
        matrix = below + below.T
        np.fill_diagonal(matrix, diagonal)
    factors, pivots, failed = lapack.dgetrf(matrix)
    if failed:
        raise np.linalg.LinAlgError("Singular matrix")
    return lambda right: np.asarray(lapack.dgetrs(factors, pivots, right)[0], dtype=np.float64)


def _whole_parts(parts: FloatArray) -> list[FloatArray]:
    """Return multiples of decreasing powers of two whose sum is ``parts``, except for the last bits of small ones.

    Sums of such multiples are exact, so that a summand of two sums has the same value in both.
    """
    multiples = []
    for bits in PART_BITS:
        multiples.append(np.ldexp(np.rint(np.ldexp(parts, bits)), -bits))
        parts = parts - multiples[-1]
    return multiples


@dataclass(frozen=True, eq=False)
class _Entries:
    """Logarithms and weights ``(k,)`` of entries, and the unknowns that scale them: places and signs, ``(k,)`` each.

    Of row, of column and, where any has one, common; one place more than there are unknowns stands for none.  Sums add
    up one entry after the other, so that they come out the same on every machine."""

    count: int
    sizes: FloatArray
    weights: FloatArray
    places: Sequence[NDArray[np.int64]]
    signs: Sequence[FloatArray]

    @classmethod
    def joined(cls, terms: Sequence[_Entries], count: int) -> _Entries:
        """Return the entries of all matrices, for ``count`` unknowns."""
        kinds = range(3 if any((term.places[2] < count).any() for term in terms) else 2)
        return cls(
            count,
            np.concatenate([np.zeros(0), *(term.sizes for term in terms)]),
            np.concatenate([np.zeros(0), *(term.weights for term in terms)]),
            [np.concatenate([np.zeros(0, dtype=np.int64), *(term.places[k] for term in terms)]) for k in kinds],
            [np.concatenate([np.zeros(0), *(term.signs[k] for term in terms)]) for k in kinds],
        )

    def logarithms(self, exponents: FloatArray) -> FloatArray:
        """Return the logarithms of the scaled entries."""
        totals, known = self.sizes.copy(), np.append(exponents, 0.0)
        for place, sign in zip(self.places, self.signs, strict=True):
            totals += sign * known[place]
        return totals

    def influence(self, exponents: FloatArray) -> FloatArray:
        """Return the weight of each scaled entry by its size: one for sizes from one on, less for smaller ones."""
        return np.asarray(1.0 / (1.0 + (np.minimum(self.logarithms(exponents), 0.0) / HALF_SAY) ** 2))

    def sums(self, parts: FloatArray) -> FloatArray:
        """Return for each unknown the signed sum ``(count,)`` of the ``parts`` of the entries that it scales."""
        totals = np.zeros(self.count + 1)
        for place, sign in zip(self.places, self.signs, strict=True):
            totals += np.bincount(place, sign * parts, len(totals))
        return totals[:-1]

    def diagonal(self, weights: FloatArray) -> FloatArray:
        """Return for each unknown the weight ``(count,)`` of all entries that it scales."""
        totals = np.zeros(self.count + 1)
        for place in self.places:
            totals += np.bincount(place, weights, len(totals))
        return totals[:-1]

    def normal(self, weights: FloatArray) -> FloatArray:
        """Return the matrix ``(count, count)`` of the normal equations."""
        count = self.count + 1
        matrix = np.diag(np.append(self.diagonal(weights), 0.0))
        scaled = list(zip(self.places, self.signs, strict=True))
        for number, (place, sign) in enumerate(scaled):
            for other, other_sign in scaled[:number]:
                products = np.bincount(place * count + other, sign * other_sign * weights, count * count)
                products = products.reshape(count, count)
                matrix += products
                matrix += products.T
        return matrix[:-1, :-1]
