"""Sylvester's equation with a pencil, ``a T E - T A = F``: by generalised Schur forms, refined for what is left.

It has one solution where no eigenvalue of a is one of the pencil ``A - s E``, whose E may be singular.  Its work grows
with the cube of the orders; as a linear system of all entries of T it would grow with their sixth power.
"""

from __future__ import annotations

import numpy as np
import scipy.linalg

from obsynth.numerics.arrays import FloatArray

#: The equation is solved so many times, each time for what is left.
SOLUTIONS = 3
#: Eigenvalues that are nearer to each other leave solutions larger than this times the right side, of rounding.
LARGEST_SOLUTION = 1e12


def pencil_sylvester(a: FloatArray, A: FloatArray, E: FloatArray, F: FloatArray) -> FloatArray | None:
    """Return T with ``a T E - T A = F``; ``None`` where eigenvalues of both sides meet, but for rounding.

    Parameters
    ----------
    a : FloatArray
        ``(m, m)``.
    A, E : FloatArray
        ``(n, n)``.
    F : FloatArray
        ``(m, n)``.
    """
    if not F.size:
        return np.zeros(F.shape)
    own, turn = scipy.linalg.schur(a)
    moved, weighed, left, right = scipy.linalg.qz(A, E)
    identity, nothing = np.eye(len(a)), np.zeros(F.shape)
    solution = np.zeros(F.shape)
    for _ in range(SOLUTIONS):
        missed = F - a @ solution @ E + solution @ A
        # Pairs (T E, T): the second equation says that they belong together.
        _, found, scale, _, info = scipy.linalg.lapack.dtgsyl(
            own, moved, turn.T @ missed @ right, identity, weighed, nothing
        )
        if info or not scale > 1.0 / LARGEST_SOLUTION or not np.all(np.isfinite(found)):
            return None
        solution = solution + turn @ (found / scale) @ left.T
    return solution
