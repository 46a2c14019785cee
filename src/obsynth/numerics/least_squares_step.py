"""One step of the descriptor Kalman filter in square-root covariance form (generalised least squares after Paige).

From ``Y = H x + S e`` with ``e ~ N(0, I)``: the estimate of x, a square root of its covariance, and the whitened parity
innovation, all from two orthogonal factorisations.  No covariance is ever formed or inverted.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from obsynth.errors import PreconditionError
from obsynth.numerics import lapack
from obsynth.numerics.arrays import FloatArray
from obsynth.numerics.ranks import PERFECT_PARITY, RANK_TOLERANCE

#: Standard deviations above this outgrow double precision soon: their squares overflow at 1e154.
OUTGROWN = 1e100
#: A column of H that keeps less than this of its length beside the others goes to the rank-revealing step: far below
#: what a condition number of 1e12 does, far above rounding.
DEPENDENT_COLUMN = 1e-14
#: The same where samples are missing, so that a rank is likely to be lost: more than rounding leaves of a column.
SUSPECT_COLUMN = RANK_TOLERANCE
#: The same for a row of the parity covariance, relative to the whole noise: the rank-revealing step then decides. It
#: must lie above `PERFECT_PARITY`, or rounding passes for noise.
SUSPECT_PARITY = 1e-12
#: Columns that LAPACK's ``tpqrt`` treats at once.
TPQRT_BLOCK = 32
#: Room for each column that LAPACK's factorisations are given: more than any of their blocks takes.
WORK = 64
#: Noise-free parity directions must vanish to this share of their terms; rounding of data in double precision.
CONSISTENCY = 1e-9


class LeastSquaresStep(NamedTuple):
    """``estimate (n, columns)``, ``P = factor factor'``, the whitened parity ``innovation (m, columns)``, and

    ``diffuse (n, r)``: directions of x about which nothing is known, none unless samples are missing.
    """

    estimate: FloatArray
    factor: FloatArray
    innovation: FloatArray
    diffuse: FloatArray


class Projection(NamedTuple):
    """The QR factorisation of H: ``rotation [Q_2'; Q_1']``, ``head`` R_H, ``lower`` ones on and below the diagonal."""

    rotation: FloatArray
    head: FloatArray
    lower: FloatArray


def projection_of(H: FloatArray, *, least: float = DEPENDENT_COLUMN) -> Projection | None:
    """Return the factorisation of ``H (rows, n)``, or ``None`` where its rank has to be decided."""
    rows, n = H.shape
    if rows < n:
        return None
    packed, tau, _, _ = lapack.dgeqrf(H)
    diagonal = np.abs(packed.diagonal())
    if (diagonal <= least * np.sqrt(np.einsum("ij,ij->j", H, H))).any():
        return None
    transposed = lapack.dormqr("L", "T", packed, tau, np.eye(rows), 64 * rows)[0]
    rotation = np.concatenate((transposed[n:], transposed[:n]))
    return Projection(rotation, np.asfortranarray(packed[:n]), np.tri(n))


def noise_triangle(noise: FloatArray) -> FloatArray:
    """Return the triangular factor ``(rows, rows)`` of rotated noise ``(any, rows)``, for `projected_step`."""
    rows = noise.shape[1]
    padded = np.zeros((max(len(noise), rows), rows), order="F")
    padded[: len(noise)] = noise
    return np.asfortranarray(np.triu(lapack.dgeqrf(padded, overwrite_a=1)[0][:rows]))


def projected_step(
    projection: Projection, noise: FloatArray, data: FloatArray, *, known: FloatArray | None = None
) -> LeastSquaresStep | None:
    """Solve one step from rotated noise ``(s, rows)`` and data; ``None`` where the rank of the noise is to be decided.

    ``known (rows, rows)``: triangular factor of more noise. Noise that outgrows double precision is left to the caller
    too.
    """
    n = len(projection.head)
    rows, columns = data.shape
    m = rows - n
    flat = noise.ravel(order="K")
    squares = flat.dot(flat) + (0.0 if known is None else float(np.vdot(known, known)))
    if not squares < OUTGROWN * OUTGROWN:
        return None
    suspect = SUSPECT_PARITY * math.sqrt(squares)
    if known is None:
        triangle = lapack.dgeqrf(noise, overwrite_a=1)[0]
    else:
        triangle = lapack.dtpqrt(0, min(TPQRT_BLOCK, rows), known, np.asfortranarray(noise), overwrite_b=1)[0]
    right = np.empty((n, columns + n), order="F")
    innovation = data[:m]
    if m:
        diagonal = triangle.diagonal()[:m]
        if min(map(abs, diagonal.tolist())) <= suspect:
            return None
        innovation = lapack.dtrtrs(triangle[:m, :m], innovation, trans=1)[0]
        right[:, :columns] = data[m:] - triangle[:m, m:rows].T.dot(innovation)
        # A reflection goes by the sign of what may be rounding of zero: that of a positive diagonal is the one taken.
        innovation = innovation * np.sign(diagonal)[:, None]
    else:
        right[:, :columns] = data
    np.multiply(triangle[m:rows, m:rows].T, projection.lower, out=right[:, columns:])
    solved = lapack.dtrtrs(projection.head, right, overwrite_b=1)[0]
    return LeastSquaresStep(solved[:, :columns], solved[:, columns:], innovation, np.empty((n, 0)))


def least_squares_step(
    H: FloatArray, S: FloatArray, Y: FloatArray, *, least: float = DEPENDENT_COLUMN
) -> LeastSquaresStep | None:
    """Solve one step by LAPACK alone, or return ``None`` where a rank has to be decided.

    With ``H = [Q_1 Q_2] [R_H; 0]`` and ``[Q_2'; Q_1'] S = [L 0; X T] Z'``: ``v = L^-1 Q_2' Y``, ``x = R_H^-1 (Q_1' Y -
    X v)`` and ``P = R_H^-1 T T' R_H^-T``.
    """
    projection = projection_of(H, least=least)
    if projection is None:
        return None
    return projected_step(projection, (projection.rotation @ S).T, projection.rotation @ Y)


def rank_revealing_step(
    H: FloatArray, S: FloatArray, Y: FloatArray, unknown: FloatArray, *, mapped: int = 0
) -> LeastSquaresStep:
    """Solve one step in which x may be undetermined, noise missing, and earlier directions ``unknown (rows, r)``."""
    n = H.shape[1]
    whole = np.hstack([H, -unknown])
    lengths = np.sqrt(np.einsum("ij,ij->j", whole, whole))
    lengths[lengths == 0.0] = 1.0
    q, r, order = _pivoted(whole / lengths)
    sizes = np.abs(np.diagonal(r))
    rank = int(np.sum(sizes > RANK_TOLERANCE * max(float(sizes[0]), 0.0))) if sizes.size else 0
    q1, q2, head = q[:, :rank], q[:, rank:], r[:rank, :rank]
    innovation, carried, rest = _whitened(q1, q2, S, Y, mapped)
    noise = _triangle(rest.T)[: min(rest.shape)].T if rest.size else np.zeros((rank, 0))
    solved = _substituted(head, np.hstack([q1.T @ Y - carried, noise])) if rank else np.zeros((0, Y.shape[1]))
    back = np.zeros((whole.shape[1], solved.shape[1]))
    back[order[:rank]] = solved
    null = np.zeros((whole.shape[1], whole.shape[1] - rank))
    if rank and null.shape[1]:
        null[order[:rank]] = -_substituted(head, r[:rank, rank:])
    null[order[rank:]] = np.eye(null.shape[1])
    back = back / lengths[:, None]
    found, factor = back[:n, Y.shape[1] :], np.zeros((n, n))
    compact = _triangle(found.T)[:n].T if found.size else found
    factor[:, : compact.shape[1]] = compact
    return LeastSquaresStep(back[:n, : Y.shape[1]], factor, innovation, _basis(null, lengths[:n]))


def _pivoted(matrix: FloatArray) -> tuple[FloatArray, FloatArray, NDArray[np.intp]]:
    """Return Q ``(rows, rows)``, R and the order of columns of ``matrix (rows, any)``: LAPACK's QR with pivoting."""
    from obsynth.numerics.lapack import dgeqp3, dorgqr

    rows, columns = matrix.shape
    if not matrix.size:
        return np.eye(rows), np.empty_like(matrix), np.arange(columns)
    packed, order, tau, _, _ = dgeqp3(_finite(matrix), lwork=WORK * (columns + 1))
    reflections = min(rows, columns)
    whole = np.empty((rows, rows), order="F")
    whole[:, :reflections] = packed[:, :reflections]
    return dorgqr(whole, tau, lwork=WORK * rows, overwrite_a=1)[0], np.triu(packed), order - 1


