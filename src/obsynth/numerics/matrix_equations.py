"""Lyapunov's and Riccati's equations, by SciPy with the same bits whichever way the matrices lie in memory, or by
doubling; a rough observer gain, and bounded gains in closed form.

A product with a matrix that lies in columns adds the same terms in another order: what is found of a design would have
other last digits than what is found of the same one as it was stored.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np
import scipy

from obsynth.numerics.arrays import SMALLEST, FloatArray, largest_singular_value
from obsynth.numerics.doubling import doubled_riccati_solution
from obsynth.numerics.gain_levels import REFUTED, is_clearly_negative, is_positive
from obsynth.numerics.norms import spectral_radius
from obsynth.numerics.scaling import power_of_two_below

#: Process noise is taken to be at least this much, relative to the squared norm of A or one.
LEAST_PROCESS = 1e-8

#: Relative sizes of the fictitious process and measurement noise, tried in turn, that make the equation regular.
REGULARISATIONS = (1e-6, 1e-4, 1e-2, 1.0)

#: A starting filter with this spectral radius is fast enough.
FAST_ENOUGH = 0.999

#: Eigenvalues of a normalising matrix are kept above this fraction of the largest.
CONDITION_LIMIT = 1e-20


def continuous_lyapunov(a: FloatArray, weight: FloatArray) -> FloatArray:
    """Return X with ``a X + X a' = weight``."""
    return _by_rows(scipy.linalg.solve_continuous_lyapunov, a, weight)


def discrete_lyapunov(a: FloatArray, weight: FloatArray, *, method: str | None = None) -> FloatArray:
    """Return X with ``X = a X a' + weight``; ``method`` is SciPy's, which takes the slow one for small matrices."""
    return _by_rows(partial(scipy.linalg.solve_discrete_lyapunov, method=method), a, weight)


def continuous_riccati(a: FloatArray, b: FloatArray, q: FloatArray, r: FloatArray, **others: Any) -> FloatArray:
    """Return SciPy's solution of ``a' X + X a - X b r^-1 b' X + q = 0``, with its ``e`` and ``s``.

    Without columns of b, of which SciPy takes one at least, it is that of the linear equation.
    """
    if b.shape[1] == 0:
        return continuous_lyapunov(a.T, -q)
    return _by_rows(scipy.linalg.solve_continuous_are, a, b, q, r, **others)


def discrete_riccati(a: FloatArray, b: FloatArray, q: FloatArray, r: FloatArray, **others: Any) -> FloatArray:
    """Return SciPy's solution of ``a' X a - X - a' X b (r + b' X b)^-1 b' X a + q = 0``, with its ``e`` and ``s``.

    Without columns of b, of which SciPy takes one at least, it is that of the linear equation.
    """
    if b.shape[1] == 0:
        return discrete_lyapunov(a.T, q)
    return _by_rows(scipy.linalg.solve_discrete_are, a, b, q, r, **others)


def _by_rows(solve: Callable[..., Any], *matrices: FloatArray, **others: FloatArray | None) -> FloatArray:
    options = {name: None if matrix is None else np.ascontiguousarray(matrix) for name, matrix in others.items()}
    # SciPy warns of equations that are nearly singular: a user of obsynth can do nothing about it, and whoever asked
    # for the solution judges it.
    with warnings.catch_warnings(action="ignore"):
        return np.asarray(solve(*map(np.ascontiguousarray, matrices), **options))


def stabilising_gain(a: FloatArray, c: FloatArray, noise_a: FloatArray, noise_c: FloatArray) -> FloatArray | None:
    """Return R ``(n, m)``, ``A - R C`` Schur stable, of the first regularisation fast enough, or the fastest."""
    n, m = a.shape[0], c.shape[0]
    if m == 0:
        return np.zeros((n, 0)) if spectral_radius(a) < 1.0 else None
    process, cross, measured = noise_a @ noise_a.T, noise_a @ noise_c.T, noise_c @ noise_c.T
    best, least = None, 1.0
    process_size = max(largest_singular_value(noise_a) ** 2, LEAST_PROCESS)
    if process_size < LEAST_PROCESS * float(np.linalg.norm(a)) ** 2:  # which is no less than with the largest value
        process_size = max(process_size, LEAST_PROCESS * largest_singular_value(a) ** 2)
    for epsilon in REGULARISATIONS:
        q = process + epsilon * process_size * np.eye(n)
        size = largest_singular_value(c @ q @ c.T) + largest_singular_value(measured)
        r = measured + epsilon * size * np.eye(m)
        # Far outside the circle doubling may settle on what is no solution: its poles tell.
        for solve in (doubled_solution, discrete_solution):
            x = solve(a, c, q, r, cross)
            if x is None:
                continue
            gain = np.linalg.solve(c @ x @ c.T + r, c @ x @ a.T + cross.T).T
            radius = spectral_radius(a - gain @ c) if np.all(np.isfinite(gain)) else np.inf
            if radius < least:
                best, least = np.asarray(gain), radius
            if radius < 1.0:
                break
        if least <= FAST_ENOUGH:
            break
    return best


