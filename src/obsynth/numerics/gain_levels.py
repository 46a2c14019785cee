"""Whether the H-infinity norm of a stable system is at most a level, by a Riccati equation in double precision."""

from __future__ import annotations

import math

import numpy as np

from obsynth.numerics import lapack
from obsynth.numerics.arrays import FloatArray, largest_singular_value
from obsynth.numerics.doubling import doubled_riccati_solution
from obsynth.numerics.thin_doubling import FEWEST_STATES

#: Residual of a Riccati equation that counts as solved, relative to its terms.
EQUATION_TOLERANCE = 1e-8

#: Share of the size of its terms by which a sign must be wrong.
REFUTED = 1e-6

#: Norm of the dynamics above which a level is not refuted by doubling.
LARGEST_TRUSTED_NORM = 10.0


def compared_gain(a: FloatArray, b: FloatArray, c: FloatArray, d: FloatArray, level: float) -> bool | None:
    """Return whether the H-infinity norm of a stable system is at most ``level``; ``None`` where that is not decided.

    A symmetric solution with ``W = level^2 I - D'D - B'PB > 0`` factors ``level^2 I - G~G`` as ``M~ W M >= 0``; W > 0
    fails over finitely many steps only if the norm is above the level.  The transposed system has the same norm, and of
    many states with few outputs a solution that takes less time and loses fewer digits.
    """
    if len(a) >= FEWEST_STATES and 0 < len(c) <= b.shape[1]:
        verdict = _is_reached(a.T, c.T, b.T, d.T, level)
        if verdict is not None:
            return verdict
    return _is_reached(a, b, c, d, level)


def _is_reached(a: FloatArray, b: FloatArray, c: FloatArray, d: FloatArray, level: float) -> bool | None:
    process, cross = c.T @ c, c.T @ d
    gap = d.T @ d - level**2 * np.eye(b.shape[1])
    refuted = False

    def possible(p: FloatArray) -> bool:
        nonlocal refuted
        refuted = is_clearly_negative(-(gap + b.T @ p @ b), b, p)
        return not refuted

    with np.errstate(all="ignore"):
        try:
            p = doubled_riccati_solution(a.T, b.T, process, gap, cross, possible=possible)
            if p is None:
                # Far from normal, rounding in the doubling outgrows any margin.
                return False if refuted and largest_singular_value(a) <= LARGEST_TRUSTED_NORM else None
            through = a.T @ p @ b + cross
            weight = -(gap + b.T @ p @ b)
            if not is_positive(weight):
                return None
            added = through @ np.linalg.solve(weight, through.T)
        except np.linalg.LinAlgError:
            return None
        moved = a.T @ p @ a
        sizes = float(np.linalg.norm(p)) + float(np.linalg.norm(moved)) + float(np.linalg.norm(added))
        return True if float(np.linalg.norm(p - moved - process - added)) <= EQUATION_TOLERANCE * sizes else None


def is_clearly_negative(weight: FloatArray, b: FloatArray, p: FloatArray) -> bool:
    """Return whether ``weight``, which holds ``-B'PB``, is below zero by more than what rounding may have done to P."""
    if not np.isfinite(weight).all() or is_positive(weight):
        return False
    margin = REFUTED * float(np.linalg.norm(b)) ** 2 * float(np.linalg.norm(p))
    return bool(np.linalg.eigvalsh(weight)[0] < -margin)


def is_positive(matrix: FloatArray) -> bool:
    """Return whether a Cholesky factorisation of a symmetric matrix runs to its end (computed, not proved)."""
    factor, failed = lapack.dpotrf(matrix, lower=1, clean=0)
    return not failed and math.isfinite(factor.trace())
