r"""Proofs that a symmetric matrix, known up to rounding, is positive definite, by a Cholesky factorisation.

S. M. Rump, *Verification of positive definiteness*, BIT 46, 2006 (formally proved by P. Roux in Coq).  With
:math:`\gamma_k = k u / (1 - k u)`, and R the computed factor of :math:`\tilde A` of order n:

1. :math:`r_{ij}` is the rounded quotient (or root) of :math:`\tilde a_{ij} - \sum_{k<i} r_{ki} r_{kj}`: at most i + 1
   roundings a term, in any order.  So :math:`|\tilde a_{ij} - \sum_{k \le i} r_{ki} r_{kj}| \le \gamma_{n+1}
   \sum_{k \le i} |r_{ki}| |r_{kj}| \le \gamma_{n+1} \|r_i\| \|r_j\|` (Cauchy, Schwarz).
2. On the diagonal: :math:`\|r_j\|^2 \le \tilde a_{jj} / (1 - \gamma_{n+1})`.
3. Hence :math:`R^T R = \tilde A + \Delta`, :math:`|\Delta| \le \frac{\gamma_{n+1}}{1 - \gamma_{n+1}} d d^T`,
   :math:`d_j = \sqrt{\tilde a_{jj}}`, of norm :math:`d^T d`:
   :math:`\lambda_{\min}(\tilde A) \ge -\frac{\gamma_{n+1}}{1 - \gamma_{n+1}} \mathrm{tr}\,\tilde A - \eta`, where
   underflow adds at most :math:`4 (n + 1 + \max_i \tilde a_{ii}) 2^{-1074}` an entry, n times that to the norm.

We take 2 (n + 4) for n + 1 (kernels may multiply by a rounded reciprocal) and twice the underflow; arithmetic rounds to
nearest with gradual underflow, and products are sums of products (no Strassen).  With
:math:`\tilde A = \mathrm{fl}(A - c I)`, completion proves

.. math::
    \lambda_{\min}(A) \ge c - \frac{\gamma_k}{1-\gamma_k} \mathrm{tr}\,\tilde A - u \max_i |\tilde a_{ii}| - \eta .

The error of forming A enters as the largest row sum of its radii, a bound on the norm of any symmetric perturbation
within them.  Then follow a congruence that brings the matrix near the identity, and more digits (`extended_balls`).
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from obsynth.numerics import lapack
from obsynth.numerics.arrays import FloatArray
from obsynth.proofs.balls import PANEL_ROWS, UNDERFLOW, UNIT_ROUNDOFF, Ball, gamma, rounded_up
from obsynth.proofs.extended_balls import Enclosed, Formula, prove_by_ball_arithmetic

#: The largest order that is tried: 128 takes 0.1 s where 128 bits decide, 0.5 s where nothing does.
LARGEST_ORDER = 128

#: The first shift that is tried, relative to the error bound: as little as leaves a bound above zero.
LEAST_SHIFT = 1.0 + 2.0**-5

#: Shares of the estimated eigenvalue that are tried as lower bounds, in turn.
EIGENVALUE_SHARES = (0.5, 2.0**-4)

#: Steps of inverse iteration behind that estimate.
INVERSE_ITERATIONS = 4

Means = Literal["Cholesky", "preconditioned Cholesky", "ball arithmetic", "none"]


@dataclass(frozen=True)
class DefinitenessProof:
    """The outcome of an attempt to prove that every symmetric member of a ball is positive definite."""

    proved: bool
    lower_bound: float  # proved, after a congruence; unproved: the computed one less the error bounds, or zero
    error_bound: float  # of rounding in double precision, and forming
    means: Means = "none"
    reason: str = ""  # precision of ball arithmetic, or why there is no proof

    @property
    def in_double_precision(self) -> bool:
        """Whether it is proved without more digits: a certificate to prefer, since everybody can check it."""
        return self.proved and self.means != "ball arithmetic"

    @property
    def text(self) -> str:
        """How it was proved, or why not, for reports."""
        if self.means == "ball arithmetic":
            return f"ball arithmetic with {self.reason} (python-flint), on a unit diagonal"
        if not self.proved:
            return f"not proved: {self.reason}" if self.reason else "not proved"
        change = " after preconditioning" if self.means == "preconditioned Cholesky" else ""
        return f"Cholesky{change} with rounding bound {self.error_bound:.1e}, on a unit diagonal"


def unproved(reason: str) -> DefinitenessProof:
    """Return that nothing is proved, for a reason found before any factorisation."""
    return DefinitenessProof(False, -float("inf"), 0.0, reason=reason)


def prove_positive_definite(matrix: Formula | Ball | FloatArray) -> DefinitenessProof:
    """Try to prove that every symmetric member of ``matrix (n, n)`` is positive definite."""
    formula = _as_formula(matrix)
    ball = formula(Ball)
    if ball.shape[0] == 0:
        return DefinitenessProof(True, float("inf"), 0.0, "Cholesky")
    if not ball.is_finite:
        return unproved("an entry is not finite")
    diagonal = np.diag(ball.midpoint).copy()  # no view, which would keep all of it
    if np.any(diagonal <= 0.0):
        place = int(np.argmin(diagonal))
        return unproved(f"diagonal entry {place + 1} is {diagonal[place]:.3g}: not positive definite")
    exponents = -np.round(np.log2(diagonal) / 2.0).astype(np.int64)
    # Large matrices are let go as soon as nothing follows from them any more.
    ball = ball.congruent(exponents)
    scaled = _symmetric(ball)
    del ball
    if not scaled.is_finite:
        return unproved("an entry beside the diagonal is larger than the diagonal allows: not positive definite")
    first = _by_cholesky(scaled)
    if first.proved:
        return first
    return _by_preconditioning(scaled) or _in_more_digits(formula, exponents, first)


def _as_formula(matrix: Formula | Ball | FloatArray) -> Formula:
    if not isinstance(matrix, (Ball, np.ndarray)):
        return matrix
    ball = Ball.of(matrix)

    def constant_formula(kind: type[Enclosed]) -> Enclosed:
        return kind.of(ball)

    return constant_formula


def _symmetric(ball: Ball) -> Ball:
    """Return a ball with symmetric midpoint and all symmetric members of ``ball``: they lie in its transpose too."""
    middle, radius = np.empty(ball.shape), np.empty(ball.shape)
    starts = range(0, len(middle), PANEL_ROWS)
    with np.errstate(over="ignore", invalid="ignore"):
        for rows, columns in (
            (slice(i, i + PANEL_ROWS), slice(j, j + PANEL_ROWS)) for i in starts for j in starts[i // PANEL_ROWS :]
        ):
            block, mirrored = ball.midpoint[rows, columns], ball.midpoint[columns, rows].T
            middle[rows, columns] = 0.5 * (block + mirrored)
            middle[columns, rows] = middle[rows, columns].T
            # The difference of the midpoints more than covers the rounding of their average.
            size = np.maximum(ball.radius[rows, columns], ball.radius[columns, rows].T) + np.abs(block - mirrored)
            radius[rows, columns] = rounded_up(size, 4)
            radius[columns, rows] = radius[rows, columns].T
    return Ball(middle, radius)


def _by_cholesky(ball: Ball, means: Means = "Cholesky") -> DefinitenessProof:
    size = ball.shape[0]
    forming = float(rounded_up(np.max(np.sum(ball.radius, axis=1)), size + 2))
    states = ball.midpoint.shape[0]
    growth = gamma(2 * (states + 4))
    trace = float(rounded_up(np.sum(np.abs(np.diag(ball.midpoint))), states))
    largest = float(np.max(np.abs(np.diag(ball.midpoint))))
    # The shift only lowers a diagonal that stays positive, so the unshifted trace bounds the shifted one.
    bound = growth * (1.0 + 2.0 * growth) * trace + 2.0 * UNIT_ROUNDOFF * largest
    underflow = 4.0 * states * (2.0 * states + largest) * UNDERFLOW
    error = forming + float(rounded_up(np.asarray(bound + underflow), 8))
    shift = LEAST_SHIFT * error
    factor = _shifted_factor(ball.midpoint, shift)
    if factor is None:
        estimate = float(np.linalg.eigvalsh(ball.midpoint)[0])
        reason = (
            f"the smallest eigenvalue, computed as {estimate:.3g} on a unit diagonal, is not above the rounding and "
            f"forming errors, {error:.3g}"
        )
        return DefinitenessProof(False, min(estimate - error, 0.0), error, reason=reason)
    # That is a proof.  How much there is besides is estimated, and proved by another factorisation.
    smallest = _smallest_eigenvalue(factor)
    for share in EIGENVALUE_SHARES:
        larger = shift + share * smallest
        if larger > shift and _shifted_factor(ball.midpoint, larger) is not None:
            return DefinitenessProof(True, larger - error, error, means)
    return DefinitenessProof(True, shift - error, error, means)


def _smallest_eigenvalue(factor: FloatArray) -> float:
    """Return an estimate of the smallest eigenvalue of ``factor factor'``, from above, by inverse iteration."""
    vector = np.ones(len(factor)) / np.sqrt(len(factor))
    # Signs that alternate where those of the factor do keep the start away from a right angle.
    vector = np.where(factor[-1] > 0.0, -vector, vector)
    size = 0.0
    for _ in range(INVERSE_ITERATIONS):
        vector = lapack.dpotrs(factor, vector, lower=1)[0]
        size = float(np.linalg.norm(vector))
        if not np.isfinite(size) or size == 0.0:
            return 0.0
        vector = vector / size
    return 1.0 / size


