"""Exact solutions of linear equations near given doubles, with a proved distance.

Doubles satisfy equations up to rounding.  What is missing is computed exactly, in whole numbers; a square part ``K`` of
the equations with a proved inverse then bounds how far an exact solution lies from the doubles: with ``R`` near the
inverse of ``K`` and ``q = |I - R K| < 1``, by ``|R r| + q / (1 - q) max |R r|`` for what is missing ``r``
(S. M. Rump, Acta Numerica 2010, section 10).  Where rows depend on each other a largest square part is solved in
rationals and the other rows are checked.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from fractions import Fraction
from typing import Any, TypeAlias

import numpy as np
from flint import arb, arb_mat, ctx, fmpq, fmpq_mat

from obsynth.numerics.arrays import FloatArray
from obsynth.proofs.balls import UNIT_ROUNDOFF, Ball, rounded_up
from obsynth.proofs.exact_doubles import rounded_outward

#: Diagonal of the pivoted triangle, as a share of its first entry, below which rows are taken as dependent.
DEPENDENT_ROW = 1e-13

#: Newton steps towards the exact solution before it is rounded for the last time.
RATIONAL_REFINEMENTS = 4

#: They end where a step is not below this share of the smallest one before: Newton's steps then only go to and fro.
REFINED_SHARE = 0.5

#: Bits of ball arithmetic where double precision proves no inverse, and the most rows for it.
INVERSE_BITS, MOST_ROWS_IN_BALLS = 256, 700

#: Most rows for which equations that depend on each other are solved in rationals.
MOST_ROWS_IN_RATIONALS = 400

#: Least radius after room was added, as a share of the largest one in the units of the values.
LEAST_RADIUS = 1e-4

#: Values below this share of the largest, in their units, are rounding of zeros.
ROUNDED_VALUE = 1e-13

#: Room for what another processor finds for the distance to the exact solution: a factor.
RADIUS_ROOM = 8.0

#: Returns what the right side lacks exactly for given values, one fraction an equation.
Missing: TypeAlias = Callable[[FloatArray], list[Fraction]]


@dataclass(frozen=True, eq=False)
class NearbySolution:
    """Doubles next to an exact solution, which lies within ``radius`` of them."""

    values: FloatArray
    radius: FloatArray

    def with_room(self, exponents: np.ndarray) -> NearbySolution:
        """Return the same with a radius that other processors find too; ``exponents`` of the units of the values."""
        chosen = self.radius > 0.0
        largest = float(np.max(np.ldexp(self.radius, -exponents), initial=0.0))
        floor = np.ldexp(LEAST_RADIUS * largest, exponents) + UNIT_ROUNDOFF * np.abs(self.values)
        return NearbySolution(self.values, np.where(chosen, RADIUS_ROOM * self.radius + floor, 0.0))


def nearby_solution(
    matrix: FloatArray,
    radius: FloatArray,
    heavy: tuple[FloatArray, np.ndarray],
    values: FloatArray,
    missing: Missing,
    *,
    refine: bool,
) -> NearbySolution | None:
    """Return values next to an exact solution; ``heavy``: weights by which entries are chosen, and their units."""
    weight, units = heavy
    square = SquarePart.of(matrix, radius, weight, units)
    if square is None:
        return _solved_in_rationals(matrix, weight, values, missing, refine=refine)
    original = values.copy()
    if refine:
        smallest = np.inf
        for _ in range(RATIONAL_REFINEMENTS):
            lacking = np.array([float(value) for value in missing(values)])
            size = float(np.max(np.abs(square.step(lacking) / np.ldexp(1.0, square.columns)), initial=0.0))
            if not size < REFINED_SHARE * smallest:
                break
            smallest = size
            values[square.chosen] += square.step(lacking)
        sizes = np.abs(np.ldexp(values, -units))
        values[sizes < ROUNDED_VALUE * float(np.max(sizes, initial=0.0))] = 0.0
    bound = square.proved_step(missing(values))
    if bound is None:
        # Rows may depend on each other though rounding hides it; such a part has led values astray.
        return _solved_in_rationals(matrix, weight, original, missing, refine=refine)
    distance = np.zeros(len(values))
    # What is chosen is seen by its radius, though it may be exact.
    distance[square.chosen] = np.maximum(bound, np.finfo(np.float64).tiny)
    return NearbySolution(values, distance)


def _solved_in_rationals(
    matrix: FloatArray, weight: FloatArray, values: FloatArray, missing: Missing, *, refine: bool
) -> NearbySolution | None:
    """Return the same where rows depend on each other: a largest square part solved exactly, the others looked at."""
    corrected = rational_correction(matrix, weight, missing(values))
    if corrected is None:
        return None
    columns, correction = corrected
    moved = [Fraction(float(values[c])) + d for c, d in zip(columns, correction, strict=True)]
    if refine:
        values[columns] = [float(value) for value in moved]
    distance = np.zeros(len(values))
    away = [rounded_outward(abs(v - Fraction(float(values[c])))) for v, c in zip(moved, columns, strict=True)]
    distance[columns] = np.maximum(away, np.finfo(np.float64).tiny)
    return NearbySolution(values, distance)


def rational_correction(
    matrix: FloatArray, weight: FloatArray, exact: list[Fraction]
) -> tuple[list[int], list[Fraction]] | None:
    """Return which columns ``matrix step = exact`` is solved by, and the step; ``None`` where there is none."""
    if len(matrix) > MOST_ROWS_IN_RATIONALS:
        return None
    rows, columns = independent_part(matrix, weight)
    entries = [Fraction(value) for value in matrix[np.ix_(rows, columns)].ravel().tolist()]
    correction = solved_by_lifting(entries, [exact[row] for row in rows])
    if correction is None:
        return None
    for row in set(range(len(matrix))) - set(rows):
        product = sum(
            (Fraction(float(matrix[row, c])) * d for c, d in zip(columns, correction, strict=True) if matrix[row, c]),
            start=Fraction(0),
        )
        if product != exact[row]:
            return None
    return columns, correction


def independent_part(matrix: FloatArray, weight: FloatArray) -> tuple[list[int], list[int]]:
    """Return rows and as many columns of a largest nonsingular part of ``matrix (m, n)``, the heavier columns
    (``weight (n,)``) the better: chosen in double precision."""
    from scipy.linalg import qr

    scaled = matrix * weight
    largest = np.abs(scaled).max(axis=1, initial=0.0)
    scaled = scaled / np.where(largest > 0.0, largest, 1.0)[:, None]
    triangle, by_row = qr(scaled.T, mode="r", pivoting=True)
    diagonal = np.abs(np.diag(triangle))
    rank = int(np.sum(diagonal > DEPENDENT_ROW * max(float(np.max(diagonal, initial=0.0)), np.finfo(float).tiny)))
    rows = np.sort(by_row[:rank]).tolist()
    _, by_column = qr(scaled[rows], mode="r", pivoting=True)
    return rows, np.sort(by_column[:rank]).tolist()


def solved_by_lifting(entries: Sequence[Fraction], right: Sequence[Fraction]) -> list[Fraction] | None:
    """Return the exact solution of square equations, entries by rows; ``None`` where they are singular."""
    count = len(right)
    part: Any = fmpq_mat(count, count, [fmpq(value.numerator, value.denominator) for value in entries])
    sides = fmpq_mat(count, 1, [fmpq(value.numerator, value.denominator) for value in right])
    try:
        # By lifting: the numbers of the solution are long.
        solution = part.solve(sides, algorithm="dixon") if count else sides
    except ZeroDivisionError:
        return None
    return [Fraction(int(solution[k, 0].p), int(solution[k, 0].q)) for k in range(count)]


@dataclass(frozen=True, eq=False)
class SquarePart:
    """A square part of equations ``K v = r``, scaled by powers of two, with an approximate inverse."""

    chosen: np.ndarray
    rows: np.ndarray  # exponents
    columns: np.ndarray
    inverse: FloatArray
    contraction: float  # bound of the infinity norm of I - inverse K
    part: Ball

    @classmethod
    def of(cls, matrix: FloatArray, radius: FloatArray, weight: FloatArray, units: np.ndarray) -> SquarePart | None:
        """Choose columns of ``matrix (m, n)``, the heavier the better; ``None`` where rows depend on each other.

        What is proved is scaled by ``units (n,)``, exponents that depend on the window alone.
        """
        from scipy.linalg import qr

        columns = np.frexp(np.where(weight > 0.0, weight, 1.0))[1].astype(np.int64)
        columns = np.where(weight > 0.0, columns, -2000)
        scaled = np.ldexp(matrix, columns)
        largest = np.abs(scaled).max(axis=1, initial=0.0)
        if matrix.shape[0] > matrix.shape[1] or not np.all(largest > 0.0):
            return None
        rows = -np.frexp(largest)[1].astype(np.int64)
        scaled = np.ldexp(scaled, rows[:, None])
        count = len(matrix)
        chosen = np.flatnonzero(weight > 0.0)
        if chosen.size != count:
            triangle, order = qr(scaled, mode="r", pivoting=True)
            diagonal = np.abs(np.diag(triangle))
            if count and not diagonal[count - 1] > DEPENDENT_ROW * diagonal[0]:
                return None
            chosen = np.sort(order[:count])
        columns = units[chosen]
        picked = np.ldexp(matrix[:, chosen], columns)
        rows = -np.frexp(np.abs(picked).max(axis=1, initial=0.0))[1].astype(np.int64)
        spread = np.ldexp(np.ldexp(radius[:, chosen], columns), rows[:, None])
        part = Ball(np.ldexp(picked, rows[:, None]), spread)
        try:
            inverse = np.asarray(np.linalg.inv(part.midpoint), dtype=np.float64)
        except np.linalg.LinAlgError:
            return None
        missing = Ball.exact(np.eye(count)) - Ball.exact(inverse) @ part
        contraction = float(np.max(rounded_up(missing.magnitude.sum(axis=1), count + 2), initial=0.0))
        return cls(chosen, rows, columns, inverse, contraction, part)

    def step(self, right: FloatArray) -> FloatArray:
        """Return the approximate correction ``(chosen,)`` that takes away a right side."""
        return np.asarray(np.ldexp(self.inverse @ np.ldexp(right, self.rows), self.columns))

    def proved_step(self, right: list[Fraction]) -> FloatArray | None:
        """Return bounds of the exact correction ``(chosen,)``; ``None`` where nothing is proved."""
        if self.contraction < 1.0:
            return self.bounded_step(np.array([rounded_outward(abs(value)) for value in right]))
        if len(right) > MOST_ROWS_IN_BALLS or self.part.radius.any():
            return None
        before = ctx.prec
        ctx.prec = INVERSE_BITS
        try:
            count = len(right)
            matrix = arb_mat(count, count, [arb(value) for value in self.part.midpoint.ravel().tolist()])
            exact = [Fraction(value) * Fraction(2) ** int(e) for value, e in zip(right, self.rows, strict=True)]
            sides = arb_mat(count, 1, [arb(fmpq(value.numerator, value.denominator)) for value in exact])
            solution = matrix.solve(sides)
            sizes = [abs(solution[k, 0]).upper() for k in range(count)]
        except ZeroDivisionError:
            return None
        finally:
            ctx.prec = before
        doubles = np.array([float(value) for value in sizes])
        return np.asarray(np.ldexp(rounded_up(doubles, 4), self.columns))

    def bounded_step(self, sizes: FloatArray) -> FloatArray:
        """Return the same for a right side of at most these sizes, where the contraction is below one."""
        magnitude = Ball.exact(np.abs(self.inverse)) @ Ball.exact(np.ldexp(sizes, self.rows)[:, None])
        first = magnitude.magnitude.ravel()
        remainder = self.contraction / (1.0 - self.contraction) * float(np.max(first, initial=0.0))
        return np.asarray(np.ldexp(rounded_up(first + remainder, 8), self.columns))
