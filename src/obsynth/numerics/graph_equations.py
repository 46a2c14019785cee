"""Linear equations with pivots inside CasADi graphs.

CasADi's own ``solve`` of scalar expressions takes no pivots, and was measured to be 75 % wrong, silently.  Up to
`SMALL` unknowns elimination is unrolled into scalar operations, which run fastest; above, a sparse QR is called.
"""

from __future__ import annotations

from functools import partial
from typing import Any

from obsynth.numerics import lazy_casadi as ca
from obsynth.numerics.arrays import FloatArray

#: Unknowns up to which elimination is unrolled.  Above, the pivots make so many scalar operations that the sparse
#: factorisation is faster, and C compilers take ten times as long.
SMALL = 8

#: A pivot below this ends the factorisation, and the function with it; the caller learns it and has no result.
SINGULAR = 1e-16


def solved(matrix: Any, right: Any) -> Any:
    """Return ``A^-1 B`` with row pivots; not finite where A is singular."""
    return _solution(matrix, right, pivots=True)


def definite_solved(matrix: Any, right: Any) -> Any:
    """Return ``A^-1 B`` for a positive definite A, scaled to a unit diagonal first."""
    scale = 1.0 / ca.sqrt(ca.diag(matrix))
    unit = matrix * (scale @ scale.T)
    return ca.repmat(scale, 1, right.shape[1]) * _solution(unit, ca.repmat(scale, 1, right.shape[1]) * right)


def equilibrated(matrix: Any, columns: FloatArray) -> tuple[Any, Any]:
    """Return ``diag(rows) J diag(columns)`` and ``rows``: the scaling of `ScaledMatrix` inside a graph."""
    scaled = ca.densify(matrix) @ ca.diag(ca.DM(columns))
    peaks = largest_entries(scaled)
    rows = 1.0 / ca.if_else(peaks > 0.0, peaks, 1.0)
    return scaled * ca.repmat(rows, 1, matrix.shape[1]), rows


def largest_entries(matrix: Any) -> Any:
    """Return the largest absolute value of each row ``(rows,)``, which is not NaN where others are not."""
    sizes = ca.fabs(matrix)
    largest = sizes[:, 0]
    for j in range(1, matrix.shape[1]):
        largest = ca.fmax(largest, sizes[:, j])
    return largest


def _solution(matrix: Any, right: Any, *, pivots: bool = False) -> Any:
    n, m = right.shape
    if not n or not m:
        return ca.MX(n, m)
    if n > SMALL:
        return ca.solve(ca.densify(matrix), ca.densify(right), "qr", {"eps": SINGULAR})
    A, B = ca.SX.sym("A", n, n), ca.SX.sym("B", n, m)
    augmented = ca.horzcat(A, B)
    function = ca.Function("solve", [A, B], [_eliminated([augmented[i, :] for i in range(n)], pivots=pivots)])
    return function(matrix, right)


def _eliminated(rows: list[Any], *, pivots: bool) -> Any:
    """Return the solution from rows of ``[A B]``; exchanging neighbours in turn brings the largest pivot up."""
    n = len(rows)
    for j in range(n):
        if pivots:
            for i in range(j + 1, n):
                larger = ca.fabs(rows[i][j]) > ca.fabs(rows[j][j])
                choose = partial(ca.if_else, larger)
                rows[j], rows[i] = choose(rows[i], rows[j]), choose(rows[j], rows[i])
        for i in range(j + 1, n):
            rows[i] = rows[i] - (rows[i][j] / rows[j][j]) * rows[j]
    solution: list[Any] = [None] * n
    for j in reversed(range(n)):
        right = rows[j][n:]
        for i in range(j + 1, n):
            right = right - rows[j][i] * solution[i]
        solution[j] = right / rows[j][j]
    return ca.vertcat(*solution)
