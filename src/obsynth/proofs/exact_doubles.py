"""Exact values of doubles: the decimal number that a double was written as, and the binary number that it stores.

A double keeps any decimal of up to 15 digits, and ``repr`` returns it.  A double whose shortest decimal has more digits
is a short multiple of a power of two, or it was computed.  A computed double stands for its shortest decimal, of which
only the last digit is uncertain.
"""

from __future__ import annotations

from collections.abc import Sequence
from fractions import Fraction
from functools import lru_cache
from math import frexp
from typing import TypeAlias

import numpy as np
from flint import fmpq, fmpq_mat, fmpz, fmpz_mat

from obsynth.numerics.arrays import FloatArray

#: Bits of the mantissa of a double.
MANTISSA_BITS = 53

#: Decimals with so many digits survive the conversion to a double and back.
LOSSLESS_DIGITS = 15

#: A double with fewer mantissa bits counts as written, not computed: data multiplied by a power of two.
SHORT_BITS = 34

#: An array of Python integers, and the exponent of the power of two by which all of them are multiplied.
ScaledIntegers: TypeAlias = tuple[np.ndarray, int]


# Matrices repeat the same numbers, and several conditions convert the numbers of one plant.
@lru_cache(maxsize=1 << 14)
def written_fraction(value: float) -> Fraction:
    """Return the rational number that a finite double was written as."""
    return Fraction(*_ratio_as_written(float(value)))


def written_rows(matrix: FloatArray) -> tuple[tuple[Fraction, ...], ...]:
    """Return the rows of a matrix ``(m, n)`` of doubles as the rational numbers that were written."""
    return tuple(tuple(map(written_fraction, row)) for row in matrix.tolist())


def written_matrix(matrix: FloatArray) -> fmpq_mat:
    """Return a matrix ``(m, n)`` of doubles as the rational numbers that were written."""
    (rows, columns), values = matrix.shape, np.ravel(matrix).tolist()
    decimals = {value: _decimal(value) for value in set(values)}
    if any(len(decimals[value][0]) > LOSSLESS_DIGITS for value in _split_entries(matrix)[0]):
        return fmpq_mat(rows, columns, [fmpq(*_ratio_as_written(value)) for value in values])
    # All entries as integers times one power of ten: faster than fractions one by one.
    powers = [0, *(power for _, power in decimals.values())]
    least = min(powers)
    tens = [10**power for power in range(max(powers) - least + 1)]
    integers = {value: int(digits) * tens[power - least] for value, (digits, power) in decimals.items()}
    rational: fmpq_mat = fmpq_mat(fmpz_mat(rows, columns, [integers[value] for value in values])) / fmpz(10) ** -least
    return rational


def is_computed(value: float) -> bool:
    """Whether a double has more digits than people write, so that it was computed and has an uncertain last digit."""
    return not _is_short(value) and _significant_digits(_decimal(value)[0]) > LOSSLESS_DIGITS


def holds_computed(matrix: FloatArray) -> bool:
    """Whether an entry of a matrix was computed."""
    return any(map(is_computed, _split_entries(matrix)[1]))


def stored_matrix(matrix: FloatArray) -> fmpq_mat:
    """Return a matrix ``(m, n)`` of doubles as the rational numbers that their bits store."""
    (integers,), unit = whole_matrices([matrix])
    rational: fmpq_mat = fmpq_mat(integers) / unit
    return rational


def scaled_integers(doubles: FloatArray) -> ScaledIntegers:
    """Return doubles ``(n,)`` exactly, as integers and the exponent of a common power of two."""
    parts, exponents = np.frexp(doubles)
    least = int(np.min(exponents, initial=0, where=doubles != 0.0)) - MANTISSA_BITS
    mantissas = np.ldexp(parts, MANTISSA_BITS).astype(np.int64).tolist()
    shifts = np.where(doubles != 0.0, exponents - MANTISSA_BITS - least, 0).tolist()
    integers = np.empty(len(mantissas), dtype=object)
    integers[:] = [value << shift for value, shift in zip(mantissas, shifts, strict=True)]
    return integers, least


def whole_matrices(matrices: Sequence[FloatArray]) -> tuple[list[fmpz_mat], fmpz]:
    """Return matrices of doubles times a power of two that makes all entries integers, and that power of two."""
    parts = [np.frexp(matrix) for matrix in matrices]
    least = min(int(np.min(powers, initial=0, where=half != 0.0)) for half, powers in parts) - MANTISSA_BITS
    scaled = []
    for half, powers in parts:
        integers, shifts = np.ldexp(half, MANTISSA_BITS).astype(np.int64), powers - MANTISSA_BITS - least
        # The exponent of a zero is meaningless, and might be a huge shift.
        shifts = np.where(integers != 0, shifts, 0)
        shifted = [
            value << shift for value, shift in zip(integers.ravel().tolist(), shifts.ravel().tolist(), strict=True)
        ]
        rows, columns = half.shape
        scaled.append(fmpz_mat(rows, columns, shifted))
    return scaled, fmpz(2) ** -least


def rounded_outward(value: Fraction) -> float:
    """Return a double that is not below a rational number."""
    nearest = float(value)
    return nearest if Fraction(nearest) >= value else float(np.nextafter(nearest, np.inf))


@lru_cache(maxsize=1 << 14)
def _ratio_as_written(value: float) -> tuple[int, int]:
    """Return numerator and denominator, not always coprime, of the number that a finite double was written as."""
    digits, power = _decimal(value)
    # The cheapest test comes first.
    if len(digits) > LOSSLESS_DIGITS and _is_short(value) and _significant_digits(digits) > LOSSLESS_DIGITS:
        return value.as_integer_ratio()
    return (int(digits) * 10**power, 1) if power >= 0 else (int(digits), int(10**-power))


def _split_entries(matrix: FloatArray) -> tuple[list[float], list[float]]:
    """Return the entries that are short multiples of a power of two, and all others."""
    parts = np.ldexp(np.frexp(matrix)[0], SHORT_BITS)
    short = parts == np.rint(parts)
    return matrix[short].tolist(), matrix[~short].tolist()


def _decimal(value: float) -> tuple[str, int]:
    """Return the shortest decimal of a finite double: signed digits, and the power of ten of the last digit."""
    mantissa, _, exponent = repr(value).partition("e")
    whole, _, part = mantissa.partition(".")
    return whole + part, int(exponent or 0) - len(part)


def _significant_digits(digits: str) -> int:
    """Return the number of significant digits, without zeros at either end."""
    return len(digits.lstrip("-").strip("0")) or 1


def _is_short(value: float) -> bool:
    """Whether a double is an integer of at most `SHORT_BITS` bits times a power of two."""
    return (frexp(value)[0] * (1 << SHORT_BITS)).is_integer()
