"""Matrices of complex balls in python-flint: conversion from floating point, selection of parts, and stacking."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import flint
import numpy as np

from obsynth.numerics.arrays import FloatArray


def complex_matrix(matrix: Any) -> Any:
    """Return a matrix of floating-point numbers as complex balls of radius zero."""
    rows, columns = np.shape(matrix)
    return flint.acb_mat(rows, columns, np.ravel(matrix).tolist())


def real_matrix(matrix: FloatArray) -> Any:
    """Return a matrix of floating-point numbers as real balls of radius zero."""
    rows, columns = matrix.shape
    return flint.arb_mat(rows, columns, matrix.ravel().tolist())


def zeros(rows: int, columns: int) -> Any:
    """Return a matrix of zeros."""
    return flint.acb_mat(rows, columns)


def middle(matrix: Any) -> Any:
    """Return the midpoints of the balls."""
    return flint.acb_mat(matrix.nrows(), matrix.ncols(), [entry.mid() for entry in matrix.entries()])


def adjoint(matrix: Any) -> Any:
    """Return the conjugate transpose."""
    return matrix.conjugate().transpose()


def rows_of(matrix: Any, rows: Sequence[int]) -> Any:
    """Return the rows with these indexes."""
    entries, width = matrix.entries(), matrix.ncols()
    return flint.acb_mat(len(rows), width, [entries[i * width + j] for i in rows for j in range(width)])


def columns_of(matrix: Any, columns: Sequence[int]) -> Any:
    """Return the columns with these indexes, of any kind of python-flint matrix."""
    table = matrix.tolist()
    return type(matrix)(len(table), len(columns), [row[j] for row in table for j in columns])


def beside(parts: Sequence[Any]) -> Any:
    """Return matrices with equal numbers of rows side by side."""
    rows = parts[0].nrows()
    tables = [part.tolist() for part in parts]
    entries = [entry for i in range(rows) for table in tables for entry in table[i]]
    return flint.acb_mat(rows, sum(part.ncols() for part in parts), entries)


def stacked(parts: Sequence[Any]) -> Any:
    """Return matrices with equal numbers of columns, one below the other."""
    rows = [row for part in parts for row in part.tolist()]
    return flint.acb_mat(len(rows), parts[0].ncols(), [entry for row in rows for entry in row])


def scaled_columns(matrix: Any, factors: Sequence[Any]) -> Any:
    """Return a matrix with its columns multiplied by these factors."""
    width = matrix.ncols()
    return flint.acb_mat(matrix.nrows(), width, [part * factors[i % width] for i, part in enumerate(matrix.entries())])


def padded_with_zeros(matrix: Any, size: int) -> Any:
    """Return a square matrix extended to ``size`` rows and columns by zeros."""
    count, padded = matrix.nrows(), zeros(size, size)
    for i in range(count):
        for j in range(count):
            padded[i, j] = matrix[i, j]
    return padded
