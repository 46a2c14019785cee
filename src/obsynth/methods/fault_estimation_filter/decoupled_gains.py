r"""Gains over a region in closed form that decouple the fault estimates from all disturbances.

The errors obey ``e+ = (A_i - R_i C) e + B_i d``, the estimates miss by ``(Cz + V C) e``.  With a basis ``S`` of all
``B_i`` for which ``C S`` has full column rank, ``M = (C S)^+`` and N a basis of what is orthogonal to ``C S``,

.. math::
    R_i = A_i S M + Z_i N^T, \qquad V = -C_z S M

make ``(A_i - R_i C) S = 0`` and ``(Cz + V C) S = 0``: a disturbance leaves the errors after one sample, and no
estimate shows it.  What is left is a problem in Z at the vertices, with the outputs ``N' C``.

Its Lyapunov matrix P proves a gain as small as rounding allows.  With a basis K of what is orthogonal to S, the errors
``K' e`` have the Lyapunov matrix :math:`Q = (K^T P^{-1} K)^{-1}`, and

.. math::
    P_\gamma = c\, K Q K^T + \frac{\gamma^2}{2 b^2} S S^T, \qquad b = \max_i |B_i|

proves the gain :math:`\gamma` for every c that is large enough, since ``S' P A`` has no part along S.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from obsynth.methods.engines.vertex_certificates import ErrorUnits
from obsynth.numerics.arrays import FloatArray
from obsynth.numerics.doubling import symmetric
from obsynth.numerics.injection_problem import null_basis
from obsynth.numerics.ranks import decide_rank
from obsynth.proofs.vertex_inequalities import Witness
from obsynth.verification.error_polytope import ErrorPolytope

#: The factor c is larger by this than the least one, at which the inequality is singular.
ENOUGH = 2.0


class Decoupling(NamedTuple):
    """What of the gains follows from the decoupling, and the errors that are left."""

    R: list[FloatArray]  # ``(n, m)`` at each vertex, but for Z
    V: FloatArray
    N: FloatArray  # ``R + Z N'``
    errors: ErrorPolytope  # of Z, without disturbances


def decoupling_of(errors: ErrorPolytope, *, free_output: bool) -> Decoupling | None:
    """Return gains that decouple every disturbance after one sample; ``None`` where these are none.

    Parameters
    ----------
    errors : ErrorPolytope
        With constant C and D, and disturbances.
    free_output : bool
        Whether V may be chosen.
    """
    C, Cz = errors.C[0], errors.Cz[0]
    if any(part.any() for part in (*errors.D, *errors.Dz)):
        return None
    driven = np.hstack(list(errors.B))
    left, rank = np.linalg.svd(driven)[0], decide_rank(driven).rank
    S = left[:, :rank]
    shown = C @ S
    if not rank or not decide_rank(shown, expected=rank).full or not (free_output or not np.any(Cz @ S)):
        return None
    M, N = np.linalg.pinv(shown), null_basis(shown.T)
    R = [A @ S @ M for A in errors.A]
    rest = ErrorPolytope([A - r @ C for A, r in zip(errors.A, R, strict=True)], N.T @ C, dt=errors.dt)
    return Decoupling(R, -Cz @ S @ M, N, rest)


def witness_of_gain(errors: ErrorPolytope, gains: Sequence[FloatArray], P: FloatArray, level: float) -> Witness | None:
    """Return the P with which gains that decouple all disturbances have a gain below ``level``; ``None`` where the
    given one proves no decay in double precision.

    Parameters
    ----------
    errors : ErrorPolytope
        With constant C, V in Cz, and disturbances.
    gains : sequence of FloatArray
        R ``(n, m)`` at each vertex, with ``(A - R C) S = 0`` and ``Cz S = 0``.
    P : FloatArray
        A common Lyapunov matrix of the ``A - R C``.
    level : float
        The gain, above zero.
    """
    units = ErrorUnits.of(errors)
    moved, s = units.moved(1.0), units.states
    closed = [a - r @ c for a, r, c in zip(moved.A, units.gains_in(gains) or (), moved.C, strict=True)]
    driven = np.hstack(list(moved.B))
    left, rank = np.linalg.svd(driven)[0], decide_rank(driven).rank
    S, K = left[:, :rank], left[:, rank:]
    shown = level**2 / (2.0 * max(float(np.linalg.norm(b, 2)) for b in moved.B) ** 2)
    whole = shown * S @ S.T
    if K.size:
        Q = np.asarray(np.linalg.inv(symmetric(K.T @ np.linalg.inv(P * s * s[:, None]) @ K)))
        try:
            needed = max(_factor(Q, a, z, S, K, shown) for a, z in zip(closed, moved.Cz, strict=True))
        except np.linalg.LinAlgError:
            return None
        whole = whole + max(ENOUGH * needed, shown) * K @ Q @ K.T
    return units.witness_out(Witness([symmetric(whole)]), 1.0)


def _factor(Q: FloatArray, A: FloatArray, Cz: FloatArray, S: FloatArray, K: FloatArray, shown: float) -> float:
    """Return the least c with which the inequality holds at a vertex."""
    kept, back, seen = K.T @ A @ K, S.T @ A @ K, Cz @ K
    root = np.linalg.cholesky(symmetric(Q - kept.T @ Q @ kept))
    rises = 2.0 * shown * back.T @ back + seen.T @ seen
    return float(np.linalg.norm(np.linalg.solve(root, np.linalg.solve(root, rises).T), 2))
