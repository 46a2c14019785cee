"""Estimation in square roots: a step of the descriptor Kalman filter, smoothing, recursive least squares.

A step is generalised least squares after Paige.  From ``Y = H x + S e`` with ``e ~ N(0, I)``, two orthogonal
factorisations give the estimate of x, a square root of its covariance, and the whitened parity innovation.  No
covariance is formed or inverted.  Recursive least squares with forgetting uses the whitened data.

Smoothing writes the state as ``x = m + F c + D d`` with ``c ~ N(0, I)`` and unknown d.  The factorisations of a step
give the backward relation ``[c; d]_k = j_0 + J_1 [c; d]_k+1 + J_2 b + J_3 w``, where ``b ~ N(0, I)`` and the unknown w
are independent of all later samples.  That is the smoother of Rauch, Tung and Striebel without an inverse, so that
covariances may be singular.
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
from obsynth.numerics.scaling import power_of_two_below

#: Larger standard deviations are left to the caller: their squares overflow at 1e154.
OUTGROWN = 1e100

#: The rank-revealing step decides if a column of H keeps less than this share of its length after projection onto the
#: complement of the others.  That is far below the effect of a condition number of 1e12, and far above rounding.
DEPENDENT_COLUMN = 1e-14

#: The same limit where samples are missing and a loss of rank is likely: more than rounding leaves of a column.
SUSPECT_COLUMN = RANK_TOLERANCE

#: The rank-revealing step also decides if a row of the parity's noise is below this share of the whole noise.  It
#: exceeds `PERFECT_PARITY`, or rounding would count as noise.
SUSPECT_PARITY = 1e-12

#: Below this share noise sources are factorised by decreasing size, since other orders lose as many digits.
FAR_PARITY = 1e-8

#: Ratio of the largest to the smallest row of H up to which a factorisation needs no scaling of rows.
FAR_ROWS = 256.0

#: If the rows are at least this many times the parity, the parity is factorised first, for a sixteenth of the work.
FEW_PARITY = 4

#: Block size of LAPACK's ``tpqrt``.
TPQRT_BLOCK = 32

#: Workspace per column for LAPACK's factorisations: more than any of their blocks needs.
WORK = 64

#: Noise-free parity has to vanish to this share of its terms: the rounding of data in double precision.
CONSISTENCY = 1e-9

#: A noise-free combination of data consists of equations only if no output has more than this share in it.
SENSOR_SHARE = RANK_TOLERANCE

#: A direction is forgotten only if new data bring at least this share of the information that forgetting removes.
WORTH_FORGETTING = 0.1

#: A factorisation with pivoting, see `_largest_first`.
_Factored = tuple[FloatArray, NDArray[np.intp], FloatArray, NDArray[np.intp]]


class LeastSquaresStep(NamedTuple):
    """The result of a step.

    ``estimate (n, columns)`` has the covariance ``factor factor'``; ``innovation (m, columns)`` is the whitened parity.
    ``diffuse (n, r)`` are unknown directions of x, none unless samples are missing.  ``rounding (n, any)`` is a root of
    the covariance of rounding errors in x, without columns unless noise-free outputs are redundant.
    """

    estimate: FloatArray
    factor: FloatArray
    innovation: FloatArray
    diffuse: FloatArray
    rounding: FloatArray = np.zeros((0, 0))


class Rounding(NamedTuple):
    """Rounding errors in the data of a step: ``root (rows, any)`` of their covariance, in arbitrary units."""

    root: FloatArray
    measured: NDArray[np.bool_]  # ``(rows,)``: which rows are outputs
    is_followed: bool  # whether an earlier step needed it

    def of(self, received: NDArray[np.bool_]) -> Rounding:
        """Return the rounding errors of the received rows ``(rows,)``."""
        return self._replace(root=self.root[received], measured=self.measured[received])


class Projection(NamedTuple):
    """The QR factorisation of H: ``rotation [Q_2'; Q_1']``, ``head`` R_H, ``lower`` ones on and below the diagonal."""

    rotation: FloatArray
    head: FloatArray
    lower: FloatArray


def row_sizes(H: FloatArray) -> FloatArray | None:
    """Return the sizes of the rows of ``H (rows, n)`` as powers of two, or ``None`` where they are similar.

    A factorisation adds multiples of rows, so that small rows lose their digits to large ones without scaling.
    """
    lengths = np.sqrt(np.einsum("ij,ij->j", H, H))
    sizes = power_of_two_below(np.max(np.abs(H) / np.where(lengths > 0.0, lengths, 1.0), axis=1, initial=0.0))
    return None if not sizes.size or np.max(sizes) <= FAR_ROWS * np.min(sizes) else sizes


def projection_of(
    H: FloatArray, *, least: float = DEPENDENT_COLUMN, sizes: FloatArray | None = None
) -> Projection | None:
    """Return the QR factorisation of ``H (rows, n)``, or ``None`` where its rank has to be decided.

    With ``sizes (rows,)`` the rows are divided by these; the rotation divides data and noise as well.
    """
    rows, n = H.shape
    if rows < n:
        return None
    if sizes is not None:
        H = H / sizes[:, None]
    packed, tau, _, _ = lapack.dgeqrf(H, lwork=WORK * n)
    diagonal = np.abs(packed.diagonal())
    if (diagonal <= least * np.sqrt(np.einsum("ij,ij->j", H, H))).any():
        return None
    weights = np.eye(rows) if sizes is None else np.diag(1.0 / sizes)
    transposed = lapack.dormqr("L", "T", packed, tau, weights, 64 * rows)[0]
    rotation = np.concatenate((transposed[n:], transposed[:n]))
    return Projection(rotation, np.asfortranarray(packed[:n]), np.tri(n))


def noise_triangle(noise: FloatArray) -> FloatArray:
    """Return the triangular factor ``(rows, rows)`` of rotated noise ``(any, rows)``, for `projected_step`."""
    rows = noise.shape[1]
    padded = np.zeros((max(len(noise), rows), rows), order="F")
    padded[: len(noise)] = noise
    return np.asfortranarray(np.triu(lapack.dgeqrf(padded, lwork=WORK * rows, overwrite_a=1)[0][:rows]))


def _added(known: FloatArray, noise: FloatArray, parity: int, far: float) -> FloatArray:
    """Return the triangular factor ``(rows, rows)`` of a triangle with further rows ``noise (any, rows)``.

    The columns of the parity come first.  If they are few, they are factorised alone, and returned alone if a diagonal
    entry is below ``far``, since the caller then discards the result.
    """
    for count in (parity, len(known)) if 0 < FEW_PARITY * parity <= len(known) else (len(known),):
        rows = np.asfortranarray(noise[:, :count])
        triangle = np.asarray(lapack.dtpqrt(0, min(TPQRT_BLOCK, count), known[:count, :count], rows)[0])
        if _least_diagonal(triangle, parity) <= far:
            break
    return triangle


def _least_diagonal(triangle: FloatArray, count: int) -> float:
    """Return the smallest modulus of the first ``count`` diagonal entries."""
    return min(map(abs, triangle.diagonal()[:count].tolist()), default=math.inf)


def projected_step(
    projection: Projection, noise: FloatArray, data: FloatArray, *, known: FloatArray | None = None
) -> LeastSquaresStep | None:
    """Solve one step from rotated noise ``(s, rows)`` and data.

    ``known (rows, rows)`` is a triangular factor of further noise.  ``None`` where the rank of the noise has to be
    decided, or the noise outgrows double precision.
    """
    n = len(projection.head)
    rows, columns = data.shape
    m = rows - n
    flat = noise.ravel(order="K")
    squares = flat.dot(flat) + (0.0 if known is None else float(np.vdot(known, known)))
    if not squares < OUTGROWN * OUTGROWN:
        return None
    suspect, far = SUSPECT_PARITY * math.sqrt(squares), FAR_PARITY * math.sqrt(squares)
    triangle = lapack.dgeqrf(noise, lwork=WORK * rows)[0] if known is None else _added(known, noise, m, far)
    if _least_diagonal(triangle, m) <= far:
        sources = noise if known is None else np.concatenate((known, noise))
        triangle = lapack.dgeqrf(sources[_largest_rows(sources)], lwork=WORK * rows)[0]
    right = np.empty((n, columns + n), order="F")
    innovation = data[:m]
    if m:
        diagonal = triangle.diagonal()[:m]
        if min(map(abs, diagonal.tolist())) <= suspect:
            return None
        innovation = lapack.dtrtrs(triangle[:m, :m], innovation, trans=1)[0]
        right[:, :columns] = data[m:] - triangle[:m, m:rows].T.dot(innovation)
        # The sign of a reflection may depend on a rounded zero: make it unique by a positive diagonal.
        innovation = innovation * np.sign(diagonal)[:, None]
    else:
        right[:, :columns] = data
    np.multiply(triangle[m:rows, m:rows].T, projection.lower, out=right[:, columns:])
    solved = lapack.dtrtrs(projection.head, right, overwrite_b=1)[0]
    return LeastSquaresStep(solved[:, :columns], solved[:, columns:], innovation, np.empty((n, 0)))


def directions_of(noise: FloatArray) -> int:
    """Return the number of nonzero columns of a square root ``(rows, any)``, an upper bound of its noise directions.

    Each whitened parity uses up one direction.  With fewer directions than rows some states have no variance after the
    step.  A triangle of the size of all rows would give them one by rounding, which the next step would take for noise.
    """
    return int(np.count_nonzero(noise.any(axis=0)))


def least_squares_step(
    H: FloatArray, S: FloatArray, Y: FloatArray, *, least: float = DEPENDENT_COLUMN
) -> LeastSquaresStep | None:
    """Solve one step by LAPACK, or return ``None`` where a rank has to be decided: that of H, of the parity, or of
    noise with fewer directions than rows.

    With ``H = [Q_1 Q_2] [R_H; 0]`` and ``[Q_2'; Q_1'] S = [L 0; X T] Z'``: ``v = L^-1 Q_2' Y``, ``x = R_H^-1 (Q_1' Y -
    X v)`` and ``P = R_H^-1 T T' R_H^-T``.
    """
    projection = projection_of(H, least=least) if directions_of(S) >= len(H) else None
    if projection is None:
        return None
    return projected_step(projection, (projection.rotation @ S).T, projection.rotation @ Y)


def rank_revealing_step(
    H: FloatArray,
    S: FloatArray,
    Y: FloatArray,
    unknown: FloatArray,
    *,
    mapped: int = 0,
    rounding: Rounding | None = None,
    terms: FloatArray | None = None,
) -> LeastSquaresStep:
    """Solve one step with decisions on all ranks: x may be undetermined, and directions ``unknown (rows, r)``.

    The factor has at most as many nonzero columns as the noise has independent directions besides the parity.  Without
    any, x is known exactly, and its covariance is exactly zero.

    In that case some combinations of the data vanish, and multiples of them may be added to x without any effect on the
    stated noise.  With ``rounding`` the multiple with the least rounding error is added; without it, none is, and
    rounding errors propagate with the plant's dynamics.

    ``terms``, of the shape of Y, are the sizes of the terms that Y is a sum of, by default Y itself.  A combination has
    to vanish relative to its terms.
    """
    n, S = H.shape[1], S[:, S.any(axis=0)]
    columns, sizes = Y.shape[1], np.abs(Y) if terms is None else terms
    if rounding is not None:
        Y = np.hstack([Y, rounding.root, np.eye(len(H))])
    has_terms = H.any(axis=1) | S.any(axis=1) | unknown.any(axis=1)
    if not has_terms.all():
        # Remove equations 0 = 0: their rounding errors would count as equations with tiny noise.
        _require_vanishing(Y[~has_terms, mapped:columns], sizes[~has_terms, mapped:], mapped)
        H, S, Y, sizes, unknown = (part[has_terms] for part in (H, S, Y, sizes, unknown))
    S = _independent_noise(S)
    lengths, q1, q2, head, independent, null = _by_columns(H, unknown)
    rank = len(head)
    innovation, carried, noise_left, vanishing = _whitened(q1, q2, S, Y, sizes[:, mapped:], mapped)
    noise = _triangle(noise_left.T)[: min(noise_left.shape)].T if noise_left.size else np.zeros((rank, 0))
    solved = _substituted(head, np.hstack([q1.T @ Y - carried, noise])) if rank else np.zeros((0, Y.shape[1]))
    back = np.zeros((len(lengths), solved.shape[1]))
    back[independent] = solved
    back = back / lengths[:, None]
    factor, diffuse = _square(back[:n, Y.shape[1] :]), _basis(null, lengths[:n])
    estimate, innovation = back[:n, : Y.shape[1]], innovation[:, :columns]
    if rounding is None or directions_of(factor) == n:
        # Rounding errors are negligible where every state has a variance.
        return LeastSquaresStep(estimate[:, :columns], factor, innovation, diffuse, np.zeros((n, 0)))
    chosen, remaining = _least_rounding(estimate, vanishing, columns, rounding)
    return LeastSquaresStep(chosen, factor, innovation, diffuse, remaining)


def _independent_noise(S: FloatArray) -> FloatArray:
    """Return a root of the covariance of ``S (rows, any)`` with independent columns, unless it has full row rank.

    Dependent columns would leave columns of rounding errors after the step, and a later step without other noise would
    take these for noise.  With full row rank this cannot happen, and new columns would only round common parts of large
    ones, such as columns of 1e9 besides sensor noise of 1e-4.
    """
    if not S.size:
        return S
    sizes = np.linalg.norm(S, axis=1, keepdims=True)
    sizes[sizes == 0.0] = 1.0
    packed, order, _ = _largest_first((S / sizes).T)[:3]
    rank = int(np.sum(np.abs(np.diagonal(packed)) > PERFECT_PARITY))
    if rank in S.shape:
        return S
    # Independent rows are chosen in scaled units, but the columns are factorised in given ones, to keep small digits.
    packed, _, tau, first = _largest_first(S[order[:rank]].T)
    return np.ascontiguousarray(_rotated(packed, tau, S.T[first])[:rank].T)


def _square(root: FloatArray) -> FloatArray:
    """Return a root ``(n, n)`` of the same covariance as ``root (n, any)``, with at most as many nonzero columns."""
    n = len(root)
    square = np.zeros((n, n))
    compact = _triangle(root.T)[:n].T if root.size else root
    square[:, : compact.shape[1]] = compact
    return square


def _least_rounding(
    estimate: FloatArray, vanishing: FloatArray, columns: int, rounding: Rounding
) -> tuple[FloatArray, FloatArray]:
    """Return the estimate ``(n, columns)`` with the least rounding error, and a root of the covariance of that error.

    Multiples of the vanishing combinations are added to the estimate.  Further columns of both arguments belong to the
    rounding errors, and to the data one by one.
    """
    end = columns + rounding.root.shape[1]
    entries = np.abs(vanishing[:, end:])
    if np.any(entries[:, rounding.measured] > SENSOR_SHARE * np.max(entries, axis=1, initial=0.0, keepdims=True)):
        weights = -np.linalg.lstsq(vanishing[:, columns:end].T, estimate[:, columns:end].T, rcond=None)[0].T
        estimate = estimate + weights @ vanishing
    elif not rounding.is_followed:
        return estimate[:, :columns], np.zeros((len(estimate), 0))
    return estimate[:, :columns], _square(estimate[:, columns:end])


def _by_columns(
    H: FloatArray, unknown: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray, NDArray[np.intp], FloatArray]:
    """Return the rank-revealing QR factorisation of ``[H -unknown]`` with scaled columns.

    Returns
    -------
    tuple
        The lengths of the columns as powers of two, by which the columns are divided; orthonormal bases of the range of
        the scaled matrix and of its complement; the triangle ``(rank, rank)`` and the columns that it belongs to; and a
        basis of the null space.
    """
    joined = np.hstack([H, -unknown])
    # Division by powers of two is exact.  Other divisors would round each entry, which for states of 1e11 is more than
    # the resolution of their sensors.
    lengths = power_of_two_below(np.sqrt(np.einsum("ij,ij->j", joined, joined)))
    q, r, order = _pivoted(joined / lengths)
    sizes = np.abs(np.diagonal(r))
    rank = int(np.sum(sizes > RANK_TOLERANCE * max(float(sizes[0]), 0.0))) if sizes.size else 0
    head = r[:rank, :rank]
    null = np.zeros((len(lengths), len(lengths) - rank))
    if rank and null.shape[1]:
        null[order[:rank]] = -_substituted(head, r[:rank, rank:])
    null[order[rank:]] = np.eye(null.shape[1])
    return lengths, q[:, :rank], q[:, rank:], head, order[:rank], null


def _parity(q2: FloatArray, S: FloatArray) -> tuple[FloatArray, _Factored, int]:
    """Return the sizes ``(rows, 1)`` of the noise in the parity, the factorisation by `_largest_first` of that noise at
    size one, and the number of its rows with noise."""
    sizes = np.abs(q2.T) @ np.linalg.norm(S, axis=1)
    sizes[sizes == 0.0] = 1.0
    factored = _largest_first((q2.T @ S / sizes[:, None]).T)
    return sizes[:, None], factored, int(np.sum(np.abs(np.diagonal(factored[0])) > PERFECT_PARITY))


def _largest_first(matrix: FloatArray) -> _Factored:
    """Return the QR factorisation of ``matrix (rows, any)`` with its rows ordered by decreasing size and with column
    pivoting: as LAPACK packs it, with the order of columns, the factors of the reflections, and the order of rows.

    With both orders the rounding error of each row is small relative to that row (Cox and Higham 1998).  The rows are
    sources of noise, whose sizes may differ by many decades.
    """
    first = _largest_rows(matrix)
    if not matrix.size:
        return matrix, np.arange(matrix.shape[1]), np.zeros(0), first
    packed, order, tau, _, _ = lapack.dgeqp3(_finite(matrix[first]), lwork=WORK * (matrix.shape[1] + 1))
    return packed, order - 1, tau, first


def _largest_rows(matrix: FloatArray) -> NDArray[np.intp]:
    """Return the order of rows in which the largest are first."""
    return np.argsort(-np.max(np.abs(matrix), axis=1, initial=0.0), kind="stable")


def _rotated(packed: FloatArray, tau: FloatArray, matrix: FloatArray) -> FloatArray:
    """Return ``Q' matrix`` by applying the reflections; a product with Q would lose the digits of small rows."""
    if not (tau.size and matrix.size):
        return matrix
    return np.asarray(lapack.dormqr("L", "T", packed[:, : len(tau)], tau, matrix, WORK * matrix.shape[1])[0])


