"""Indefinite Riccati equations by a doubling algorithm: only products and solves, fast for hundreds of states."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np

from obsynth.numerics import lapack
from obsynth.numerics.arrays import FloatArray
from obsynth.numerics.thin_doubling import (
    FEWEST_STATES,
    FIRST_POWER,
    Lifts,
    RankWatch,
    ThinBack,
    slow_equation,
    symmetric_product,
)

#: Doubling stops when a step changes the solution by less than this, relative to it; each step squares the error.
DOUBLING_TOLERANCE = 1e-14

STAGNATION = 1e-9

#: Below this change, that of the next step follows from the last two; and when it is far below rounding.
SETTLED_CHANGE = 1e-8

FAR_BELOW_ROUNDING = 1e-18

MOST_DOUBLINGS = 60

#: A change larger than the solution, after the first steps, is a jump through infinity: where a stabilising solution
#: exists there was none (1,253 equations of random plants).
FIRST_DOUBLINGS, LARGE_CHANGE, MOST_JUMPS = 8, 1.5, 1

#: Eigenvalues that are smaller than the largest by more than this share do not set the rate of a Cayley transform.
WIDEST_SPECTRUM = 1e-3

#: Keeps that rate off an eigenvalue, which a single one would be.
RATE_OFFSET = 1.3


#: Keeps a division by the size of a zero solution from failing.
LEAST_POSITIVE = float(np.finfo(np.float64).tiny)


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
