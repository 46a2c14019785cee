"""Matrices of rational numbers: blocks, null spaces, and rows and columns in units that make all entries integers."""

from __future__ import annotations

from flint import fmpq, fmpq_mat, fmpz, fmpz_mat


def blocks(parts: list[list[fmpq_mat]]) -> fmpq_mat:
    """Return the block matrix with these rows of blocks."""
    height = sum(row[0].nrows() for row in parts)
    width = sum(part.ncols() for part in parts[0])
    entries: list[fmpq] = []
    for row in parts:
        for i in range(row[0].nrows()):
            for part in row:
                entries += [part[i, j] for j in range(part.ncols())]
    return fmpq_mat(height, width, entries)


def zeros_matrix(rows: int, columns: int) -> fmpq_mat:
    """Return a zero matrix."""
    return fmpq_mat(rows, columns)


def identity(order: int) -> fmpq_mat:
    """Return a unit matrix."""
    return fmpq_mat(order, order, [int(i == j) for i in range(order) for j in range(order)])


def pivot_columns(matrix: fmpq_mat) -> list[int]:
    """Return the columns, from the left, that are no combination of those before them."""
    reduced, rank = matrix.rref()
    return [next(j for j in range(matrix.ncols()) if reduced[i, j] != 0) for i in range(rank)]


def null_basis(matrix: fmpq_mat) -> fmpq_mat:
    """Return a basis ``(n, n - rank)`` of the null space, as columns."""
    reduced, rank = matrix.rref()
    columns = int(matrix.ncols())
    pivots = [next(j for j in range(columns) if reduced[i, j] != 0) for i in range(rank)]
    free = [j for j in range(columns) if j not in set(pivots)]
    basis = fmpq_mat(columns, len(free))
    for k, j in enumerate(free):
        basis[j, k] = fmpq(1)
        for i, pivot in enumerate(pivots):
            basis[pivot, k] = -reduced[i, j]
    return basis


def with_integer_entries(E: fmpq_mat, A: fmpq_mat) -> tuple[fmpz_mat, fmpz_mat]:
    """Return two matrices ``(m, n)`` with common rows and columns multiplied by rationals, so that all are integers."""
    tables: tuple[list[list[fmpq]], list[list[fmpq]]] = (E.tolist(), A.tolist())
    rows, columns = int(A.nrows()), int(A.ncols())
    for i in range(rows):
        factor = _common_factor([value for table in tables for value in table[i]])
        for table in tables:
            table[i] = [value / factor for value in table[i]]
    for j in range(columns):
        factor = _common_factor([table[i][j] for table in tables for i in range(rows)])
        for table in tables:
            for i in range(rows):
                table[i][j] = table[i][j] / factor
    # Columns may have brought denominators back; rows are cleared for good.
    for i in range(rows):
        factor = _common_factor([value for table in tables for value in table[i]])
        for table in tables:
            table[i] = [value / factor for value in table[i]]
    e, a = ([fmpz(value.p) for row in table for value in row] for table in tables)
    return fmpz_mat(rows, columns, e), fmpz_mat(rows, columns, a)


def _common_factor(values: list[fmpq]) -> fmpq:
    """Return the number that divides all of these into coprime integers."""
    there = [value for value in values if value != 0]
    if not there:
        return fmpq(1)
    numerator, denominator = fmpz(0), fmpz(1)
    for value in there:
        numerator = numerator.gcd(value.p)
        denominator = denominator.lcm(value.q)
    return fmpq(numerator, denominator)