def _pivoted(matrix: FloatArray) -> tuple[FloatArray, FloatArray, NDArray[np.intp]]:
    """Return Q ``(rows, rows)``, R and the order of columns of ``matrix (rows, any)``: LAPACK's QR with pivoting."""
    rows, columns = matrix.shape
    if not matrix.size:
        return np.eye(rows), np.empty_like(matrix), np.arange(columns)
    packed, order, tau, _, _ = lapack.dgeqp3(_finite(matrix), lwork=WORK * (columns + 1))
    return _formed(packed, tau), np.triu(packed), order - 1


def _formed(packed: FloatArray, tau: FloatArray) -> FloatArray:
    """Return Q ``(rows, rows)`` of a packed factorisation of LAPACK."""
    rows, reflections = len(packed), len(tau)
    if not reflections:
        return np.eye(rows)
    q = np.empty((rows, rows), order="F")
    q[:, :reflections] = packed[:, :reflections]
    return np.asarray(lapack.dorgqr(q, tau, lwork=WORK * rows, overwrite_a=1)[0])


def _triangle(matrix: FloatArray) -> FloatArray:
    """Return R of the QR factorisation of a matrix, with as many rows as that has."""
    return np.triu(lapack.dgeqrf(_finite(matrix), lwork=WORK * matrix.shape[1])[0])


