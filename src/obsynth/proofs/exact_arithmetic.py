"""Exact arithmetic: what a stored double was written as, matrices of rational numbers, and roots of polynomials.

A double holds a decimal of up to 15 digits, which ``repr`` gives back; one with more is a short multiple of a power of
two, or was computed: the shortest decimal that rounds to it stands for it, known only to its last digit.
A root on the boundary, and every pair that mirror each other (one is unstable), is a root of the greatest common
divisor with ``p(-s)`` or ``z^n p(1/z)``; all others are distinguished from the boundary by isolating them in enough
digits.

Pencils ``A - s E`` decided exactly where their numbers are rational, and to hundreds of digits where they are not.

Rational numbers: normal rank, zeros, index, left null space. The greatest common divisor of all r-minors, r the normal
rank, has the finite zeros as its roots. Determinants of two random integer compressions to r by r combine all these
minors (Cauchy, Binet): so does their greatest common divisor, unless chance adds a factor, which a third removes. They
are of degree rank E at most: values at integers give them. The rank at any point (modulo a prime) bounds r from below;
rank r or less at one point more than rank E, from above, as all (r + 1)-minors are polynomials of that degree.

Irrational numbers, those of sampled plants: an enclosure without zero tells a number from zero for certain; one with
zero counts as zero: *to digits*, not exact. Elimination with the surest pivots, Euclid's algorithm and the recursion of
Schur and Cohn (Jury): none needs a root.
"""

from __future__ import annotations

import random
from collections.abc import Sequence
from dataclasses import dataclass
from fractions import Fraction
from functools import cache, cached_property, lru_cache
from itertools import count
from math import frexp, gcd, isqrt, lcm, prod
from typing import Any, TypeAlias

import flint
import numpy as np
from flint import arb, arb_mat, fmpq, fmpq_mat, fmpq_poly, fmpz, fmpz_mat, fmpz_poly, nmod_mat, nmod_poly

from obsynth.numerics.arguments import FloatArray


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


#: The prime modulo which ranks are bounded from below first.
PRIME = (1 << 61) - 1


def rank_of(matrix: fmpq_mat) -> int:
    """Return the rank; a full one shows modulo a prime, but for bad luck, in a fraction of the time."""
    most = min(int(matrix.nrows()), int(matrix.ncols()))
    return most if most and int(nmod_mat(matrix.numer_denom()[0], PRIME).rank()) == most else int(matrix.rank())


