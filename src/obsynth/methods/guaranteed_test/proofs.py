"""Proofs about a window: what shipped multipliers promise, what a witness shows, and why there is no test.

Shipped doubles satisfy equations up to rounding.  What is missing is computed exactly, in whole numbers; a square part
of the equations with a proved inverse then tells how far the exact solution lies from what is shipped, at most.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from fractions import Fraction
from typing import Any, TypeAlias

import numpy as np
from flint import arb, arb_mat, ctx, fmpq, fmpq_mat

from obsynth.methods.guaranteed_test.condensed import LEAST_WEIGHT, Condensed
from obsynth.methods.guaranteed_test.windows import Window
from obsynth.numerics.arrays import FloatArray
from obsynth.proofs.balls import UNIT_ROUNDOFF, Ball, rounded_up
from obsynth.proofs.exact_arithmetic import rounded_outward

#: Diagonal of the pivoted triangle, as a share of its first entry, below which rows are taken as dependent.
DEPENDENT_ROW = 1e-13

#: Newton steps towards the exact solution before it is rounded for the last time.
RATIONAL_REFINEMENTS = 4

#: Bits of ball arithmetic where double precision proves no inverse, and the most rows for it.
INVERSE_BITS, MOST_ROWS_IN_BALLS = 256, 700

#: A bounded number so near to its bound, as a share of it, is at its bound.
AT_BOUND_SHARE = 1e-9

#: Least room that a bounded number counts for when a square part is chosen, as a share of its bound.
LEAST_ROOM = 1e-4

#: Values below this share of the largest, in their units, are rounding of zeros.
ROUNDED_VALUE = 1e-13

#: Room for what another processor finds for the distance to the exact solution: a factor.
RADIUS_ROOM = 8.0

_MANTISSA = 53


#: Doubles as whole numbers of Python times one power of two, of which this is the exponent: exact.
Whole: TypeAlias = tuple[np.ndarray, int]


#: Most rows for which a course that hides a fault is looked for: all of them at once.
MOST_ROWS_FOR_A_RAY = 2500

#: Most rows for which equations that depend on each other are solved in rationals.
MOST_ROWS_IN_RATIONALS = 400


#: Residual, in scaled equations, below which a fault is taken as hidden, to be proved then.
HIDDEN = 1e-9


def _whole(doubles: FloatArray) -> Whole:
    """Return doubles exactly."""
    parts, exponents = np.frexp(doubles)
    least = int(np.min(exponents, initial=0, where=doubles != 0.0)) - _MANTISSA
    whole = np.ldexp(parts, _MANTISSA).astype(np.int64).tolist()
    shifts = np.where(doubles != 0.0, exponents - _MANTISSA - least, 0).tolist()
    found = np.empty(len(whole), dtype=object)
    found[:] = [value << shift for value, shift in zip(whole, shifts, strict=True)]
    return found, least


def _entries(window: Window) -> Whole:
    """Return the entries of the matrix exactly."""
    values, exponent = _whole(window.value)
    return values * np.array(window.times.tolist(), dtype=object), exponent


def _sums(entries: Whole, doubles: FloatArray, places: np.ndarray, onto: np.ndarray, count: int) -> list[Fraction]:
    """Return exact sums of entries times doubles."""
    (values, exponent), (factors, more) = entries, _whole(doubles)
    totals = [0] * count
    for there, product in zip(onto.tolist(), (values * factors[places]).tolist(), strict=True):
        totals[there] += product
    one = Fraction(2) ** (exponent + more)
    return [value * one for value in totals]


def columns_of(window: Window, multipliers: FloatArray) -> list[Fraction]:
    """Return the matrix transposed times multipliers, exactly ``(columns,)``."""
    return _sums(_entries(window), multipliers, window.i, window.j, len(window.bar))


def rows_of(window: Window, point: FloatArray) -> list[Fraction]:
    """Return the matrix times a point, exactly ``(rows,)``."""
    return _sums(_entries(window), point, window.j, window.i, window.rows)


def columns_of_exact(window: Window, multipliers: Sequence[Fraction]) -> list[Fraction]:
    """Return the matrix transposed times multipliers that are fractions, exactly ``(columns,)``."""
    (values, exponent), found = _entries(window), [Fraction(0)] * len(window.bar)
    one = Fraction(2) ** exponent
    for row, column, entry in zip(window.i.tolist(), window.j.tolist(), values.tolist(), strict=True):
        if multipliers[row]:
            found[column] += multipliers[row] * entry
    return [value * one for value in found]


def exact_right_sides(window: Window, y: FloatArray, u: FloatArray) -> list[Fraction]:
    """Return the right sides of a window of samples, exactly: ``B u`` and ``y - D u``."""
    plant, found = window.plant, [Fraction(0)] * window.rows

    def times(row: FloatArray, known: FloatArray) -> Fraction:
        return sum(
            (Fraction(float(a)) * Fraction(float(b)) for a, b in zip(row, known, strict=True)), start=Fraction(0)
        )

    for k in range(window.equations):
        for r in range(plant.nx):
            found[k * plant.nx + r] = times(plant.B[r], u[k])
    for k in range(window.question.samples):
        for r in range(plant.ny):
            place = window.outputs_at + k * plant.ny + r
            found[place] = Fraction(float(y[k, r])) - times(plant.D[r], u[k])
    if window.standing:
        found = [side - middle for side, middle in zip(found, window.standing, strict=True)]
    return found


def _weights(window: Window, multipliers: FloatArray) -> FloatArray:
    """Return how readily each equation's multiplier is corrected: the larger ones first."""
    rows, _ = window.scales
    sizes = np.ldexp(np.abs(multipliers), -rows)
    return np.asarray(np.ldexp(np.maximum(sizes, LEAST_WEIGHT * float(np.max(sizes, initial=0.0))), rows))


