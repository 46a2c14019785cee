"""The steady state of the descriptor Kalman filter of a time-invariant plant, from its algebraic Riccati equation."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from obsynth.analysis.conditions import require_all
from obsynth.analysis.recursive_conditions import recursive_conditions
from obsynth.analysis.time_varying import as_time_varying
from obsynth.errors import SolverError, SpecError
from obsynth.models.descriptor import DescriptorSystem
from obsynth.models.time_varying import TimeVaryingDescriptorSystem
from obsynth.numerics.arrays import FloatArray, as_matrix, read_only
from obsynth.numerics.covariances import covariance_factor
from obsynth.numerics.paper_filter import paper_gains

#: The solution must satisfy its equation to this share of its size: half the digits.
RICCATI_TOLERANCE = 1e-8


@dataclass(frozen=True, eq=False)
class SteadyState:
    """What the filter converges to.

    Parameters
    ----------
    P : FloatArray
        ``(nx, nx)``: covariance of the estimate.
    P_predicted : FloatArray
        ``(ne, ne)``: ``A P A' + Q``, the unknown of (16).
    L, K : FloatArray
        ``(nx, ne)`` and ``(nx, ny)``: the gains (11).
    rate : float
        Factor per step by which the distance of P to its limit shrinks: the squared spectral radius of L A.
    """

    P: FloatArray
    P_predicted: FloatArray
    L: FloatArray
    K: FloatArray
    rate: float


def steady_state_filter(
    plant: DescriptorSystem | TimeVaryingDescriptorSystem, *, Q: ArrayLike, R: ArrayLike
) -> SteadyState:
    r"""Return the steady state of the descriptor Kalman filter.

    Solves (16) for the inverse of P, which is the generalised equation

    .. math::
        X = E^T Q^{-1} E + C^T R^{-1} C - E^T Q^{-1} A (A^T Q^{-1} A + X)^{-1} A^T Q^{-1} E, \qquad P = X^{-1}

    Parameters
    ----------
    plant : DescriptorSystem or TimeVaryingDescriptorSystem
        Time-invariant, discrete; ``E (ne, nx)``, ``C (ny, nx)``.
    Q, R : array_like
        ``(ne, ne)`` and ``(ny, ny)``, positive definite (A3).

    Returns
    -------
    SteadyState
        Covariances, gains, and the rate of convergence per step (dimensionless).

    Raises
    ------
    SpecError
        The plant changes with k, or Q or R is not positive definite.
    PreconditionError
        ``rank [E; C] < nx``.
    SolverError
        The Riccati equation has no stabilising solution that passes its own residual; the recursion may still converge.

    References
    ----------
    .. [MoussaAli2013] Fault diagnosis for linear time-varying descriptor systems, IFAC ALCOSP 2013, eq. (16).
    """
    from scipy.linalg import solve_discrete_are

    varying = as_time_varying(plant)
    if not varying.is_time_invariant:
        raise SpecError("The plant changes with k: it has no steady state.", path="plant")
    require_all(recursive_conditions(varying, parameters=False))
    q, r = as_matrix(Q, "Q"), as_matrix(R, "R")
    for name, matrix, size in (("Q", q, varying.ne), ("R", r, varying.ny)):
        if matrix.shape != (size, size):
            raise SpecError(f"{name} is {matrix.shape}, but {(size, size)} is needed.", path=name)
        if np.linalg.matrix_rank(covariance_factor(matrix, name)) < size:
            raise SpecError(f"{name} is singular: the Riccati equation needs it definite; run the filter instead.",
                            path=name)  # fmt: skip
    E, A, C = varying.E.at(1), varying.A.at(0), varying.C.at(1)
    weighted = np.linalg.solve(q, np.hstack([E, A]))
    known = E.T @ weighted[:, : varying.nx] + C.T @ np.linalg.solve(r, C)
    cross, square = E.T @ weighted[:, varying.nx :], A.T @ weighted[:, varying.nx :]
    n = varying.nx
    try:
        inverse = solve_discrete_are(
            np.zeros((n, n)), np.eye(n), 0.5 * (known + known.T), 0.5 * (square + square.T), e=np.eye(n), s=cross
        )
        P = np.asarray(np.linalg.inv(inverse), dtype=np.float64)
        gains = paper_gains(E, A, C, q, r, P)
    except np.linalg.LinAlgError as error:
        raise SolverError(f"The Riccati equation (16) was not solved: {error}. Run the filter instead.") from error
    if not np.linalg.norm(gains.P - P) <= RICCATI_TOLERANCE * np.linalg.norm(P):
        raise SolverError("The solution of the Riccati equation (16) fails its own residual. Run the filter instead.")
    rate = float(np.max(np.abs(np.linalg.eigvals(gains.L @ A)))) ** 2
    P = 0.5 * (P + P.T)
    return SteadyState(read_only(P), read_only(A @ P @ A.T + q), read_only(gains.L), read_only(gains.K), rate)
