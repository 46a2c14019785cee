"""Numbers as they were written: the rational number that a stored double stands for.

A double holds a decimal of up to 15 digits without loss, and ``repr`` gives that decimal back.  A double with more
digits is a short multiple of a power of two (data scaled by powers of two are exact), or it was computed: then the
shortest decimal that rounds to it stands for it, known only to its last digit.
"""

from __future__ import annotations

from collections.abc import Sequence
from fractions import Fraction
from typing import TYPE_CHECKING, TypeAlias

import numpy as np

from obsynth.numerics.arrays import FloatArray

if TYPE_CHECKING:
    from flint import fmpq, fmpq_mat

#: Decimals of so many digits survive the way into a double and back.
LOSSLESS_DIGITS = 15
#: Odd parts of fewer bits are data that were multiplied by a power of two.
SHORT_BITS = 34

#: Rows of rational numbers.
FractionRows: TypeAlias = Sequence[Sequence[Fraction]]


#: Bits of the whole number that, times a power of two, is a double.
MANTISSA_BITS = 53


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
    from flint import fmpq_mat

    rows, columns = matrix.shape
    return fmpq_mat(rows, columns, [_as_fmpq(written_fraction(value)) for value in np.ravel(matrix).tolist()])


def stored_matrix(matrix: FloatArray) -> fmpq_mat:
    """Return a matrix ``(m, n)`` of doubles as the rational numbers that are stored, whatever they stand for."""
    from flint import fmpq_mat, fmpz, fmpz_mat

    # Whole numbers of one power of two.
    parts, exponents = np.frexp(matrix)
    least = int(np.min(exponents, initial=0, where=matrix != 0.0)) - MANTISSA_BITS
    whole, shifts = np.ldexp(parts, MANTISSA_BITS).astype(np.int64), exponents - MANTISSA_BITS - least
    shifted = [value << shift for value, shift in zip(whole.ravel().tolist(), shifts.ravel().tolist(), strict=True)]
    return fmpq_mat(fmpz_mat(*matrix.shape, shifted)) / fmpz(2) ** -least


def rational_matrix(rows: FractionRows, columns: int) -> fmpq_mat:
    """Return rows of fractions as a matrix ``(m, columns)``."""
    from flint import fmpq_mat

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
    from flint import fmpq

    return fmpq(value.numerator, value.denominator)


def _digits(text: str) -> int:
    mantissa = text.lower().partition("e")[0].lstrip("-").replace(".", "")
    return len(mantissa.strip("0")) or 1


def _odd_part(value: Fraction) -> int:
    numerator = abs(value.numerator)
    return numerator >> ((numerator & -numerator).bit_length() - 1) if numerator else 0
