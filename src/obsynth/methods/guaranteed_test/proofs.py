"""Proofs for a window of samples: thresholds by multipliers, lower bounds by a witness, and why there is no test.

Shipped doubles satisfy the equations of the window up to rounding: `nearby_solutions` bounds the distance to an exact
solution, and what bounds hold for every number within that distance holds for the exact one.
"""

from __future__ import annotations

from collections.abc import Sequence
from fractions import Fraction

import numpy as np

from obsynth.methods.guaranteed_test.condensed import LEAST_WEIGHT, Condensed
from obsynth.methods.guaranteed_test.windows import Window
from obsynth.numerics.arrays import FloatArray
from obsynth.proofs.balls import UNIT_ROUNDOFF, rounded_up
from obsynth.proofs.exact_doubles import ScaledIntegers, rounded_outward, scaled_integers
from obsynth.proofs.nearby_solutions import NearbySolution, nearby_solution, rational_correction

#: A bounded number so near to its bound, as a share of it, is at its bound.
AT_BOUND_SHARE = 1e-9

#: Least room that a bounded number counts for when a square part is chosen, as a share of its bound.
LEAST_ROOM = 1e-4

#: Most rows for which a trajectory that hides a fault is looked for: all of them at once.
MOST_ROWS_FOR_A_RAY = 2500

#: Residual, in scaled equations, below which a fault is taken as hidden, to be proved then.
HIDDEN = 1e-9


def _entries(window: Window) -> ScaledIntegers:
    """Return the entries of the matrix exactly."""
    values, exponent = scaled_integers(window.value)
    return values * np.array(window.times.tolist(), dtype=object), exponent


def _sums(
    entries: ScaledIntegers, doubles: FloatArray, places: np.ndarray, onto: np.ndarray, count: int
) -> list[Fraction]:
    """Return exact sums of entries times doubles."""
    (values, exponent), (factors, more) = entries, scaled_integers(doubles)
    totals = [0] * count
    for place, product in zip(onto.tolist(), (values * factors[places]).tolist(), strict=True):
        totals[place] += product
    unit = Fraction(2) ** (exponent + more)
    return [value * unit for value in totals]


def columns_of(window: Window, multipliers: FloatArray) -> list[Fraction]:
    """Return the matrix transposed times multipliers, exactly ``(columns,)``."""
    return _sums(_entries(window), multipliers, window.i, window.j, len(window.bar))


def rows_of(window: Window, point: FloatArray) -> list[Fraction]:
    """Return the matrix times a point, exactly ``(rows,)``."""
    return _sums(_entries(window), point, window.j, window.i, window.rows)


def columns_of_exact(window: Window, multipliers: Sequence[Fraction]) -> list[Fraction]:
    """Return the matrix transposed times multipliers that are fractions, exactly ``(columns,)``."""
    (values, exponent), columns = _entries(window), [Fraction(0)] * len(window.bar)
    unit = Fraction(2) ** exponent
    for row, column, entry in zip(window.i.tolist(), window.j.tolist(), values.tolist(), strict=True):
        if multipliers[row]:
            columns[column] += multipliers[row] * entry
    return [value * unit for value in columns]


def exact_right_sides(window: Window, y: FloatArray, u: FloatArray) -> list[Fraction]:
    """Return the right sides of a window of samples, exactly: ``B u`` and ``y - D u``."""
    plant, sides = window.plant, [Fraction(0)] * window.rows

    def times(row: FloatArray, known: FloatArray) -> Fraction:
        return sum(
            (Fraction(float(a)) * Fraction(float(b)) for a, b in zip(row, known, strict=True)), start=Fraction(0)
        )

    for k in range(window.equations):
        for r in range(plant.nx):
            sides[k * plant.nx + r] = times(plant.B[r], u[k])
    for k in range(window.test_problem.samples):
        for r in range(plant.ny):
            place = window.outputs_at + k * plant.ny + r
            sides[place] = Fraction(float(y[k, r])) - times(plant.D[r], u[k])
    if window.standing:
        sides = [side - middle for side, middle in zip(sides, window.standing, strict=True)]
    return sides


def _weights(window: Window, multipliers: FloatArray) -> FloatArray:
    """Return how readily each equation's multiplier is corrected: the larger ones first."""
    rows, _ = window.scales
    sizes = np.ldexp(np.abs(multipliers), -rows)
    return np.asarray(np.ldexp(np.maximum(sizes, LEAST_WEIGHT * float(np.max(sizes, initial=0.0))), rows))


def exact_multipliers(window: Window, multipliers: FloatArray) -> list[Fraction] | None:
    """Return fractions next to multipliers that see no free column at all; ``None`` where none are found."""
    prescribed = np.flatnonzero(window.free)
    columns = columns_of(window, multipliers)
    weight = _weights(window, multipliers)
    dense, _ = _dense(window, prescribed)
    corrected = rational_correction(dense.T, weight, [-columns[column] for column in prescribed])
    if corrected is None:
        return None
    exact = [Fraction(float(value)) for value in multipliers]
    for place, step in zip(*corrected, strict=True):
        exact[place] += step
    return exact


def down(value: Fraction) -> float:
    """Return a double that is not above a rational number."""
    return -rounded_outward(-value)


def _dense(window: Window, columns: np.ndarray) -> tuple[FloatArray, FloatArray]:
    """Return columns of the matrix, and what rounding of their products may be."""
    matrix = window.matrix[:, columns].toarray()
    multiplied = np.abs(window.times).max(initial=1) > 1
    radius = UNIT_ROUNDOFF * np.abs(matrix) * (2.0 if multiplied else 0.0)
    return matrix, radius