def _substituted(triangle: FloatArray, right: FloatArray, *, lower: bool = False) -> FloatArray:
    """Return ``triangle^-1 right`` for a nonsingular triangular matrix, upper or ``lower``."""
    if not right.size:
        return np.zeros(right.shape)
    _finite(right)
    if triangle.flags.f_contiguous:
        return np.asarray(lapack.dtrtrs(_finite(triangle), right, lower=lower)[0])
    # LAPACK reads matrices by columns, and so sees the transposed triangle: solve with its transpose.
    return np.asarray(lapack.dtrtrs(_finite(triangle).T, right, lower=not lower, trans=1)[0])


def _finite(matrix: FloatArray) -> FloatArray:
    if not np.isfinite(matrix).all():
        raise ValueError("a step of the recursion is not finite")
    return matrix


def _basis(null: FloatArray, lengths: FloatArray) -> FloatArray:
    """Return an orthonormal basis of the directions of x in the null space, without those of rounding size."""
    n = len(lengths)
    if not null.shape[1]:
        return np.zeros((n, 0))
    left_vectors, values, _ = np.linalg.svd(np.linalg.qr(null)[0][:n], full_matrices=False)
    return np.asarray(np.linalg.qr(left_vectors[:, values > RANK_TOLERANCE] / lengths[:, None])[0])


