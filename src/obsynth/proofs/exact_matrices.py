"""Rational numbers and matrices: what a stored double was written as, blocks, null spaces, integer entries.

A double holds a decimal of up to 15 digits without loss, and ``repr`` gives that decimal back.  A double with more
digits is a short multiple of a power of two (data scaled by powers of two are exact), or it was computed: then the
shortest decimal that rounds to it stands for it, known only to its last digit.
"""

from __future__ import annotations

from collections.abc import Sequence
from fractions import Fraction
from typing import TypeAlias

import numpy as np
from flint import fmpq, fmpq_mat, fmpz, fmpz_mat
from numpy.typing import NDArray

from obsynth.numerics.arrays import FloatArray


def blocks(parts: list[list[fmpq_mat]]) -> fmpq_mat:
    """Return the block matrix with these rows of blocks."""
    height = sum(row[0].nrows() for row in parts)
    width = sum(part.ncols() for part in parts[0])
    entries: list[fmpq] = []
    for row in parts:
        for i in range(row[0].nrows()):
            for part in row:
                entries += [part[i, j] for j in range(part.ncols())]
    return fmpq_mat(height, width, entries)


def zeros_matrix(rows: int, columns: int) -> fmpq_mat:
    """Return a zero matrix."""
    return fmpq_mat(rows, columns)


def identity(order: int) -> fmpq_mat:
    """Return a unit matrix."""
    return fmpq_mat(order, order, [int(i == j) for i in range(order) for j in range(order)])


def pivot_columns(matrix: fmpq_mat) -> list[int]:
    """Return the columns, from the left, that are no combination of those before them."""
    return _leading(*matrix.rref())


def _leading(reduced: fmpq_mat, rank: int) -> list[int]:
    return [next(j for j in range(reduced.ncols()) if reduced[i, j] != 0) for i in range(rank)]


def null_basis(matrix: fmpq_mat) -> fmpq_mat:
    """Return a basis ``(n, n - rank)`` of the null space, as columns."""
    reduced, rank = matrix.rref()
    columns, pivots = int(matrix.ncols()), _leading(reduced, rank)
    free = [j for j in range(columns) if j not in set(pivots)]
    basis = fmpq_mat(columns, len(free))
    for k, j in enumerate(free):
        basis[j, k] = fmpq(1)
        for i, pivot in enumerate(pivots):
            basis[pivot, k] = -reduced[i, j]
    return basis


def with_integer_entries(E: fmpq_mat, A: fmpq_mat) -> tuple[fmpz_mat, fmpz_mat]:
    """Return two matrices ``(m, n)`` with common rows and columns multiplied by rationals, so that all are integers."""
    rows, columns = int(A.nrows()), int(A.ncols())
    table = np.array([E.tolist(), A.tolist()], dtype=object).reshape(2, rows, columns)
    for i in range(rows):
        table[:, i] /= _common_factor(table[:, i])
    for j in range(columns):
        table[:, :, j] /= _common_factor(table[:, :, j])
    # Columns may have brought denominators back; rows are cleared for good.
    for i in range(rows):
        table[:, i] /= _common_factor(table[:, i])
    e, a = ([fmpz(value.p) for value in part.ravel()] for part in table)
    return fmpz_mat(rows, columns, e), fmpz_mat(rows, columns, a)


def _common_factor(values: NDArray[np.object_]) -> fmpq:
    """Return the number that divides all of these into coprime integers."""
    numerator, denominator = fmpz(0), fmpz(1)
    for value in values.ravel():
        numerator, denominator = numerator.gcd(value.p), denominator.lcm(value.q)
    return fmpq(numerator, denominator) if numerator else fmpq(1)


#: Decimals of so many digits survive the way into a double and back.
LOSSLESS_DIGITS = 15


#: Odd parts of fewer bits are data that were multiplied by a power of two.
SHORT_BITS = 34


#: Rows of rational numbers.
FractionRows: TypeAlias = Sequence[Sequence[Fraction]]


def written_fraction(value: float) -> Fraction:
    """Return the rational number that a finite double was written as."""
    text = repr(float(value))
    if _digits(text) <= LOSSLESS_DIGITS:
        return Fraction(text)
    exact = Fraction(value)
    return exact if _odd_part(exact).bit_length() <= SHORT_BITS else Fraction(text)


def is_computed(value: float) -> bool:
    """Whether a double has so many digits that it was computed, and is known only to its last digit."""
    if _digits(repr(float(value))) <= LOSSLESS_DIGITS:
        return False
    return _odd_part(Fraction(value)).bit_length() > SHORT_BITS


def computed_entries(matrix: FloatArray) -> int:
    """Return how many entries of a matrix were computed."""
    return sum(is_computed(value) for value in np.ravel(matrix).tolist())


def written_matrix(matrix: FloatArray) -> fmpq_mat:
    """Return a matrix ``(m, n)`` of doubles as the rational numbers that were written."""
    rows, columns = matrix.shape
    return fmpq_mat(rows, columns, [_as_fmpq(written_fraction(value)) for value in np.ravel(matrix).tolist()])


def stored_matrix(matrix: FloatArray) -> fmpq_mat:
    """Return a matrix ``(m, n)`` of doubles as the rational numbers that are stored, whatever they stand for."""
    rows, columns = matrix.shape
    return fmpq_mat(rows, columns, [_as_fmpq(Fraction(value)) for value in np.ravel(matrix).tolist()])


def rational_matrix(rows: FractionRows, columns: int) -> fmpq_mat:
    """Return rows of fractions as a matrix ``(m, columns)``."""
    return fmpq_mat(len(rows), columns, [_as_fmpq(value) for row in rows for value in row])


def fractions_of(matrix: fmpq_mat) -> tuple[tuple[Fraction, ...], ...]:
    """Return the rows of a rational matrix as fractions."""
    return tuple(tuple(Fraction(int(entry.p), int(entry.q)) for entry in row) for row in matrix.tolist())


def nearest_doubles(matrix: fmpq_mat) -> FloatArray:
    """Return a rational matrix with every entry rounded once."""
    shape = (matrix.nrows(), matrix.ncols())
    values = [_nearest_double(int(entry.p), int(entry.q)) for entry in matrix.entries()]
    return np.array(values, dtype=np.float64).reshape(shape)


def _nearest_double(numerator: int, denominator: int) -> float:
    """Return the quotient, infinite where it is larger than any double."""
    try:
        return numerator / denominator
    except OverflowError:
        return float("inf") if numerator > 0 else float("-inf")


def _as_fmpq(value: Fraction) -> fmpq:
    return fmpq(value.numerator, value.denominator)


def _digits(text: str) -> int:
    mantissa = text.lower().partition("e")[0].lstrip("-").replace(".", "")
    return len(mantissa.strip("0")) or 1


def _odd_part(value: Fraction) -> int:
    numerator = abs(value.numerator)
    return numerator >> ((numerator & -numerator).bit_length() - 1) if numerator else 0
