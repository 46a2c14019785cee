"""Matrices of rational numbers in python-flint: conversion, selection of parts, ranks and null spaces."""

from __future__ import annotations

from collections.abc import Sequence
from fractions import Fraction
from math import gcd, lcm
from typing import Any, TypeAlias

import numpy as np
from flint import fmpq, fmpq_mat, fmpz, fmpz_mat, nmod_mat

from obsynth.numerics.arrays import FloatArray

#: A prime modulo which a rank is computed first: that is a lower bound, and fast.
PRIME = (1 << 61) - 1

#: Rows of rational numbers.
FractionRows: TypeAlias = Sequence[Sequence[Fraction]]


def blocks(parts: list[list[fmpq_mat]]) -> fmpq_mat:
    """Return a block matrix from rows of blocks, all rational or all enclosures."""
    height = sum(row[0].nrows() for row in parts)
    width = sum(part.ncols() for part in parts[0])
    lines = (line for row in parts for line in zip(*(part.tolist() for part in row), strict=True))
    return type(parts[0][0])(height, width, [value for line in lines for piece in line for value in piece])


def zeros_matrix(rows: int, columns: int) -> fmpq_mat:
    """Return a zero matrix."""
    return fmpq_mat(rows, columns)


def identity(order: int) -> fmpq_mat:
    """Return a unit matrix."""
    return fmpq_mat(order, order, [int(i == j) for i in range(order) for j in range(order)])


def rational_matrix(rows: FractionRows, columns: int) -> fmpq_mat:
    """Return rows of fractions as a matrix ``(m, columns)``."""
    return fmpq_mat(len(rows), columns, [fmpq(value.numerator, value.denominator) for row in rows for value in row])


def fractions_of(matrix: fmpq_mat) -> tuple[tuple[Fraction, ...], ...]:
    """Return the rows of a rational matrix as fractions."""
    return tuple(tuple(Fraction(int(entry.p), int(entry.q)) for entry in row) for row in matrix.tolist())


def nearest_doubles(matrix: fmpq_mat) -> FloatArray:
    """Return a rational matrix in double precision, with every entry rounded once."""
    shape = (matrix.nrows(), matrix.ncols())
    values = [_nearest_double(int(entry.p), int(entry.q)) for entry in matrix.entries()]
    return np.array(values, dtype=np.float64).reshape(shape)


def _nearest_double(numerator: int, denominator: int) -> float:
    """Return the quotient in double precision, infinite where it overflows."""
    try:
        return numerator / denominator
    except OverflowError:
        return float("inf") if numerator > 0 else float("-inf")


def picked_columns(matrix: fmpq_mat, columns: Sequence[int]) -> fmpq_mat:
    """Return the columns with these indexes."""
    rows = int(matrix.nrows())
    return type(matrix)(rows, len(columns), [matrix[i, j] for i in range(rows) for j in columns])


def picked_rows(matrix: fmpq_mat, rows: Sequence[int]) -> fmpq_mat:
    """Return the rows with these indexes."""
    columns = int(matrix.ncols())
    return type(matrix)(len(rows), columns, [matrix[i, j] for i in rows for j in range(columns)])


def rank_of(matrix: fmpq_mat) -> int:
    """Return the rank; a full rank modulo a prime proves a full rank in a fraction of the time."""
    most = min(int(matrix.nrows()), int(matrix.ncols()))
    return most if most and int(nmod_mat(matrix.numer_denom()[0], PRIME).rank()) == most else int(matrix.rank())


def row_basis(matrix: fmpq_mat) -> fmpq_mat:
    """Return a basis of the row space, in reduced echelon form."""
    reduced, rank = matrix.rref()
    return picked_rows(reduced, range(rank))


def pivot_columns(matrix: fmpq_mat) -> list[int]:
    """Return the indexes of the columns that are no combination of columns to their left."""
    return _leading(*matrix.rref())


def null_basis(matrix: fmpq_mat) -> fmpq_mat:
    """Return a basis ``(n, n - rank)`` of the null space, as columns."""
    reduced, rank = matrix.rref()
    columns, pivots = int(matrix.ncols()), _leading(reduced, rank)
    free = [j for j in range(columns) if j not in set(pivots)]
    basis = fmpq_mat(columns, len(free))
    for k, j in enumerate(free):
        basis[j, k] = fmpq(1)
        for i, pivot in enumerate(pivots):
            basis[pivot, k] = -reduced[i, j]
    return basis


def whole_null_basis(matrix: fmpq_mat) -> tuple[Any, fmpz, list[int]]:
    """Return an integer multiple of the basis of `null_basis`, the multiplier, and the free columns.

    Reducing the entries of a large basis to lowest terms would take most of its time.
    """
    reduced, size, rank = matrix.numer_denom()[0].rref()
    columns, pivots, table = int(matrix.ncols()), _leading(reduced, rank), reduced.tolist()
    free = [j for j in range(columns) if j not in set(pivots)]
    basis = fmpz_mat(columns, len(free))
    for k, j in enumerate(free):
        basis[j, k] = size
        for i, pivot in enumerate(pivots):
            basis[pivot, k] = -table[i][j]
    return basis, fmpz(size), free


def left_null_basis(matrix: fmpq_mat) -> fmpq_mat:
    """Return a basis ``(m - rank, m)`` of the left null space, as rows."""
    return null_basis(matrix.transpose()).transpose()


def _leading(reduced: Any, rank: int) -> list[int]:
    """Return the column of the first nonzero entry in each of the first ``rank`` rows of an echelon form."""
    return [next(j for j in range(reduced.ncols()) if reduced[i, j] != 0) for i in range(rank)]


def over_one_denominator(E: fmpq_mat, A: fmpq_mat) -> tuple[fmpz_mat, fmpz_mat]:
    """Return two matrices times the least number that makes all of their entries integers."""
    (e, own), (a, other) = E.numer_denom(), A.numer_denom()
    common = lcm(int(own), int(other))
    return e * (common // int(own)), a * (common // int(other))


def coprime(values: list[int]) -> list[int]:
    """Return integers divided by their greatest common divisor."""
    common = gcd(*values)
    return [value // common for value in values] if common > 1 else values
