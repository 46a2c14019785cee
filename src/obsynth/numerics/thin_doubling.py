"""Doubling steps of low rank: a power that has lost rank down to rounding, or a matrix of few rows.

With ``P = U V'``, ``X = H + P (X^-1 + G)^-1 P'`` is solved by ``X = H + U Z U'``, ``Z = h + p (Z^-1 + g)^-1 p'``, with
``p = V' M^-1 U``, ``g = U' G M^-1 U``, ``h = V' M^-1 H V``, ``M = I + H G``; so is the sum ``X = H + P X P'``, where G
is zero.
"""

from __future__ import annotations

import math
from itertools import pairwise
from typing import NamedTuple

import numpy as np

from obsynth.numerics import lapack
from obsynth.numerics.arrays import FloatArray
from obsynth.numerics.scaling import power_of_two_below

#: Below so many states a full step costs less than a test of the rank.
FEWEST_STATES = 200

#: The first power whose rank is tested: earlier ones have hardly decayed.
FIRST_POWER = 3

#: The rest of a doubling is in fewer states where the range of the power has at most this share of all directions.
SLOW_SHARE = 0.5

#: A part of a power outside of these directions that counts as rounding, relative to it; each squaring doubles the
#: logarithm of that part, which so says when to test again.
POWER_ROUNDING = 4e-15

#: Diagonal entries of a solution are taken to be at least this share of the largest when they set units.
LEAST_SIZE = 1e-20

#: Rows of a thin matrix, as a share of the states, up to which a step with them costs less than one with the matrix.
THIN_SHARE = 0.7

#: Rows of blocks in which a symmetric product is formed: five eighths of the work of the full product.
BLOCK_ROWS = 4

#: Random directions that measure this part, beside those of the basis.
PROBES = 6


class RankWatch:
    """Tests when a power is of low rank, as rarely as its decay allows."""

    def __init__(self) -> None:
        self.wait = FIRST_POWER

    def slow_part(self, power: FloatArray) -> tuple[FloatArray, FloatArray] | None:
        """Return a power ``(n, n)`` as an orthonormal basis ``(n, s)`` and rows ``(s, n)``, or ``None``; to be asked
        once for each squaring."""
        n = len(power)
        if n < FEWEST_STATES:
            return None
        if self.wait:
            self.wait -= 1
            return None
        rank = int(SLOW_SHARE * n)
        directions = np.random.default_rng(0).normal(size=(n, rank + PROBES))
        images = power @ directions
        if not np.all(np.isfinite(images)):
            return None
        basis = np.linalg.qr(images[:, :rank])[0]
        probes = images[:, rank:]
        missed = float(np.linalg.norm(probes - basis @ (basis.T @ probes)))
        share = missed / max(float(np.linalg.norm(probes)), float(np.finfo(np.float64).tiny))
        if share <= POWER_ROUNDING:
            return np.asarray(basis), basis.T @ power
        self.wait = max(0, math.ceil(math.log2(math.log(POWER_ROUNDING) / math.log(share))) - 1) if share < 1.0 else 1
        return None


class ThinBack(NamedTuple):
    """A matrix ``G = rows' W^-1 rows`` of few rows ``(r, n)``: the first steps of a doubling, which each double r."""

    rows: FloatArray
    weight: FloatArray

    @property
    def is_thin(self) -> bool:
        """Whether a step with the rows costs less than one with G."""
        r, n = self.rows.shape
        return bool(n >= FEWEST_STATES and r <= THIN_SHARE * n)

    def whole(self) -> FloatArray:
        """Return G."""
        return symmetric_product(self.rows.T, np.asarray(np.linalg.solve(self.weight, self.rows)))

    def scaled(self, units: FloatArray) -> ThinBack:
        """Return the rows in other units of the states."""
        return ThinBack(self.rows * units, self.weight)

    def passed(self, factor: FloatArray, solution: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray] | None:
        """Return ``factor M^-1``, ``factor X`` and ``N = W + rows X rows'``; ``None`` if ``M = I + X G`` is singular.

        ``M^-1 = I - X rows' N^-1 rows`` and ``G M^-1 = rows' N^-1 rows``.
        """
        image = solution.dot(self.rows.T)
        weight = self.weight + self.rows.dot(image)
        weight = 0.5 * (weight + weight.T)
        moved = factor.dot(solution)
        _, _, solved, failed = lapack.dgesv(weight, moved.dot(self.rows.T).T, overwrite_b=1)
        if failed:
            return None
        return factor - solved.T.dot(self.rows), moved, weight


