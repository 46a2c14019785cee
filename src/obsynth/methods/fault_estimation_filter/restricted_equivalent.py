r"""The matrices T and N with ``T E + N C = I``, which turn a descriptor plant into an explicit one.

Source: Wang, Rodrigues, Theilliol, Shen 2015, eqs. (7), (16)-(17).  Differences: the paper's choice
``S = [I, C']`` gives a singular T in 13 of 276 random systems, and a singular T loses the information in the
algebraic equations; `restricted_equivalent` uses a T that is nonsingular by construction unless S is given.
"""

from __future__ import annotations

import numpy as np

from obsynth.errors import SpecError
from obsynth.numerics.arrays import FloatArray
from obsynth.numerics.ranks import RANK_TOLERANCE, decide_rank


def restricted_equivalent(e: FloatArray, c: FloatArray) -> tuple[FloatArray, FloatArray]:
    r"""Return ``T (nx, nx)``, nonsingular, and ``N (nx, ny)`` with ``T E + N C = I``.

    With :math:`W = E^T E + C^T C`: :math:`T = W^{-1} E^T + K Q U^T`, :math:`N = W^{-1} C^T`, where the columns
    of U span the null space of :math:`E^T`, those of K span :math:`C^T C \ker E`, and Q is the orthogonal polar
    factor of :math:`K^T U`.

    Shapes: ``e (nx, nx)``, ``c (ny, nx)``.
    """
    stacked = np.vstack([e, c])
    # W^-1 [E' C'] is the pseudo-inverse; by QR, and one refinement, it is accurate where forming W is not.
    q, r = np.linalg.qr(stacked)
    solved = np.linalg.solve(r, q.T)
    solved = solved + (np.eye(e.shape[1]) - solved @ stacked) @ solved
    t, n = solved[:, : e.shape[0]], solved[:, e.shape[0] :]
    left, values, right = np.linalg.svd(e)
    rank = int(np.sum(values > RANK_TOLERANCE * values[0])) if values[0] > 0.0 else 0
    if rank == e.shape[0]:
        return t, n
    left_null, null = left[:, rank:], right[rank:].T
    k = np.linalg.qr(c.T @ (c @ null))[0]
    u, _, v = np.linalg.svd(k.T @ left_null)
    return t + k @ (u @ v) @ left_null.T, n


def restricted_equivalent_from(e: FloatArray, c: FloatArray, s: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return T and N by the paper's general solution (16)-(17) with its free matrix S.

    Shapes: ``e (nx, nx)``, ``c (ny, nx)``, ``s (nx, nx + ny)``.
    """
    nx, ny = e.shape[0], c.shape[0]
    if s.shape != (nx, nx + ny):
        raise SpecError(f"S is {s.shape[0]} by {s.shape[1]}, but {nx} by {nx + ny} is needed.", path="S")
    stacked = np.vstack([e, c])
    # Of full column rank: its columns may be scaled, so that states in small units are not taken for zero.
    units = np.exp2(np.round(np.log2(np.linalg.norm(stacked, axis=0))))
    pseudo = np.linalg.pinv(stacked / units) / units[:, None]
    m = pseudo + s @ (np.eye(nx + ny) - stacked @ pseudo)
    t, n = m[:, :nx], m[:, nx:]
    rank = decide_rank(t, expected=nx)
    if not rank.full:
        raise SpecError(
            f"This S makes T singular ({rank.describe()}), which throws away algebraic "
            "equations: choose another S, or leave it out for a T that is nonsingular by construction.",
            path="S",
        )
    return t, n
