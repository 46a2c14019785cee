"""Pencils ``A - z E`` of irrational numbers, known to hundreds of digits: those of sampled plants.

An enclosure without zero tells a number from zero for certain; one with zero counts as zero: *to digits*, not exact.
Elimination with the surest pivots, Euclid's algorithm and the recursion of Schur and Cohn (Jury): none needs a root.
"""

from __future__ import annotations

import random
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, TypeAlias

import flint
import numpy as np
from flint import arb, arb_mat, fmpq_mat

from obsynth.proofs.exact_pencils import BASE_BITS, BITS_PER_STATE, POINTS_SEED

#: Rows of enclosures, real or complex.
EnclosedRows: TypeAlias = list[list[Any]]


def bits_for(states: int) -> int:
    """Return the precision in which plants of this size are enclosed."""
    return BASE_BITS + BITS_PER_STATE * states


def exponential(matrix: fmpq_mat) -> Any:
    """Return an enclosure of the exponential of a square rational matrix."""
    return arb_mat(matrix).exp()


def rank_to_digits(rows: EnclosedRows) -> int:
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
    A: EnclosedRows
    bits: int

    @property
    def shape(self) -> tuple[int, int]:
        """Rows and columns."""
        return int(self.E.nrows()), int(self.E.ncols())

    def at(self, point: Any) -> EnclosedRows:
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
            divisor = self._determinant(0)
            rows, columns = self.shape
            for seed in (1, 2) if rows > columns else ():
                if len(divisor) == 1:
                    break
                divisor = greatest_common_divisor(divisor, self._determinant(seed))
            return divisor

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
            compression = arb_mat(columns, rows, [rng.randint(-4096, 4096) for _ in range(columns * rows)])
            e, a = compression * e, compression * a
        shift = arb(flint.fmpq(rng.randrange(1 << 20), 1 << 19))
        # det(a - z e) = det(s0) det(I - t s0^-1 e), t = z - shift: the reversed characteristic polynomial.
        characteristic = (a - e * shift).solve(e).charpoly().coeffs()
        degree = int(self.E.rank())
        coefficients = characteristic[::-1][: degree + 1]
        # The coefficients of p(z - shift).
        moved = list(coefficients)
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
    trimmed = list(coefficients)
    while trimmed and trimmed[-1].contains(0):
        trimmed.pop()
    return trimmed
