"""Structure of matrix pencils ``A - z E`` of any shape, by orthogonal transformations only, and their rank at points.

P. Van Dooren, Linear Algebra and its Applications 27, 1979: what the staircase of the infinite and singular parts
leaves is square with nonsingular E and holds the finite zeros, so that no generalised eigenvalue has to be recognised
as infinite by its size.

At points: in the Schur basis of the part on the range of E a tall pencil is ``[T - z I; W]``, T triangular, few rows W:
one Schur form, then a cheap QR (``tpqrt``) at each point and inverse iteration, in a tenth of the time of all singular
values.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any, TypeAlias

import numpy as np
import scipy
from numpy.typing import NDArray

from obsynth.numerics.arguments import ComplexArray, FloatArray, largest_singular_value, read_only
from obsynth.numerics.lapack import eigenvalues
from obsynth.numerics.ranks import CLUSTER_TOLERANCE, RANK_TOLERANCE, RankDecision, rank_from
from obsynth.numerics.scaling import EquilibratedPencil, equilibrate_pencil
from obsynth.numerics.square_root_estimation import TPQRT_BLOCK

#: Matrices with fewer columns are decomposed as a whole.
FEW_COLUMNS = 80
#: Steps of inverse iteration: values that decide are smaller than the next by many digits, and each step squares that.
NULL_DIRECTION_STEPS = 4


#: Singular values, smallest first, right singular vectors as columns, and a bound on the largest value.
Smallest: TypeAlias = tuple[FloatArray, NDArray[Any], float]


def smallest_singular(matrix: NDArray[Any], count: int = 1) -> Smallest:
    """Return the smallest singular values of a matrix ``(m, n)``, ``m >= n``, or more, with right singular vectors."""
    if matrix.shape[1] < FEW_COLUMNS:
        _, values, right = np.linalg.svd(matrix)
        order = slice(None, -count - 1, -1)
        return values[order], right[order].conj().T, float(values[0])
    return iterated(np.asarray(scipy.linalg.qr(matrix, mode="r", check_finite=False)[0][: matrix.shape[1]]), count)


def iterated(triangle: NDArray[Any], count: int) -> Smallest:
    """Return the smallest singular values of an upper triangular matrix by inverse iteration."""
    size = triangle.shape[0]
    norm = float(np.sqrt(np.linalg.norm(triangle, 1) * np.linalg.norm(triangle, np.inf)))
    if norm == 0.0:
        return np.zeros(count), np.eye(size, count), 0.0
    work = np.array(triangle)
    diagonal = np.einsum("ii->i", work)
    # An exact zero would be divided by: as small as rounding, it does as well.
    small = np.abs(diagonal) < np.finfo(float).eps * norm
    diagonal[small] = np.finfo(float).eps * norm
    basis = np.random.default_rng(0).normal(size=(size, count)).astype(work.dtype)
    with np.errstate(over="ignore", invalid="ignore"):
        for _ in range(NULL_DIRECTION_STEPS):
            inner = scipy.linalg.solve_triangular(work, basis, trans="C", check_finite=False)
            inner /= np.max(np.abs(inner), axis=0, initial=0.0) + np.finfo(float).tiny
            basis = np.linalg.qr(scipy.linalg.solve_triangular(work, inner, check_finite=False))[0]
    _, values, turned = np.linalg.svd(triangle @ basis, full_matrices=False)
    return values[::-1], basis @ turned[::-1].conj().T, norm


#: Above this condition of its leading part the Schur basis is not orthonormal enough to judge the pencil in it.
SAFE_BASIS_CONDITION = 1e5
#: Points without meaning, at which a pencil has its normal rank; where several are tried, the clearest is used.
GENERIC_POINTS = (0.7391, -1.3247, 1.9561, -0.4142)
#: Most null directions that are looked for at a point.
MOST_DIRECTIONS = 4
#: Steps in which a computed zero is improved before the pencil there is judged.
ZERO_STEPS = 4
#: A zero that moves further than this, relative to its size or one, is another one.
ZERO_REACH = 1e-2


class PencilPoints:
    """A tall pencil ``A - z E (m, n)``, E of full column rank, judged at points; ``scales`` are the norms of E, A."""

    def __init__(self, E: FloatArray, A: FloatArray, scales: tuple[float, float]) -> None:
        self.E, self.A, self.scales = E, A, scales

    def nullity(self, point: complex) -> int:
        """Return how many singular values at a point are below the tolerance of every rank."""
        decision = self.rank(point)
        return decision.expected - decision.rank

    def rank(self, point: complex) -> RankDecision:
        """Decide whether the columns are independent at a point; in large pencils by the smallest singular values."""
        scale = self.scales[1] + abs(point) * self.scales[0]
        if self.E.shape[1] < FEW_COLUMNS or self._schur is None:
            values = np.asarray(np.linalg.svd(self.A - point * self.E, compute_uv=False))
            return rank_from(values, scale=scale, expected=len(values))
        count = min(MOST_DIRECTIONS, self.E.shape[1])
        # In the basis of the Schur form values are those of the pencil up to the condition of E.
        least = iterated(self._triangle(point), 1)[0]
        if least[0] > RANK_TOLERANCE * scale * self._schur[3]:
            return rank_from(least / self._schur[3], scale=scale, expected=1)
        vectors = self._schur[1] @ iterated(self._triangle(point), count)[1]
        basis = np.linalg.qr(vectors)[0]
        values = np.asarray(np.linalg.svd((self.A - point * self.E) @ basis, compute_uv=False))
        return rank_from(values, scale=scale, expected=count)

    def smallest(self, point: complex) -> float:
        """Return the smallest singular value at a point relative to the largest, up to the condition of E."""
        if self.E.shape[1] < FEW_COLUMNS or self._schur is None:
            values, _, largest = smallest_singular(self.A - point * self.E)
        else:
            values, _, largest = iterated(self._triangle(point), 1)
        return float(values[0]) / largest if largest else 0.0

    def confirmed(self, point: complex) -> complex | None:
        """Return a computed zero, improved where that is needed; ``None`` where the pencil has full rank all around."""
        if self.nullity(point):
            return point
        place = point
        for _ in range(ZERO_STEPS):
            matrix = self.A - place * self.E
            left, _, right = np.linalg.svd(matrix, full_matrices=False)
            u, v = left[:, -1].conj(), right[-1].conj()
            slope = u @ self.E @ v
            if slope == 0.0:
                return None
            place = place + (u @ matrix @ v) / slope
            if not abs(place - point) <= ZERO_REACH * max(1.0, abs(point)):
                return None
            if self.nullity(place):
                return complex(place.real, place.imag if point.imag else 0.0)
        return None

    @cached_property
    def _schur(self) -> tuple[ComplexArray, ComplexArray, ComplexArray, float] | None:
        """Return T, the basis, the rows below, and the condition of E; ``None`` where that is too large."""
        columns = self.E.shape[1]
        basis, square = np.linalg.qr(self.E, mode="complete")
        turned, top = basis.T @ self.A, square[:columns]
        sizes = np.linalg.svd(top, compute_uv=False)
        if not sizes[-1] * SAFE_BASIS_CONDITION > sizes[0]:
            return None
        t, u = scipy.linalg.rsf2csf(*scipy.linalg.schur(np.linalg.solve(top, turned[:columns]), check_finite=False))
        # The leading part is divided by E; the rows below are brought to its size.
        return t, u, np.asarray(turned[columns:] @ u / sizes[0]), float(sizes[0] / sizes[-1] / sizes[-1])

    def _triangle(self, point: complex) -> NDArray[Any]:
        from obsynth.numerics.lapack import ztpqrt

        schur = self._schur
        triangle = np.array(schur[0] if schur else self.A, order="F")
        np.einsum("ii->i", triangle)[:] -= point
        below = np.array(schur[2] if schur else self.E, dtype=np.complex128, order="F")
        if not below.shape[0]:
            return triangle
        found, _, _, _ = ztpqrt(0, min(TPQRT_BLOCK, triangle.shape[0]), triangle, below, overwrite_a=1, overwrite_b=1)
        return np.triu(found)


_Svd: TypeAlias = tuple[FloatArray, FloatArray, FloatArray]


@dataclass(frozen=True, eq=False)
class Deflation:
    """A pencil without its infinite and right singular part, and the sizes of the steps taken."""

    E: FloatArray
    A: FloatArray
    nullities: tuple[int, ...]
    ranks: tuple[int, ...]
    decisions: tuple[RankDecision, ...]


def without_infinite_part(pencil: EquilibratedPencil) -> tuple[tuple[float, float], Deflation]:
    """Deflate the infinite and right singular part; the norms of E and A, which decide its ranks, come first."""
    first = full_svd(pencil.E)
    scales = (float(np.max(first[1], initial=0.0)), largest_singular_value(pencil.A))
    return scales, _deflate(pencil.E, pencil.A, scales, most_nullity=pencil.E.shape[1], first=first)


def without_left_singular_part(right: Deflation, scales: tuple[float, float]) -> Deflation:
    """Deflate what is left of the singular part."""
    # E now has full column rank, so the ranks of E in the second pass follow from its shape.
    surplus = right.E.shape[0] - right.E.shape[1]
    return _deflate(right.E.T, right.A.T, scales, most_nullity=surplus)


def _deflate(
    E: FloatArray, A: FloatArray, scales: tuple[float, float], *, most_nullity: int, first: _Svd | None = None
) -> Deflation:
    """Deflate step by step; ``first`` is the singular value decomposition of E, where it is known."""
    nullities: list[int] = []
    ranks: list[int] = []
    decisions: list[RankDecision] = []
    while most_nullity > 0:
        rows, columns = E.shape
        if first is None and (columns > rows or not E.size):
            first = full_svd(E)
        # Most often nothing is left to deflate after the first step: bases are then not needed.
        values = np.asarray(np.linalg.svd(E, compute_uv=False)) if first is None else first[1]
        decision = rank_from(values, scale=scales[0], expected=columns)
        # Rows were removed from a matrix of full column rank: this bounds the loss, whatever the tolerance says.
        rank = max(decision.rank, columns - most_nullity)
        if max(columns - rows, 0) < most_nullity:
            decisions.append(decision)
        if rank == columns:
            break
        right = (full_svd(E) if first is None else first)[2]
        kernel, complement, first = right[rank:].T, right[:rank].T, None
        left, values, _ = full_svd(A @ kernel)
        decision = rank_from(values, scale=scales[1], expected=columns - rank)
        decisions.append(decision)
        rest = left[:, decision.rank :].T
        E, A = rest @ E @ complement, rest @ A @ complement
        nullities.append(columns - rank)
        ranks.append(decision.rank)
        most_nullity = decision.rank
    return Deflation(E, A, tuple(nullities), tuple(ranks), tuple(decisions))


def full_svd(matrix: FloatArray) -> _Svd:
    """Return the full left basis, the singular values and the full right basis."""
    if matrix.size == 0:
        return np.eye(matrix.shape[0]), np.zeros(0), np.eye(matrix.shape[1])
    left, values, right = np.linalg.svd(matrix)
    return left, values, right


def normal_rank_of(right: Deflation, left: Deflation) -> int:
    """Return the rank of the pencil at almost every point, from both passes."""
    return sum(right.ranks) + sum(left.ranks) + int(left.E.shape[0])


#: From so many states on, a well-conditioned E is inverted: ordinary eigenvalues take a fraction of the time.
STATES_FOR_INVERTED_E = 100
SAFE_E_CONDITION = 1e5
#: An eigenvalue belongs to the closest of others unless a second one is not further away than this many times that.
TIE = 4.0


@dataclass(frozen=True, eq=False)
class PencilStructure:
    """What a pencil ``A - z E`` looks like; finite eigenvalues with multiplicity, conjugate pairs exact.

    ``index``: size of the largest infinite block, 0 for nonsingular E, None when not regular; ``infinite_block_sizes``:
    largest first; ``decisions``: every rank decided on the way, relative to the norm of the equilibrated pencil.
    """

    regular: bool
    normal_rank: int
    index: int | None
    finite_eigenvalues: ComplexArray
    infinite_block_sizes: tuple[int, ...]
    decisions: tuple[RankDecision, ...]


@dataclass(frozen=True, eq=False)
class FiniteZeros:
    """The points where a pencil loses rank, with multiplicity; conjugate pairs are exact.

    ``decisions``: the ranks of the staircase's steps; of its second pass the ranks at its zeros instead, where the same
    are found without it.
    """

    values: ComplexArray
    normal_rank: int
    decisions: tuple[RankDecision, ...]


def reduced(E: FloatArray, A: FloatArray) -> tuple[Deflation, Deflation]:
    """Return what two passes (Algorithms 3.1 and 4.1) leave of ``A - z E (m, n)``, of any size, zero included: all that
    structure and regularity follow from.

    The infinite and right singular part are deflated first, then, transposed, the left singular part."""
    scales, right = without_infinite_part(equilibrate_pencil(E, A))
    return right, without_left_singular_part(right, scales)


def structure_of_reduced(shape: tuple[int, ...], passes: tuple[Deflation, Deflation]) -> PencilStructure:
    """Return the structure of a pencil ``(m, n)`` from its two passes."""
    right, left = passes
    regular = is_regular(shape, right)
    next_nullities = (*right.nullities[1:], 0)
    counts = [rank - following for rank, following in zip(right.ranks, next_nullities, strict=False)]
    sizes = tuple(size for size in range(len(counts), 0, -1) for _ in range(counts[size - 1]))
    return PencilStructure(
        regular=regular,
        normal_rank=normal_rank_of(right, left),
        index=len(right.ranks) if regular else None,
        finite_eigenvalues=_eigenvalues(left.E, left.A),
        infinite_block_sizes=sizes,
        decisions=right.decisions + left.decisions,
    )


def finite_zeros(E: FloatArray, A: FloatArray, *, to_the_end: bool = True) -> FiniteZeros:
    """Return the points where ``rank (A - z E)``, ``(m, n)``, drops below the normal rank, with multiplicity."""
    # A tall pencil leaves the long chains to the second pass, whose findings can be checked below.
    tall = equilibrate_pencil(E, A) if E.shape[0] >= E.shape[1] else equilibrate_pencil(E.T, A.T)
    scales, right = without_infinite_part(tall)
    rows, columns = right.E.shape
    if not rows > columns > 0:
        left = without_left_singular_part(right, scales)
        values = _eigenvalues(left.E, left.A)
        return FiniteZeros(values, normal_rank_of(right, left), right.decisions + left.decisions)
    basis, square = np.linalg.qr(right.E, mode="complete")
    turned = basis.T @ right.A
    candidates, clear = _clearly_no_zeros((square[:columns], turned[:columns], turned[columns:]), scales)
    if np.all(clear) and not to_the_end:
        # Full rank of the columns everywhere.
        return FiniteZeros(_in_pairs(np.zeros(0, dtype=np.complex128)), sum(right.ranks) + columns, right.decisions)
    left = without_left_singular_part(right, scales)
    found, rank = _eigenvalues(left.E, left.A), normal_rank_of(right, left)
    decisions = right.decisions + left.decisions
    if np.all(clear):
        return FiniteZeros(_in_pairs(found[:0]), sum(right.ranks) + columns, decisions)
    if rank < sum(right.ranks) + columns:
        # Singular everywhere: that the pencil is so at a point says nothing.
        return FiniteZeros(found, rank, decisions)
    points = PencilPoints(right.E, right.A, scales)
    # A staircase on the verge of a rank invents zeros at which the pencil is not singular.
    upper = [points.confirmed(complex(value)) for value in found if value.imag >= 0.0]
    kept = _in_pairs(np.array([value for value in upper if value is not None], dtype=np.complex128))
    zeros = _with_missed_zeros(kept, candidates[~clear], points)
    if len(zeros) == len(kept) == len(found):
        # What a long staircase leaves of a zero is its rounding; the same zeros are found without it.
        places = kept if len(kept) else candidates[~clear]
        decisions = right.decisions + tuple(points.rank(complex(place)) for place in places if place.imag >= 0.0)
    return FiniteZeros(zeros, rank, decisions)


#: Square E and A of a tall pencil in an orthonormal basis of the range of E, and what is beside it.
_SquarePart: TypeAlias = tuple[FloatArray, FloatArray, FloatArray]


def _with_missed_zeros(found: ComplexArray, candidates: ComplexArray, points: PencilPoints) -> ComplexArray:
    """Add zeros of a tall pencil, E of full column rank, that a long staircase lost.

    All zeros are among the eigenvalues of the part on the range of E, and each can be tested by itself.
    """
    zeros = list(found)
    nullities: dict[complex, int] = {}
    for candidate in map(complex, _in_pairs(candidates)):
        near = sum(abs(zero - candidate) <= CLUSTER_TOLERANCE * max(1.0, abs(candidate)) for zero in zeros)
        # The pencil is real: of a pair one is judged.
        upper = complex(candidate.real, abs(candidate.imag))
        if upper not in nullities:
            nullities[upper] = points.nullity(upper)
        if nullities[upper] > near:
            zeros.append(candidate)
    return _in_pairs(np.array(zeros, dtype=np.complex128))


def _clearly_no_zeros(parts: _SquarePart, scales: tuple[float, float]) -> tuple[ComplexArray, NDArray[np.bool_]]:
    """Return the eigenvalues of the square part, and around which ``[square_a - z square_e; rest]`` has full rank.

    Suppose it maps ``x`` of unit norm to no more than t.  Let V hold eigenvectors of the square part, F their residual,
    w_j be the rows of ``(square_e V)^-1``, and ``x = V y``.  Then ``|y_j| <= |w_j| (t + |F| |V^-1|) / |lambda_j - z|``.
    So x is a multiple of the eigenvector v whose lambda is closest to z, but for ``y_j v_j`` of the others.  With r the
    sum of these ``|y_j|``, ``rest`` maps it to ``|rest v| (1 - r)`` at least, less the sum of ``|y_j| |rest v_j|``.
    Where that is more than t for a v, no zero is closest to its lambda.  Ill-conditioned eigenvectors and close
    eigenvalues leave the question open.
    """
    square_e, square_a, rest = parts
    # What overflows is not clear.
    with np.errstate(all="ignore"):
        try:
            values, vectors = np.linalg.eig(np.linalg.solve(square_e, square_a))
            weights = np.linalg.norm(np.linalg.inv(square_e @ vectors), axis=1)
            spread = float(np.linalg.norm(np.linalg.inv(vectors)))
        except np.linalg.LinAlgError:
            return _candidates(parts)
        residual = float(np.linalg.norm(square_a @ vectors - square_e @ vectors * values))
        tolerances = RANK_TOLERANCE * (scales[1] + np.abs(values) * scales[0])
        apart = np.abs(values - values[:, None])
        np.fill_diagonal(apart, np.inf)
        # Closest to lambda_i means up to half way to the others.
        reach = 2.0 * (tolerances + residual * spread)[:, None] * (weights / apart)
        away, shown = np.sum(reach, axis=1), np.linalg.norm(rest @ vectors, axis=0)
        least = shown * (1.0 - away) - reach @ shown
        clear = np.asarray((away < 1.0) & (least > 2.0 * tolerances))
    pairs = np.flatnonzero(values.imag > 0.0)
    clear[pairs] &= clear[pairs + 1]
    clear[pairs + 1] = clear[pairs]
    if not np.all(clear) and _safe_inverse(square_e) is None:
        return _by_qz(parts, values, clear) if np.any(clear) else _candidates(parts)
    return np.asarray(values, dtype=np.complex128), clear


def _by_qz(
    parts: _SquarePart, values: ComplexArray, clear: NDArray[np.bool_]
) -> tuple[ComplexArray, NDArray[np.bool_]]:
    """Return the eigenvalues of the square part by QZ, clear where those around are clear whose E was inverted.

    A zero is closest to one that is not clear, and QZ has it nearby.  Where that is as good as a tie, nothing is clear.
    """
    better, unclear = _candidates(parts)
    if len(better) < len(values):
        # What is no number was left out.
        return better, unclear
    distances = np.abs(better[:, None] - values)
    open_, known = distances[:, ~clear], distances[:, clear]
    rounding = CLUSTER_TOLERANCE * np.maximum(1.0, np.abs(better))
    # A distance that is no number leaves the question open.
    still = np.asarray(np.min(open_, axis=1) > TIE * np.min(known, axis=1) + rounding)
    still[np.argmin(open_, axis=0)] = False
    # Pairs follow each other: the other of a pair is beside it.
    still &= still[np.arange(len(better)) + (better.imag > 0.0) - (better.imag < 0.0)]
    return better, still


def _candidates(parts: _SquarePart) -> tuple[ComplexArray, NDArray[np.bool_]]:
    """Return the eigenvalues of the square part by QZ, none of them clear: its E may be nearly singular."""
    values = _eigenvalues(*parts[:2])
    return values, np.zeros(len(values), dtype=bool)


def is_regular(shape: tuple[int, ...], right: Deflation) -> bool:
    """Whether a pencil ``(m, n)`` is regular, from the pass over its columns."""
    # Without right singular blocks a square pencil has no left ones either.
    return shape[0] == shape[1] and right.nullities == right.ranks


def _eigenvalues(E: FloatArray, A: FloatArray) -> ComplexArray:
    """Return the eigenvalues of a square pencil with nonsingular ``E``, in exact conjugate pairs."""
    if not E.size:
        return _in_pairs(np.zeros(0, dtype=np.complex128))
    if len(E) >= STATES_FOR_INVERTED_E and (inverse := _safe_inverse(E)) is not None:
        return _in_pairs(np.asarray(np.linalg.eigvals(inverse @ A), dtype=np.complex128))
    try:
        values = eigenvalues(A, E)
    except np.linalg.LinAlgError:
        # LAPACK's shifts may go round in circles on matrices of great symmetry: turned, the pencil has none.
        left, right = (np.linalg.qr(np.random.default_rng(seed).normal(size=E.shape))[0] for seed in (0, 1))
        values = eigenvalues(left @ A @ right, left @ E @ right)
    return _in_pairs(np.asarray(values, dtype=np.complex128))


def _safe_inverse(E: FloatArray) -> FloatArray | None:
    """Return the inverse of a well-conditioned matrix; ``None`` for any other."""
    try:
        inverse = np.linalg.inv(E)
    except np.linalg.LinAlgError:
        return None
    return np.asarray(inverse) if float(np.linalg.norm(E) * np.linalg.norm(inverse)) <= SAFE_E_CONDITION else None


def _in_pairs(values: ComplexArray) -> ComplexArray:
    """Sort values by their upper half and put the exact conjugate behind each complex one."""
    upper = values[values.imag >= 0.0]
    upper = upper[np.lexsort((upper.imag, upper.real))]
    paired = [pair for value in upper for pair in ((value, value.conjugate()) if value.imag > 0.0 else (value,))]
    return read_only(np.array(paired), np.complex128)
