"""Balls around the solutions of large square equations: refinement from double precision, with a proved distance.

Elimination in balls of 256 bits takes a hundred times as long as one product with the matrix.  An approximate inverse
in double precision corrects the solution until no digit is missing; it also proves how far the exact solution is away
(S. M. Rump, Acta Numerica 2010, section 10; see `nearby_solutions`).
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import flint
import numpy as np

from obsynth.numerics.arrays import FloatArray
from obsynth.proofs.balls import Ball, rounded_up
from obsynth.proofs.complex_balls import columns_of
from obsynth.proofs.nearby_solutions import SquarePart

#: With fewer rows elimination in balls is as fast.
ROWS_OF_REFINEMENT = 20

#: Corrections of a solution at most; they end where one is not below this share of the one before.
MOST_CORRECTIONS, CORRECTED_SHARE = 40, 0.25


def enclosed_solution(matrix: Any, right: Any, nearby: Sequence[Ball]) -> Any:
    """Return balls that hold the solution of ``matrix x = right``.

    Parameters
    ----------
    matrix : flint.arb_mat or flint.acb_mat (n, n)
        Of the precision in which the solution is wanted.
    right : of the same type (n, k)
        Right sides.
    nearby : one or two Ball (n, n)
        The same matrix in double precision with its rounding: the real part, and the imaginary one if any.

    Raises
    ------
    ZeroDivisionError
        The matrix is singular to these digits.
    """
    if right.nrows() < ROWS_OF_REFINEMENT:
        return matrix.solve(right)
    part = _square_part(nearby)
    if part is None or not part.contraction < 1.0:
        return matrix.solve(right)
    columns = list[list[Any]]()
    for place in range(right.ncols()):
        column = _enclosed_column(matrix, columns_of(right, [place]), part)
        if column is None:
            return matrix.solve(right)
        columns.append(column)
    return type(right)([list(row) for row in zip(*columns, strict=True)])


def _enclosed_column(matrix: Any, right: Any, part: SquarePart) -> list[Any] | None:
    """Return the entries of the solution for one right side; ``None`` where double precision is left."""
    count, is_real = right.nrows(), isinstance(right, flint.arb_mat)
    solution, smallest = type(right)(count, 1), np.inf
    for _ in range(MOST_CORRECTIONS):
        step = part.step(_doubles(right - matrix * solution, is_real=is_real))
        size = float(np.max(np.abs(step)))
        if not np.isfinite(size):
            return None
        if not size < CORRECTED_SHARE * smallest:
            break
        smallest = size
        moved = [entry + one for entry, one in zip(solution.entries(), _numbers(step, is_real=is_real), strict=True)]
        solution = type(right)(count, 1, [entry.mid() for entry in moved])
    distance = part.bounded_step(_sizes(right - matrix * solution, is_real=is_real))
    return _widened(solution.entries(), distance, is_real=is_real) if np.all(np.isfinite(distance)) else None


def _square_part(nearby: Sequence[Ball]) -> SquarePart | None:
    """Return the equations in double precision, a complex number as two real ones."""
    whole = nearby[0]
    if len(nearby) > 1:
        real, imaginary = nearby
        whole = Ball.blocks([[real, -imaginary], [imaginary, real]])
    count = len(whole.midpoint)
    return SquarePart.of(whole.midpoint, whole.radius, np.ones(count), np.zeros(count, dtype=np.int64))


def _doubles(column: Any, *, is_real: bool) -> FloatArray:
    """Return the midpoints of a column of balls, real parts above imaginary ones."""
    if is_real:
        return np.array([float(entry.mid()) for entry in column.entries()])
    numbers = np.array([complex(entry.mid()) for entry in column.entries()])
    return np.concatenate([numbers.real, numbers.imag])


def _numbers(doubles: FloatArray, *, is_real: bool) -> list[Any]:
    """Return balls of radius zero: the inverse of `_doubles`."""
    if is_real:
        return [flint.arb(value) for value in doubles.tolist()]
    real, imaginary = np.split(doubles, 2)
    return [flint.acb(*pair) for pair in zip(real.tolist(), imaginary.tolist(), strict=True)]


def _sizes(column: Any, *, is_real: bool) -> FloatArray:
    """Return upper bounds of the sizes in a column of balls, real parts above imaginary ones."""
    entries = column.entries()
    parts = entries if is_real else [entry.real for entry in entries] + [entry.imag for entry in entries]
    return np.asarray(rounded_up(np.array([float(part.abs_upper()) for part in parts]), 2))


def _widened(entries: list[Any], distance: FloatArray, *, is_real: bool) -> list[Any]:
    """Return balls around points that reach as far as ``distance`` says for each real and imaginary part."""
    if is_real:
        return [flint.arb(entry, radius) for entry, radius in zip(entries, distance.tolist(), strict=True)]
    radii = zip(*(part.tolist() for part in np.split(distance, 2)), strict=True)
    return [
        flint.acb(flint.arb(entry.real, first), flint.arb(entry.imag, second))
        for entry, (first, second) in zip(entries, radii, strict=True)
    ]
