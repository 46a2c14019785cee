"""Solutions of linear equations, enclosed: in balls of double precision, or in the digits that python-flint is set to.

With R an approximate inverse, ``E = I - R M`` and ``|E| = d < 1`` (largest sum of a row) M is nonsingular, and the
solution of ``M x = b`` is within ``|R r| + d / (1 - d) max |R r|`` of any guess with the residual ``r = b - M x``
(S. M. Rump, Acta Numerica 2010, section 10).
"""

from __future__ import annotations

from typing import Any, cast

import numpy as np

from obsynth.numerics.arrays import FloatArray
from obsynth.numerics.scaling import equilibrating_factors
from obsynth.proofs.balls import Ball, rounded_up
from obsynth.proofs.extended_balls import Enclosed, ExtendedBall

#: The largest sum of a row of ``I - R M`` with which an approximate inverse R is one.
MOST_MISSING = 0.5


def enclosed_solution(matrix: Enclosed, right: Enclosed) -> Enclosed | None:
    """Return a ball ``(n, m)`` of all solutions of ``M x = b`` with M in ``matrix (n, n)`` and b in ``right (n, m)``.

    ``None`` without a proof that every M is nonsingular."""
    if not right.shape[0]:
        return right
    equations: Any = (matrix, right)
    solution: Any = _solved_in_digits(*equations) if isinstance(right, ExtendedBall) else _solved_in_doubles(*equations)
    return cast("Enclosed | None", solution)


def _solved_in_digits(matrix: ExtendedBall, right: ExtendedBall) -> Any:
    try:
        return ExtendedBall(matrix.content.solve(right.content))
    except ZeroDivisionError:
        return None


def _solved_in_doubles(matrix: Ball, right: Ball) -> Ball | None:
    if not np.all(np.isfinite(matrix.midpoint)) or not np.all(np.isfinite(right.midpoint)):
        return None
    # Powers of two change no digit.
    rows, columns = equilibrating_factors(np.abs(matrix.midpoint))
    scaled = Ball(*(rows[:, None] * part * columns for part in (matrix.midpoint, matrix.radius)))
    scaled_right = Ball(rows[:, None] * right.midpoint, rows[:, None] * right.radius)
    try:
        inverse = np.asarray(np.linalg.inv(scaled.midpoint), dtype=np.float64)
    except np.linalg.LinAlgError:
        return None
    guess: FloatArray = inverse @ scaled_right.midpoint
    guess = guess + inverse @ (scaled_right.midpoint - scaled.midpoint @ guess)
    missing = Ball.exact(np.eye(len(inverse))) - Ball.exact(inverse) @ scaled
    share = float(np.max(rounded_up(missing.magnitude.sum(axis=1), len(inverse) + 2)))
    apart = (Ball.exact(inverse) @ (scaled_right - scaled @ Ball.exact(guess))).magnitude
    if not share < MOST_MISSING or not np.all(np.isfinite(apart)):
        return None
    radius = rounded_up(apart + share / (1.0 - share) * np.max(apart, axis=0, keepdims=True), 6)
    return Ball(columns[:, None] * guess, columns[:, None] * radius)