def _triangle(matrix: FloatArray) -> FloatArray:
    """Return R of the QR factorisation of a matrix, with as many rows as that has."""
    from obsynth.numerics.lapack import dgeqrf

    return np.triu(dgeqrf(_finite(matrix), lwork=WORK * matrix.shape[1])[0])


def _substituted(triangle: FloatArray, right: FloatArray, *, lower: bool = False) -> FloatArray:
    """Return ``triangle^-1 right`` of a triangle without zeros on its diagonal, upper or ``lower``."""
    from obsynth.numerics.lapack import dtrtrs

    if not right.size:
        return np.zeros(right.shape)
    _finite(right)
    if triangle.flags.f_contiguous:
        return np.asarray(dtrtrs(_finite(triangle), right, lower=lower)[0])
    # LAPACK reads rows as columns: the transposed triangle, transposed.
    return np.asarray(dtrtrs(_finite(triangle).T, right, lower=not lower, trans=1)[0])


def _finite(matrix: FloatArray) -> FloatArray:
    if not np.isfinite(matrix).all():
        raise ValueError("a step of the recursion is not finite")
    return matrix


def _basis(null: FloatArray, lengths: FloatArray) -> FloatArray:
    """Return an orthonormal basis of what the null space leaves open in x, not counting rounding."""
    n = len(lengths)
    if not null.shape[1]:
        return np.zeros((n, 0))
    left, values, _ = np.linalg.svd(np.linalg.qr(null)[0][:n], full_matrices=False)
    return np.asarray(np.linalg.qr(left[:, values > RANK_TOLERANCE] / lengths[:, None])[0])