def repaired_multipliers(
    window: Window, multipliers: FloatArray, *, refine: bool, exact_zero: bool = False, among: FloatArray | None = None
) -> NearbySolution | None:
    """Return multipliers with the distance to exact ones: no free column is seen, theta with weight one.

    ``exact_zero``: no bounded column is seen either.  ``refine``: move them to the nearest doubles first.
    ``among``: only those with a positive number there differ from the exact ones.
    """
    condensed = None if exact_zero else Condensed.of(window)
    if condensed is not None:
        repaired = condensed.multipliers(multipliers, refine=refine, among=among)
        if repaired is not None:
            return NearbySolution(*repaired)
    # The columns whose products with multipliers are prescribed: 0, or 1 for that of theta.
    prescribed = [0, *(range(1, len(window.bar)) if exact_zero else np.flatnonzero(window.free).tolist())]
    targets = [Fraction(int(column == 0)) for column in prescribed]

    def missing(values: FloatArray) -> list[Fraction]:
        columns = columns_of(window, values)
        return [want - columns[column] for want, column in zip(targets, prescribed, strict=True)]

    matrix, radius = _dense(window, np.array(prescribed))
    rows, _ = window.scales
    weight = _weights(window, multipliers)
    weight = weight if among is None else np.where(among > 0.0, weight, 0.0)
    return nearby_solution(matrix.T, radius.T, (weight, rows), np.array(multipliers), missing, refine=refine)


def repaired_point(
    window: Window, point: FloatArray, *, refine: bool, among: FloatArray | None = None
) -> NearbySolution | None:
    """Return a hidden fault's point ``(columns,)`` with the distance to one that satisfies every equation exactly."""
    bar, bounded = window.bar, window.bounded
    values = np.array(point)
    if refine:
        near = bounded & (bar - np.abs(values) < AT_BOUND_SHARE * bar)
        values[near] = np.copysign(bar[near], values[near])
    condensed = Condensed.of(window)
    if condensed is not None:
        repaired = condensed.point(values)
        if repaired is not None:
            return NearbySolution(*repaired) if refine else NearbySolution(values, _distances(*repaired, values))
    _, columns = window.scales
    sizes = np.ldexp(np.abs(values), -columns)
    room = np.ldexp(np.maximum(1.0, sizes), columns)
    bound = np.where(bounded, bar, 0.0)
    weight = np.where(bounded, np.maximum(bound - np.abs(values), LEAST_ROOM * bound), room)
    weight[0] = 0.0
    weight = weight if among is None else np.where(among > 0.0, weight, 0.0)
    matrix, radius = _dense(window, np.arange(len(bar)))

    def missing(values: FloatArray) -> list[Fraction]:
        return [-value for value in rows_of(window, values)]

    return nearby_solution(matrix, radius, (weight, columns), values, missing, refine=refine)


def _distances(exact: FloatArray, distance: FloatArray, values: FloatArray) -> FloatArray:
    """Return how far values are from what lies within a distance of others."""
    return np.where(distance > 0.0, rounded_up(np.abs(exact - values) + distance, 3), 0.0)


def proved_threshold(window: Window, repaired: NearbySolution, *, exact_zero: bool = False) -> float:
    """Return what the test never passes without a fault: an upper bound of ``sum bar |M_s' mu|``."""
    if exact_zero:
        return 0.0
    standing = Fraction(window.standing_room(repaired.values, repaired.radius))
    columns = columns_of(window, repaired.values)
    away = _absolute(window, repaired.radius)
    bounded = np.flatnonzero(window.bounded)
    parts = [Fraction(float(window.bar[j])) * (abs(columns[j]) + away[j]) for j in bounded]
    if not window.test_problem.ellipsoid:
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


def proved_least(window: Window, repaired: NearbySolution) -> float:
    """Return the size of the hidden fault that the exact point next to these doubles shows, within all bounds."""
    bounded = np.flatnonzero(window.bounded)
    sizes = rounded_up((np.abs(repaired.values) + repaired.radius)[bounded], 2) / window.bar[bounded]
    sizes = rounded_up(sizes, 2)
    groups = window.group[bounded]
    alone = sizes if not window.test_problem.ellipsoid else sizes[groups < 0]
    worst = float(np.max(alone, initial=1.0))
    if window.test_problem.ellipsoid:
        for group in np.unique(groups[groups >= 0]):
            part = sizes[groups == group]
            worst = float(np.maximum(worst, rounded_up(np.sqrt(np.sum(part**2)), 2 * len(part) + 8)))
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
    solution = np.linalg.lstsq(scaled, -np.ldexp(theta, rows), rcond=None)[0]
    size = 1.0 + float(np.max(np.abs(solution), initial=0.0))
    if np.max(np.abs(scaled @ solution + np.ldexp(theta, rows)), initial=0.0) > HIDDEN * size:
        return None
    point = np.zeros(len(window.bar))
    point[0], point[prescribed] = 1.0, np.ldexp(solution, columns[prescribed])

    def missing(values: FloatArray) -> list[Fraction]:
        full_point = point.copy()
        full_point[prescribed] = values
        return [-value for value in rows_of(window, full_point)]

    weight = np.ldexp(np.maximum(np.abs(solution), 1.0), columns[prescribed])
    repaired = nearby_solution(
        matrix, radius, (weight, columns[prescribed]), point[prescribed].copy(), missing, refine=True
    )
    if repaired is None:
        return None
    point[prescribed] = repaired.values
    return point
