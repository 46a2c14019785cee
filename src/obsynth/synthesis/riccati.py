"""Riccati equations: a rough observer gain, and certificates of a bounded gain in closed form."""

from __future__ import annotations

import warnings

import numpy as np

from obsynth.numerics.arrays import FloatArray
from obsynth.numerics.norms import spectral_radius

#: Relative sizes of the fictitious process and measurement noise, tried in turn, that make the equation regular.
REGULARISATIONS = (1e-6, 1e-4, 1e-2, 1.0)
#: Doubling stops when a step changes the solution by less than this, relative to it; each step squares the error.
DOUBLING_TOLERANCE = 1e-14
STAGNATION = 1e-9
#: Residual of a Riccati equation that counts as solved, relative to its terms.
EQUATION_TOLERANCE = 1e-8
MOST_DOUBLINGS = 60
#: A starting filter with this spectral radius forgets fast enough.
FAST_ENOUGH = 0.999
#: Eigenvalues of a normalising matrix are kept above this fraction of the largest.
CONDITION_LIMIT = 1e-20


def stabilising_gain(a: FloatArray, c: FloatArray, noise_a: FloatArray, noise_c: FloatArray) -> FloatArray | None:
    """Return R ``(n, m)`` such that ``A - R C`` is Schur stable, by a Kalman filter Riccati equation.

    The first regularisation that forgets fast enough is taken, or the fastest filter of all.

    Parameters
    ----------
    a, c : FloatArray
        ``(n, n)`` and ``(m, n)``.
    noise_a, noise_c : FloatArray
        ``(n, k)`` and ``(m, k)``: how one common input enters both equations (may be singular).

    Returns
    -------
    FloatArray or None
        ``None`` when no regularisation gave a stable result.
    """
    n, m = a.shape[0], c.shape[0]
    if m == 0:
        return np.zeros((n, 0)) if spectral_radius(a) < 1.0 else None
    process, cross, measured = noise_a @ noise_a.T, noise_a @ noise_c.T, noise_c @ noise_c.T
    best, least = None, 1.0
    process_size = max(float(np.linalg.norm(process, 2)), 1e-8 * float(np.linalg.norm(a, 2)) ** 2, 1e-8)
    for epsilon in REGULARISATIONS:
        q = process + epsilon * process_size * np.eye(n)
        size = float(np.linalg.norm(c @ q @ c.T, 2)) + float(np.linalg.norm(measured, 2))
        r = measured + epsilon * size * np.eye(m)
        x = riccati_solution(a, c, q, r, cross)
        if x is None:
            continue
        gain = np.linalg.solve(c @ x @ c.T + r, c @ x @ a.T + cross.T).T
        radius = spectral_radius(a - gain @ c) if np.all(np.isfinite(gain)) else np.inf
        if radius < least:
            best, least = np.asarray(gain), radius
        if least <= FAST_ENOUGH:
            break
    return best


def bounded_real_matrix(
    a: FloatArray, b: FloatArray, c: FloatArray, d: FloatArray, level: float, *, slack: float
) -> FloatArray | None:
    """Return P > 0 with the bounded real inequality strict at ``level``, or ``None``.

    Solves ``P = A'PA + C'C + slack*I + (A'PB + C'D)(level^2 I - D'D - B'PB)^-1 (A'PB + C'D)'`` for its
    stabilising solution; the slack makes the inequality strict.

    Parameters
    ----------
    a, b, c, d : FloatArray
        ``(n, n)``, ``(n, m)``, ``(p, n)``, ``(p, m)``, ``a`` Schur stable.
    level : float
        Above the H-infinity norm.
    slack : float
        Positive.
    """
    n = a.shape[0]
    if n == 0:
        return np.zeros((0, 0))
    weight = c.T @ c + slack * np.eye(n)
    cross, gap = c.T @ d, d.T @ d - level**2 * np.eye(b.shape[1])
    p = riccati_solution(a.T, b.T, weight, gap, cross) if b.shape[1] else _lyapunov_solution(a, weight)
    if p is None:
        return None
    p = 0.5 * (p + p.T)
    return p if np.all(np.isfinite(p)) and float(np.linalg.eigvalsh(p)[0]) > 0.0 else None