def _whitened(
    q1: FloatArray, q2: FloatArray, S: FloatArray, Y: FloatArray, terms: FloatArray, mapped: int
) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    """Return the whitened parity of Y, its share in the rest, the remaining noise of the rest, and noise-free parity.

    The noise-free parity has to vanish relative to ``terms`` in the columns from ``mapped`` on, which are data.
    """
    data = q2.T @ Y
    if not q2.shape[1]:
        return data, np.zeros((q1.shape[1], Y.shape[1])), q1.T @ S, data
    sizes, (packed, order, tau, first), rank = _parity(q2, S)
    t = np.triu(packed)
    scaled = (data / sizes)[order]
    lower = t[:rank, :rank].T
    innovation = _substituted(lower, scaled[:rank], lower=True) if rank else np.zeros((0, Y.shape[1]))
    # The rest of the parity is free of noise: it has to vanish, or the constraints contradict each other.
    remainder = scaled[rank:] - (t[:rank, rank:].T @ innovation if rank else 0.0)
    term_sizes = ((np.abs(q2.T) @ terms) / sizes)[order][rank:]
    _require_vanishing(remainder[:, mapped : mapped + terms.shape[1]], term_sizes, mapped)
    rotated = _rotated(packed, tau, (S.T @ q1)[first]).T
    signs = np.sign(np.diagonal(lower))[:, None]
    return signs * innovation, rotated[:, :rank] @ innovation, rotated[:, rank:], remainder