def symmetric_product(a: FloatArray, b: FloatArray) -> FloatArray:
    """Return ``a @ b (n, n)`` where that is symmetric: of many rows only the blocks below the diagonal are formed."""
    n = len(a)
    if n < FEWEST_STATES:
        return np.asarray(a.dot(b))
    product, ends = np.empty((n, n)), [n * i // BLOCK_ROWS for i in range(BLOCK_ROWS + 1)]
    for start, end in pairwise(ends):
        np.matmul(a[start:end], b[:, :end], out=product[start:end, :end])
        product[:start, start:end] = product[start:end, :start].T
    return product


def slow_equation(
    part: tuple[FloatArray, FloatArray], power: FloatArray, back: FloatArray | ThinBack, solution: FloatArray
) -> tuple[FloatArray, FloatArray | ThinBack, FloatArray] | None:
    """Return p, g and h ``(s, s)`` of the equation in the lower order, all in C order; ``None`` where M is singular."""
    u, rows = part
    if isinstance(back, ThinBack):
        passed = back.passed(rows, solution)
        if passed is None:
            return None
        through, moved, weight = passed
        return through.dot(u), ThinBack(back.rows.dot(u), weight), moved.dot(through.T)
    matrix = solution.dot(back)
    matrix.reshape(-1)[:: len(power) + 1] += 1.0
    _, _, solved, failed = lapack.dgesv(matrix.T, np.concatenate([rows, u.T.dot(back)]).T, overwrite_a=1)
    if failed:
        return None
    through, returned = solved.T[: len(rows)], solved.T[len(rows) :]
    return np.ascontiguousarray(through.dot(u)), returned.dot(u), through.dot(solution.dot(rows.T))


class Lifts:
    """The way back to all states: ``X = D (H + U Z U') D``, once for each time that the order became less."""

    def __init__(self) -> None:
        self.steps: list[tuple[FloatArray, FloatArray]] = []
        self.units: FloatArray | None = None

    def balanced(
        self, power: FloatArray, back: FloatArray | ThinBack, solution: FloatArray
    ) -> tuple[FloatArray, FloatArray | ThinBack, FloatArray]:
        """Return the matrices in units in which the solution's diagonal is near one, so that rounding has one size."""
        sizes = np.abs(np.diagonal(solution))
        least = LEAST_SIZE * float(np.max(sizes, initial=0.0))
        if not 0.0 < least < np.inf:
            return power, back, solution
        units = power_of_two_below(np.sqrt(np.maximum(sizes, least)))
        self.units = units if self.units is None else self.units * units
        column = units[:, None]
        turned = back.scaled(units) if isinstance(back, ThinBack) else column * back * units
        return power / column * units, turned, solution / column / units

    def add(self, solution: FloatArray, basis: FloatArray) -> None:
        """Note the solution H ``(n, n)`` and the basis U ``(n, s)`` of one reduction."""
        self.steps.append((solution, basis))

    def full(self, solution: FloatArray) -> FloatArray:
        """Return what a solution ``(s, s)`` of the smallest equation is in all states."""
        for base, basis in reversed(self.steps):
            solution = base + basis.dot(solution).dot(basis.T)
        return solution if self.units is None else self.units[:, None] * solution * self.units
