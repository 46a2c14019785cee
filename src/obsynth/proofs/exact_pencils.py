"""Pencils ``A - s E`` of rational numbers, decided exactly: normal rank, zeros, index, left null space.

The greatest common divisor of all r-minors, r the normal rank, has the finite zeros as its roots.  Determinants of two
random integer compressions to r by r combine all these minors (Cauchy, Binet): so does their greatest common divisor,
unless chance adds a factor, which a third removes.  They are of degree rank E at most: values at integers give them.
The rank at any point (modulo a prime) bounds r from below; rank r or less at one point more than rank E, from above,
as all (r + 1)-minors are polynomials of that degree.
"""

from __future__ import annotations

import random
from dataclasses import dataclass
from fractions import Fraction
from functools import cache, cached_property
from itertools import count
from math import gcd, isqrt, prod
from typing import Any

import numpy as np
from flint import fmpq, fmpq_mat, fmpq_poly, fmpz, fmpz_mat, fmpz_poly, nmod_mat, nmod_poly

from obsynth.numerics.arrays import FloatArray
from obsynth.proofs.exact_doubles import written_matrix
from obsynth.proofs.polynomial_roots import Root, locate_roots, primitive
from obsynth.proofs.rational_matrices import PRIME, blocks, coprime, identity, over_one_denominator, zeros_matrix

#: Primes for ranks that are only bounded from below.
_PRIMES = (PRIME, 2305843009213693921, 2305843009213693907)

#: Random integers of a compression are of 16 bits less these; and the seed that makes every decision repeatable.
_DROPPED_BITS = 3

POINTS_SEED = 20150709

#: Compressions after which a factor that all of them share is a factor of all minors.
_MOST_COMPRESSIONS = 6

#: Binary digits for a pencil of one state, and for each state more.
BASE_BITS, BITS_PER_STATE = 1200, 60


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
        divisor = self._compressed_determinant(rank)
        if self.shape == (rank, rank):
            return divisor
        for _ in range(_MOST_COMPRESSIONS):
            if divisor.degree() == 0:
                break
            if self._is_coprime_modulo(divisor, rank):
                return fmpz_poly([1])
            other = divisor.gcd(self._compressed_determinant(rank))
            settled = other.degree() == divisor.degree() and other.degree() < self._degree
            divisor = primitive(fmpq_poly(other))
            if settled:
                break
        return divisor

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
        unit, pairs = identity(degree), zip(self.A.tolist(), self.E.tolist(), strict=True)
        substituted = blocks([[unit * a - companion * e for a, e in zip(*pair, strict=True)] for pair in pairs])
        return int(substituted.rank()) // degree

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
        table = [coprime([int(value) for part in pair for value in part]) for pair in pairs]
        for j in range(columns):
            common = gcd(*(row[k] for row in table for k in (j, columns + j)))
            if common > 1:
                for row in table:
                    row[j], row[columns + j] = row[j] // common, row[columns + j] // common
        table = [coprime(row) for row in table]
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
        degree, columns = min(self._degree, rank), self.shape[1]
        if rank < columns:
            return degree
        e, a = (part.tolist() for part in self._plain_integers)
        moving = [any(row) for row in e]
        still = [j for j in range(columns) if not any(row[j] for row in e)]
        if any(row[j] for row, moves in zip(a, moving, strict=True) if not moves for j in still):
            return degree
        return min(degree, sum(moving) - len(still))

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

    def _compressed(self, pencil: tuple[Any, Any], rank: int) -> tuple[Any, Any]:
        """Return both matrices with rows and columns compressed at random to the normal rank."""
        (e, a), (rows, columns) = pencil, self.shape
        if rows > rank:
            row_compression = self._random(rank, rows)
            e, a = row_compression * e, row_compression * a
        if columns > rank:
            column_compression = self._random(columns, rank)
            e, a = e * column_compression, a * column_compression
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
    residues = [0] * (degree + 1)
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
            residues[k] += product * ((size * int(coefficient) - residues[k]) * inverse % prime)
        product *= prime
    moved = fmpz_poly([value - product if 2 * value > product else value for value in residues])
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
