"""Exact arithmetic: what a stored double was written as, matrices of rational numbers, and roots of polynomials.

A double holds a decimal of up to 15 digits, which ``repr`` gives back; one with more is a short multiple of a power of
two, or was computed: the shortest decimal that rounds to it stands for it, known only to its last digit.
A root on the boundary, and every pair that mirror each other (one is unstable), is a root of the greatest common
divisor with ``p(-s)`` or ``z^n p(1/z)``; all others are distinguished from the boundary by isolating them in enough
digits.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from fractions import Fraction
from functools import lru_cache
from math import frexp, gcd, lcm
from typing import Any, TypeAlias

import flint
import numpy as np
from flint import fmpq, fmpq_mat, fmpq_poly, fmpz, fmpz_mat, fmpz_poly, nmod_mat

from obsynth.numerics.arrays import FloatArray

#: The prime modulo which ranks are bounded from below first.
PRIME = (1 << 61) - 1

#: Bits of the whole number that, times a power of two, is a double.
MANTISSA_BITS = 53

#: Decimals of so many digits survive the way into a double and back.
LOSSLESS_DIGITS = 15

#: Odd parts of fewer bits are data that were multiplied by a power of two.
SHORT_BITS = 34

#: Integers of Python, and the exponent of the power of two by which they are multiplied.
ScaledIntegers: TypeAlias = tuple[np.ndarray, int]

#: Rows of rational numbers.
FractionRows: TypeAlias = Sequence[Sequence[Fraction]]

#: Digits (binary) in which roots are isolated first, and how often they are doubled.
FIRST_BITS = 106

MOST_DIGIT_DOUBLINGS = 7


def blocks(parts: list[list[fmpq_mat]]) -> fmpq_mat:
    """Return the block matrix with these rows of blocks, rational or enclosures."""
    height = sum(row[0].nrows() for row in parts)
    width = sum(part.ncols() for part in parts[0])
    lines = (line for row in parts for line in zip(*(part.tolist() for part in row), strict=True))
    return type(parts[0][0])(height, width, [value for line in lines for piece in line for value in piece])


def zeros_matrix(rows: int, columns: int) -> fmpq_mat:
    """Return a zero matrix."""
    return fmpq_mat(rows, columns)


def identity(order: int) -> fmpq_mat:
    """Return a unit matrix."""
    return fmpq_mat(order, order, [int(i == j) for i in range(order) for j in range(order)])


def picked_columns(matrix: fmpq_mat, columns: Sequence[int]) -> fmpq_mat:
    """Return some columns."""
    rows = int(matrix.nrows())
    return type(matrix)(rows, len(columns), [matrix[i, j] for i in range(rows) for j in columns])


def picked_rows(matrix: fmpq_mat, rows: Sequence[int]) -> fmpq_mat:
    """Return some rows."""
    columns = int(matrix.ncols())
    return type(matrix)(len(rows), columns, [matrix[i, j] for i in rows for j in range(columns)])


def row_basis(matrix: fmpq_mat) -> fmpq_mat:
    """Return a basis of the rows, in reduced echelon form."""
    reduced, rank = matrix.rref()
    return picked_rows(reduced, range(rank))


def pivot_columns(matrix: fmpq_mat) -> list[int]:
    """Return the columns, from the left, that are no combination of those before them."""
    return _leading(*matrix.rref())


def _leading(reduced: Any, rank: int) -> list[int]:
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


def whole_null_basis(matrix: fmpq_mat) -> tuple[Any, fmpz, list[int]]:
    """Return the basis of `null_basis` times a number that makes it whole, that number, and the columns that are free.

    Entries in lowest terms take most of the time of a large basis."""
    reduced, size, rank = matrix.numer_denom()[0].rref()
    columns, pivots, table = int(matrix.ncols()), _leading(reduced, rank), reduced.tolist()
    free = [j for j in range(columns) if j not in set(pivots)]
    basis = fmpz_mat(columns, len(free))
    for k, j in enumerate(free):
        basis[j, k] = size
        for i, pivot in enumerate(pivots):
            basis[pivot, k] = -table[i][j]
    return basis, fmpz(size), free


def left_null_basis(matrix: fmpq_mat) -> fmpq_mat:
    """Return a basis ``(m - rank, m)`` of the left null space, as rows."""
    return null_basis(matrix.transpose()).transpose()


def rank_of(matrix: fmpq_mat) -> int:
    """Return the rank; a full one shows modulo a prime, but for bad luck, in a fraction of the time."""
    most = min(int(matrix.nrows()), int(matrix.ncols()))
    return most if most and int(nmod_mat(matrix.numer_denom()[0], PRIME).rank()) == most else int(matrix.rank())


def over_one_denominator(E: fmpq_mat, A: fmpq_mat) -> tuple[fmpz_mat, fmpz_mat]:
    """Return two matrices multiplied by the least number that makes all of their entries integers."""
    (e, own), (a, other) = E.numer_denom(), A.numer_denom()
    common = lcm(int(own), int(other))
    return e * (common // int(own)), a * (common // int(other))


def coprime(values: list[int]) -> list[int]:
    """Return whole numbers without their common divisor."""
    common = gcd(*values)
    return [value // common for value in values] if common > 1 else values


# Matrices hold the same numbers many times, and what is asked of a plant is asked of its numbers again.
@lru_cache(maxsize=1 << 14)
def written_fraction(value: float) -> Fraction:
    """Return the rational number that a finite double was written as."""
    return Fraction(*_ratio_as_written(float(value)))


def written_rows(matrix: FloatArray) -> tuple[tuple[Fraction, ...], ...]:
    """Return the rows of a matrix ``(m, n)`` of doubles as the rational numbers that were written."""
    return tuple(tuple(map(written_fraction, row)) for row in matrix.tolist())


@lru_cache(maxsize=1 << 14)
def _ratio_as_written(value: float) -> tuple[int, int]:
    """Return numerator and denominator, which may have common factors, of what a finite double was written as."""
    digits, power = _decimal(value)
    # In the order of what they cost: digits that count are not more than all.
    if len(digits) > LOSSLESS_DIGITS and _is_short(value) and _digits_that_count(digits) > LOSSLESS_DIGITS:
        return value.as_integer_ratio()
    return (int(digits) * 10**power, 1) if power >= 0 else (int(digits), int(10**-power))


def is_computed(value: float) -> bool:
    """Whether a double has so many digits that it was computed, and is known only to its last digit."""
    return not _is_short(value) and _digits_that_count(_decimal(value)[0]) > LOSSLESS_DIGITS


def holds_computed(matrix: FloatArray) -> bool:
    """Whether an entry of a matrix was computed."""
    return any(map(is_computed, _split_entries(matrix)[1]))


def _split_entries(matrix: FloatArray) -> tuple[list[float], list[float]]:
    """Return the entries that are short multiples of a power of two, which are as they were written, and all others."""
    parts = np.ldexp(np.frexp(matrix)[0], SHORT_BITS)
    short = parts == np.rint(parts)
    return matrix[short].tolist(), matrix[~short].tolist()


def written_matrix(matrix: FloatArray) -> fmpq_mat:
    """Return a matrix ``(m, n)`` of doubles as the rational numbers that were written."""
    (rows, columns), values = matrix.shape, np.ravel(matrix).tolist()
    decimals = {value: _decimal(value) for value in set(values)}
    if any(len(decimals[value][0]) > LOSSLESS_DIGITS for value in _split_entries(matrix)[0]):
        return fmpq_mat(rows, columns, [fmpq(*_ratio_as_written(value)) for value in values])
    # Whole numbers of one power of ten.
    powers = [0, *(power for _, power in decimals.values())]
    least = min(powers)
    tens = [10**power for power in range(max(powers) - least + 1)]
    integers = {value: int(digits) * tens[power - least] for value, (digits, power) in decimals.items()}
    rational: fmpq_mat = fmpq_mat(fmpz_mat(rows, columns, [integers[value] for value in values])) / fmpz(10) ** -least
    return rational


def stored_matrix(matrix: FloatArray) -> fmpq_mat:
    """Return a matrix ``(m, n)`` of doubles as the rational numbers that are stored, whatever they stand for."""
    (integers,), unit = whole_matrices([matrix])
    rational: fmpq_mat = fmpq_mat(integers) / unit
    return rational


def scaled_integers(doubles: FloatArray) -> ScaledIntegers:
    """Return doubles exactly: integers ``(n,)``, and the exponent of the power of two by which all are multiplied."""
    parts, exponents = np.frexp(doubles)
    least = int(np.min(exponents, initial=0, where=doubles != 0.0)) - MANTISSA_BITS
    mantissas = np.ldexp(parts, MANTISSA_BITS).astype(np.int64).tolist()
    shifts = np.where(doubles != 0.0, exponents - MANTISSA_BITS - least, 0).tolist()
    integers = np.empty(len(mantissas), dtype=object)
    integers[:] = [value << shift for value, shift in zip(mantissas, shifts, strict=True)]
    return integers, least


def whole_matrices(matrices: Sequence[FloatArray]) -> tuple[list[fmpz_mat], fmpz]:
    """Return matrices of doubles as they are stored, times a power of two that makes all entries whole, and that."""
    parts = [np.frexp(matrix) for matrix in matrices]
    least = min(int(np.min(powers, initial=0, where=half != 0.0)) for half, powers in parts) - MANTISSA_BITS
    scaled = []
    for half, powers in parts:
        integers, shifts = np.ldexp(half, MANTISSA_BITS).astype(np.int64), powers - MANTISSA_BITS - least
        # What is zero is not shifted.
        shifts = np.where(integers != 0, shifts, 0)
        shifted = [
            value << shift for value, shift in zip(integers.ravel().tolist(), shifts.ravel().tolist(), strict=True)
        ]
        rows, columns = half.shape
        scaled.append(fmpz_mat(rows, columns, shifted))
    return scaled, fmpz(2) ** -least


def rational_matrix(rows: FractionRows, columns: int) -> fmpq_mat:
    """Return rows of fractions as a matrix ``(m, columns)``."""
    return fmpq_mat(len(rows), columns, [fmpq(value.numerator, value.denominator) for row in rows for value in row])


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


def _decimal(value: float) -> tuple[str, int]:
    """Return the shortest decimal of a finite double: its digits with their sign, and the power of ten of the last."""
    mantissa, _, exponent = repr(value).partition("e")
    whole, _, part = mantissa.partition(".")
    return whole + part, int(exponent or 0) - len(part)


def _digits_that_count(digits: str) -> int:
    """Return how many digits of a decimal count."""
    return len(digits.lstrip("-").strip("0")) or 1


def _is_short(value: float) -> bool:
    """Whether a double is a whole number of few bits times a power of two."""
    return (frexp(value)[0] * (1 << SHORT_BITS)).is_integer()


@dataclass(frozen=True)
class Root:
    """One root: its value to double precision, how often, and which side of the stability boundary it is on."""

    value: complex
    multiplicity: int
    side: str  # stable, boundary or unstable


def locate_roots(polynomial: fmpz_poly, *, discrete: bool) -> tuple[Root, ...]:
    """Return the roots of a nonzero polynomial, by decreasing instability, and where they are: exact, however close to
    the stability boundary."""
    if polynomial.degree() <= 0:
        return ()
    coefficients = polynomial.coeffs()
    at_minus = [(-1) ** power * coefficient for power, coefficient in enumerate(coefficients)]
    mirror = fmpz_poly(coefficients[::-1] if discrete else at_minus)
    common = polynomial.gcd(mirror)
    roots: list[Root] = []
    # Origin: under the mirror of the unit circle it goes to infinity, and reversing has dropped it.
    remaining = primitive(fmpq_poly(polynomial) / fmpq_poly(common)) if common.degree() > 0 else polynomial
    for part, may_lie_on_boundary in ((common, True), (remaining, False)):
        roots += _roots_with_sides(part, discrete=discrete, may_lie_on_boundary=may_lie_on_boundary)
    roots.sort(key=lambda root: -(abs(root.value) if discrete else root.value.real))
    return tuple(roots)


def primitive(polynomial: fmpq_poly) -> fmpz_poly:
    """Return a multiple with coprime integer coefficients and a positive leading one."""
    numerator = polynomial.numer()
    if numerator.is_zero():
        return numerator
    content = numerator.content()
    sign = -1 if int(numerator.leading_coefficient()) < 0 else 1
    return fmpz_poly([sign * coefficient // content for coefficient in numerator.coeffs()])


def _roots_with_sides(polynomial: fmpz_poly, *, discrete: bool, may_lie_on_boundary: bool) -> list[Root]:
    """Return the roots with their sides; more digits until each is distinguished from the boundary, or shown to be on
    it."""
    if polynomial.degree() <= 0:
        return []
    bits = FIRST_BITS
    enclosures: list[tuple[flint.acb, int, str]] = []
    for _ in range(MOST_DIGIT_DOUBLINGS):
        with flint.ctx.workprec(bits):
            pairs: Any = polynomial.complex_roots()
            enclosures = [(root, int(times), _side(root, discrete)) for root, times in pairs]
        if all(side != "boundary" for _, _, side in enclosures):
            break
        # What mirrors itself within so many digits cannot be one of a pair: those are further apart.
        if may_lie_on_boundary and bits > _separation_bits(polynomial):
            break
        bits *= 2
    return [Root(_value(root, side, discrete), times, side) for root, times, side in enclosures]


def _side(root: flint.acb, discrete: bool) -> str:
    distance = root.real * root.real + root.imag * root.imag - 1 if discrete else root.real
    return "unstable" if distance > 0 else "stable" if distance < 0 else "boundary"


def _separation_bits(polynomial: fmpz_poly) -> int:
    """Return digits in which two different roots differ for certain (Mahler 1964), generously."""
    degree = polynomial.degree()
    return int(degree * (degree.bit_length() + 2) + degree * (polynomial.height_bits() + degree.bit_length()))


def _value(root: flint.acb, side: str, discrete: bool) -> complex:
    # Roots are isolated far beyond double precision: a part that may be zero is.
    real, imaginary = (0.0 if part.contains(0) else float(part.mid()) for part in (root.real, root.imag))
    value = complex(real, imaginary)
    if side == "boundary":
        value = value / abs(value) if discrete else complex(0.0, imaginary)
    return value


def rounded_outward(value: Fraction) -> float:
    """Return a double that is not below a rational number."""
    nearest = float(value)
    return nearest if Fraction(nearest) >= value else float(np.nextafter(nearest, np.inf))
