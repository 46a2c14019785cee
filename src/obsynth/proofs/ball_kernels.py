"""Kernels of matrices in ball arithmetic: by a well-conditioned square part, or in rational numbers."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import flint
import numpy as np
import scipy.linalg

from obsynth.numerics.arrays import SMALLEST, FloatArray
from obsynth.numerics.ranks import RANK_TOLERANCE
from obsynth.proofs.balls import Ball
from obsynth.proofs.complex_balls import columns_of, scaled_columns, zeros
from obsynth.proofs.enclosed_solutions import enclosed_solution

#: Columns of signals that are smaller beside the others, in double precision, are left out.
DEPENDENT_SHARE = 1e-12
#: Dependent equations of last samples with more unknowns than this are not solved in rational numbers.
MOST_UNKNOWNS = 120


def exact_kernel(system: FloatArray) -> Any:
    """Return a basis of the kernel of a matrix whose rows are dependent, in rational numbers; none of a large one."""
    rows, width = system.shape
    if width > MOST_UNKNOWNS:
        return zeros(width, 0)
    entries = []
    for row in system:
        parts = [float(entry).as_integer_ratio() for entry in row]
        scale = max(bottom for _, bottom in parts)
        entries += [top * (scale // bottom) for top, bottom in parts]
    basis, count = flint.fmpz_mat(rows, width, entries).nullspace()
    table = [[flint.acb(flint.arb(entry)) for entry in row[:count]] for row in basis.tolist()]
    kernel = flint.acb_mat(width, count, [entry for row in table for entry in row])
    sizes = [max(abs(row[j]).abs_upper() for row in table) for j in range(count)]
    return scaled_columns(kernel, [1 / flint.acb(size.mid()) for size in sizes])


def independent_columns(matrix: Any) -> list[int]:
    """Return columns that span all of them, in double precision: whatever is left out, the rest is as valid."""
    table = np.array([[complex(entry) for entry in row] for row in matrix.tolist()]).reshape(matrix.nrows(), -1)
    sizes = np.linalg.norm(table, axis=0)
    if not sizes.any():
        return []
    _, upper, order = scipy.linalg.qr(table / np.where(sizes > 0.0, sizes, 1.0), mode="economic", pivoting=True)
    diagonal = np.abs(np.diag(upper))
    return sorted(int(i) for i in order[: len(diagonal)][diagonal > DEPENDENT_SHARE * diagonal[0]])


def pivots_of(matrix: Any) -> tuple[list[int], list[int]]:
    """Return the columns of a well-conditioned square part, and the others; raise for rows that are dependent."""
    sizes = np.max(np.abs(matrix), axis=1, keepdims=True)
    scaled = matrix / np.where(sizes > 0.0, sizes, 1.0)
    _, upper, order = scipy.linalg.qr(scaled, mode="economic", pivoting=True)
    if len(matrix) > matrix.shape[1]:
        raise ZeroDivisionError
    diagonal = np.abs(np.diag(upper))
    if len(diagonal) and not diagonal[-1] > RANK_TOLERANCE * max(diagonal[0], SMALLEST):
        raise ZeroDivisionError
    return [int(i) for i in order[: len(matrix)]], [int(i) for i in order[len(matrix) :]]


def solution_with_free(
    matrix: Any, nearby: Sequence[Ball], pivots: Sequence[int], others: Sequence[int], free: Any
) -> Any:
    """Return the solution of homogeneous equations whose free entries are given, a column.

    ``nearby`` are the pivots' columns in double precision with their rounding: the real part, and the imaginary one if
    there is any.
    """
    right = -(columns_of(matrix, others) * free)
    solved = enclosed_solution(columns_of(matrix, pivots), right, nearby)
    entries = dict(zip([*pivots, *others], [*solved.entries(), *free.entries()], strict=True))
    return type(matrix)(len(entries), 1, [entries[place] for place in range(len(entries))])


def solution_with_one_free(solved: Any, pivots: Sequence[int], others: Sequence[int], which: int) -> Any:
    """Return the solution in which one free entry is 1 and the other free ones are 0."""
    column = zeros(len(pivots) + len(others), 1)
    column[others[which], 0] = 1
    for row, place in enumerate(pivots):
        column[place, 0] = solved[row, which]
    return column
