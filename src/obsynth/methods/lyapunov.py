"""Finding a Lyapunov factor with which the stability of a matrix in hand can be proved."""

from __future__ import annotations

import warnings
from functools import partial
from itertools import chain, product

import numpy as np

from obsynth.numerics.arrays import FloatArray
from obsynth.numerics.norms import balancing_factors
from obsynth.numerics.spectra import abscissa
from obsynth.verification.lyapunov import prove_stable

#: Shares of the decay that the Lyapunov function is asked to show, largest first: more makes a tighter fit to the slow
#: modes and a larger condition number.
SHARES = (0.9, 0.5, 0.99, 0.0)
#: Times the equation is solved again in the coordinates of its last solution.
ROUNDS = 3


def lyapunov_factor(a: FloatArray, dt: float) -> FloatArray:
    """Return Q ``(n, n)``, upper triangular, with which `prove_stable` succeeds; the last try when none does."""
    n = a.shape[0]
    best, spare = np.eye(n), None
    edge = abscissa(a, dt)
    if n == 0 or not edge < (1.0 if dt > 0.0 else 0.0):
        return best
    ways = (partial(_factor, a, dt, share, rounds, edge) for rounds, share in product(range(1, ROUNDS + 1), SHARES))
    for way in chain(ways, [partial(_modal_factor, a)]):
        found = way()
        if found is None:
            continue
        best = found
        proof = prove_stable(a, best, dt)
        if proof.in_double_precision:
            return best
        spare = best if proof.proved and spare is None else spare
    return best if spare is None else spare


def _factor(a: FloatArray, dt: float, share: float, rounds: int, edge: float) -> FloatArray | None:
    from scipy.linalg import solve_continuous_lyapunov, solve_discrete_lyapunov

    n = a.shape[0]
    change = np.diag(balancing_factors(a))
    for _ in range(rounds):
        moved = np.linalg.solve(change, a @ change)
        try:
            with warnings.catch_warnings(), np.errstate(all="ignore"):
                # What a badly conditioned equation gives is judged by whether it proves anything.
                warnings.simplefilter("ignore")
                if dt > 0.0:
                    p = solve_discrete_lyapunov((moved / max(edge, 1e-300) ** share).T, np.eye(n))
                else:
                    p = solve_continuous_lyapunov((moved - share * edge * np.eye(n)).T, -np.eye(n))
        except (np.linalg.LinAlgError, ValueError):
            return None
        values, vectors = np.linalg.eigh(0.5 * (p + p.T))
        if not np.all(np.isfinite(values)) or values[0] <= 0.0:
            return None
        change = change @ (vectors / np.sqrt(values))
    return _triangular(change)


def _modal_factor(a: FloatArray) -> FloatArray | None:
    """Return the factor whose coordinates are the modes, from no equation: its accuracy does not suffer from P's size.

    Fault models of high order, or with eigenvalues close to each other, have a P beyond double precision otherwise.
    """
    balance = balancing_factors(a)
    values, vectors = np.linalg.eig(a * balance / balance[:, None])
    # A pair has the real and the imaginary part of its eigenvector as coordinates.
    modes = [vectors[:, values.imag >= 0.0].real, vectors[:, values.imag > 0.0].imag]
    return _triangular(balance[:, None] * np.hstack(modes))


def _triangular(change: FloatArray) -> FloatArray | None:
    """Return the triangular factor of the Lyapunov function that is the sum of squares in these coordinates."""
    try:
        factor = np.triu(np.linalg.qr(np.linalg.inv(change), mode="r"))
    except np.linalg.LinAlgError:
        return None
    return np.asarray(factor) if np.all(np.isfinite(factor)) else None