def exact_multipliers(window: Window, multipliers: FloatArray) -> list[Fraction] | None:
    """Return fractions next to multipliers that see no free column at all; ``None`` where none are found."""
    prescribed = np.flatnonzero(window.free)
    seen = columns_of(window, multipliers)
    weight = _weights(window, multipliers)
    dense, _ = _dense(window, prescribed)
    corrected = _rational_step(dense.T, weight, [-seen[column] for column in prescribed])
    if corrected is None:
        return None
    found = [Fraction(float(value)) for value in multipliers]
    for place, step in zip(*corrected, strict=True):
        found[place] += step
    return found


def down(value: Fraction) -> float:
    """Return a double that is not above a rational number."""
    return -rounded_outward(-value)


@dataclass(frozen=True, eq=False)
class Square:
    """A square part of equations ``K v = r``, scaled by powers of two, with an approximate inverse."""

    chosen: np.ndarray
    rows: np.ndarray  # exponents
    columns: np.ndarray
    inverse: FloatArray
    contraction: float  # bound of the infinity norm of I - inverse K
    part: Ball

    @classmethod
    def of(cls, matrix: FloatArray, radius: FloatArray, weight: FloatArray, units: np.ndarray) -> Square | None:
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
            found = matrix.solve(sides)
            sizes = [abs(found[k, 0]).upper() for k in range(count)]
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
        rest = self.contraction / (1.0 - self.contraction) * float(np.max(first, initial=0.0))
        return np.asarray(np.ldexp(rounded_up(first + rest, 8), self.columns))


def _dense(window: Window, columns: np.ndarray) -> tuple[FloatArray, FloatArray]:
    """Return columns of the matrix, and what rounding of their products may be."""
    matrix = window.matrix[:, columns].toarray()
    several = np.abs(window.times).max(initial=1) > 1
    radius = UNIT_ROUNDOFF * np.abs(matrix) * (2.0 if several else 0.0)
    return matrix, radius


