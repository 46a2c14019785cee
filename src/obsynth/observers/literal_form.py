"""The adaptive observer (18) as printed: what it learns from, and where it never learns."""

from __future__ import annotations

import numpy as np

from obsynth.errors import PreconditionError
from obsynth.numerics.arrays import FloatArray
from obsynth.numerics.least_squares_step import LeastSquaresStep, least_squares_step


def posterior_residual(
    found: LeastSquaresStep, H: FloatArray, S: FloatArray, right: FloatArray, ne: int, *, columns: int = 1
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return what (18f) learns from: ``y - C x`` weighted by R, its regressor (18d), and a root of its covariance.

    Parameters
    ----------
    found : LeastSquaresStep
        Of the data and the regressors.
    H, S, right : FloatArray
        What it was found from.
    ne : int
        Number of equations; the outputs follow.
    columns : int, optional
        How many columns of ``right`` are data; the regressors follow.

    Raises
    ------
    PreconditionError
        R is singular, or samples are missing so that H_k is not of full rank.

    References
    ----------
    .. [MoussaAli2013] Eqs. (18b), (18d), (18f).  Its covariance is not R but one of rank ``rank E + ny - nx``.
    """
    gaps = right[ne:] - H[ne:] @ found.estimate
    triangle = np.asarray(np.linalg.qr(S[ne:].T, mode="r")).T
    if not np.all(np.abs(np.diag(triangle)) > 0.0):
        raise PreconditionError("The literal form (18) divides by R, which is singular: use form 'innovation'.",
                                condition="R nonsingular")  # fmt: skip
    gains = least_squares_step(H, S, np.eye(len(H)))
    if gains is None:
        raise PreconditionError(
            "The literal form (18) needs the gains L and K, and H_k is not of full rank where samples are missing: "
            "use form 'innovation'.", condition="rank [E; C]",
        )  # fmt: skip
    spread = S[ne:] - H[ne:] @ gains.estimate @ S
    weighted = np.linalg.solve(triangle, np.hstack((gaps, spread)))
    regressor, end = slice(columns, gaps.shape[1]), gaps.shape[1]
    return weighted[:, :columns], -weighted[:, regressor], weighted[:, end:]