def over_one_denominator(E: fmpq_mat, A: fmpq_mat) -> tuple[fmpz_mat, fmpz_mat]:
    """Return two matrices multiplied by the least number that makes all of their entries integers."""
    (e, own), (a, other) = E.numer_denom(), A.numer_denom()
    common = lcm(int(own), int(other))
    return e * (common // int(own)), a * (common // int(other))


def _coprime(values: list[int]) -> list[int]:
    common = gcd(*values)
    return [value // common for value in values] if common > 1 else values


#: Bits of the whole number that, times a power of two, is a double.
MANTISSA_BITS = 53
#: Decimals of so many digits survive the way into a double and back.
LOSSLESS_DIGITS = 15
#: Odd parts of fewer bits are data that were multiplied by a power of two.
SHORT_BITS = 34
#: Rows of rational numbers.
FractionRows: TypeAlias = Sequence[Sequence[Fraction]]


# Matrices hold the same numbers many times, and what is asked of a plant is asked of its numbers again.
@lru_cache(maxsize=1 << 14)
def written_fraction(value: float) -> Fraction:
    """Return the rational number that a finite double was written as."""
    return Fraction(*_written(float(value)))


def written_rows(matrix: FloatArray) -> tuple[tuple[Fraction, ...], ...]:
    """Return the rows of a matrix ``(m, n)`` of doubles as the rational numbers that were written."""
    return tuple(tuple(map(written_fraction, row)) for row in matrix.tolist())


@lru_cache(maxsize=1 << 14)
def _written(value: float) -> tuple[int, int]:
    """Return numerator and denominator, which may have common factors, of what a finite double was written as."""
    digits, power = _decimal(value)
    # In the order of what they cost: digits that count are not more than all.
    if len(digits) > LOSSLESS_DIGITS and _is_short(value) and _count(digits) > LOSSLESS_DIGITS:
        return value.as_integer_ratio()
    return (int(digits) * 10**power, 1) if power >= 0 else (int(digits), int(10**-power))


def is_computed(value: float) -> bool:
    """Whether a double has so many digits that it was computed, and is known only to its last digit."""
    return not _is_short(value) and _count(_decimal(value)[0]) > LOSSLESS_DIGITS


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
        return fmpq_mat(rows, columns, [fmpq(*_written(value)) for value in values])
    # Whole numbers of one power of ten.
    powers = [0, *(power for _, power in decimals.values())]
    least = min(powers)
    tens = [10**power for power in range(max(powers) - least + 1)]
    whole = {value: int(digits) * tens[power - least] for value, (digits, power) in decimals.items()}
    found: fmpq_mat = fmpq_mat(fmpz_mat(rows, columns, [whole[value] for value in values])) / fmpz(10) ** -least
    return found


def stored_matrix(matrix: FloatArray) -> fmpq_mat:
    """Return a matrix ``(m, n)`` of doubles as the rational numbers that are stored, whatever they stand for."""
    (whole,), unit = whole_matrices([matrix])
    found: fmpq_mat = fmpq_mat(whole) / unit
    return found


def whole_matrices(matrices: Sequence[FloatArray]) -> tuple[list[fmpz_mat], fmpz]:
    """Return matrices of doubles as they are stored, times a power of two that makes all entries whole, and that."""
    parts = [np.frexp(matrix) for matrix in matrices]
    least = min(int(np.min(powers, initial=0, where=half != 0.0)) for half, powers in parts) - MANTISSA_BITS
    found = []
    for half, powers in parts:
        whole, shifts = np.ldexp(half, MANTISSA_BITS).astype(np.int64), powers - MANTISSA_BITS - least
        # What is zero is not shifted.
        shifts = np.where(whole != 0, shifts, 0)
        shifted = [value << shift for value, shift in zip(whole.ravel().tolist(), shifts.ravel().tolist(), strict=True)]
        rows, columns = half.shape
        found.append(fmpz_mat(rows, columns, shifted))
    return found, fmpz(2) ** -least


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


def _count(digits: str) -> int:
    """Return how many digits of a decimal count."""
    return len(digits.lstrip("-").strip("0")) or 1


def _is_short(value: float) -> bool:
    """Whether a double is a whole number of few bits times a power of two."""
    return (frexp(value)[0] * (1 << SHORT_BITS)).is_integer()


#: Digits (binary) in which roots are isolated first, and how often they are doubled.
FIRST_BITS = 106


MOST_DIGIT_DOUBLINGS = 7


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
    found: list[Root] = []
    # Origin: under the mirror of the unit circle it goes to infinity, and reversing has dropped it.
    others = primitive(fmpq_poly(polynomial) / fmpq_poly(common)) if common.degree() > 0 else polynomial
    for part, may_lie_on_boundary in ((common, True), (others, False)):
        found += _isolated(part, discrete=discrete, may_lie_on_boundary=may_lie_on_boundary)
    found.sort(key=lambda root: -(abs(root.value) if discrete else root.value.real))
    return tuple(found)


def primitive(polynomial: fmpq_poly) -> fmpz_poly:
    """Return a multiple with coprime integer coefficients and a positive leading one."""
    numerator = polynomial.numer()
    if numerator.is_zero():
        return numerator
    content = numerator.content()
    sign = -1 if int(numerator.leading_coefficient()) < 0 else 1
    return fmpz_poly([sign * coefficient // content for coefficient in numerator.coeffs()])


def _isolated(polynomial: fmpz_poly, *, discrete: bool, may_lie_on_boundary: bool) -> list[Root]:
    """Return the roots with their sides; more digits until each is distinguished from the boundary, or shown to be on
    it."""
    if polynomial.degree() <= 0:
        return []
    bits = FIRST_BITS
    found: list[tuple[flint.acb, int, str]] = []
    for _ in range(MOST_DIGIT_DOUBLINGS):
        with flint.ctx.workprec(bits):
            pairs: Any = polynomial.complex_roots()
            found = [(root, int(times), _side(root, discrete)) for root, times in pairs]
        if all(side != "boundary" for _, _, side in found):
            break
        # What mirrors itself within so many digits cannot be one of a pair: those are further apart.
        if may_lie_on_boundary and bits > _separation_bits(polynomial):
            break
        bits *= 2
    return [Root(_value(root, side, discrete), times, side) for root, times, side in found]


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


#: Primes for ranks that are only bounded from below.
_PRIMES = (PRIME, 2305843009213693921, 2305843009213693907)
#: Random integers of a compression are of 16 bits less these; and the seed that makes every decision repeatable.
_DROPPED_BITS = 3
POINTS_SEED = 20150709
#: Compressions after which a factor that all of them share is a factor of all minors.
_MOST_COMPRESSIONS = 6


@dataclass(frozen=True, eq=False)
class ExactPencil:
    """The pencil ``A - s E`` with rational matrices ``(m, n)``; its parts are computed once and kept."""

    E: fmpq_mat
    A: fmpq_mat

    @classmethod
    def written(cls, E: FloatArray, A: FloatArray) -> ExactPencil:
        """Return the pencil of two matrices ``(m, n)`` of doubles, each as the number it was written as."""
        return cls(written_matrix(E), written_matrix(A))

    @property
    def shape(self) -> tuple[int, int]:
        """Rows and columns."""
        return int(self.A.nrows()), int(self.A.ncols())

    @cached_property
    def normal_rank(self) -> int:
        """Rank of ``A - s E`` at almost every s."""
        (e, a), least = self._plain_integers, 0
        for prime, point in [(prime, self._rng.randrange(prime)) for prime in _PRIMES]:
            moving, still = self._modulo if prime == _PRIMES[0] else (nmod_mat(e, prime), nmod_mat(a, prime))
            least = max(least, int((still - moving * point).rank()))
            if least == min(self.shape):
                return least
        e, a = self._integers
        return max([least, *(_at(e, a, point).rank() for point in _points(self._degree + 1))])

    @cached_property
    def zero_polynomial(self) -> fmpz_poly:
        """Primitive polynomial whose roots, with multiplicity, are the finite zeros; 1 where there are none."""
        rank = self.normal_rank
        if rank == 0 or self._degree == 0 or self._has_no_zero_modulo(rank):
            return fmpz_poly([1])
        found = self._compressed_determinant(rank)
        if self.shape == (rank, rank):
            return found
        for _ in range(_MOST_COMPRESSIONS):
            if found.degree() == 0:
                break
            if self._is_coprime_modulo(found, rank):
                return fmpz_poly([1])
            other = found.gcd(self._compressed_determinant(rank))
            settled = other.degree() == found.degree() and other.degree() < self._degree
            found = primitive(fmpq_poly(other))
            if settled:
                break
        return found

    def zeros(self, *, discrete: bool) -> tuple[Root, ...]:
        """Return the finite zeros and where they are: exact, however close to the stability boundary."""
        return locate_roots(self.zero_polynomial, discrete=discrete)

    def rank_at(self, point: Fraction) -> int:
        """Return the rank at a rational point."""
        e, a = self._integers
        return int((a * point.denominator - e * point.numerator).rank())

    def rank_at_root(self, polynomial: fmpz_poly) -> int:
        """Return the rank at a root of an irreducible polynomial: the same at all of them."""
        degree = polynomial.degree()
        if 0 in self.shape:
            return 0
        if degree == 1:
            constant, leading = (int(value) for value in polynomial.coeffs())
            return self.rank_at(Fraction(-constant, leading))
        companion = fmpq_mat(degree, degree)
        for row in range(degree):
            companion[row, degree - 1] = -fmpq(polynomial[row], polynomial[degree])
            if row:
                companion[row, row - 1] = fmpq(1)
        one, pairs = identity(degree), zip(self.A.tolist(), self.E.tolist(), strict=True)
        whole = blocks([[one * a - companion * e for a, e in zip(*pair, strict=True)] for pair in pairs])
        return int(whole.rank()) // degree

    @cached_property
    def index(self) -> int | None:
        """Size of the largest block at infinity, 0 for nonsingular E; ``None`` for a pencil that is not regular."""
        rows, columns = self.shape
        if rows != columns or self.normal_rank < columns:
            return None
        e, a = self._integers
        shift = next(point for point in _points(self._degree + 2) if _at(e, a, point).rank() == columns)
        chain = fmpq_mat(_at(e, a, shift)).solve(fmpq_mat(e))
        power, ranks = chain, [columns, int(chain.rank())]
        while ranks[-1] != ranks[-2]:
            power = power * chain
            ranks.append(int(power.rank()))
        return len(ranks) - 2

    @cached_property
    def _plain_integers(self) -> tuple[fmpz_mat, fmpz_mat]:
        """Both multiplied by one number: enough modulo a prime, and for where the zeros of their entries are."""
        return over_one_denominator(self.E, self.A)

    @cached_property
    def _modulo(self) -> tuple[nmod_mat, nmod_mat]:
        """The same modulo the first prime."""
        e, a = self._plain_integers
        return nmod_mat(e, _PRIMES[0]), nmod_mat(a, _PRIMES[0])

    @cached_property
    def _integers(self) -> tuple[fmpz_mat, fmpz_mat]:
        """E and A with rows and columns multiplied by rational numbers, so that all entries are small integers."""
        rows, columns = int(self.A.nrows()), int(self.A.ncols())
        # Over one denominator each row is a multiple of what it is over its own.
        pairs = zip(*(part.tolist() for part in over_one_denominator(self.E, self.A)), strict=True)
        table = [_coprime([int(value) for part in pair for value in part]) for pair in pairs]
        for j in range(columns):
            common = gcd(*(row[k] for row in table for k in (j, columns + j)))
            if common > 1:
                for row in table:
                    row[j], row[columns + j] = row[j] // common, row[columns + j] // common
        table = [_coprime(row) for row in table]
        parts = ([value for row in table for value in row[part]] for part in (slice(columns), slice(columns, None)))
        e, a = (fmpz_mat(rows, columns, part) for part in parts)
        return e, a

    @cached_property
    def _degree(self) -> int:
        return int(self.E.rank())

    def _most_degree(self, rank: int) -> int:
        """Return a bound on the degree of all minors of the order of the normal rank, and of their combinations.

        A minor of all columns has the columns in which E is zero. Where A is zero in them too in the rows without E,
        each takes up one of the rows with E."""
        found, columns = min(self._degree, rank), self.shape[1]
        if rank < columns:
            return found
        e, a = (part.tolist() for part in self._plain_integers)
        moving = [any(row) for row in e]
        still = [j for j in range(columns) if not any(row[j] for row in e)]
        if any(row[j] for row, moves in zip(a, moving, strict=True) if not moves for j in still):
            return found
        return min(found, sum(moving) - len(still))

    @cached_property
    def _rng(self) -> random.Random:
        return random.Random(POINTS_SEED)

    def _has_no_zero_modulo(self, rank: int) -> bool:
        """Whether two compressions have coprime determinants modulo a prime that keeps the degree: then they are."""
        if self.shape == (rank, rank):
            return False
        shift = self._rng.randrange(_PRIMES[0])
        first, second = (self._determinant_modulo(rank, shift) for _ in range(2))
        # A common factor keeps its degree where the leading coefficient that it divides is not zero.
        full = first is not None and first.degree() == self._most_degree(rank)
        return bool(full and first and second and first.gcd(second).degree() == 0)

    def _is_coprime_modulo(self, known: fmpz_poly, rank: int) -> bool:
        """Whether another compression has no factor of a known determinant modulo a prime that keeps its degree."""
        prime = _PRIMES[0]
        shift = self._rng.randrange(prime)
        other = self._determinant_modulo(rank, shift)
        moved = nmod_poly([int(value) % prime for value in known.coeffs()], prime)(nmod_poly([shift, 1], prime))
        return bool(other is not None and moved.degree() == known.degree() and moved.gcd(other).degree() == 0)

    def _determinant_modulo(self, rank: int, shift: int) -> nmod_poly | None:
        """Return a multiple of ``det(A - (shift + t) E)`` of a compression modulo the first prime, or none."""
        prime = _PRIMES[0]
        e, a = self._compressed(self._modulo, rank)
        start = a - e * shift
        if start.rank() < rank:
            return None
        # det(start - t e) / det(start) is the reversed characteristic polynomial of start^-1 e.
        coefficients = start.solve(e).charpoly().coeffs()
        return nmod_poly([int(value) for value in coefficients[::-1]], prime)

    def _compressed(self, whole: tuple[Any, Any], rank: int) -> tuple[Any, Any]:
        """Return both matrices with rows and columns compressed at random to the normal rank."""
        (e, a), (rows, columns) = whole, self.shape
        if rows > rank:
            left = self._random(rank, rows)
            e, a = left * e, left * a
        if columns > rank:
            right = self._random(columns, rank)
            e, a = e * right, a * right
        return e, a

    def _compressed_determinant(self, rank: int) -> fmpz_poly:
        e, a = self._compressed(self._integers, rank)
        return _determinant(e, a, min(self._degree, rank))

    def _random(self, rows: int, columns: int) -> fmpz_mat:
        drawn = np.frombuffer(self._rng.randbytes(2 * rows * columns), dtype="<i2") >> _DROPPED_BITS
        return fmpz_mat(rows, columns, drawn.tolist())


def system_pencil(E: fmpq_mat, A: fmpq_mat, B: fmpq_mat, C: fmpq_mat, D: fmpq_mat) -> ExactPencil:
    """Return ``[A - s E, B; C, D]``."""
    nothing = [zeros_matrix(part.nrows(), part.ncols()) for part in (B, C, D)]
    return ExactPencil(blocks([[E, nothing[0]], nothing[1:]]), blocks([[A, B], [C, D]]))


def _at(e: fmpz_mat, a: fmpz_mat, point: int) -> fmpz_mat:
    return a - e * point


def _points(count: int) -> list[int]:
    """Return so many different integers of small size."""
    return [(k + 1) // 2 * (1 if k % 2 else -1) for k in range(count)]


def _determinant(e: fmpz_mat, a: fmpz_mat, degree: int) -> fmpz_poly:
    """Return ``det(a - s e)``, of at most this degree, as a primitive polynomial.

    With ``s = s0 + t`` it is ``det(b) det(I - t b^-1 e)``, ``b = a - s0 e``: modulo primes a characteristic polynomial,
    whose coefficients tell those over the integers as soon as the product of the primes is beyond twice their size.
    """
    shift = _regular_point(e, a, degree)
    if shift is None:
        return fmpz_poly([0])
    start = _at(e, a, shift)
    limit, product = 2 * _largest_coefficient(e, start), 1
    found = [0] * (degree + 1)
    for prime in map(_prime, count()):
        if product > limit:
            break
        inner = nmod_mat(start, prime)
        size = int(inner.det())
        if size == 0:
            continue
        coefficients = inner.solve(nmod_mat(e, prime)).charpoly().coeffs()[::-1]
        inverse = pow(product, -1, prime)
        for k, coefficient in enumerate(coefficients[: degree + 1]):
            found[k] += product * ((size * int(coefficient) - found[k]) * inverse % prime)
        product *= prime
    moved = fmpz_poly([value - product if 2 * value > product else value for value in found])
    return primitive(fmpq_poly(moved(fmpz_poly([-shift, 1]))))


def _regular_point(e: fmpz_mat, a: fmpz_mat, degree: int) -> int | None:
    """Return an integer where ``det(a - s e)`` is not zero; ``None`` where it is zero at more than ``degree``."""
    points = _points(degree + 1)
    for point in points:
        if int(nmod_mat(_at(e, a, point), _PRIMES[0]).det()):
            return point
    return next((point for point in points if _at(e, a, point).det() != 0), None)


def _largest_coefficient(e: fmpz_mat, a: fmpz_mat) -> int:
    """Return a bound on the coefficients of ``det(a - s e)``: on its size where s is of modulus one (Hadamard)."""
    sizes = np.array([[abs(int(value)) for value in part.entries()] for part in (a, e)], dtype=object).sum(axis=0)
    squares = (sizes * sizes).reshape(a.nrows(), a.ncols())
    return min(prod(isqrt(total) + 1 for total in squares.sum(axis=axis).tolist()) for axis in (0, 1))


@cache
def _prime(k: int) -> int:
    """Return the k-th prime down from 2^61; to be asked for in order."""
    if k == 0:
        return _PRIMES[0]
    return next(value for value in count(_prime(k - 1) - 2, -2) if fmpz(value).is_prime())


#: Binary digits for a pencil of one state, and for each state more.
BASE_BITS, BITS_PER_STATE = 1200, 60

#: Rows of enclosures, real or complex.
Rows: TypeAlias = list[list[Any]]


def bits_for(states: int) -> int:
    """Return the precision in which plants of this size are enclosed."""
    return BASE_BITS + BITS_PER_STATE * states


def exponential(matrix: fmpq_mat) -> Any:
    """Return an enclosure of the exponential of a square rational matrix."""
    return arb_mat(matrix).exp()


def rank_to_digits(rows: Rows) -> int:
    """Return the rank: at least this for certain, at most this to digits."""
    work = [list(row) for row in rows]
    rank, width = 0, len(work[0]) if work else 0
    free = list(range(width))
    while rank < len(work) and free:
        # A number whose enclosure holds zero counts as zero.
        places = [(i, j) for i in range(rank, len(work)) for j in free if not work[i][j].contains(0)]
        if not places:
            break
        i, j = max(places, key=lambda place: float(work[place[0]][place[1]].abs_lower().log()))
        work[rank], work[i] = work[i], work[rank]
        pivot = work[rank]
        free.remove(j)
        for row in work[rank + 1 :]:
            if not row[j].is_zero():
                factor = row[j] / pivot[j]
                for k in free:
                    row[k] = row[k] - factor * pivot[k]
        rank += 1
    return rank


@dataclass(frozen=True, eq=False)
class EnclosedPencil:
    """The pencil ``A - z E (m, n)``; E is rational, A enclosed in a precision of ``bits``."""

    E: fmpq_mat
    A: Rows
    bits: int

    @property
    def shape(self) -> tuple[int, int]:
        """Rows and columns."""
        return int(self.E.nrows()), int(self.E.ncols())

    def at(self, point: Any) -> Rows:
        """Return ``A - point E``."""
        return [
            [value if entry == 0 else value - point * arb(entry) for value, entry in zip(row, entries, strict=True)]
            for row, entries in zip(self.A, self.E.tolist(), strict=True)
        ]

    def rank_at(self, point: Any) -> int:
        """Return the rank at a real or complex point."""
        with flint.ctx.workprec(self.bits):
            return rank_to_digits(self.at(point))

    @cached_property
    def normal_rank(self) -> int:
        """Rank at almost every z: at least this for certain."""
        return self.rank_at(arb(flint.fmpq(random.Random(POINTS_SEED).randrange(1 << 40), 1 << 39)))

    @cached_property
    def zero_coefficients(self) -> list[Any]:
        """Coefficients, lowest first, of a polynomial whose roots are the finite zeros; the columns must be full."""
        with flint.ctx.workprec(self.bits):
            found = self._determinant(0)
            rows, columns = self.shape
            for seed in (1, 2) if rows > columns else ():
                if len(found) == 1:
                    break
                found = greatest_common_divisor(found, self._determinant(seed))
            return found

    @property
    def zeros(self) -> tuple[complex, ...]:
        """The finite zeros, to about double precision."""
        with flint.ctx.workprec(self.bits):
            leading = self.zero_coefficients[-1]
            shares = [float(value / leading) for value in self.zero_coefficients]
        return tuple(complex(value) for value in np.roots(shares[::-1]))

    @property
    def stable(self) -> bool:
        """Whether every finite zero is strictly inside the unit circle."""
        with flint.ctx.workprec(self.bits):
            # Yes for certain; no where a root is on the circle to so many digits.
            p = _trimmed(self.zero_coefficients)
            while len(p) > 1:
                first, last = p[0], p[-1]
                if not bool(abs(first) < abs(last)):
                    return False
                p = [last * p[i] - first * p[-1 - i] for i in range(1, len(p))]
                # |last| > |first|: the new leading coefficient, last^2 - first^2, is not zero.
                scale = abs(p[-1])
                p = [value / scale for value in p]
            return True

    def _determinant(self, seed: int) -> list[Any]:
        """Return the coefficients of the determinant of the pencil with its rows compressed at random."""
        rows, columns = self.shape
        rng = random.Random(POINTS_SEED + seed)
        e, a = arb_mat(self.E), arb_mat(self.A)
        if rows > columns:
            left = arb_mat(columns, rows, [rng.randint(-4096, 4096) for _ in range(columns * rows)])
            e, a = left * e, left * a
        shift = arb(flint.fmpq(rng.randrange(1 << 20), 1 << 19))
        # det(a - z e) = det(s0) det(I - t s0^-1 e), t = z - shift: the reversed characteristic polynomial.
        characteristic = (a - e * shift).solve(e).charpoly().coeffs()
        degree = int(self.E.rank())
        found = characteristic[::-1][: degree + 1]
        # The coefficients of p(z - shift).
        moved = list(found)
        for start in range(len(moved)):
            for i in range(len(moved) - 2, start - 1, -1):
                moved[i] = moved[i] + (-shift) * moved[i + 1]
        return _trimmed(moved)


def greatest_common_divisor(first: Sequence[Any], second: Sequence[Any]) -> list[Any]:
    """Return the common divisor of two polynomials, coefficients lowest first: of no lower degree, to digits."""
    large, small = _normalised(first), _normalised(second)
    if len(large) < len(small):
        large, small = small, large
    while small:
        remainder = list(large)
        for k in range(len(large) - len(small), -1, -1):
            factor = remainder[k + len(small) - 1] / small[-1]
            for i, value in enumerate(small):
                remainder[k + i] = remainder[k + i] - factor * value
        large, small = small, _normalised(remainder[: len(small) - 1])
    return large


def _normalised(coefficients: Sequence[Any]) -> list[Any]:
    trimmed = _trimmed(coefficients)
    if not trimmed:
        return trimmed
    largest = max(abs(value).mid() for value in trimmed)
    return [value / largest for value in trimmed]


def _trimmed(coefficients: Sequence[Any]) -> list[Any]:
    found = list(coefficients)
    while found and found[-1].contains(0):
        found.pop()
    return found
