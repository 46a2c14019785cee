"""The staircase (Van Dooren) of the infinite and singular parts of a pencil."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TypeAlias

import numpy as np

from obsynth.numerics.arrays import FloatArray, largest_singular_value
from obsynth.numerics.ranks import RankDecision, rank_from
from obsynth.numerics.scaling import EquilibratedPencil

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
        left_vectors, values, _ = full_svd(A @ kernel)
        decision = rank_from(values, scale=scales[1], expected=columns - rank)
        decisions.append(decision)
        left_null = left_vectors[:, decision.rank :].T
        E, A = left_null @ E @ complement, left_null @ A @ complement
        nullities.append(columns - rank)
        ranks.append(decision.rank)
        most_nullity = decision.rank
    return Deflation(E, A, tuple(nullities), tuple(ranks), tuple(decisions))


def full_svd(matrix: FloatArray) -> _Svd:
    """Return the full left basis, the singular values and the full right basis."""
    if matrix.size == 0:
        return np.eye(matrix.shape[0]), np.zeros(0), np.eye(matrix.shape[1])
    left_vectors, values, right_vectors = np.linalg.svd(matrix)
    return left_vectors, values, right_vectors


def normal_rank_of(right_deflation: Deflation, left_deflation: Deflation) -> int:
    """Return the rank of the pencil at almost every point, from both passes."""
    return sum(right_deflation.ranks) + sum(left_deflation.ranks) + int(left_deflation.E.shape[0])
