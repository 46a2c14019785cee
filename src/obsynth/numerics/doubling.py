"""Indefinite Riccati equations by doubling: products and solves alone, so that hundreds of states take little time.

Powers of a stable matrix that have lost rank, down to rounding: the rest of a doubling takes place in fewer states.

With ``P = U V'``, ``X = H + P (X^-1 + G)^-1 P'`` is solved by ``X = H + U Z U'``, ``Z = h + p (Z^-1 + g)^-1 p'``, with
``p = V' M^-1 U``, ``g = U' G M^-1 U``, ``h = V' M^-1 H V``, ``M = I + H G``; so is the sum ``X = H + P X P'``, where G
is zero.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from itertools import pairwise
from typing import NamedTuple

import numpy as np

from obsynth.numerics import lapack
from obsynth.numerics.arrays import FloatArray, largest_singular_value
from obsynth.numerics.scaling import power_of_two_below

#: Below so many states a whole step costs less than to look.
FEWEST_STATES = 200

#: The first power that is looked at.
FIRST_POWER = 3

#: Share of the directions that must be enough.
SHARE = 0.5

#: What they leave of a power, relative to it, that counts as rounding; its logarithm tells when to look
#: again, since each squaring doubles it.
POWER_ROUNDING = 4e-15

#: Diagonal entries of a solution are taken to be at least this share of the largest when they set units.
LEAST_SIZE = 1e-20

#: Rows of a thin matrix, as a share of the states, up to which a step with them costs less than one with the matrix.
THIN = 0.7

#: Rows of blocks in which a symmetric product is formed: five eighths of the work of all.
BLOCK_ROWS = 4

#: Directions in which that is measured, beside those that make the basis.
PROBES = 6

#: Doubling stops when a step changes the solution by less than this, relative to it; each step squares the error.
DOUBLING_TOLERANCE = 1e-14

STAGNATION = 1e-9

#: Below this change, that of the next step follows from the last two; and when it is far below rounding.
SETTLED_CHANGE = 1e-8

FAR_BELOW_ROUNDING = 1e-18

#: Residual of a Riccati equation that counts as solved, relative to its terms.
EQUATION_TOLERANCE = 1e-8

MOST_DOUBLINGS = 60

#: A change larger than the solution, after the first steps, is a jump through infinity: where a stabilising solution
#: exists there was none (1,253 equations of random plants).
FIRST_DOUBLINGS, LARGE_CHANGE, MOST_JUMPS = 8, 1.5, 1

#: Eigenvalues that are smaller than the largest by more than this share do not set the rate of a Cayley transform.
WIDEST_SPECTRUM = 1e-3

#: Keeps that rate off an eigenvalue, which a single one would be.
RATE_OFFSET = 1.3

#: Share of the size of its terms by which a sign must be wrong.
REFUTED = 1e-6

#: Norm of the dynamics above which a level is not refuted by doubling.
LARGEST_TRUSTED_NORM = 10.0

#: Keeps a division by the size of a zero solution from failing.
LEAST_POSITIVE = float(np.finfo(np.float64).tiny)


class RankWatch:
    """Says when fewer directions of a power are enough, with as few looks as its decay allows."""

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
        rank = int(SHARE * n)
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
        return bool(n >= FEWEST_STATES and r <= THIN * n)

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


def doubled_riccati_solution(
    a: FloatArray,
    h: FloatArray,
    process: FloatArray,
    weight: FloatArray,
    cross: FloatArray,
    *,
    possible: Callable[[FloatArray], bool] | None = None,
    most_jumps: int = MOST_DOUBLINGS,
) -> FloatArray | None:
    """Return the stabilising solution of ``Y = A Y A' - (A Y H' + S) (W + H Y H')^-1 (A Y H' + S)' + Q``.

    Doubling of Chu, Fan, Lin and Wang (2004); it needs no definite weight W, but may break down: ``None``.
    """
    n = a.shape[0]
    if n == 0:
        return np.zeros((0, 0))
    solved = np.linalg.solve(weight, np.concatenate([h, cross.T], axis=1))
    thin = ThinBack(h, weight)
    back = thin if thin.is_thin else h.T @ solved[:, :n]
    start = a - cross @ solved[:, :n], back, process - cross @ solved[:, n:]
    return _doubled(*start, possible=possible, most_jumps=most_jumps)


def continuous_riccati_solution(
    a: FloatArray, c: FloatArray, process: FloatArray, measured: FloatArray
) -> FloatArray | None:
    """Return the stabilising solution of ``A Y + Y A' - Y C' R^-1 C Y + Q = 0``, by doubling.

    A Cayley transform makes it an equation in discrete time with the same solution (Chu, Fan and Lin 2005).
    """
    n, identity = a.shape[0], np.eye(a.shape[0])
    if n == 0:
        return np.zeros((0, 0))
    sizes = np.abs(np.linalg.eigvals(a))
    # In the middle of the eigenvalues, on a logarithmic scale: both ends are as slow.
    largest = max(float(sizes.max()), LEAST_POSITIVE)
    rate = RATE_OFFSET * math.sqrt(largest * max(float(sizes.min()), WIDEST_SPECTRUM * largest))
    information = c.T @ np.linalg.solve(measured, c)
    try:
        inverse = np.linalg.inv(a.T - rate * identity)
        outer = np.linalg.inv((a - rate * identity) + process @ inverse @ information)
    except np.linalg.LinAlgError:
        return None
    power = np.ascontiguousarray(identity + 2.0 * rate * outer)
    back, solution = inverse @ information @ outer, outer @ process @ inverse
    return _doubled(power, np.asarray(2.0 * rate * back), np.asarray(2.0 * rate * solution))


def _doubled(
    power: FloatArray,
    back: FloatArray | ThinBack,
    solution: FloatArray,
    *,
    possible: Callable[[FloatArray], bool] | None = None,
    most_jumps: int = MOST_DOUBLINGS,
) -> FloatArray | None:
    """Double an equation without cross term from its first step; ``power`` (transposed in the papers) in C order."""
    back, solution = back if isinstance(back, ThinBack) else symmetric(back), symmetric(solution)
    error, jumps, full = np.inf, 0, solution
    watch, lifts = RankWatch(), Lifts()
    with np.errstate(over="ignore", invalid="ignore"):
        for step in range(MOST_DOUBLINGS):
            if possible is not None and not possible(full):
                return None
            # At first in the units of what drives the states, then in those of what it has reached.
            if step in (0, FIRST_POWER) and len(power) >= FEWEST_STATES:
                power, back, solution = lifts.balanced(power, back, solution)
            if isinstance(back, ThinBack) and not back.is_thin:
                back = symmetric(back.whole())
            part = watch.slow_part(power)
            if part is not None:
                lifts.add(solution, part[0])
            stepped = (
                _doubled_once(power, back, solution) if part is None else slow_equation(part, power, back, solution)
            )
            if stepped is None:
                return None
            # A step adds to the last equation; the first of a lower order stands alone.
            power, back, change = stepped[0], _symmetric_sum(None if part else back, stepped[1]), symmetric(stepped[2])
            solution = solution + change if part is None else change
            full, before = lifts.full(solution), full
            # The change itself is known far below rounding of the solution, where nothing was lifted.
            changed = change if full is solution else full - before
            size = math.sqrt(np.vdot(full, full))
            if not math.isfinite(size):
                return None
            error, last = math.sqrt(np.vdot(changed, changed)) / max(size, LEAST_POSITIVE), error
            jumps += step >= FIRST_DOUBLINGS and error > LARGE_CHANGE
            if jumps > most_jumps:
                return None
            # Rounding leaves changes that shrink no more; small ones are as good as none.
            if error <= DOUBLING_TOLERANCE or last <= error <= STAGNATION:
                return full
            # Each step squares the change, up to a factor that the last two show: the next adds nothing.
            if error <= SETTLED_CHANGE and error * max(error, (error / last) ** 2) <= FAR_BELOW_ROUNDING:
                return full
    return None


def _symmetric_sum(back: FloatArray | ThinBack | None, added: FloatArray | ThinBack) -> FloatArray | ThinBack:
    """Return the sum of what was there and what a step adds, its symmetric part."""
    if isinstance(back, ThinBack) and isinstance(added, ThinBack):
        rows, r = np.concatenate([back.rows, added.rows]), len(back.rows)
        weight = np.zeros((len(rows), len(rows)))
        weight[:r, :r], weight[r:, r:] = back.weight, added.weight
        return ThinBack(rows, weight)
    if isinstance(added, ThinBack):
        return added
    return symmetric(added) if back is None else np.asarray(back + symmetric(added))


def symmetric(matrix: FloatArray) -> FloatArray:
    """Return the symmetric part ``(n, n)``."""
    average = matrix + matrix.T
    average *= 0.5
    return np.asarray(average)


def _doubled_once(
    power: FloatArray, back: FloatArray | ThinBack, solution: FloatArray
) -> tuple[FloatArray, FloatArray | ThinBack, FloatArray] | None:
    """Return the next power and what a step adds to the other two, symmetric parts yet to be taken; else ``None``."""
    if isinstance(back, ThinBack):
        passed = back.passed(power, solution)
        if passed is None:
            return None
        through, moved, weight = passed
        return through.dot(power), ThinBack(back.rows.dot(power), weight), symmetric_product(moved, through.T)
    n = len(power)
    # `dot` is `@` with half the overhead, which for few states is most of the time.
    matrix, parts = solution.dot(back), np.concatenate([power, back])
    matrix.reshape(-1)[:: n + 1] += 1.0
    if not _solved_in_place(matrix, parts):
        return None
    returned, through = symmetric_product(power.T.dot(parts[n:]), power), solution.dot(parts[:n].T)
    return parts[:n].dot(power), returned, symmetric_product(power, through)


def _solved_in_place(matrix: FloatArray, rows: FloatArray) -> bool:
    """Replace ``rows (k, n)`` by ``rows @ inv(matrix)``, both in C order, uncopied; false where singular."""
    _, _, solution, failed = lapack.dgesv(matrix.T, rows.T, overwrite_a=1, overwrite_b=1)
    if not np.may_share_memory(solution, rows):
        rows[...] = solution.T
    return not failed


def compared_gain(a: FloatArray, b: FloatArray, c: FloatArray, d: FloatArray, level: float) -> bool | None:
    """Return whether the H-infinity norm of a stable system is at most ``level``; ``None`` where that is not told.

    A symmetric solution with ``W = level^2 I - D'D - B'PB > 0`` factors ``level^2 I - G~G`` as ``M~ W M >= 0``; W > 0
    fails over finitely many steps only if the norm is above the level.  The transposed system has the same norm, and of
    many states with few outputs a solution that takes less time and loses fewer digits.
    """
    if len(a) >= FEWEST_STATES and 0 < len(c) <= b.shape[1]:
        verdict = _is_reached(a.T, c.T, b.T, d.T, level)
        if verdict is not None:
            return verdict
    return _is_reached(a, b, c, d, level)


def _is_reached(a: FloatArray, b: FloatArray, c: FloatArray, d: FloatArray, level: float) -> bool | None:
    process, cross = c.T @ c, c.T @ d
    gap = d.T @ d - level**2 * np.eye(b.shape[1])
    refuted = False

    def possible(p: FloatArray) -> bool:
        nonlocal refuted
        refuted = is_clearly_negative(-(gap + b.T @ p @ b), b, p)
        return not refuted

    with np.errstate(all="ignore"):
        try:
            p = doubled_riccati_solution(a.T, b.T, process, gap, cross, possible=possible)
            if p is None:
                # Far from normal, rounding in the doubling outgrows any margin.
                return False if refuted and largest_singular_value(a) <= LARGEST_TRUSTED_NORM else None
            through = a.T @ p @ b + cross
            weight = -(gap + b.T @ p @ b)
            if not is_positive(weight):
                return None
            added = through @ np.linalg.solve(weight, through.T)
        except np.linalg.LinAlgError:
            return None
        moved = a.T @ p @ a
        sizes = float(np.linalg.norm(p)) + float(np.linalg.norm(moved)) + float(np.linalg.norm(added))
        return True if float(np.linalg.norm(p - moved - process - added)) <= EQUATION_TOLERANCE * sizes else None


def is_clearly_negative(weight: FloatArray, b: FloatArray, p: FloatArray) -> bool:
    """Return whether ``weight``, which holds ``-B'PB``, is below zero by more than what rounding may have done to P."""
    if not np.isfinite(weight).all() or is_positive(weight):
        return False
    margin = REFUTED * float(np.linalg.norm(b)) ** 2 * float(np.linalg.norm(p))
    return bool(np.linalg.eigvalsh(weight)[0] < -margin)


def is_positive(matrix: FloatArray) -> bool:
    """Return whether a Cholesky factorisation of a symmetric matrix runs to its end (computed, not proved)."""
    factor, failed = lapack.dpotrf(matrix, lower=1, clean=0)
    return not failed and math.isfinite(factor.trace())
