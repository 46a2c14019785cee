r"""Gains over a region in closed form that decouple the fault estimates from all disturbances.

The errors obey ``e+ = (A_i - R_i C) e + B_i d``, the estimates miss by ``(Cz + V C) e``.  With a basis ``S`` of all
``B_i`` for which ``C S`` has full column rank, ``M = (C S)^+`` and N a basis of what is orthogonal to ``C S``,

.. math::
    R_i = A_i S M + Z_i N^T, \qquad V = -C_z S M

make ``(A_i - R_i C) S = 0`` and ``(Cz + V C) S = 0``: a disturbance leaves the errors after one sample, and no
estimate shows it.  What is left is a problem in Z at the vertices, with the outputs ``N' C``.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from obsynth.numerics.arrays import FloatArray
from obsynth.numerics.injection_problem import null_basis
from obsynth.numerics.ranks import decide_rank
from obsynth.verification.error_polytope import ErrorPolytope


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