@dataclass(frozen=True, eq=False)
class Repaired:
    """Doubles next to an exact solution, which lies within ``radius`` of them."""

    values: FloatArray
    radius: FloatArray

    def with_room(self, exponents: np.ndarray) -> Repaired:
        """Return the same with a radius that other processors find too; ``exponents`` of the units of the values."""
        chosen = self.radius > 0.0
        largest = float(np.max(np.ldexp(self.radius, -exponents), initial=0.0))
        floor = np.ldexp(LEAST_ROOM * largest, exponents) + UNIT_ROUNDOFF * np.abs(self.values)
        return Repaired(self.values, np.where(chosen, RADIUS_ROOM * self.radius + floor, 0.0))


def repaired_multipliers(
    window: Window, multipliers: FloatArray, *, refine: bool, exact_zero: bool = False, among: FloatArray | None = None
) -> Repaired | None:
    """Return multipliers with the distance to exact ones: no free column is seen, theta with weight one.

    ``exact_zero``: no bounded column is seen either.  ``refine``: move them to the nearest doubles first.
    ``among``: only those with a positive number there differ from the exact ones.
    """
    condensed = None if exact_zero else Condensed.of(window)
    if condensed is not None:
        found = condensed.multipliers(multipliers, refine=refine, among=among)
        if found is not None:
            return Repaired(*found)
    # The columns whose products with multipliers are prescribed: 0, or 1 for that of theta.
    prescribed = [0, *(range(1, len(window.bar)) if exact_zero else np.flatnonzero(window.free).tolist())]
    wanted = [Fraction(int(column == 0)) for column in prescribed]

    def missing(values: FloatArray) -> list[Fraction]:
        seen = columns_of(window, values)
        return [want - seen[column] for want, column in zip(wanted, prescribed, strict=True)]

    matrix, radius = _dense(window, np.array(prescribed))
    rows, _ = window.scales
    weight = _weights(window, multipliers)
    weight = weight if among is None else np.where(among > 0.0, weight, 0.0)
    return _repaired(matrix.T, radius.T, (weight, rows), np.array(multipliers), missing, refine=refine)


def repaired_point(
    window: Window, point: FloatArray, *, refine: bool, among: FloatArray | None = None
) -> Repaired | None:
    """Return a hidden fault's point ``(columns,)`` with the distance to one that satisfies every equation exactly."""
    bar, bounded = window.bar, window.bounded
    values = np.array(point)
    if refine:
        near = bounded & (bar - np.abs(values) < AT_BOUND_SHARE * bar)
        values[near] = np.copysign(bar[near], values[near])
    condensed = Condensed.of(window)
    if condensed is not None:
        found = condensed.point(values)
        if found is not None:
            return Repaired(*found) if refine else Repaired(values, _distances(*found, values))
    _, columns = window.scales
    sizes = np.ldexp(np.abs(values), -columns)
    room = np.ldexp(np.maximum(1.0, sizes), columns)
    held = np.where(bounded, bar, 0.0)
    weight = np.where(bounded, np.maximum(held - np.abs(values), LEAST_ROOM * held), room)
    weight[0] = 0.0
    weight = weight if among is None else np.where(among > 0.0, weight, 0.0)
    matrix, radius = _dense(window, np.arange(len(bar)))

    def missing(values: FloatArray) -> list[Fraction]:
        return [-value for value in rows_of(window, values)]

    return _repaired(matrix, radius, (weight, columns), values, missing, refine=refine)


def _distances(found: FloatArray, distance: FloatArray, values: FloatArray) -> FloatArray:
    """Return how far values are from what lies within a distance of others."""
    return np.where(distance > 0.0, rounded_up(np.abs(found - values) + distance, 3), 0.0)


