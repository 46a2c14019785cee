"""Damped Newton iteration on scaled equations; linear equations with pivots inside CasADi graphs.

CasADi's own ``solve`` of scalar expressions takes no pivots, and was measured to be 75 % wrong, silently.  Up to
`SMALL` unknowns elimination is unrolled into scalar operations, which run fastest; above, a sparse QR is called.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np

from obsynth.numerics import lazy_casadi as ca
from obsynth.numerics.arrays import FloatArray

#: Iterations before we give up: a damped iteration that needs more is not converging.
MOST_ITERATIONS = 25

#: Convergence is quadratic, so that a step below this size is the last one: the error after it is about its square.
LAST_STEP = 1e-8

#: After the last step the scaled residual must be below this: rounding, with room for ill-conditioned equations.
LARGEST_RESIDUAL = 1e-9

#: A step is halved at most so often; 2^-12 of a Newton step that does not help is no progress.
MOST_HALVINGS = 12


#: Unknowns up to which elimination is unrolled.  Above, the pivots make so many scalar operations that the sparse
#: factorisation is faster, and C compilers take ten times as long.
SMALL = 8

#: A pivot below this ends the factorisation, and the function with it; the caller is told and has no result.
SINGULAR = 1e-16


@dataclass(frozen=True, eq=False)
class ScaledMatrix:
    """A square matrix ``diag(rows) J diag(columns)``: columns in given sizes, a largest entry of one in each row."""

    matrix: FloatArray
    rows: FloatArray
    columns: FloatArray

    @classmethod
    def of(cls, jacobian: FloatArray, columns: FloatArray) -> ScaledMatrix:
        """Scale a matrix ``(n, n)`` by columns ``(n,)``."""
        scaled = jacobian * columns
        peaks = np.abs(scaled).max(axis=1)
        rows = 1.0 / np.where(peaks > 0.0, peaks, 1.0)
        return cls(rows[:, None] * scaled, rows, columns)

    def solve(self, right: FloatArray) -> FloatArray:
        """Return ``J^-1 right`` by pivoted elimination."""
        rows, columns = (self.rows, self.columns) if right.ndim == 1 else (self.rows[:, None], self.columns[:, None])
        return np.asarray(columns * np.linalg.solve(self.matrix, rows * right))

    @property
    def condition(self) -> float:
        """Condition number of the scaled matrix; infinite where it is singular."""
        return condition_number(self.matrix)


def condition_number(matrix: FloatArray) -> float:
    """Return the condition number of a matrix ``(n, n)``; infinite where it is singular or not finite."""
    if not np.isfinite(matrix).all():
        return float("inf")
    values = np.linalg.svd(matrix, compute_uv=False)
    return float(values[0] / values[-1]) if values[-1] > 0.0 else float("inf")


@dataclass(frozen=True, eq=False)
class NewtonResult:
    """Where an iteration ended; ``residuals (n,)``: the last ones in units of the unknowns' sizes."""

    x: FloatArray
    converged: bool
    iterations: int
    residuals: FloatArray

    @property
    def residual(self) -> float:
        """Largest scaled residual; infinite where there is no value."""
        return float(np.where(np.isnan(self.residuals), np.inf, np.abs(self.residuals)).max())

    @property
    def worst(self) -> int:
        """Index of the equation with the largest residual."""
        return int(np.argmax(np.where(np.isnan(self.residuals), np.inf, np.abs(self.residuals))))