def _require_vanishing(remainder: FloatArray, terms: FloatArray, mapped: int) -> None:
    """Raise `PreconditionError` where noise-free data do not vanish relative to their terms.

    With ``mapped`` earlier columns none of the data belong to the mean.
    """
    if mapped:
        no_mean = np.zeros((len(remainder), 1))
        remainder, terms = np.hstack([no_mean, remainder]), np.hstack([no_mean, terms])
    _require_consistent(remainder, terms)


def _require_consistent(remainder: FloatArray, terms: FloatArray) -> None:
    bad = np.abs(remainder) > CONSISTENCY * terms
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


class SquareRootGaussian(NamedTuple):
    """Partly known coordinates: ``mean (c, columns) + factor (c, any) e + diffuse (c, any) w`` with unknown w.

    The first column of ``mean`` is the mean, the others are its derivatives by parameters.
    """

    mean: FloatArray
    factor: FloatArray
    diffuse: FloatArray


class SmootherGain(NamedTuple):
    """The backward relation: j_0 ``offset (c, columns)``, J_1 ``from_next (c, c_next)``, J_2 and J_3 ``(c, any)``."""

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
) -> tuple[SquareRootGaussian, SmootherGain]:
    """Return x from ``H x = right + [known noise] e + unknown d``, and the backward relation.

    ``known`` and ``unknown`` multiply the coordinates before the step.  If the step is not ``complete``, because
    samples are missing, H may lack rank.
    """
    S = np.hstack((known, noise))
    if S.shape[1] < len(H):
        S = np.hstack((S, np.zeros((len(H), len(H) - S.shape[1]))))
    least = DEPENDENT_COLUMN if complete else SUSPECT_COLUMN
    regular = not unknown.shape[1] and directions_of(S) >= len(H)
    step = _regular(H, S, known.shape[1], right, least) if regular else None
    return _by_rank(H, S, known.shape[1], right, unknown) if step is None else step


