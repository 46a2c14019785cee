"""Rank decisions and square roots of covariances, and the tolerances of every decision on rank and sign.

A numerical rank is a decision: each one reports the singular values on both sides of the cut, so that a reader sees how
clear it is.  Constants that decide neither ranks nor signs are in the module of their algorithm.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal

import numpy as np

from obsynth.errors import SpecError
from obsynth.numerics.arrays import FloatArray, read_only

#: Singular values below this fraction of the largest count as zero (data are balanced first).
RANK_TOLERANCE = 1e-10

#: Singular values of windows of outputs, whose entries are powers of a plant's, below this fraction count as zero.
WINDOW_RANK_TOLERANCE = 1e-9

#: A gap between kept and dropped singular values smaller than this is reported as unclear.
CLEAR_GAP = 1e3

#: Outputs nearly depend on each other if a direction of their rows, in natural units, is below this share of the
#: largest.  An estimate that uses this direction amplifies noise by the inverse of that share.
NEARLY_DEPENDENT = 0.1

#: Distance from the stability boundary below which an eigenvalue or zero counts as lying on it.
BOUNDARY_TOLERANCE = 1e-8

#: Singular value of a pair's observability pencil, relative to the pair, below which a known zero is a hidden mode.
HIDDEN_MODE_TOLERANCE = 1e-9

#: Relative size below which a Markov parameter of a fault counts as zero.
MARKOV_TOLERANCE = 1e-9

#: A chain ``(TA)^k T f`` below this fraction of its a-priori bound counts as zero.
DEAD_CHAIN_TOLERANCE = 1e-13

#: An eigenvalue this close to the stability boundary is tested for lying on it (a multiple one scatters far).
BOUNDARY_NEIGHBOURHOOD = 1e-2

#: Singular value of a pencil, relative to its largest, below which it is singular at a point up to rounding.
BOUNDARY_RANK_TOLERANCE = 1e-13

#: Zeros closer than this, relative to their size, are taken for one multiple zero when directions are assigned.
CLUSTER_TOLERANCE = 1e-6

#: Share of the input in a zero direction below which the zero is an unobservable mode.
NEGLIGIBLE_INPUT = 1e-6

#: Signals whose share in a null vector is at least this fraction of the largest share are named.
NAMED_SHARE = 1e-3

#: A sum or product below this share of the sizes of its terms is only rounding.
CANCELLATION_TOLERANCE = 1e-14

#: Largest eigenvalue, relative to the norm of the balanced matrix, below which all of them are rounding errors of zero.
NEGLIGIBLE_MODE = 1e-6

#: Entries (i, j) and (j, i) of a covariance may differ by this much, relative to the standard deviations.
SYMMETRY_TOLERANCE = 1e-10

#: A negative eigenvalue of a correlation matrix above minus this number, for each of its rows, is a rounded zero.
DEFINITENESS_TOLERANCE = 1e-12

#: An eigenvalue of a correlation matrix below this share of the largest, times its number of rows, counts as zero: this
#: covers the rounding of the entries and of the decomposition.
ROUNDED_EIGENVALUE = 4.0 * float(np.finfo(np.float64).eps)

#: A state counts as determined if its share of a diffuse direction is below the rounding of an orthonormal basis.
UNDETERMINED_SHARE = 1e-8

#: Singular values of a scaled exact Jacobian below this share of the largest are zero.
JACOBIAN_RANK_TOLERANCE = 1e-9

#: Hankel singular values below this share of the largest are rounding: significant ones of long windows end at 1e-7,
#: and rounding of the factors of their Gramians begins at 1e-16.
HANKEL_SHARE = 1e-13

#: Directions of a Riccati solution below this share count as zero.
NEGLIGIBLE_SHARE = 1e-12

#: A set of directions has as many independent ones as singular values above this share of the largest.
DIRECTION_SHARE = 1e-9

#: Combinations of signals, each in units of its deviation, with less than this share of the mean variance count as
#: zero: the signals depend on each other up to rounding.
DEPENDENT_SIGNAL_SHARE = 1e-4

#: A zero counts as lying at the point of a constant fault (1 in discrete, 0 in continuous time) up to this distance.
REST_TOLERANCE = 1e-6

#: Singular values of a constant's effect below this share count as zero; the remainder bounds their effect.
EFFECT_RANK_SHARE = 1e-12

#: Singular values of sensitivities below this share of the largest count as zero.  The sensitivities have relative
#: rounding errors of 1e-16 times the condition of (7), which is below 1e5 in useful models.
IDENTIFIABLE_SHARE = 1e-10

#: Directions of the state that no constant affects are determined up to this share of the others.
UNTOUCHED_SHARE = 1e-7

#: Eigenvalues of the information on variances below this share of the largest are left out.
LEAST_INFORMATION = 1e-10

#: Deviations below this share of the terms that they are computed from count as zero.  Rounding is seven orders
#: smaller, so that larger ones have seven significant digits.
KNOWN_SHARE = 1e-9

#: A sum that vanishes in exact arithmetic is computed with the rounding errors of other terms in the same equation.
#: This share of these terms is added to its own, so that bounds of 1e-9 to 1e-7 of its terms exceed the rounding errors
#: of the others some hundred times.
ROUNDED_BESIDE = 1e-4

#: A fault counts as decoupled if its column in a decoupled plant is below this share of its size before.
TRACE_TOLERANCE = 1e-9

#: Parity directions whose noise is below this share of the terms in it, some rounding errors, count as noise-free.
PERFECT_PARITY = 1e-14

#: A matrix of (7) counts as singular if its condition is above this, with three of sixteen digits left.
SINGULAR_CONDITION = 1e13

#: A value below this share of the largest of its range is zero up to rounding.
ROUNDED_ZERO = 1e-12

#: Bounds of states count as dependent if their moves differ by less than this share.
DEPENDENT_BOUND = 1e-13


def rounding_rank(matrix: FloatArray) -> int:
    """Return the rank to working precision."""
    return int(np.linalg.matrix_rank(matrix))


def first_independent(directions: FloatArray, count: int) -> list[int]:
    """Return the first rows, at most ``count``, that are independent to working precision; each is zero or of length
    one."""
    picked: list[int] = []
    for place in range(len(directions)):
        if len(picked) < count and rounding_rank(directions[[*picked, place]]) > len(picked):
            picked.append(place)
    return picked


def independent_directions(rows: FloatArray) -> FloatArray:
    """Return independent directions ``(m, r)`` of signals ``(n, m)`` with deviations of one, which may contain NaN.

    If all signals are independent, the directions are the signals themselves.
    """
    known = rows[np.isfinite(rows).all(axis=1)]
    sizes, vectors = np.linalg.eigh(known.T @ known / max(len(known), 1))
    significant = sizes > DEPENDENT_SIGNAL_SHARE * sizes.mean()
    return np.eye(len(sizes)) if significant.all() or not significant.any() else np.asarray(vectors[:, significant])


def but_rounding(sums: FloatArray, size_of_terms: FloatArray) -> FloatArray:
    """Return sums with zeros for those that cancel up to the rounding of their terms; NaN stays NaN."""
    return np.where(np.abs(sums) <= CANCELLATION_TOLERANCE * size_of_terms, 0.0, sums)


def real_but_rounding(value: complex) -> float:
    """Return the real part of a number, or zero if it may be a rounding error of a large imaginary part."""
    return float(but_rounding(np.array(value.real), np.array(abs(value))))


def product_but_rounding(matrix: Any, other: FloatArray, more: FloatArray | None = None) -> FloatArray:
    """Return ``more + matrix other`` with zeros where its terms cancel up to rounding."""
    product, terms = matrix @ other, abs(matrix) @ np.abs(other)
    return but_rounding(product, terms) if more is None else but_rounding(more + product, np.abs(more) + terms)


@dataclass(frozen=True, eq=False)
class RankDecision:
    """A numerical rank with its evidence: the singular values of the scaled matrix, largest first.

    ``smallest_kept`` is the smallest singular value that counts as nonzero, relative to the largest.  ``gap`` is its
    ratio to the next one; it is infinite if only exact zeros are dropped, and the ratio to the tolerance if the rank is
    full.  ``share`` is the last value relative to the terms that it is a sum of.
    """

    rank: int
    expected: int
    singular_values: FloatArray
    smallest_kept: float
    gap: float
    means: Literal["tolerance", "exact", "unclear"] = "tolerance"
    share: float = np.inf

    @property
    def full(self) -> bool:
        """Whether the decided rank equals the expected one."""
        return self.rank == self.expected

    @property
    def clear(self) -> bool:
        """Whether the gap is large enough to trust the decision without a second look."""
        return self.gap >= CLEAR_GAP

    @property
    def _margin(self) -> str:
        values = self.singular_values
        if not 0 < self.expected <= len(values) or values[0] == 0.0:
            return ""
        return f", least singular value {min(values[self.expected - 1] / values[0], self.share):.1e}"

    def describe(self) -> str:
        """Return one line for a report, such as ``rank 4 of 4 (gap 2.1e+09)``."""
        if self.means == "exact":
            lost = "on the numbers as written; if only rounding makes it so, every observer has gains of about 1e16"
            return f"rank {self.rank} of {self.expected} (exactly{self._margin if self.full else f', {lost}'})"
        if self.means == "unclear":
            return f"rank {self.expected} exactly, but less of data that differ by rounding{self._margin}"
        note = "" if self.clear else ", unclear: check the scaling of the data"
        gap = f" (gap {self.gap:.1e}{note})" if np.isfinite(self.gap) else ""
        return f"rank {self.rank} of {self.expected}{gap}"


def equilibrate(matrix: FloatArray) -> FloatArray:
    """Return ``matrix`` with rows, then columns, scaled by powers of two to a largest entry near one."""
    scaled = np.array(matrix, dtype=np.float64)
    for axis in (1, 0, 1, 0):
        if scaled.size == 0:
            return scaled
        peak = np.max(np.abs(scaled), axis=axis, keepdims=True)
        peak[peak == 0.0] = 1.0
        scaled = scaled / np.exp2(np.floor(np.log2(peak)))
    return scaled


def decide_rank(
    matrix: FloatArray,
    *,
    expected: int | None = None,
    tolerance: float = RANK_TOLERANCE,
    scale: float | None = None,
    equilibrated: bool = True,
) -> RankDecision:
    """Decide the rank of ``matrix (rows, cols)`` by its singular values."""
    work = equilibrate(matrix) if equilibrated and not np.iscomplexobj(matrix) else np.asarray(matrix)
    values = np.asarray(np.linalg.svd(work, compute_uv=False)) if work.size else np.zeros(0)
    return rank_from(
        values, expected=min(work.shape) if expected is None else expected, tolerance=tolerance, scale=scale
    )


def rank_in_any_units(first: FloatArray, second: FloatArray, *, expected: int) -> RankDecision:
    """Decide a rank by the one of two scalings of a matrix that gives the higher one.

    Rounding errors are relative to the entries in all units, so that no scaling makes a singular matrix look regular.
    A regular matrix may look singular if its units drift apart, as along a chain of weakly coupled parts.
    """
    decided = decide_rank(first, expected=expected)
    if decided.full and decided.clear:
        return decided
    other = decide_rank(second, expected=expected)
    return max(decided, other, key=lambda decision: (decision.rank, decision.smallest_kept))


def numerical_rank(values: FloatArray, *, scale: float | None = None, tolerance: float = RANK_TOLERANCE) -> int:
    """Return how many singular values, sorted from the largest, are nonzero relative to ``scale``, by default the
    largest one."""
    return int(np.sum(values > tolerance * (values[0] if scale is None else scale))) if values.size else 0


def rank_from(
    values: FloatArray, *, expected: int, tolerance: float = RANK_TOLERANCE, scale: float | None = None
) -> RankDecision:
    """Decide a rank by the singular values of a matrix."""
    reference = scale if scale is not None else (float(values[0]) if values.size else 0.0)
    rank = int(np.count_nonzero(values > tolerance * reference)) if reference > 0.0 else 0
    relative = values / reference if reference > 0.0 else values
    smallest_kept = float(relative[rank - 1]) if rank else 0.0
    dropped = float(relative[rank]) if rank < values.size else 0.0
    if rank == values.size:
        gap = smallest_kept / tolerance if rank else float("inf")
    elif dropped == 0.0:
        gap = float("inf")
    else:
        gap = (smallest_kept if rank else tolerance) / dropped
    return RankDecision(rank, expected, read_only(np.asarray(values, dtype=np.float64)), smallest_kept, gap)


def covariance_factor(covariance: FloatArray, name: str) -> FloatArray:
    """Return ``F (n, n)`` with ``F F' = covariance``; zero variances and singular matrices are allowed.

    The correlation matrix is factorised, so that variances of 1e-30 and of 1 have equally many digits.
    """
    if covariance.ndim != 2 or covariance.shape[0] != covariance.shape[1]:
        raise SpecError(f"{name} has shape {covariance.shape}: a covariance must be square.", path=name)
    diagonal = np.diag(covariance)
    if not np.any(covariance - np.diag(diagonal)) and np.all(diagonal >= 0.0):
        return np.diag(np.sqrt(diagonal))
    deviations = np.sqrt(np.maximum(diagonal, 0.0))
    bounds = np.outer(deviations, deviations)
    worst = np.unravel_index(
        int(np.argmax(np.abs(covariance - covariance.T) - SYMMETRY_TOLERANCE * bounds)), bounds.shape
    )
    if abs(covariance[worst] - covariance.T[worst]) > SYMMETRY_TOLERANCE * bounds[worst]:
        i, j = int(worst[0]) + 1, int(worst[1]) + 1
        raise SpecError(
            f"{name} is not symmetric: entry ({i}, {j}) is {covariance[worst]:.6g}, entry ({j}, {i}) is "
            f"{covariance.T[worst]:.6g}.",
            path=name,
        )
    zero = bounds == 0.0
    if np.any(diagonal < 0.0) or np.any(covariance[zero]):
        raise SpecError(
            f"{name} is no covariance: it has a negative variance, or a covariance with a signal that has none.",
            path=name,
        )
    scale = np.where(deviations > 0.0, deviations, 1.0)
    correlation = 0.5 * (covariance + covariance.T) / np.outer(scale, scale)
    rounding = ROUNDED_EIGENVALUE * len(correlation)
    try:
        factor = np.linalg.cholesky(correlation + np.diag(1.0 * (deviations == 0.0)))
        if np.min(np.diagonal(factor)) ** 2 > rounding:
            return np.asarray(deviations[:, None] * factor)
    except np.linalg.LinAlgError:
        pass
    values, vectors = np.linalg.eigh(correlation)
    if values[0] < -DEFINITENESS_TOLERANCE * len(values):
        raise SpecError(
            f"{name} is not positive semidefinite: its correlation matrix has the eigenvalue {values[0]:.3g}.",
            path=name,
        )
    # Without this limit, an eigenvalue of 1e-16 by rounding would give a deviation of 1e-8.
    return np.asarray(scale[:, None] * vectors * np.sqrt(np.where(values > rounding * values[-1], values, 0.0)))


def is_definite(covariance: FloatArray, factor: FloatArray) -> bool:
    """Return whether a covariance is positive definite, by its correlations, which do not depend on units."""
    variances = np.diag(covariance)
    if not np.all(variances > 0.0):
        return False
    return not len(factor) or bool(rounding_rank(factor / np.sqrt(variances)[:, None]) == len(factor))