def _by_preconditioning(ball: Ball) -> DefinitenessProof | None:
    """Prove ``C' X C`` near I instead, formed with error bounds: for condition numbers up to 1e12; else ``None``.

    C is close to the inverse Cholesky factor, triangular with a nonzero diagonal, hence nonsingular exactly.
    """
    factor = _shifted_factor(ball.midpoint, 0.0)
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
    proof = _by_cholesky(near_identity, "preconditioned Cholesky") if near_identity.is_finite else None
    return proof if proof and proof.proved else None


def _in_more_digits(formula: Formula, exponents: NDArray[np.int64], first: DefinitenessProof) -> DefinitenessProof:
    """Prove by ball arithmetic what double precision left open; or return ``first`` with the reason."""
    if first.lower_bound < -2.0 * first.error_bound:
        return first  # negative beyond all errors
    if len(exponents) > LARGEST_ORDER:
        reason = f"ball arithmetic is tried up to order {LARGEST_ORDER}, this is {len(exponents)}"
        return replace(first, reason=f"{first.reason}; {reason}")
    units = np.diag(np.ldexp(1.0, exponents))

    def scaled(kind: type[Enclosed]) -> Enclosed:
        change = kind.exact(units)
        return change @ formula(kind) @ change

    bound, reason = prove_by_ball_arithmetic(scaled)
    if bound is None:
        return replace(first, reason=f"{first.reason}; {reason}")
    return DefinitenessProof(True, bound, first.error_bound, "ball arithmetic", reason)


def _shifted_factor(matrix: FloatArray, shift: float) -> FloatArray | None:
    """Return the lower triangular factor of a symmetric matrix less ``shift`` times the identity, or ``None``."""
    # Transposed, it is the same matrix in the order that LAPACK reads, and its copy the only one.
    lowered = np.array(matrix, order="C", dtype=np.float64).T
    np.einsum("ii->i", lowered)[:] -= shift
    factor, failed = lapack.dpotrf(lowered, lower=1, clean=1, overwrite_a=1)
    return np.asarray(factor) if not failed and np.isfinite(factor).all() else None