def _regular(
    H: FloatArray, S: FloatArray, width: int, right: FloatArray, least: float
) -> tuple[SquareRootGaussian, SmootherGain] | None:
    """Solve a step for smoothing by LAPACK, or return ``None`` where a rank has to be decided."""
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
    return SquareRootGaussian(solved[:, :columns], solved[:, columns:], np.zeros((n, 0))), back


def _by_rank(
    H: FloatArray, S: FloatArray, width: int, right: FloatArray, unknown: FloatArray
) -> tuple[SquareRootGaussian, SmootherGain]:
    """Solve a step for smoothing with decisions on all ranks."""
    n, columns = H.shape[1], right.shape[1]
    lengths, q1, q2, head, places, free = _by_columns(H, unknown)
    white, turned, count = _fixed_by_parity(q2, S, right)
    rotated = q1.T @ S @ turned
    solved = np.zeros((len(lengths), columns + S.shape[1] - count))
    if len(head):
        data = np.hstack((q1.T @ right + rotated[:, :count] @ white, rotated[:, count:]))
        solved[places] = _substituted(head, data)
    solved = solved / lengths[:, None]
    # The free part of the solution, in x and in the coordinates d, in scaled units.
    free = np.linalg.qr(free)[0] if free.shape[1] else free
    left_vectors, values, right_vectors = np.linalg.svd(free[:n], full_matrices=True)
    undetermined = int(np.sum(values > RANK_TOLERANCE))
    basis, weights = np.linalg.qr(left_vectors[:, :undetermined] / lengths[:n, None])
    into = right_vectors[:undetermined].T @ (np.linalg.inv(weights) / values[:undetermined, None])
    # Noise that acts on x, in as few directions as possible; the other directions act only on earlier coordinates.
    spread = solved[:n, columns:]
    compact, triangle = np.linalg.qr(spread.T, mode="complete")
    most = min(n, spread.shape[1])
    before, lost = turned[:width, count:], free[n:] / lengths[n:, None]
    upper = np.hstack((before @ compact[:, :most], np.zeros((width, undetermined))))
    lower = np.hstack((solved[n:, columns:] @ compact[:, :most], lost @ into))
    back = SmootherGain(
        np.vstack((turned[:width, :count] @ white, solved[n:, :columns])),
        np.vstack((upper, lower)),
        np.vstack((before @ compact[:, most:], solved[n:, columns:] @ compact[:, most:])),
        np.vstack((np.zeros((width, free.shape[1] - undetermined)), lost @ right_vectors[undetermined:].T)),
    )
    return SquareRootGaussian(solved[:n, :columns], triangle[:most].T, basis), back