def newton(
    evaluate: Callable[[FloatArray], tuple[FloatArray, FloatArray]], start: FloatArray, sizes: FloatArray
) -> NewtonResult:
    """Solve ``f(x) = 0`` from a start and sizes of the unknowns ``(n,)``."""
    x = start.copy()
    value, jacobian = evaluate(x)
    residuals = np.full(len(x), np.inf)
    for iteration in range(1, MOST_ITERATIONS + 1):
        if not (np.isfinite(value).all() and np.isfinite(jacobian).all()):
            defined = np.isfinite(value) & np.isfinite(jacobian).all(axis=1)
            return NewtonResult(x, False, iteration - 1, np.where(defined, 0.0, np.inf))
        scaled = ScaledMatrix.of(jacobian, sizes)
        residuals = scaled.rows * value
        try:
            step = scaled.solve(-value)
        except np.linalg.LinAlgError:
            return NewtonResult(x, False, iteration - 1, residuals)
        sizes_now = np.maximum(np.abs(x), sizes)
        if np.abs(step / sizes_now).max() <= LAST_STEP:
            x = x + step
            last = scaled.rows * evaluate(x)[0]
            return NewtonResult(x, bool(np.abs(last).max() <= LARGEST_RESIDUAL), iteration, last)
        found = _damped(evaluate, x, step, scaled.rows, float(np.abs(residuals).max()))
        if found is None:
            return NewtonResult(x, False, iteration, residuals)
        x, value, jacobian = found
    return NewtonResult(x, False, MOST_ITERATIONS, residuals)


def _damped(
    evaluate: Callable[[FloatArray], tuple[FloatArray, FloatArray]],
    x: FloatArray,
    step: FloatArray,
    rows: FloatArray,
    before: float,
) -> tuple[FloatArray, FloatArray, FloatArray] | None:
    """Return the first of x + step, x + step / 2, ... at which the scaled residual is smaller, with what is there."""
    for halvings in range(MOST_HALVINGS + 1):
        tried = x + 0.5**halvings * step
        value, jacobian = evaluate(tried)
        if np.isfinite(value).all() and np.abs(rows * value).max() < before:
            return tried, value, jacobian
    return None


def equilibrated(matrix: Any, columns: FloatArray) -> tuple[Any, Any]:
    """Return ``diag(rows) J diag(columns)`` and ``rows``: the scaling of `ScaledMatrix` inside a graph."""
    scaled = ca.densify(matrix) @ ca.diag(ca.DM(columns))
    peaks = largest_entries(scaled)
    rows = 1.0 / ca.if_else(peaks > 0.0, peaks, 1.0)
    return scaled * ca.repmat(rows, 1, matrix.shape[1]), rows


def largest_entries(matrix: Any) -> Any:
    """Return the largest absolute value of each row ``(rows,)``, which is not NaN where others are not."""
    sizes = ca.fabs(matrix)
    found = sizes[:, 0]
    for j in range(1, matrix.shape[1]):
        found = ca.fmax(found, sizes[:, j])
    return found


def solved(matrix: Any, right: Any) -> Any:
    """Return ``A^-1 B`` with row pivots; not finite where A is singular."""
    return _solution(matrix, right, pivots=True)


def definite_solved(matrix: Any, right: Any) -> Any:
    """Return ``A^-1 B`` for a positive definite A, scaled to a unit diagonal first."""
    scale = 1.0 / ca.sqrt(ca.diag(matrix))
    unit = matrix * (scale @ scale.T)
    return ca.repmat(scale, 1, right.shape[1]) * _solution(unit, ca.repmat(scale, 1, right.shape[1]) * right)


def _solution(matrix: Any, right: Any, *, pivots: bool = False) -> Any:
    n, m = right.shape
    if not n or not m:
        return ca.MX(n, m)
    if n > SMALL:
        return ca.solve(ca.densify(matrix), ca.densify(right), "qr", {"eps": SINGULAR})
    A, B = ca.SX.sym("A", n, n), ca.SX.sym("B", n, m)
    whole = ca.horzcat(A, B)
    function = ca.Function("solve", [A, B], [_eliminated([whole[i, :] for i in range(n)], pivots=pivots)])
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
    found: list[Any] = [None] * n
    for j in reversed(range(n)):
        rest = rows[j][n:]
        for i in range(j + 1, n):
            rest = rest - rows[j][i] * found[i]
        found[j] = rest / rows[j][j]
    return ca.vertcat(*found)
