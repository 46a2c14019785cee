r"""Stability of a shipped matrix, proved with a Lyapunov factor and bounds on every rounding error.

With P = Q'Q, Q triangular and nonsingular, and S close to the inverse of Q (a congruence with any nonsingular S keeps
definiteness):

.. math::
    -S^T (A^T Q^T Q + Q^T Q A) S > 0 \quad (\dot z = A z), \qquad
    \begin{bmatrix} (QS)^T QS & (QAS)^T \\ QAS & I \end{bmatrix} > 0 \quad (z^+ = A z).
"""

from __future__ import annotations

import numpy as np

from obsynth.numerics.arrays import FloatArray
from obsynth.proofs.balls import Enclosed, block
from obsynth.proofs.definiteness import DefinitenessProof, prove_positive_definite, unproved


def prove_stable(a: FloatArray, factor: FloatArray, dt: float) -> DefinitenessProof:
    """Try to prove that every mode of ``a`` dies out.

    Shapes: ``a (n, n)``, ``factor (n, n)``.
    """
    if factor.shape != a.shape or not np.all(np.isfinite(factor)) or not np.all(np.isfinite(a)):
        return unproved("the certificate does not fit, or a number is not finite")
    if a.shape[0] == 0:
        return DefinitenessProof(True, np.inf, 0.0, "Cholesky")
    if np.any(np.tril(factor, -1) != 0.0) or np.any(np.diag(factor) == 0.0):
        return unproved("the certificate is not triangular and nonsingular")
    inverse = np.triu(np.linalg.inv(factor))
    if not np.all(np.isfinite(inverse)) or np.any(np.diag(inverse) == 0.0):
        return unproved("the certificate cannot be inverted")

    def formula(kind: type[Enclosed]) -> Enclosed:
        q, s = kind.exact(factor), kind.exact(inverse)
        whole, moved = q @ s, q @ (kind.exact(a) @ s)
        if dt > 0.0:
            identity = kind.exact(np.eye(a.shape[0]))
            return block([[whole.T @ whole, moved.T], [moved, identity]])
        half = whole.T @ moved
        return -(half + half.T)

    return prove_positive_definite(formula)
