"""Lyapunov's and Riccati's equations by SciPy, with the same bits whichever way the matrices lie in memory.

A product with a matrix that lies in columns adds the same terms in another order: what is found of a design would have
other last digits than what is found of the same one as it was stored.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from obsynth.numerics.arrays import FloatArray


def continuous_lyapunov(a: FloatArray, weight: FloatArray) -> FloatArray:
    """Return X with ``a X + X a' = weight``."""
    from scipy.linalg import solve_continuous_lyapunov

    return _by_rows(solve_continuous_lyapunov, a, weight)


def discrete_lyapunov(a: FloatArray, weight: FloatArray) -> FloatArray:
    """Return X with ``X = a X a' + weight``."""
    from scipy.linalg import solve_discrete_lyapunov

    return _by_rows(solve_discrete_lyapunov, a, weight)


def continuous_riccati(a: FloatArray, b: FloatArray, q: FloatArray, r: FloatArray, **others: Any) -> FloatArray:
    """Return SciPy's solution of ``a' X + X a - X b r^-1 b' X + q = 0``, with its ``e`` and ``s``."""
    from scipy.linalg import solve_continuous_are

    return _by_rows(solve_continuous_are, a, b, q, r, **others)


def discrete_riccati(a: FloatArray, b: FloatArray, q: FloatArray, r: FloatArray, **others: Any) -> FloatArray:
    """Return SciPy's solution of ``a' X a - X - a' X b (r + b' X b)^-1 b' X a + q = 0``, with its ``e`` and ``s``."""
    from scipy.linalg import solve_discrete_are

    return _by_rows(solve_discrete_are, a, b, q, r, **others)


def _by_rows(solve: Callable[..., Any], *matrices: FloatArray, **others: FloatArray | None) -> FloatArray:
    given = {name: None if matrix is None else np.ascontiguousarray(matrix) for name, matrix in others.items()}
    return np.asarray(solve(*map(np.ascontiguousarray, matrices), **given))