def _whitened(
    q1: FloatArray, q2: FloatArray, S: FloatArray, Y: FloatArray, mapped: int
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return the whitened parity of Y, what it tells about the rest, and the noise that is left in the rest."""
    parity, data = q2.T @ S, q2.T @ Y
    if not q2.shape[1]:
        return data, np.zeros((q1.shape[1], Y.shape[1])), q1.T @ S
    sizes = np.abs(q2.T) @ np.linalg.norm(S, axis=1)
    sizes[sizes == 0.0] = 1.0
    z, t, order = _pivoted((parity / sizes[:, None]).T)
    rank = int(np.sum(np.abs(np.diagonal(t)) > PERFECT_PARITY))
    scaled = (data / sizes[:, None])[order]
    lower = t[:rank, :rank].T
    innovation = _substituted(lower, scaled[:rank], lower=True) if rank else np.zeros((0, Y.shape[1]))
    # What is left is free of noise: it must vanish, or the constraints contradict each other.
    left = scaled[rank:] - (t[:rank, rank:].T @ innovation if rank else 0.0)
    terms = ((np.abs(q2.T) @ np.abs(Y)) / sizes[:, None])[order][rank:]
    if mapped:
        _require_consistent(
            np.hstack([np.zeros((len(left), 1)), left[:, mapped:]]),
            np.hstack([np.zeros((len(left), 1)), terms[:, mapped:]]),
        )
    else:
        _require_consistent(left, terms)
    rotated = q1.T @ S @ z
    signs = np.sign(np.diagonal(lower))[:, None]
    return signs * innovation, rotated[:, :rank] @ innovation, rotated[:, rank:]


def _require_consistent(left: FloatArray, terms: FloatArray) -> None:
    bad = np.abs(left) > CONSISTENCY * terms
    if np.any(bad[:, :1]):
        raise PreconditionError(
            "Equations or outputs without noise contradict each other: no state fits them. Give the ones that are only "
            "nearly true a variance in Q or R.",
            condition="consistent perfect constraints",
        )
    if np.any(bad):
        raise PreconditionError(
            "Equations or outputs without noise determine the parameters exactly, which a filter cannot weigh against "
            "noisy data. Give them a variance in Q or R.",
            condition="parity covariance nonsingular",
        )
