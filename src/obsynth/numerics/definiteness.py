r"""Proofs that a symmetric matrix, known up to rounding, is positive definite.

An eigenvalue computed in floating point proves nothing near zero.  A Cholesky factorisation that runs to
completion does (S. M. Rump, *Verification of positive definiteness*, BIT 46, 2006): if it completes for the
floating-point matrix :math:`\tilde A`, the factor satisfies :math:`R^T R = \tilde A + \Delta` with
:math:`|\Delta_{ij}| \le \frac{\gamma_{k}}{1 - \gamma_{k}} \sqrt{\tilde a_{ii} \tilde a_{jj}}`, hence
:math:`\lambda_{\min}(\tilde A) \ge -\frac{\gamma_k}{1-\gamma_k}\,\mathrm{tr}\,\tilde A` up to underflow.
Rump's k is n + 1; we use 2 (n + 4), which also covers kernels that multiply by rounded reciprocals.
So, with :math:`\tilde A = \mathrm{fl}(A - c I)`, completion proves

.. math::
    \lambda_{\min}(A) \ge c - \frac{\gamma_k}{1-\gamma_k} \mathrm{tr}\,\tilde A - u \max_i |\tilde a_{ii}| - \eta .

The error of forming A enters as the largest row sum of its radii, a bound on the spectral norm of any
symmetric perturbation within them.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from obsynth.numerics.arrays import FloatArray
from obsynth.numerics.balls import UNDERFLOW, UNIT_ROUNDOFF, Ball, gamma, rounded_up


@dataclass(frozen=True)
class DefinitenessProof:
    """The outcome of an attempt to prove positive definiteness.

    Parameters
    ----------
    proved : bool
        Whether every symmetric member of the ball is proved positive definite.
    lower_bound : float
        Proved lower bound on the smallest eigenvalue after a congruence: scaling the diagonal near one or, where
        that leaves too little, preconditioning to near the identity.  Without a proof, the computed eigenvalue
        less the error bounds, or zero.
    error_bound : float
        What rounding and forming could have contributed, on the same scale.
    """

    proved: bool
    lower_bound: float
    error_bound: float


def prove_positive_definite(matrix: Ball | FloatArray) -> DefinitenessProof:
    """Try to prove that every symmetric member of ``matrix (n, n)`` is positive definite.

    Parameters
    ----------
    matrix : Ball or FloatArray
        Symmetric up to its radii; a plain array is taken as exact.

    Returns
    -------
    DefinitenessProof
        ``proved`` is never true for a ball with a member that is not positive definite.
    """
    ball = matrix if isinstance(matrix, Ball) else Ball.exact(matrix)
    size = ball.shape[0]
    if size == 0:
        return DefinitenessProof(True, float("inf"), 0.0)
    diagonal = np.diag(ball.midpoint)
    if not _is_finite(ball) or np.any(diagonal <= 0.0):
        return DefinitenessProof(False, -float("inf"), 0.0)
    scaled = _symmetric(ball.congruent(-np.round(np.log2(diagonal) / 2.0).astype(np.int64)))
    if not _is_finite(scaled):
        return DefinitenessProof(False, -float("inf"), 0.0)
    first = _by_cholesky(scaled)
    return first if first.proved else _by_preconditioning(scaled) or first


def _is_finite(ball: Ball) -> bool:
    return bool(np.all(np.isfinite(ball.midpoint)) and np.all(np.isfinite(ball.radius)))


def _symmetric(ball: Ball) -> Ball:
    """Return a ball with symmetric midpoint that holds every symmetric member of ``ball``.

    Such members lie in the ball and in its transpose, so averaging the midpoints loses none; the difference of the
    midpoints more than covers the rounding of the average.
    """
    with np.errstate(over="ignore", invalid="ignore"):
        middle = 0.5 * (ball.midpoint + ball.midpoint.T)
        radius = np.maximum(ball.radius, ball.radius.T) + np.abs(ball.midpoint - ball.midpoint.T)
        return Ball(middle, rounded_up(radius, 4))


def _by_cholesky(ball: Ball) -> DefinitenessProof:
    size = ball.shape[0]
    forming = float(rounded_up(np.max(np.sum(ball.radius, axis=1)), size + 2))
    error = forming + _factorisation_bound(ball.midpoint)
    estimate = float(np.linalg.eigvalsh(ball.midpoint)[0])
    # Half way to the computed eigenvalue leaves a good bound; close to the error bound is the last that can succeed.
    for share in (0.5, 2.0**-6):
        shift = error + share * (estimate - error)
        if shift > error and _cholesky_factor(ball.midpoint - shift * np.eye(size)) is not None:
            return DefinitenessProof(True, shift - error, error)
    return DefinitenessProof(False, min(estimate - error, 0.0), error)


def _by_preconditioning(ball: Ball) -> DefinitenessProof | None:
    """Prove ``C' X C`` instead, with C close to the inverse Cholesky factor; ``None`` when that does not help.

    A congruence with any nonsingular C keeps definiteness, and this one makes the matrix close to the identity, so
    that a condition number up to about 1e12 no longer eats the margin.  C is triangular with a nonzero diagonal,
    hence nonsingular exactly; the product is formed with error bounds.
    """
    factor = _cholesky_factor(ball.midpoint)
    if factor is None:
        return None
    try:
        change = np.triu(np.linalg.inv(factor).T)
    except np.linalg.LinAlgError:
        # Pivoting can make pivots underflow although the diagonal of the factor does not.
        return None
    if not np.all(np.isfinite(change)) or np.any(np.diag(change) == 0.0):
        return None
    exact = Ball.exact(change)
    near_identity = _symmetric(exact.T @ ball @ exact)
    if not _is_finite(near_identity):
        return None
    proof = _by_cholesky(near_identity)
    return proof if proof.proved else None


def _factorisation_bound(symmetric: FloatArray) -> float:
    """Bound on what a completed Cholesky factorisation of ``symmetric`` less a shift leaves open."""
    size = symmetric.shape[0]
    growth = gamma(2 * (size + 4))
    trace = float(rounded_up(np.sum(np.abs(np.diag(symmetric))), size))
    largest = float(np.max(np.abs(np.diag(symmetric))))
    # The shift only lowers a diagonal that stays positive, so the unshifted trace bounds the shifted one.
    bound = growth * (1.0 + 2.0 * growth) * trace + 2.0 * UNIT_ROUNDOFF * largest
    underflow = 4.0 * size * (2.0 * size + largest) * UNDERFLOW
    return float(rounded_up(np.asarray(bound + underflow), 8))


def _cholesky_factor(matrix: FloatArray) -> FloatArray | None:
    try:
        factor = np.linalg.cholesky(matrix)
    except np.linalg.LinAlgError:
        return None
    return np.asarray(factor) if np.all(np.isfinite(factor)) else None