def _repaired(
    matrix: FloatArray,
    radius: FloatArray,
    heavy: tuple[FloatArray, np.ndarray],
    values: FloatArray,
    missing: Any,
    *,
    refine: bool,
) -> Repaired | None:
    """Return values next to an exact solution; ``heavy``: weights by which entries are chosen, and their units."""
    weight, units = heavy
    square = Square.of(matrix, radius, weight, units)
    if square is None:
        return _in_rationals(matrix, weight, values, missing, refine=refine)
    given = values.copy()
    if refine:
        left = np.inf
        for _ in range(RATIONAL_REFINEMENTS):
            lacking = np.array([float(value) for value in missing(values)])
            size = float(np.max(np.abs(square.step(lacking) / np.ldexp(1.0, square.columns)), initial=0.0))
            if not size < 0.5 * left:
                break
            left = size
            values[square.chosen] += square.step(lacking)
        sizes = np.abs(np.ldexp(values, -units))
        values[sizes < ROUNDED_VALUE * float(np.max(sizes, initial=0.0))] = 0.0
    bound = square.proved_step(missing(values))
    if bound is None:
        # Rows may depend on each other though rounding hides it; such a part has led values astray.
        return _in_rationals(matrix, weight, given, missing, refine=refine)
    distance = np.zeros(len(values))
    # What is chosen is seen by its radius, though it may be exact.
    distance[square.chosen] = np.maximum(bound, np.finfo(np.float64).tiny)
    return Repaired(values, distance)


def _in_rationals(
    matrix: FloatArray, weight: FloatArray, values: FloatArray, missing: Any, *, refine: bool
) -> Repaired | None:
    """Return the same where rows depend on each other: a largest square part solved exactly, the others looked at."""
    corrected = _rational_step(matrix, weight, missing(values))
    if corrected is None:
        return None
    columns, correction = corrected
    moved = [Fraction(float(values[c])) + d for c, d in zip(columns, correction, strict=True)]
    if refine:
        values[columns] = [float(value) for value in moved]
    distance = np.zeros(len(values))
    away = [rounded_outward(abs(v - Fraction(float(values[c])))) for v, c in zip(moved, columns, strict=True)]
    distance[columns] = np.maximum(away, np.finfo(np.float64).tiny)
    return Repaired(values, distance)


def _rational_step(
    matrix: FloatArray, weight: FloatArray, exact: list[Fraction]
) -> tuple[list[int], list[Fraction]] | None:
    """Return which columns ``matrix step = exact`` is solved by, and the step; ``None`` where there is none."""
    from scipy.linalg import qr

    if len(matrix) > MOST_ROWS_IN_RATIONALS:
        return None
    scaled = matrix * weight
    largest = np.abs(scaled).max(axis=1, initial=0.0)
    scaled = scaled / np.where(largest > 0.0, largest, 1.0)[:, None]
    triangle, by_row = qr(scaled.T, mode="r", pivoting=True)
    diagonal = np.abs(np.diag(triangle))
    rank = int(np.sum(diagonal > DEPENDENT_ROW * max(float(np.max(diagonal, initial=0.0)), np.finfo(float).tiny)))
    rows = np.sort(by_row[:rank])
    _, by_column = qr(scaled[rows], mode="r", pivoting=True)
    columns = np.sort(by_column[:rank])
    entries = matrix[np.ix_(rows, columns)].ravel().tolist()
    part: Any = fmpq_mat(rank, rank, [fmpq(*value.as_integer_ratio()) for value in entries])
    right = fmpq_mat(rank, 1, [fmpq(exact[row].numerator, exact[row].denominator) for row in rows])
    try:
        # By lifting: the numbers of the solution are long.
        step = part.solve(right, algorithm="dixon") if rank else right
    except ZeroDivisionError:
        return None
    correction = [Fraction(int(step[k, 0].p), int(step[k, 0].q)) for k in range(rank)]
    for row in set(range(len(matrix))) - set(rows.tolist()):
        seen = sum(
            (Fraction(float(matrix[row, c])) * d for c, d in zip(columns, correction, strict=True) if matrix[row, c]),
            start=Fraction(0),
        )
        if seen != exact[row]:
            return None
    return columns.tolist(), correction


