"""Recursive least squares with forgetting on whitened data; what is carried is a triangle, so it stays definite."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from obsynth.numerics.arrays import FloatArray

#: A direction is forgotten only where new data bring at least this share of what forgetting takes away.
WORTH_FORGETTING = 0.1


class ParameterState(NamedTuple):
    """The estimate of constant parameters and two different spreads.

    Fields: theta: ``(nq,)``; triangle: ``(nq, nq)``, upper: ``S = (triangle' triangle)^-1`` sets the gain; it is no
    covariance of theta; spread: ``(nq, nq)``: ``spread spread'`` is the covariance of theta.
    """

    theta: FloatArray
    triangle: FloatArray
    spread: FloatArray


def start_of(theta: FloatArray, factor: FloatArray) -> ParameterState:
    """Return the state before any data.

    Shapes: ``theta (nq,)``, ``factor (nq, nq)``.
    """
    triangle = np.linalg.qr(np.linalg.inv(factor), mode="r") if factor.size else factor
    return ParameterState(theta.copy(), np.asarray(triangle), factor.copy())


def update(
    state: ParameterState,
    v: FloatArray,
    G: FloatArray,
    *,
    forgetting: float,
    regular: FloatArray | None = None,
    directional: bool = False,
    noise: FloatArray | None = None,
) -> tuple[ParameterState, FloatArray]:
    r"""Take in ``v = G theta + noise``; return the new state and the gain.

    .. math::
        M^+ = \lambda M + (1 - \lambda) M_{reg} + G^T G, \quad \Theta = (M^+)^{-1} G^T, \quad
        \theta^+ = \theta + \Theta (v - G \theta), \quad
        P^+ = (I - \Theta G) P (I - \Theta G)^T + \Theta W W^T \Theta^T

    with ``M = S^-1``.  The second term is a guard against wind-up: it bounds S by the inverse of M_reg.

    Shapes: ``v (m,)``, ``G (m, nq)``, ``regular (nq, nq)``, ``noise (m, any)``.
    """
    from scipy.linalg.lapack import dgeqrf, dtrtrs

    q, gap = len(state.theta), v - G @ state.theta
    if q == 1:
        kept = _scalar(state, G, forgetting, regular, directional)
        triangle = np.array([[np.sqrt(kept)]])
        gain = G.T / kept
        theta = state.theta + gain @ gap
    else:
        carried = _directional(state.triangle, G, forgetting) if directional else np.sqrt(forgetting) * state.triangle
        blocks = [carried, G] if regular is None else [carried, np.sqrt(1.0 - forgetting) * regular, G]
        stacked = np.zeros((sum(len(block) for block in blocks), q + 1))
        stacked[:, :q] = np.concatenate(blocks)
        stacked[len(stacked) - len(G) :, q] = gap
        packed = dgeqrf(stacked)[0]
        triangle = np.triu(packed[:q, :q])
        theta = state.theta + dtrtrs(triangle, packed[:q, q])[0]
        gain = dtrtrs(triangle, dtrtrs(triangle, G.T, trans=1)[0])[0] if len(G) else np.zeros((q, 0))
    spread = np.concatenate((state.spread - gain @ (G @ state.spread), gain if noise is None else gain @ noise), axis=1)
    compact = np.triu(dgeqrf(spread.T)[0][:q]).T
    return ParameterState(theta, triangle, compact), np.asarray(gain)


def _scalar(
    state: ParameterState, G: FloatArray, forgetting: float, regular: FloatArray | None, directional: bool
) -> float:
    """Return the new information on a single parameter."""
    information, news = float(state.triangle[0, 0]) ** 2, float(np.vdot(G, G))
    if directional:
        worth = news >= WORTH_FORGETTING * (1.0 - forgetting) * information
        return (forgetting if worth else 1.0) * information + news
    guard = 0.0 if regular is None else (1.0 - forgetting) * float(regular[0, 0]) ** 2
    return forgetting * information + guard + news


def _directional(triangle: FloatArray, G: FloatArray, forgetting: float) -> FloatArray:
    """Return the triangle after forgetting where G excites: ``M - (1 - lambda) G' (G S G')^-1 G``."""
    if not len(G):
        return triangle
    # In coordinates in which the present information is the identity, the directions that G excites are orthogonal.
    relative = np.linalg.solve(triangle.T, G.T)
    left, sizes, _ = np.linalg.svd(relative, full_matrices=False)
    excited = left[:, sizes**2 >= WORTH_FORGETTING * (1.0 - forgetting)]
    return np.asarray(triangle - (1.0 - np.sqrt(forgetting)) * excited @ (excited.T @ triangle))
