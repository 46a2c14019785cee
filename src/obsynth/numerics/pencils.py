"""Structure of matrix pencils ``A - z E`` of any shape, by orthogonal transformations only.

P. Van Dooren, Linear Algebra and its Applications 27, 1979: what the staircase leaves is square with nonsingular E and
holds the finite zeros, so that no generalised eigenvalue has to be recognised as infinite by its size.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from obsynth.numerics.arrays import ComplexArray, FloatArray, read_only
from obsynth.numerics.lapack import eigenvalues
from obsynth.numerics.pencil_points import PencilPoints
from obsynth.numerics.ranks import CLUSTER_TOLERANCE, RANK_TOLERANCE, RankDecision
from obsynth.numerics.scaling import equilibrate_pencil
from obsynth.numerics.staircase import Deflation, normal_rank_of, without_infinite_part, without_left_singular_part

#: From so many states on, a well-conditioned E is inverted: ordinary eigenvalues take a fraction of the time.
STATES_FOR_INVERTED_E = 100

SAFE_E_CONDITION = 1e5

#: An eigenvalue belongs to the closest of others unless a second one is not further away than this many times that.
TIE = 4.0

#: Square E and A of a tall pencil in an orthonormal basis of the range of E, and what is beside it.
_SquarePart: TypeAlias = tuple[FloatArray, FloatArray, FloatArray]


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


def with_nonsingular_e(E: FloatArray, A: FloatArray) -> tuple[Deflation, Deflation]:
    """Return the two passes over a square pencil whose E is known to be nonsingular: nothing is taken away."""
    identity, dynamics = np.eye(len(E)), np.asarray(np.linalg.solve(E, A), dtype=np.float64)
    return Deflation(identity, dynamics, (), (), ()), Deflation(identity, dynamics.T, (), (), ())


def structure_of_reduced(shape: tuple[int, ...], passes: tuple[Deflation, Deflation]) -> PencilStructure:
    """Return the structure of a pencil ``(m, n)`` from its two passes."""
    right_deflation, left_deflation = passes
    regular = is_regular(shape, right_deflation)
    next_nullities = (*right_deflation.nullities[1:], 0)
    counts = [rank - following for rank, following in zip(right_deflation.ranks, next_nullities, strict=False)]
    sizes = tuple(size for size in range(len(counts), 0, -1) for _ in range(counts[size - 1]))
    return PencilStructure(
        regular=regular,
        normal_rank=normal_rank_of(right_deflation, left_deflation),
        index=len(right_deflation.ranks) if regular else None,
        finite_eigenvalues=_eigenvalues(left_deflation.E, left_deflation.A),
        infinite_block_sizes=sizes,
        decisions=right_deflation.decisions + left_deflation.decisions,
    )


def finite_zeros(E: FloatArray, A: FloatArray, *, to_the_end: bool = True) -> FiniteZeros:
    """Return the points where ``rank (A - z E)``, ``(m, n)``, drops below the normal rank, with multiplicity."""
    # A tall pencil leaves the long chains to the second pass, whose findings can be checked below.
    tall = equilibrate_pencil(E, A) if E.shape[0] >= E.shape[1] else equilibrate_pencil(E.T, A.T)
    scales, right_deflation = without_infinite_part(tall)
    rows, columns = right_deflation.E.shape
    if not rows > columns > 0:
        left_deflation = without_left_singular_part(right_deflation, scales)
        values = _eigenvalues(left_deflation.E, left_deflation.A)
        return FiniteZeros(
            values,
            normal_rank_of(right_deflation, left_deflation),
            right_deflation.decisions + left_deflation.decisions,
        )
    basis, square = np.linalg.qr(right_deflation.E, mode="complete")
    turned = basis.T @ right_deflation.A
    candidates, clear = _clearly_no_zeros((square[:columns], turned[:columns], turned[columns:]), scales)
    if np.all(clear) and not to_the_end:
        # Full rank of the columns everywhere.
        return FiniteZeros(
            _in_pairs(np.zeros(0, dtype=np.complex128)), sum(right_deflation.ranks) + columns, right_deflation.decisions
        )
    left_deflation = without_left_singular_part(right_deflation, scales)
    computed = _eigenvalues(left_deflation.E, left_deflation.A)
    decisions = right_deflation.decisions + left_deflation.decisions
    # E has full column rank now, so the pencil has it at almost every point, whatever a long staircase makes of it.
    rank = sum(right_deflation.ranks) + columns
    if np.all(clear):
        return FiniteZeros(_in_pairs(computed[:0]), rank, decisions)
    points = PencilPoints(right_deflation.E, right_deflation.A, scales)
    # A staircase on the verge of a rank invents zeros at which the pencil is not singular.
    upper = [points.confirmed(complex(value)) for value in computed if value.imag >= 0.0]
    confirmed = _in_pairs(np.array([value for value in upper if value is not None], dtype=np.complex128))
    zeros = _with_missed_zeros(confirmed, candidates[~clear], points)
    if len(zeros) == len(confirmed) == len(computed):
        # What a long staircase leaves of a zero is its rounding; the same zeros are found without it.
        places = confirmed if len(confirmed) else candidates[~clear]
        decisions = right_deflation.decisions + tuple(
            points.rank(complex(place)) for place in places if place.imag >= 0.0
        )
    return FiniteZeros(zeros, rank, decisions)


def _with_missed_zeros(confirmed: ComplexArray, candidates: ComplexArray, points: PencilPoints) -> ComplexArray:
    """Add zeros of a tall pencil, E of full column rank, that a long staircase lost.

    All zeros are among the eigenvalues of the part on the range of E, and each can be tested by itself.
    """
    zeros = list(confirmed)
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
        away, rest_norms = np.sum(reach, axis=1), np.linalg.norm(rest @ vectors, axis=0)
        least = rest_norms * (1.0 - away) - reach @ rest_norms
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
    if np.array_equal(E, np.eye(len(E))):
        return _in_pairs(np.asarray(np.linalg.eigvals(A), dtype=np.complex128))
    if len(E) >= STATES_FOR_INVERTED_E and (inverse := _safe_inverse(E)) is not None:
        return _in_pairs(np.asarray(np.linalg.eigvals(inverse @ A), dtype=np.complex128))
    try:
        values = eigenvalues(A, E)
    except np.linalg.LinAlgError:
        # LAPACK's shifts may go round in circles on matrices of great symmetry: turned, the pencil has none.
        left_basis, right_basis = (np.linalg.qr(np.random.default_rng(seed).normal(size=E.shape))[0] for seed in (0, 1))
        values = eigenvalues(left_basis @ A @ right_basis, left_basis @ E @ right_basis)
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