def bounded_real_matrix(
    a: FloatArray, b: FloatArray, c: FloatArray, d: FloatArray, level: float, *, slack: float
) -> FloatArray | None:
    """Return P > 0 with the bounded real inequality strict at ``level``, or ``None``; ``a (n, n)``, ``d (p, m)``.

    Of ``P = A'PA + C'C + slack*I + (A'PB + C'D)(level^2 I - D'D - B'PB)^-1 (A'PB + C'D)'``, the stabilising solution.
    """
    n = a.shape[0]
    if n == 0:
        return np.zeros((0, 0))
    weight = c.T @ c + slack * np.eye(n)
    cross, gap = c.T @ d, d.T @ d - level**2 * np.eye(b.shape[1])
    exceeded, last = False, np.zeros(n)

    def possible(solution: FloatArray) -> bool:
        """Whether the gain may still be below the level after the steps of a solution."""
        nonlocal exceeded, last
        reserve, sizes = -(gap + b.T @ solution @ b), solution.diagonal().copy()
        if np.isfinite(reserve).all():
            # Over more steps the solution grows: one that does not is behind a level that was exceeded in between.
            shrunk = (sizes < last - REFUTED * last.max(initial=0.0)).any()
            exceeded, last = bool(shrunk) or is_clearly_negative(reserve, b, solution), sizes
        return not exceeded

    if b.shape[1]:
        p = doubled_solution(a.T, b.T, weight, gap, cross, possible=possible)
        p = p if exceeded or p is not None else discrete_solution(a.T, b.T, weight, gap, cross)
    else:
        p = lyapunov_solution(a, weight)
    if p is None:
        return None
    p = 0.5 * (p + p.T)
    return p if np.all(np.isfinite(p)) and is_positive(p) else None


def lyapunov_solution(a: FloatArray, weight: FloatArray) -> FloatArray | None:
    """Return ``P = a' P a + weight``, however badly conditioned; None where there is none."""
    return _attempted(discrete_lyapunov, a.T, weight)


def riccati_solution(
    a: FloatArray, h: FloatArray, process: FloatArray, weight: FloatArray, cross: FloatArray
) -> FloatArray | None:
    """Return the stabilising solution by doubling, or where that breaks down by SciPy; ``None`` without one."""
    solution = doubled_solution(a, h, process, weight, cross)
    return discrete_solution(a, h, process, weight, cross) if solution is None else solution


def doubled_solution(
    a: FloatArray, h: FloatArray, process: FloatArray, weight: FloatArray, cross: FloatArray, **others: Any
) -> FloatArray | None:
    """Return the solution of `doubled_riccati_solution`; ``None`` also where a matrix is singular."""
    return _attempted(doubled_riccati_solution, a, h, process, weight, cross, **others)


def discrete_solution(
    a: FloatArray, h: FloatArray, process: FloatArray, weight: FloatArray, cross: FloatArray | None = None
) -> FloatArray | None:
    """Return the solution of the same equation by SciPy, or ``None``."""
    return _attempted(discrete_riccati, a.T, h.T, process, weight, s=cross)


def continuous_solution(
    a: FloatArray, h: FloatArray, process: FloatArray, weight: FloatArray, cross: FloatArray | None = None
) -> FloatArray | None:
    """Return P with ``a P + P a' - (P h' + cross) weight^-1 (P h' + cross)' + process = 0`` by SciPy, or ``None``."""
    p = _attempted(continuous_riccati, a.T, h.T, process, weight, s=cross)
    if p is None:
        # SciPy takes a weight for singular where only the units of its rows are decades apart.
        units = power_of_two_below(np.sqrt(np.maximum(np.diag(weight), SMALLEST)))
        columns = None if cross is None else cross / units
        p = _attempted(continuous_riccati, a.T, (h / units[:, None]).T, process, weight / np.outer(units, units),
                       s=columns)  # fmt: skip
    # What an ill-conditioned equation gives is judged by its user: by poles, or by whether it proves anything.
    return None if p is None or not np.all(np.isfinite(p)) else p


def _attempted(solve: Callable[..., FloatArray | None], *matrices: FloatArray, **others: Any) -> FloatArray | None:
    """Return a solution, however badly conditioned: that only makes a worse filter or certificate, which is then not
    taken; ``None`` where there is none."""
    try:
        with warnings.catch_warnings(action="ignore"):
            return solve(*matrices, **others)
    except (np.linalg.LinAlgError, ValueError):
        return None


def normalising_change(p: FloatArray) -> FloatArray:
    """Return S ``(n, n)`` with ``S' P S`` close to the identity, of bounded condition."""
    values, vectors = np.linalg.eigh(0.5 * (p + p.T))
    floor = CONDITION_LIMIT * max(float(values[-1]), np.finfo(np.float64).tiny)
    return np.asarray(vectors / np.sqrt(np.maximum(values, floor)))