def _fixed_by_parity(q2: FloatArray, S: FloatArray, right: FloatArray) -> tuple[FloatArray, FloatArray, int]:
    """Return the values of e in the directions that the parity fixes, an orthogonal basis with these first, and their
    number."""
    if not q2.shape[1]:
        return np.zeros((0, right.shape[1])), np.eye(S.shape[1]), 0
    sizes, (packed, order, tau, first), count = _parity(q2, S)
    t, turned = np.triu(packed), np.empty((S.shape[1], S.shape[1]))
    turned[first] = _formed(packed, tau)
    data = (q2.T @ right / sizes)[order][:count]
    return (-_substituted(t[:count, :count].T, data, lower=True) if count else data), turned, count


def stepped_back(later: SquareRootGaussian, back: SmootherGain) -> SquareRootGaussian:
    """Return the smoothed coordinates before a step from the smoothed coordinates after it."""
    mean = back.offset + back.from_next @ later.mean
    factor = np.hstack((back.from_next @ later.factor, back.noise))
    if factor.shape[1] > len(factor):
        factor = np.asarray(np.linalg.qr(factor.T, mode="r")).T
    diffuse = np.hstack((back.from_next @ later.diffuse, back.unknown))
    if diffuse.shape[1]:
        left_vectors, values, _ = np.linalg.svd(diffuse, full_matrices=False)
        diffuse = left_vectors[:, values > RANK_TOLERANCE * max(float(values[0]), 1.0)]
    return SquareRootGaussian(mean, factor, diffuse)


def nothing_later(width: int, unknown: int, columns: int) -> SquareRootGaussian:
    """Return the coordinates at the last sample, without later data: c ~ N(0, I), and d unknown."""
    factor, diffuse = np.zeros((width + unknown, width)), np.zeros((width + unknown, unknown))
    factor[:width], diffuse[width:] = np.eye(width), np.eye(unknown)
    return SquareRootGaussian(np.zeros((width + unknown, columns)), factor, diffuse)


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
    """Return the state after the data ``v = G theta + noise``, and the gain.

    ``M+ = lambda M + (1 - lambda) M_reg + G'G``, ``Theta = M+^-1 G'``, ``theta+ = theta + Theta (v - G theta)``, ``P+ =
    (I - Theta G) P (I - Theta G)' + Theta W W' Theta'``; M_reg bounds ``M^-1`` against wind-up.
    """
    q, gap = len(state.theta), v - G @ state.theta
    if q == 1:
        information = _scalar(state, G, forgetting, regular, directional)
        triangle = np.array([[np.sqrt(information)]])
        gain = G.T / information
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
    """Return the triangle after forgetting in the directions that G excites: ``M - (1 - lambda) G' (G S G')^-1 G``."""
    if not len(G):
        return triangle
    # In coordinates in which the present information is the identity, the directions that G excites are orthogonal.
    relative = np.linalg.solve(triangle.T, G.T)
    left_vectors, sizes, _ = np.linalg.svd(relative, full_matrices=False)
    excited = left_vectors[:, sizes**2 >= WORTH_FORGETTING * (1.0 - forgetting)]
    return np.asarray(triangle - (1.0 - np.sqrt(forgetting)) * excited @ (excited.T @ triangle))
