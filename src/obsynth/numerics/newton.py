"""Damped Newton iteration on scaled equations."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from obsynth.numerics.arrays import FloatArray

#: Iterations before we give up: a damped iteration that needs more is not converging.
MOST_ITERATIONS = 25

#: Convergence is quadratic, so that a step below this size is the last one: the error after it is about its square.
LAST_STEP = 1e-8

#: After the last step the scaled residual must be below this: rounding, with room for ill-conditioned equations.
LARGEST_RESIDUAL = 1e-9

#: A step is halved at most so often; 2^-12 of a Newton step that does not help is no progress.
MOST_HALVINGS = 12


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
    evaluate: Callable[[FloatArray], tuple[FloatArray, FloatArray, FloatArray]], start: FloatArray, sizes: FloatArray
) -> NewtonResult:
    """Solve ``f(x) = 0`` from a start and sizes of the unknowns ``(n,)``; ``evaluate(x)``: the value, the scales of
    its rows and the Newton step, ``(n,)`` each, and not finite where there are none."""
    x = start.copy()
    value, rows, step = evaluate(x)
    residuals = np.full(len(x), np.inf)
    for iteration in range(1, MOST_ITERATIONS + 1):
        residuals = rows * value
        if not (np.isfinite(value).all() and np.isfinite(step).all()):
            return NewtonResult(x, False, iteration - 1, residuals)
        if np.abs(step / np.maximum(np.abs(x), sizes)).max() <= LAST_STEP:
            x = x + step
            last = rows * evaluate(x)[0]
            return NewtonResult(x, bool(np.abs(last).max() <= LARGEST_RESIDUAL), iteration, last)
        damped = _damped(evaluate, x, step, rows, float(np.abs(residuals).max()))
        if damped is None:
            return NewtonResult(x, False, iteration, residuals)
        x, value, rows, step = damped
    return NewtonResult(x, False, MOST_ITERATIONS, residuals)


def _damped(
    evaluate: Callable[[FloatArray], tuple[FloatArray, FloatArray, FloatArray]],
    x: FloatArray,
    step: FloatArray,
    rows: FloatArray,
    before: float,
) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray] | None:
    """Return the first of x + step, x + step / 2, ... at which the scaled residual is smaller, with what is there."""
    for halvings in range(MOST_HALVINGS + 1):
        tried = x + 0.5**halvings * step
        found = evaluate(tried)
        if np.isfinite(found[0]).all() and np.abs(rows * found[0]).max() < before:
            return tried, *found
    return None
