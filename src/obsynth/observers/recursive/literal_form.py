"""The adaptive observer (18) as printed: what it learns from, and where it never learns."""

from __future__ import annotations

import numpy as np

from obsynth.errors import PreconditionError
from obsynth.numerics.arrays import FloatArray
from obsynth.numerics.least_squares_step import LeastSquaresStep, least_squares_step, rank_revealing_step


def posterior_residual(
    found: LeastSquaresStep,
    H: FloatArray,
    S: FloatArray,
    right: FloatArray,
    ne: int,
    *,
    unknown: FloatArray,
    columns: int = 1,
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return what (18f) learns from: ``y - C x`` weighted by R, its regressor (18d), and a root of its covariance.

    Shapes: ``unknown (rows, r)``.

    References
    ----------
    .. [MoussaAli2013] Eqs. (18b), (18d), (18f).  Its covariance is not R but one of rank ``rank E + ny - nx``.
    """
    gaps = right[ne:] - H[ne:] @ found.estimate
    triangle = np.asarray(np.linalg.qr(S[ne:].T, mode="r")).T
    if not np.all(np.abs(np.diag(triangle)) > 0.0):
        raise PreconditionError("The literal form (18) divides by R, which is singular: use form 'innovation'.",
                                condition="R nonsingular")  # fmt: skip
    data = np.eye(len(H))
    gains = None if unknown.shape[1] else least_squares_step(H, S, data)
    if gains is None:
        # Undetermined directions lie in the null space of the outputs that are there: y - C xhat is what it is.
        gains = rank_revealing_step(H, S, data, unknown, mapped=len(H))
    spread = S[ne:] - H[ne:] @ gains.estimate @ S
    weighted = np.linalg.solve(triangle, np.hstack((gaps, spread)))
    regressor, end = slice(columns, gaps.shape[1]), gaps.shape[1]
    return weighted[:, :columns], -weighted[:, regressor], weighted[:, end:]
