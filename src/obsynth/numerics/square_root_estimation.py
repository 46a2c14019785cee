"""Estimation in square roots: smoothing, and recursive least squares with forgetting on whitened data.

With ``x = m + F c + D d``, ``c ~ N(0, I)`` and d unknown, the factorisations of a step give the way back ``[c; d]_k =
j_0 + J_1 [c; d]_k+1 + J_2 b + J_3 w``, ``b ~ N(0, I)`` and w unknown, independent of everything later: the smoother of
Rauch, Tung and Striebel without an inverse, so that covariances may be singular.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from obsynth.numerics import lapack
from obsynth.numerics.arrays import FloatArray
from obsynth.numerics.least_squares_step import (
    DEPENDENT_COLUMN,
    SUSPECT_COLUMN,
    SUSPECT_PARITY,
    projection_of,
)
from obsynth.numerics.ranks import PERFECT_PARITY, RANK_TOLERANCE


class Gaussian(NamedTuple):
    """Coordinates as far as they are known: ``mean (c, columns) + factor (c, any) e + diffuse (c, any) w``, w unknown.

    The first column is the mean, the others its derivatives by parameters.
    """

    mean: FloatArray
    factor: FloatArray
    diffuse: FloatArray


class SmootherGain(NamedTuple):
    """The way back: j_0 ``offset (c, columns)``, J_1 ``from_next (c, c_next)``, J_2 and J_3 ``(c, any)``."""

    offset: FloatArray
    from_next: FloatArray
    noise: FloatArray
    unknown: FloatArray


def joint_step(
    H: FloatArray,
    known: FloatArray,
    noise: FloatArray,
    right: FloatArray,
    unknown: FloatArray,
    *,
    complete: bool = True,
) -> tuple[Gaussian, SmootherGain]:
    """Solve ``H x = right + [known noise] e + unknown d``, where known and unknown multiply the coordinates before;
    return x, and the way back.

    Where the step is not complete, as samples are missing, the rank of H may be short.
    """
    S = np.hstack((known, noise))
    if S.shape[1] < len(H):
        S = np.hstack((S, np.zeros((len(H), len(H) - S.shape[1]))))
    least = DEPENDENT_COLUMN if complete else SUSPECT_COLUMN
    found = None if unknown.shape[1] else _regular(H, S, known.shape[1], right, least)
    return _by_rank(H, S, known.shape[1], right, unknown) if found is None else found


def _regular(
    H: FloatArray, S: FloatArray, width: int, right: FloatArray, least: float
) -> tuple[Gaussian, SmootherGain] | None:
    """Solve a step by LAPACK alone, or return ``None`` where a rank has to be decided."""
    from scipy.linalg import solve_triangular

    projection = projection_of(H, least=least)
    if projection is None:
        return None
    n, rows = len(projection.head), len(H)
    m = rows - n
    orthogonal, triangle = np.linalg.qr((projection.rotation @ S).T, mode="complete")
    data = projection.rotation @ right
    if m and np.abs(np.diagonal(triangle)[:m]).min() <= SUSPECT_PARITY * np.linalg.norm(S):
        return None
    white = -solve_triangular(triangle[:m, :m].T, data[:m], lower=True) if m else data[:0]
    carried = data[m:] + triangle[:m, m:rows].T @ white
    solved = solve_triangular(projection.head, np.hstack((carried, triangle[m:rows, m:rows].T)))
    head = orthogonal[:width]
    back = SmootherGain(head[:, :m] @ white, head[:, m:rows], head[:, rows:], np.zeros((width, 0)))
    columns = right.shape[1]
    return Gaussian(solved[:, :columns], solved[:, columns:], np.zeros((n, 0))), back


def _by_rank(
    H: FloatArray, S: FloatArray, width: int, right: FloatArray, unknown: FloatArray
) -> tuple[Gaussian, SmootherGain]:
    """Solve a step in which x may be undetermined, noise may be missing, and earlier directions are unknown."""
    from scipy.linalg import qr, solve_triangular

    n, columns = H.shape[1], right.shape[1]
    whole = np.hstack([H, -unknown])
    lengths = np.linalg.norm(whole, axis=0)
    lengths[lengths == 0.0] = 1.0
    q, r, order = qr(whole / lengths, pivoting=True)
    sizes = np.abs(np.diagonal(r))
    rank = int(np.sum(sizes > RANK_TOLERANCE * max(float(sizes[0]), 0.0))) if sizes.size else 0
    q1, q2, head = q[:, :rank], q[:, rank:], r[:rank, :rank]
    white, turned, count = _whitened(q2, S, right)
    rotated = q1.T @ S @ turned
    solved = np.zeros((whole.shape[1], columns + S.shape[1] - count))
    if rank:
        data = np.hstack((q1.T @ right + rotated[:, :count] @ white, rotated[:, count:]))
        solved[order[:rank]] = solve_triangular(head, data)
    solved = solved / lengths[:, None]
    # The part of the solution that is free: x and the coordinates d, in scaled units.
    free = np.zeros((whole.shape[1], whole.shape[1] - rank))
    if rank and free.shape[1]:
        free[order[:rank]] = -solve_triangular(head, r[:rank, rank:])
    free[order[rank:]] = np.eye(free.shape[1])
    free = np.linalg.qr(free)[0] if free.shape[1] else free
    left, values, right_vectors = np.linalg.svd(free[:n], full_matrices=True)
    kept = int(np.sum(values > RANK_TOLERANCE))
    basis, weights = np.linalg.qr(left[:, :kept] / lengths[:n, None])
    into = right_vectors[:kept].T @ (np.linalg.inv(weights) / values[:kept, None])
    # What acts on x, in as few directions as it needs; the others only act on what came before.
    spread = solved[:n, columns:]
    compact, triangle = np.linalg.qr(spread.T, mode="complete")
    most = min(n, spread.shape[1])
    before, lost = turned[:width, count:], free[n:] / lengths[n:, None]
    upper = np.hstack((before @ compact[:, :most], np.zeros((width, kept))))
    lower = np.hstack((solved[n:, columns:] @ compact[:, :most], lost @ into))
    back = SmootherGain(
        np.vstack((turned[:width, :count] @ white, solved[n:, :columns])),
        np.vstack((upper, lower)),
        np.vstack((before @ compact[:, most:], solved[n:, columns:] @ compact[:, most:])),
        np.vstack((np.zeros((width, free.shape[1] - kept)), lost @ right_vectors[kept:].T)),
    )
    return Gaussian(solved[:n, :columns], triangle[:most].T, basis), back


def _whitened(q2: FloatArray, S: FloatArray, right: FloatArray) -> tuple[FloatArray, FloatArray, int]:
    """Return what the parity says of some directions of e, an orthogonal matrix that has these first, their number."""
    from scipy.linalg import qr, solve_triangular

    if not q2.shape[1]:
        return np.zeros((0, right.shape[1])), np.eye(S.shape[1]), 0
    sizes = np.abs(q2.T) @ np.linalg.norm(S, axis=1)
    sizes[sizes == 0.0] = 1.0
    turned, t, order = qr((q2.T @ S / sizes[:, None]).T, pivoting=True)
    count = int(np.sum(np.abs(np.diagonal(t)) > PERFECT_PARITY))
    data = (q2.T @ right / sizes[:, None])[order][:count]
    white = -solve_triangular(t[:count, :count].T, data, lower=True) if count else data
    return white, turned, count


def stepped_back(later: Gaussian, back: SmootherGain) -> Gaussian:
    """Return what is known of the coordinates before a step from what is known of those after it."""
    mean = back.offset + back.from_next @ later.mean
    factor = np.hstack((back.from_next @ later.factor, back.noise))
    if factor.shape[1] > len(factor):
        factor = np.asarray(np.linalg.qr(factor.T, mode="r")).T
    diffuse = np.hstack((back.from_next @ later.diffuse, back.unknown))
    if diffuse.shape[1]:
        left, values, _ = np.linalg.svd(diffuse, full_matrices=False)
        diffuse = left[:, values > RANK_TOLERANCE * max(float(values[0]), 1.0)]
    return Gaussian(mean, factor, diffuse)


def nothing_later(width: int, unknown: int, columns: int) -> Gaussian:
    """Return what a filter knows of its own coordinates: c ~ N(0, I), and nothing of d."""
    factor, diffuse = np.zeros((width + unknown, width)), np.zeros((width + unknown, unknown))
    factor[:width], diffuse[width:] = np.eye(width), np.eye(unknown)
    return Gaussian(np.zeros((width + unknown, columns)), factor, diffuse)


#: A direction is discounted only where new data bring at least this share of what forgetting takes away.
WORTH_FORGETTING = 0.1


class ParameterState(NamedTuple):
    """``theta (nq,)``, its covariance ``spread spread'``, and ``triangle (nq, nq)``, upper, which sets the gain."""

    theta: FloatArray
    triangle: FloatArray
    spread: FloatArray


def start_of(theta: FloatArray, factor: FloatArray) -> ParameterState:
    """Return the state before any data from ``theta (nq,)`` and a square root ``factor (nq, nq)``."""
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
    """Take in ``v = G theta + noise``; return the new state and the gain.

    ``M+ = lambda M + (1 - lambda) M_reg + G'G``, ``Theta = M+^-1 G'``, ``theta+ = theta + Theta (v - G theta)``, ``P+ =
    (I - Theta G) P (I - Theta G)' + Theta W W' Theta'``; M_reg bounds ``M^-1`` against wind-up.
    """
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
        packed = lapack.dgeqrf(stacked)[0]
        triangle = np.triu(packed[:q, :q])
        theta = state.theta + lapack.dtrtrs(triangle, packed[:q, q])[0]
        gain = lapack.dtrtrs(triangle, lapack.dtrtrs(triangle, G.T, trans=1)[0])[0] if len(G) else np.zeros((q, 0))
    spread = np.concatenate((state.spread - gain @ (G @ state.spread), gain if noise is None else gain @ noise), axis=1)
    compact = np.triu(lapack.dgeqrf(spread.T)[0][:q]).T
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
