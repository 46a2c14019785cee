"""The square-root step over many samples as one compiled loop. Needs numba (`obsynth[fast]`); import it only then.

The reflections are those of `projected_step` in `square_root_estimation`, in the same order, so that even signs agree.
Compiled at the first import, for seconds, and kept beside this file, or where ``NUMBA_CACHE_DIR`` says.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any, TypeVar, cast

import numba
import numpy as np

from obsynth.numerics.arrays import FloatArray
from obsynth.numerics.square_root_estimation import OUTGROWN

#: A factorisation that changes by no more than this, relative to each column, and so many times in a row, has settled:
#: what it would change from then on is what rounding does at every step.
SETTLED_FACTOR = 4.0 * np.finfo(np.float64).eps

SETTLED_STEPS = 3

Function = TypeVar("Function", bound=Callable[..., object])

#: Types of `square_root_steps`, so that it is compiled once for all sizes.
VECTOR, MATRIX_TYPE, STACK_TYPE = "float64[::1]", "float64[:, ::1]", "float64[:, :, ::1]"

SIGNATURE = f"int64({', '.join([VECTOR, MATRIX_TYPE, *[STACK_TYPE] * 3, *[MATRIX_TYPE] * 4, STACK_TYPE, 'float64'])})"


def compiled(function: Function, signature: str | None = None) -> Function:
    """Return a function compiled by numba, at its first call or, with a signature, at once."""
    arguments = () if signature is None else (signature,)
    njit: Any = numba.njit
    try:
        return cast(Function, njit(*arguments, cache=True, nogil=True)(function))
    except RuntimeError:
        # No place for a cache can be written: compile for this process alone.
        return cast(Function, njit(*arguments, nogil=True)(function))


@compiled
def _fill(triangle: FloatArray, work: FloatArray, factor: FloatArray, moved: FloatArray, known: FloatArray) -> float:
    """Write the noise of one step, that of the step itself as its triangle; return its squared length."""
    n, rows = moved.shape
    total = 0.0
    for i in range(rows):
        for r in range(rows):
            triangle[i, r] = known[i, r]
            total += known[i, r] * known[i, r]
    for i in range(n):
        for r in range(rows):
            work[i, r] = 0.0
        for c in range(n):
            weight = factor[c, i]
            if weight != 0.0:
                for r in range(rows):
                    work[i, r] += weight * moved[c, r]
        for r in range(rows):
            total += work[i, r] * work[i, r]
    return total


@compiled
def _triangularise(triangle: FloatArray, work: FloatArray, sums: FloatArray) -> None:
    """Take the reflections of a QR factorisation of a triangle above more rows; these are spoilt."""
    height, rows = work.shape
    for j in range(rows):
        squares = 0.0
        for i in range(height):
            squares += work[i, j] * work[i, j]
        if squares == 0.0:
            continue
        head = triangle[j, j]
        length = -math.copysign(math.sqrt(head * head + squares), head)
        first = head - length
        scale = -1.0 / (length * first)
        for c in range(j + 1, rows):
            sums[c] = first * triangle[j, c]
        for i in range(height):
            entry = work[i, j]
            for c in range(j + 1, rows):
                sums[c] += entry * work[i, c]
        for c in range(j + 1, rows):
            sums[c] *= scale
            triangle[j, c] -= first * sums[c]
        for i in range(height):
            entry = work[i, j]
            for c in range(j + 1, rows):
                work[i, c] -= entry * sums[c]
        triangle[j, j] = length


@compiled
def _is_settled(
    triangle: FloatArray, before: FloatArray, factor: FloatArray, lengths: FloatArray, share: float
) -> bool:
    """Whether a triangle, and the length of each row of the root of the covariance, are those before to rounding.

    Rows of a triangle count up to their signs, and each column has a scale of its own.  Both are replaced.
    """
    rows = len(triangle)
    settled = True
    for i in range(len(factor)):
        total = 0.0
        for j in range(len(factor)):
            total += factor[i, j] * factor[i, j]
        settled = settled and abs(total - lengths[i]) <= share * total
        lengths[i] = total
    for j in range(rows):
        size = 0.0
        for i in range(j + 1):
            size += triangle[i, j] * triangle[i, j]
        size = share * math.sqrt(size)
        for i in range(j + 1):
            value = math.copysign(1.0, triangle[i, i]) * triangle[i, j]
            # Also false where something is not finite.
            settled = settled and abs(value - before[i, j]) <= size
            before[i, j] = value
    return settled


@compiled
def _whiten(work: FloatArray, right: FloatArray, innovation: FloatArray) -> None:
    """Whiten the parity in ``right``, and take from the rest what it tells."""
    m = len(innovation)
    for i in range(m):
        innovation[i] = right[i] / work[i, i]
        for r in range(i + 1, len(right)):
            right[r] -= work[i, r] * innovation[i]
        if work[i, i] < 0.0:
            # That of a positive diagonal, whatever the reflections met.
            innovation[i] = -innovation[i]


@compiled
def _solve_estimate(right: FloatArray, head: FloatArray, x: FloatArray, state: FloatArray) -> None:
    """Solve with R_H for the estimate alone."""
    n = len(head)
    m = len(right) - n
    for i in range(n - 1, -1, -1):
        value = right[m + i]
        for c in range(i + 1, n):
            value -= head[i, c] * x[c]
        x[i] = value / head[i, i]
        state[i] = x[i]


@compiled
def _solve(
    work: FloatArray, right: FloatArray, head: FloatArray, x: FloatArray, factor: FloatArray, state: FloatArray
) -> None:
    """Solve with R_H for the estimate and for the square root of its covariance."""
    n = len(head)
    m = len(right) - n
    for i in range(n - 1, -1, -1):
        value = right[m + i]
        for j in range(n):
            factor[i, j] = work[m + j, m + i] if j <= i else 0.0
        for c in range(i + 1, n):
            weight = head[i, c]
            value -= weight * x[c]
            for j in range(n):
                factor[i, j] -= weight * factor[c, j]
        inverse = 1.0 / head[i, i]
        x[i] = value * inverse
        state[i] = x[i]
        for j in range(n):
            factor[i, j] *= inverse


@compiled
def _note_spreads(factor: FloatArray, deviations: FloatArray, covariance: FloatArray) -> None:
    """Write the deviations of the first entries of the state, and the covariance of the others."""
    n, nx = len(factor), len(deviations)
    for i in range(nx):
        total = 0.0
        for j in range(n):
            total += factor[i, j] * factor[i, j]
        deviations[i] = math.sqrt(total)
    for i in range(nx, n):
        for c in range(nx, n):
            total = 0.0
            for j in range(n):
                total += factor[i, j] * factor[c, j]
            covariance[i - nx, c - nx] = total


@compiled
def _note_again(k: int, deviations: FloatArray, covariances: FloatArray) -> None:
    """Write what was noted a step before, entry by entry: for whole slices numba compiles twice as long."""
    nx, walking = deviations.shape[1], covariances.shape[1]
    for i in range(nx):
        deviations[k, i] = deviations[k - 1, i]
    for i in range(walking):
        for c in range(walking):
            covariances[k, i, c] = covariances[k - 1, i, c]


def _steps(
    x: FloatArray,
    factor: FloatArray,
    moved: FloatArray,
    known: FloatArray,
    head: FloatArray,
    data: FloatArray,
    states: FloatArray,
    innovations: FloatArray,
    deviations: FloatArray,
    covariances: FloatArray,
    share: float,
) -> int:
    """Take steps of the square-root recursion until one needs a decision about a rank; return how many were taken.

    Arrays in C order, writeable; what does not change with k has one entry along its first axis.  Shapes: ``x (n,),
    factor (n, n), moved (., n, rows), known (., rows, rows) upper triangular, head (., n, n), data (steps, rows),
    states (steps, n), innovations (steps, rows - n), deviations (steps, nx), covariances (steps, n - nx, n - nx)``.
    Where the step stays the same, so does its factorisation once it has settled: then the estimate alone goes on.
    """
    n, rows = moved.shape[1], moved.shape[2]
    m = rows - n
    triangle, work, before = np.zeros((rows, rows)), np.zeros((n, rows)), np.zeros((rows, rows))
    sums, right, lengths = np.zeros(rows), np.zeros(rows), np.zeros(n)
    stays, settled = len(moved) == 1 and len(known) == 1 and len(head) == 1, 0
    for k in range(len(data)):
        move, noise, top = moved[k % len(moved)], known[k % len(known)], head[k % len(head)]
        if settled < SETTLED_STEPS:
            squares = _fill(triangle, work, factor, move, noise)
            if not squares < OUTGROWN * OUTGROWN:
                return k
            suspect = share * math.sqrt(squares)
            _triangularise(triangle, work, sums)
            for i in range(m):
                if not abs(triangle[i, i]) > suspect:
                    return k
        for r in range(rows):
            right[r] = data[k, r]
        for c in range(n):
            for r in range(rows):
                right[r] += x[c] * move[c, r]
        _whiten(triangle, right, innovations[k])
        if settled < SETTLED_STEPS:
            _solve(triangle, right, top, x, factor, states[k])
            _note_spreads(factor, deviations[k], covariances[k])
            if stays:
                settled = settled + 1 if _is_settled(triangle, before, factor, lengths, SETTLED_FACTOR) else 0
        else:
            _solve_estimate(right, top, x, states[k])
            _note_again(k, deviations, covariances)
    return len(data)


square_root_steps = compiled(_steps, SIGNATURE)
