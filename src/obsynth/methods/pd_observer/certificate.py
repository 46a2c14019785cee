"""Certificate of Theorem 1 for given gains, without a solver.

A solution P1, P3 exists for every delta > 0 (elimination lemma): P1 from a Lyapunov equation, and in coordinates in
which the factors around P3 are unit columns, P3 cancels its off-diagonal block.
"""

from __future__ import annotations

import warnings

import numpy as np

from obsynth.numerics.arrays import FloatArray, largest_singular_value
from obsynth.numerics.matrix_equations import continuous_lyapunov, continuous_solution
from obsynth.numerics.scaling import balanced_matrix
from obsynth.numerics.spectra import abscissa
from obsynth.proofs.balls import Ball
from obsynth.verification.inequalities import prove_gain

#: delta is moved by this factor when -1/delta is close to an eigenvalue, where the construction breaks down.
DELTA_STEP = 1.7

#: Condition number of the change of coordinates that is good enough.
GOOD_CONDITION = 1e3

#: As many values of delta are tried.
DELTA_TRIES = 12

#: Slack of the Riccati equation relative to the output weight, largest first: the first that proves is taken.
PD_SLACKS = (1e-1, 1e-2, 1e-3, 1e-4, 1e-5, 1e-6, 1e-7, 1e-8)


def explicit_certificate(
    Az: FloatArray, estimate: FloatArray, *, decay: float
) -> tuple[FloatArray, FloatArray, float] | None:
    """Return P1, P3 ``(n, n)`` and delta for a shipped observer; ``None`` when its errors do not decay so fast."""
    moving = Az + decay * np.eye(len(Az))
    if not abscissa(moving, 0.0) < 0.0:
        return None
    balanced, units = balanced_matrix(moving)
    try:
        p = _gram(balanced)
        # A delta for which -1 / delta is far from the eigenvalues.
        identity = np.eye(len(balanced))
        middle = 1.0 / float(np.exp(np.mean(np.log(np.abs(np.linalg.eigvals(balanced))))))
        steps = sorted(range(-DELTA_TRIES // 2, DELTA_TRIES // 2), key=abs)
        candidates = [middle * DELTA_STEP**step for step in steps]
        conditions = [float(np.linalg.cond(identity + delta * balanced)) for delta in candidates]
        good = [i for i, condition in enumerate(conditions) if condition <= GOOD_CONDITION]
        delta = candidates[good[0] if good else int(np.argmin(conditions))]
        x = _coupling(balanced, p, delta)
        inverse = np.linalg.inv(estimate)
    except np.linalg.LinAlgError:
        return None
    p1 = inverse.T @ (p / units[:, None] / units) @ inverse
    return 0.5 * (p1 + p1.T), (x / units[:, None] / units) @ inverse, delta


def symmetric_certificate(Az: FloatArray) -> tuple[FloatArray, FloatArray, float] | None:
    """Return a certificate of Theorem 2 in closed form for ``Az (n, n)`` and L = 0; ``None`` when errors do not decay.

    It is a symmetric P3 and a weight, both positive definite: ``A' P3 + P3 A = -weight``, and ``P3 + (delta / 2)
    weight`` is P1 for every delta below a limit, infinite where it always serves.
    """
    from scipy.linalg import eigvalsh

    if not abscissa(Az, 0.0) < 0.0:
        return None
    balanced, units = balanced_matrix(Az)
    try:
        p = _gram(balanced)
        through = p @ balanced
        weight, skew = -(through + through.T), 0.5 * (through - through.T)
        largest = float(eigvalsh(skew.T @ np.linalg.solve(p, skew), weight)[-1])
    except np.linalg.LinAlgError:
        return None
    # With P1 = P3 + (delta / 2) weight the lower left block is delta times S, the skew part of P3 A: it holds when
    # weight > (delta / 2) S' P3^-1 S.
    limit = 2.0 / largest if largest > 0.0 else np.inf
    return p / units[:, None] / units, weight / units[:, None] / units, limit


def coupled_certificate(a: FloatArray, delta: float) -> tuple[FloatArray, FloatArray]:
    """Return P1 and P3 ``(n, n)`` of Theorem 1 for a stable observer, L = 0; of no use where ``-1 / delta`` is nearly a
    pole."""
    balanced, units = balanced_matrix(a)
    p = _gram(balanced)
    x = _coupling(balanced, p, delta)
    return p / units[:, None] / units, x / units[:, None] / units


def gain_certificate(a: FloatArray, b: Ball, c: FloatArray, gain: float) -> FloatArray | None:
    """Return P ``(n, n)`` that proves the l2 gain of ``x' = a x + b v``, ``z = c x`` below ``gain``, or ``None``."""
    balanced, units = balanced_matrix(a)
    driving, output_map = b.midpoint / units[:, None], c * units
    weight = max(largest_singular_value(output_map) ** 2, np.finfo(np.float64).tiny)
    in_many_digits = None
    for slack in PD_SLACKS:  # the largest that gives a proof
        out = output_map.T @ output_map + slack * weight * np.eye(len(a))
        p = continuous_solution(balanced.T, driving.T, out, -(gain**2) * np.eye(driving.shape[1]))
        if p is None:
            continue
        witness = 0.5 * (p + p.T) / units[:, None] / units
        witness = np.asarray(0.5 * (witness + witness.T))
        if not np.all(np.isfinite(witness)):
            continue
        proof = prove_gain(a, b, c, witness, gain)
        if proof.in_double_precision:
            return witness
        in_many_digits = witness if proof.proved and in_many_digits is None else in_many_digits
    return in_many_digits


def _gram(a: FloatArray) -> FloatArray:
    """Return P with ``a' P + P a = -norm(a) I`` for a stable ``a (n, n)``."""

    with warnings.catch_warnings(action="ignore"):
        # "An eigenvalue pair whose sum is very close to zero": what comes of it is proved or thrown away.
        p = continuous_lyapunov(a.T, -np.linalg.norm(a) * np.eye(len(a)))
    return np.asarray(0.5 * (p + p.T))


def _coupling(a: FloatArray, p: FloatArray, delta: float) -> FloatArray:
    """Return X with ``He([a'; -I] X [I, delta I]) + [0, p; p, 0] < 0`` for a stable ``a`` with Gram matrix p."""
    # With alpha = a xi1 - xi2, beta = xi1 + delta xi2 the first term is 2 alpha' X beta; the second is negative on
    # alpha = 0 and on beta = 0, whatever delta is.
    n, identity = len(a), np.eye(len(a))
    change = np.linalg.inv(np.block([[a, -identity], [identity, delta * identity]]))
    form = change.T @ np.block([[np.zeros((n, n)), p], [p, np.zeros((n, n))]]) @ change
    return np.asarray(-form[:n, n:])
