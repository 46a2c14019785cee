"""The descriptor Kalman filter and the adaptive observer exactly as printed: readable references, not for use.

They invert covariances, so they lose digits, or fail, where `obsynth.numerics.square_root_estimation` does not.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from obsynth.numerics.arrays import FloatArray


class PaperGains(NamedTuple):
    """Gains and covariance of one step.

    Fields: L: ``(nx, ne)``; K: ``(nx, ny)``; P: ``(nx, nx)``: covariance of the estimate at k + 1.
    """

    L: FloatArray
    K: FloatArray
    P: FloatArray


def paper_gains(E: FloatArray, A: FloatArray, C: FloatArray, Q: FloatArray, R: FloatArray, P: FloatArray) -> PaperGains:
    """Return (10) and (11) for ``E_{k+1}, A_k, C_{k+1}, Q_k, R_k, P_k``.

    References
    ----------
    .. [MoussaAli2013] A. Moussa Ali, Q. Zhang, Fault diagnosis for linear time-varying descriptor systems, IFAC ALCOSP
       2013, eqs. (9)-(11); the covariance of V_k as printed below (6).
    """
    ne, ny = A.shape[0], C.shape[0]
    H = np.vstack([E, C])
    covariance = np.block([[A @ P @ A.T + Q, np.zeros((ne, ny))], [np.zeros((ny, ne)), R]])
    weighted = H.T @ np.linalg.inv(covariance)
    following = np.asarray(np.linalg.inv(weighted @ H), dtype=np.float64)
    gains = following @ weighted
    return PaperGains(gains[:, :ne], gains[:, ne:], following)


class PaperState(NamedTuple):
    """What (18) carries from step to step.

    Fields: x: ``(nx,)``; theta, theta_before: ``(nq,)``: the estimates at k and at k - 1; Upsilon: ``(nx, nq)``; S:
    ``(nq, nq)``; P: ``(nx, nx)``.
    """

    x: FloatArray
    theta: FloatArray
    theta_before: FloatArray
    Upsilon: FloatArray
    S: FloatArray
    P: FloatArray


def paper_step(
    state: PaperState,
    matrices: dict[str, FloatArray],
    Q: FloatArray,
    R: FloatArray,
    *,
    y: FloatArray,
    u: FloatArray,
    forgetting: float,
) -> PaperState:
    """Return the state of (18) one step later, in the only order in which (22) and (23) hold.

    References
    ----------
    .. [MoussaAli2013] Eqs. (18a)-(18i).
    """
    E, A, B, C = (matrices[name] for name in ("E", "A", "B", "C"))
    Phi, Psi = matrices["Phi"], matrices["Psi"]
    L, K, P = paper_gains(E, A, C, Q, R, state.P)
    omega = L @ A @ state.Upsilon @ (state.theta - state.theta_before)
    drive = L @ Phi - K @ Psi
    x = L @ A @ state.x + K @ y + L @ B @ u + drive @ state.theta + omega
    Upsilon = L @ A @ state.Upsilon + drive
    Omega = C @ Upsilon + Psi
    predicted = C @ x + Psi @ state.theta
    Theta = state.S @ Omega.T @ np.linalg.inv(forgetting * R + Omega @ state.S @ Omega.T)
    theta = state.theta + Theta @ (y - predicted)
    S = (np.eye(len(theta)) - Theta @ Omega) @ state.S / forgetting
    return PaperState(x, theta, state.theta, Upsilon, S, P)