def proved_threshold(window: Window, repaired: Repaired, *, exact_zero: bool = False) -> float:
    """Return what the test never passes without a fault: an upper bound of ``sum bar |M_s' mu|``."""
    if exact_zero:
        return 0.0
    standing = Fraction(window.standing_room(repaired.values, repaired.radius))
    seen = columns_of(window, repaired.values)
    away = _absolute(window, repaired.radius)
    bounded = np.flatnonzero(window.bounded)
    parts = [Fraction(float(window.bar[j])) * (abs(seen[j]) + away[j]) for j in bounded]
    if not window.question.ellipsoid:
        return rounded_outward(sum(parts, start=standing))
    return sum_in_ellipsoids(window, parts, rounded_outward(standing))


def sum_in_ellipsoids(window: Window, parts: Sequence[Fraction], more: float = 0.0) -> float:
    """Return an upper bound of the sum of what each bounded column can do at most; those of one ellipsoid together."""
    sizes, groups = np.array([rounded_outward(part) for part in parts]), window.group[window.bounded]
    norms = [float(np.sqrt(np.sum(sizes[groups == group] ** 2))) for group in np.unique(groups[groups >= 0])]
    return float(rounded_up(np.array(sum([*norms, *sizes[groups < 0].tolist(), more])), 2 * len(sizes) + 8))


def _absolute(window: Window, radius: FloatArray) -> list[Fraction]:
    """Return |matrix| transposed times non-negative numbers, exactly."""
    values, exponent = _entries(window)
    return _sums((abs(values), exponent), radius, window.i, window.j, len(window.bar))


def proved_least(window: Window, repaired: Repaired) -> float:
    """Return the size of the hidden fault that the exact point next to these doubles shows, within all bounds."""
    bounded = np.flatnonzero(window.bounded)
    sizes = rounded_up((np.abs(repaired.values) + repaired.radius)[bounded], 2) / window.bar[bounded]
    sizes = rounded_up(sizes, 2)
    groups = window.group[bounded]
    alone = sizes if not window.question.ellipsoid else sizes[groups < 0]
    worst = float(np.max(alone, initial=1.0))
    if window.question.ellipsoid:
        for group in np.unique(groups[groups >= 0]):
            part = sizes[groups == group]
            worst = max(worst, float(rounded_up(np.sqrt(np.sum(part**2)), 2 * len(part) + 8)))
    return down(Fraction(float(repaired.values[0])) / Fraction(worst))


def proved_ray(window: Window) -> FloatArray | None:
    """Return states and free faults ``(columns,)`` that hide a fault of size one exactly, without any disturbance.

    There is then no test on these samples.  ``None`` where none is found, or none is proved.
    """
    if window.rows > MOST_ROWS_FOR_A_RAY:
        return None
    prescribed = np.flatnonzero(window.free)
    _, columns = window.scales
    rows, _ = window.scales
    matrix, radius = _dense(window, prescribed)
    theta = window.matrix[:, [0]].toarray().ravel()
    scaled = np.ldexp(np.ldexp(matrix, columns[prescribed]), rows[:, None])
    found = np.linalg.lstsq(scaled, -np.ldexp(theta, rows), rcond=None)[0]
    size = 1.0 + float(np.max(np.abs(found), initial=0.0))
    if np.max(np.abs(scaled @ found + np.ldexp(theta, rows)), initial=0.0) > HIDDEN * size:
        return None
    point = np.zeros(len(window.bar))
    point[0], point[prescribed] = 1.0, np.ldexp(found, columns[prescribed])

    def missing(values: FloatArray) -> list[Fraction]:
        whole = point.copy()
        whole[prescribed] = values
        return [-value for value in rows_of(window, whole)]

    weight = np.ldexp(np.maximum(np.abs(found), 1.0), columns[prescribed])
    repaired = _repaired(matrix, radius, (weight, columns[prescribed]), point[prescribed].copy(), missing, refine=True)
    if repaired is None:
        return None
    point[prescribed] = repaired.values
    return point