def gain_is_below(a: FloatArray, b: FloatArray, c: FloatArray, d: FloatArray, level: float) -> bool:
    """Return whether a Riccati equation says that the H-infinity norm of a stable system is at most ``level``.

    Any symmetric solution with ``W = level^2 I - D'D - B'PB > 0`` factors ``level^2 I - G~G`` as ``M~ W M >= 0``; its
    residual is judged against what it is made of.

    Parameters
    ----------
    a, b, c, d : FloatArray
        ``(n, n)``, ``(n, m)``, ``(p, n)``, ``(p, m)``, ``a`` Schur stable.
    level : float
        Positive.
    """
    process, cross = c.T @ c, c.T @ d
    gap = d.T @ d - level**2 * np.eye(b.shape[1])
    with np.errstate(all="ignore"):
        p = doubled_riccati_solution(a.T, b.T, process, gap, cross)
        if p is None:
            return False
        through = a.T @ p @ b + cross
        left = -(gap + b.T @ p @ b)
        try:
            np.linalg.cholesky(left)
            added = through @ np.linalg.solve(left, through.T)
        except np.linalg.LinAlgError:
            return False
        moved = a.T @ p @ a
        sizes = float(np.linalg.norm(p)) + float(np.linalg.norm(moved)) + float(np.linalg.norm(added))
        return float(np.linalg.norm(p - moved - process - added)) <= EQUATION_TOLERANCE * sizes


def _lyapunov_solution(a: FloatArray, weight: FloatArray) -> FloatArray | None:
    from scipy.linalg import solve_discrete_lyapunov

    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            return np.asarray(solve_discrete_lyapunov(a.T, weight))
    except (np.linalg.LinAlgError, ValueError):
        return None


def riccati_solution(
    a: FloatArray, h: FloatArray, process: FloatArray, weight: FloatArray, cross: FloatArray
) -> FloatArray | None:
    """Return the stabilising solution by doubling, or where that breaks down by SciPy; ``None`` without one.

    Parameters
    ----------
    a, h, process, weight, cross : FloatArray
        As for `doubled_riccati_solution`.
    """
    from scipy.linalg import solve_discrete_are

    try:
        with warnings.catch_warnings():
            # An ill-conditioned equation only makes a worse filter or certificate, which is then not taken.
            warnings.simplefilter("ignore")
            doubled = doubled_riccati_solution(a, h, process, weight, cross)
            return np.asarray(solve_discrete_are(a.T, h.T, process, weight, s=cross)) if doubled is None else doubled
    except (np.linalg.LinAlgError, ValueError):
        return None


def normalising_change(p: FloatArray) -> FloatArray:
    """Return S ``(n, n)`` with ``S' P S`` close to the identity, of bounded condition."""
    values, vectors = np.linalg.eigh(0.5 * (p + p.T))
    floor = CONDITION_LIMIT * max(float(values[-1]), np.finfo(np.float64).tiny)
    return np.asarray(vectors / np.sqrt(np.maximum(values, floor)))


def doubled_riccati_solution(
    a: FloatArray, h: FloatArray, process: FloatArray, weight: FloatArray, cross: FloatArray
) -> FloatArray | None:
    """Return the stabilising solution of a filtering Riccati equation with an indefinite weight, by doubling.

    ``Y = A Y A' - (A Y H' + S) (W + H Y H')^-1 (A Y H' + S)' + Q``; matrix products and solves alone, so that hundreds
    of states take a fraction of a second.

    Parameters
    ----------
    a, h : FloatArray
        ``(n, n)`` and ``(p, n)``.
    process, weight, cross : FloatArray
        Q ``(n, n)``, W ``(p, p)`` nonsingular, S ``(n, p)``.

    Returns
    -------
    FloatArray or None
        Symmetric ``(n, n)``; ``None`` when the doubling breaks down or does not settle.

    Notes
    -----
    Structure-preserving doubling of Chu, Fan, Lin and Wang (2004); it needs no definite weight, but may break down.
    """
    n = a.shape[0]
    inverse = np.linalg.inv(weight)
    power = (a - cross @ inverse @ h).T
    back, solution = h.T @ inverse @ h, process - cross @ inverse @ cross.T
    error = np.inf
    with np.errstate(over="ignore", invalid="ignore"):
        for _ in range(MOST_DOUBLINGS):
            between = np.linalg.inv(np.eye(n) + back @ solution)
            step = power @ between
            change = power.T @ solution @ between @ power
            back = back + step @ back @ power.T
            power = step @ power
            solution = solution + 0.5 * (change + change.T)
            back = 0.5 * (back + back.T)
            size = float(np.linalg.norm(solution))
            if not np.isfinite(size):
                return None
            error, last = float(np.linalg.norm(change)) / max(size, np.finfo(np.float64).tiny), error
            # Rounding leaves changes that shrink no more; small ones are as good as none.
            if error <= DOUBLING_TOLERANCE or last <= error <= STAGNATION:
                return solution
    return None
