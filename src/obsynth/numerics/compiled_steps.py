"""The square-root step over many samples as one compiled loop. Needs numba (`obsynth[fast]`); import it only then.

The reflections are those of `obsynth.numerics.least_squares_step.projected_step`, in the same order, so that even signs
agree. Compiled at the first import, for seconds, and kept beside this file, or where ``NUMBA_CACHE_DIR`` says.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any, TypeVar, cast

import numba
import numpy as np

from obsynth.numerics.arrays import FloatArray
from obsynth.numerics.least_squares_step import OUTGROWN

Function = TypeVar("Function", bound=Callable[..., object])

#: Types of `square_root_steps`, so that it is compiled once for all sizes.
VECTOR, MATRIX, STACK = "float64[::1]", "float64[:, ::1]", "float64[:, :, ::1]"
SIGNATURE = f"int64({', '.join([VECTOR, MATRIX, *[STACK] * 3, *[MATRIX] * 4, STACK, 'float64'])})"


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
def _fill(work: FloatArray, factor: FloatArray, moved: FloatArray, known: FloatArray) -> float:
    """Write the transposed noise of one step; return its squared length."""
    n, width, rows = len(moved), len(known), work.shape[1]
    total = 0.0
    for i in range(len(work)):
        for r in range(rows):
            work[i, r] = known[i - n, r] if n <= i < n + width else 0.0
        if i < n:
            for c in range(n):
                weight = factor[c, i]
                for r in range(rows):
                    work[i, r] += weight * moved[c, r]
        for r in range(rows):
            total += work[i, r] * work[i, r]
    return total


@compiled
def _triangularise(work: FloatArray, sums: FloatArray) -> None:
    """Take the reflections of a QR factorisation; only the triangle is valid afterwards."""
    height, rows = work.shape
    for j in range(rows):
        squares = 0.0
        for i in range(j + 1, height):
            squares += work[i, j] * work[i, j]
        if squares == 0.0:
            continue
        head = work[j, j]
        length = -math.copysign(math.sqrt(head * head + squares), head)
        first = head - length
        scale = -1.0 / (length * first)
        for c in range(j + 1, rows):
            sums[c] = first * work[j, c]
        for i in range(j + 1, height):
            entry = work[i, j]
            for c in range(j + 1, rows):
                sums[c] += entry * work[i, c]
        for c in range(j + 1, rows):
            sums[c] *= scale
            work[j, c] -= first * sums[c]
        for i in range(j + 1, height):
            entry = work[i, j]
            for c in range(j + 1, rows):
                work[i, c] -= entry * sums[c]
        work[j, j] = length


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
def _solve(
    work: FloatArray, right: FloatArray, head: FloatArray, x: FloatArray, factor: FloatArray, state: FloatArray
) -> None:  # fmt: skip
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


def _steps(
    x: FloatArray, factor: FloatArray, moved: FloatArray, known: FloatArray, head: FloatArray, data: FloatArray,
    states: FloatArray, innovations: FloatArray, deviations: FloatArray, covariances: FloatArray, share: float,
) -> int:  # fmt: skip
    """Take steps of the square-root recursion until one needs a decision about a rank; return how many were taken.

    Arrays in C order, writeable; what does not change with k has one entry along its first axis.  Shapes: ``x (n,),
    factor (n, n), moved (., n, rows), known (., any, rows), head (., n, n), data (steps, rows), states (steps, n),
    innovations (steps, rows - n), deviations (steps, nx), covariances (steps, n - nx, n - nx)``.
    """
    n, rows = moved.shape[1], moved.shape[2]
    m = rows - n
    work = np.zeros((max(n + known.shape[1], rows), rows))
    sums, right = np.zeros(rows), np.zeros(rows)
    for k in range(len(data)):
        move, noise, top = moved[k % len(moved)], known[k % len(known)], head[k % len(head)]
        squares = _fill(work, factor, move, noise)
        if not squares < OUTGROWN * OUTGROWN:
            return k
        suspect = share * math.sqrt(squares)
        _triangularise(work, sums)
        for i in range(m):
            if not abs(work[i, i]) > suspect:
                return k
        for r in range(rows):
            right[r] = data[k, r]
        for c in range(n):
            for r in range(rows):
                right[r] += x[c] * move[c, r]
        _whiten(work, right, innovations[k])
        _solve(work, right, top, x, factor, states[k])
        _note_spreads(factor, deviations[k], covariances[k])
    return len(data)


square_root_steps = compiled(_steps, SIGNATURE)
