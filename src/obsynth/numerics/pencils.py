r"""Structure of matrix pencils ``A - z E`` of any shape, by orthogonal transformations only.

The staircase reduction of Van Dooren: compress the columns of ``E``; the part of ``A`` on its null
space, compressed by rows, is infinite or singular structure and is deflated; repeat; then do the
same with the transposed pencil.  What is left is square with nonsingular ``E`` and holds exactly the
finite zeros, so no generalised eigenvalue has to be recognised as infinite by its size.

References
----------
.. [VanDooren1979] P. Van Dooren, "The computation of Kronecker's canonical form of a singular
   pencil", Linear Algebra and its Applications 27, 1979.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple, TypeAlias

import numpy as np

from obsynth.numerics.arrays import ComplexArray, FloatArray
from obsynth.numerics.ranks import CLUSTER_TOLERANCE, RANK_TOLERANCE, RankDecision, rank_from
from obsynth.numerics.scaling import EquilibratedPencil, equilibrate_pencil


@dataclass(frozen=True, eq=False)
class PencilStructure:
    """What a pencil ``A - z E`` looks like.

    Parameters
    ----------
    rows, columns : int
        Its shape.
    regular : bool
        Square with a determinant that is not identically zero.
    normal_rank : int
        Rank of ``A - z E`` at almost every ``z``.
    index : int or None
        Size of the largest infinite block, 0 for nonsingular ``E``; None when not regular.
    finite_eigenvalues : ComplexArray
        ``(k,)``, finite zeros with multiplicity, read-only; conjugate pairs are exact.
    infinite_block_sizes : tuple of int
        Sizes of the Jordan blocks at infinity, largest first.
    decisions : tuple of RankDecision
        Every rank decided on the way, in order, relative to the norm of the equilibrated pencil.
    """

    rows: int
    columns: int
    regular: bool
    normal_rank: int
    index: int | None
    finite_eigenvalues: ComplexArray
    infinite_block_sizes: tuple[int, ...]
    decisions: tuple[RankDecision, ...]


@dataclass(frozen=True, eq=False)
class FiniteZeros:
    """The points where a pencil loses rank.

    Parameters
    ----------
    values : ComplexArray
        ``(k,)``, with multiplicity, read-only; conjugate pairs are exact.
    normal_rank : int
        Rank of the pencil at almost every point.
    decisions : tuple of RankDecision
        Every rank decided on the way.
    """

    values: ComplexArray
    normal_rank: int
    decisions: tuple[RankDecision, ...]


@dataclass(frozen=True, eq=False)
class _Deflation:
    """A pencil without its infinite and right singular part, and the sizes of the steps taken."""

    E: FloatArray
    A: FloatArray
    nullities: tuple[int, ...]
    ranks: tuple[int, ...]
    decisions: tuple[RankDecision, ...]


class _Reduction(NamedTuple):
    """Both passes of the staircase, and the norms of E and A that its ranks were decided by."""

    right: _Deflation
    left: _Deflation
    scales: tuple[float, float]


_Svd: TypeAlias = tuple[FloatArray, FloatArray, FloatArray]


def pencil_structure(E: FloatArray, A: FloatArray) -> PencilStructure:
    """Return the structure of ``A - z E`` for matrices ``(m, n)`` of any size, including zero.

    Parameters
    ----------
    E, A : FloatArray
        ``(m, n)`` real matrices; they are not modified.

    Returns
    -------
    PencilStructure
        For non-square and singular pencils too: ``regular`` is then False and ``index`` None.

    References
    ----------
    .. [VanDooren1979] Algorithms 3.1 and 4.1.
    """
    right, left, _ = _reduce(equilibrate_pencil(E, A))
    rows, columns = E.shape
    regular = _is_regular(E, right)
    next_nullities = (*right.nullities[1:], 0)
    counts = [rank - following for rank, following in zip(right.ranks, next_nullities, strict=False)]
    sizes = tuple(size for size in range(len(counts), 0, -1) for _ in range(counts[size - 1]))
    return PencilStructure(
        rows=rows,
        columns=columns,
        regular=regular,
        normal_rank=_normal_rank(right, left),
        index=len(right.ranks) if regular else None,
        finite_eigenvalues=_eigenvalues(left.E, left.A),
        infinite_block_sizes=sizes,
        decisions=right.decisions + left.decisions,
    )


def finite_zeros(E: FloatArray, A: FloatArray) -> FiniteZeros:
    """Return the points where ``rank (A - z E)`` drops below the normal rank, with multiplicity.

    Parameters
    ----------
    E, A : FloatArray
        ``(m, n)`` real matrices of any size, including zero; they are not modified.

    Returns
    -------
    FiniteZeros
        Zeros, normal rank, and the rank decisions behind them.

    References
    ----------
    .. [VanDooren1979] Algorithms 3.1 and 4.1.
    """
    # A tall pencil leaves the long chains to the second pass, whose findings can be checked below.
    tall = equilibrate_pencil(E, A) if E.shape[0] >= E.shape[1] else equilibrate_pencil(E.T, A.T)
    right, left, scales = _reduce(tall)
    values = _eigenvalues(left.E, left.A)
    values = _with_missed_zeros(values, right.E, right.A, scales)
    return FiniteZeros(values, _normal_rank(right, left), right.decisions + left.decisions)


def _with_missed_zeros(found: ComplexArray, E: FloatArray, A: FloatArray, scales: tuple[float, float]) -> ComplexArray:
    """Add zeros of a tall pencil, ``E`` of full column rank, that a long staircase lost.

    A chain of many steps, each with a modest singular value, may hide that the pencil is singular at
    some point.  All zeros are among the eigenvalues of the part on the range of ``E``, and each of
    these candidates can be tested by itself.
    """
    rows, columns = E.shape
    if rows == columns:
        return found
    basis = np.linalg.svd(E)[0]
    square_e, square_a = basis[:, :columns].T @ E, basis[:, :columns].T @ A
    if _clearly_without_zeros(square_e, square_a, basis[:, columns:].T @ A, scales):
        return found
    zeros = list(found)
    for candidate in _eigenvalues(square_e, square_a):
        values = np.linalg.svd(A - candidate * E, compute_uv=False)
        nullity = np.sum(values <= RANK_TOLERANCE * (scales[1] + abs(candidate) * scales[0]))
        if nullity > sum(abs(zero - candidate) <= CLUSTER_TOLERANCE * max(1.0, abs(candidate)) for zero in zeros):
            zeros.append(candidate)
    return _in_pairs(np.array(zeros, dtype=np.complex128))


def _clearly_without_zeros(
    square_e: FloatArray, square_a: FloatArray, rest: FloatArray, scales: tuple[float, float]
) -> bool:
    """Return whether ``[square_a - z square_e; rest]`` clearly has full rank at every z; false says nothing.

    Suppose it maps ``x`` of unit norm to no more than t.  Let V hold eigenvectors of the square part, F their residual,
    w_j be the rows of ``(square_e V)^-1``, and ``x = V y``.  Then ``|y_j| <= |w_j| (t + |F| |V^-1|) / |lambda_j - z|``.
    So x is a multiple of the eigenvector v whose lambda is closest to z, but for r, the sum of these over the others,
    and ``rest`` cannot map it to less than ``|rest v| (1 - r) - |rest| r``.  Where that is more than t for every v,
    there is no z left to look at.  Ill-conditioned eigenvectors and close eigenvalues leave the question open.
    """
    # What overflows is not clear.
    with np.errstate(all="ignore"):
        try:
            values, vectors = np.linalg.eig(np.linalg.solve(square_e, square_a))
            weights = np.linalg.norm(np.linalg.inv(square_e @ vectors), axis=1)
            spread = float(np.linalg.norm(np.linalg.inv(vectors)))
        except np.linalg.LinAlgError:
            return False
        residual = float(np.linalg.norm(square_a @ vectors - square_e @ vectors * values))
        tolerances = RANK_TOLERANCE * (scales[1] + np.abs(values) * scales[0])
        apart = np.abs(values - values[:, None])
        np.fill_diagonal(apart, np.inf)
        # Closest to lambda_i means up to half way to the others.
        away = (tolerances + residual * spread) * np.sum(2.0 * weights / apart, axis=1)
        least = np.linalg.norm(rest @ vectors, axis=0) * (1.0 - away) - float(np.linalg.norm(rest)) * away
    return bool(np.all(away < 1.0) and np.all(least > 2.0 * tolerances))


def regularity(E: FloatArray, A: FloatArray) -> tuple[bool, int]:
    """Return whether ``A - z E`` is regular, and its normal rank; what `pencil_structure` says without eigenvalues.

    Parameters
    ----------
    E, A : FloatArray
        ``(m, n)`` real matrices; they are not modified.
    """
    right, left, _ = _reduce(equilibrate_pencil(E, A))
    return _is_regular(E, right), _normal_rank(right, left)


def _is_regular(E: FloatArray, right: _Deflation) -> bool:
    # Without right singular blocks a square pencil has no left ones either.
    return E.shape[0] == E.shape[1] and right.nullities == right.ranks


def _reduce(pencil: EquilibratedPencil) -> _Reduction:
    """Deflate the infinite and right singular part, then the left singular part (transposed)."""
    first = _svd(pencil.E)
    scales = (float(np.max(first[1], initial=0.0)), _norm(pencil.A))
    right = _deflate(pencil.E, pencil.A, scales, most_nullity=pencil.E.shape[1], first=first)
    # E now has full column rank, so the ranks of E in the second pass follow from its shape.
    surplus = right.E.shape[0] - right.E.shape[1]
    left = _deflate(right.E.T, right.A.T, scales, most_nullity=surplus)
    return _Reduction(right, left, scales)


def _deflate(
    E: FloatArray, A: FloatArray, scales: tuple[float, float], *, most_nullity: int, first: _Svd | None = None
) -> _Deflation:
    """Deflate step by step; ``first`` is the singular value decomposition of E, where it is known."""
    nullities: list[int] = []
    ranks: list[int] = []
    decisions: list[RankDecision] = []
    while most_nullity > 0:
        rows, columns = E.shape
        if first is None and columns > rows:
            first = _svd(E)
        # Most often nothing is left to deflate after the first step: bases are then not needed.
        values = _singular_values(E) if first is None else first[1]
        decision = rank_from(values, scale=scales[0], expected=columns)
        # Rows were removed from a matrix of full column rank: this bounds the loss, whatever the tolerance says.
        rank = max(decision.rank, columns - most_nullity)
        if max(columns - rows, 0) < most_nullity:
            decisions.append(decision)
        if rank == columns:
            break
        right = (_svd(E) if first is None else first)[2]
        kernel, complement, first = right[rank:].T, right[:rank].T, None
        left, values, _ = _svd(A @ kernel)
        decision = rank_from(values, scale=scales[1], expected=columns - rank)
        decisions.append(decision)
        rest = left[:, decision.rank :].T
        E, A = rest @ E @ complement, rest @ A @ complement
        nullities.append(columns - rank)
        ranks.append(decision.rank)
        most_nullity = decision.rank
    return _Deflation(E, A, tuple(nullities), tuple(ranks), tuple(decisions))


def _svd(matrix: FloatArray) -> _Svd:
    """Return the full left basis, the singular values and the full right basis."""
    if matrix.size == 0:
        return np.eye(matrix.shape[0]), np.zeros(0), np.eye(matrix.shape[1])
    left, values, right = np.linalg.svd(matrix)
    return left, values, right


def _singular_values(matrix: FloatArray) -> FloatArray:
    return np.asarray(np.linalg.svd(matrix, compute_uv=False)) if matrix.size else np.zeros(0)


def _normal_rank(right: _Deflation, left: _Deflation) -> int:
    return sum(right.ranks) + sum(left.ranks) + int(left.E.shape[0])


def _eigenvalues(E: FloatArray, A: FloatArray) -> ComplexArray:
    """Return the eigenvalues of a square pencil with nonsingular ``E``, in exact conjugate pairs."""
    from scipy.linalg import eigvals

    if not E.size:
        return _in_pairs(np.zeros(0, dtype=np.complex128))
    try:
        values = eigvals(A, E)
    except np.linalg.LinAlgError:
        # LAPACK's shifts may go round in circles on matrices of great symmetry: turned, the pencil has none.
        left, right = (np.linalg.qr(np.random.default_rng(seed).normal(size=E.shape))[0] for seed in (0, 1))
        values = eigvals(left @ A @ right, left @ E @ right)
    return _in_pairs(np.asarray(values, dtype=np.complex128))


def _in_pairs(values: ComplexArray) -> ComplexArray:
    """Sort values by their upper half and put the exact conjugate behind each complex one."""
    upper = values[values.imag >= 0.0]
    upper = upper[np.lexsort((upper.imag, upper.real))]
    paired = [pair for value in upper for pair in ((value, value.conjugate()) if value.imag > 0.0 else (value,))]
    result = np.array(paired, dtype=np.complex128)
    result.setflags(write=False)
    return result


def _norm(matrix: FloatArray) -> float:
    return float(np.linalg.norm(matrix, 2)) if matrix.size else 0.0
