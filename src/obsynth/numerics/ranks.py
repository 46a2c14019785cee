"""Rank decisions and square roots of covariances, and the tolerances of every decision on rank and sign.

A rank is a decision, not a fact: each one reports the singular values on both sides of the cut, so that a reader sees
how clear it was.  Other constants stand with their algorithm.
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

#: Directions of the outputs below this share of the largest, in units of their own, are of outputs that nearly depend
#: on each other: an estimate that uses them has as many times the noise as this is small.
NEARLY_DEPENDENT = 0.1

#: Distance from the stability boundary below which an eigenvalue or zero counts as lying on it.
BOUNDARY_TOLERANCE = 1e-8

#: Singular value of a pair's observability pencil, relative to the pair, below which a known zero is a hidden mode.
HIDDEN_MODE_TOLERANCE = 1e-9

#: Relative size below which a Markov parameter of a fault counts as zero.
MARKOV_TOLERANCE = 1e-9

#: A chain ``(TA)^k T f`` that shrank below this fraction of its a-priori bound has decayed.
DEAD_CHAIN_TOLERANCE = 1e-13

#: An eigenvalue this close to the stability boundary is tested for lying on it (a multiple one scatters far).
BOUNDARY_NEIGHBOURHOOD = 1e-2

#: Singular value of a pencil, relative to its largest, below which rounding alone may have moved a zero away.
BOUNDARY_RANK_TOLERANCE = 1e-13

#: Zeros closer than this, relative to their size, are taken for one multiple zero when directions are assigned.
CLUSTER_TOLERANCE = 1e-6

#: Share of the input in a zero direction below which the zero is an unobservable mode.
NEGLIGIBLE_INPUT = 1e-6

#: Signals whose share in a null vector is at least this fraction of the largest share are named.
NAMED_SHARE = 1e-3

#: Result of a sum or product, relative to the sizes of its terms, below which it is only rounding.
CANCELLATION_TOLERANCE = 1e-14

#: Largest eigenvalue, relative to the norm of the balanced matrix, below which all of them are rounding errors of zero.
NEGLIGIBLE_MODE = 1e-6

#: Entries (i, j) and (j, i) of a covariance may differ by this much, relative to the standard deviations.
SYMMETRY_TOLERANCE = 1e-10

#: An eigenvalue of a correlation matrix above minus this is a rounded zero.
DEFINITENESS_TOLERANCE = 1e-12

#: An eigenvalue of a correlation matrix below this share of the largest, for each of its rows, is zero: entries are
#: rounded by half of it, of two digits of a product that was rounded once, and so is the decomposition.
ROUNDED_EIGENVALUE = 4.0 * float(np.finfo(np.float64).eps)

#: Share of a diffuse direction below which a state is held to be determined: rounding of an orthonormal basis.
UNDETERMINED_SHARE = 1e-8

#: Singular values of a scaled exact Jacobian below this share of the largest are zero.
JACOBIAN_RANK_TOLERANCE = 1e-9

#: Hankel singular values below this share of the largest are rounding: those of long windows end at 1e-7, and rounding
#: of the factors of their Gramians begins at 1e-16.
HANKEL_SHARE = 1e-13

#: Directions of a Riccati solution below this share are not told from zero.
NEGLIGIBLE_SHARE = 1e-12

#: Singular values of a set of directions below this share of the largest are no direction of their own.
DIRECTION_SHARE = 1e-9

#: Directions of signals in their own deviations that have less than this share of the mean variance follow from the
#: others: what is in them is rounding, and how the signals depend on each other.
DEPENDENT_SIGNAL_SHARE = 1e-4

#: A zero nearer than this to the point at which a constant fault stands is that point.
REST_TOLERANCE = 1e-6

#: Singular values of a constant's effect below this share count as zero; what is left out goes into the remainder.
EFFECT_RANK_SHARE = 1e-12

#: Singular values below this share of the largest are zero: the sensitivities carry rounding of 1e-16 times
#: the condition of (7), which stays below 1e5 in models that can be used.
IDENTIFIABLE_SHARE = 1e-10

#: Directions of the state that no constant touches are found down to this share of the others.
UNTOUCHED_SHARE = 1e-7

#: Eigenvalues of the variances' information below this share of the largest are left out.
LEAST_INFORMATION = 1e-10

#: Deviations below this share of the terms they are computed from are zero: rounding is seven orders smaller, so that
#: what is kept has seven digits.
KNOWN_SHARE = 1e-9

#: What is zero but for rounding beside other terms ends at the rounding of these: this share of them counts among its
#: own terms, so that bounds of 1e-9 to 1e-7 of its terms are above some hundred roundings of the others.
ROUNDED_BESIDE = 1e-4

#: Size of a fault's column in a decoupled plant, relative to before the reduction, below which it left no trace.
TRACE_TOLERANCE = 1e-9

#: Parity directions whose noise is below this share of the terms it is made of are free of noise: a few roundings.
PERFECT_PARITY = 1e-14

#: A matrix of (7) whose condition is above this is singular: three digits are left of sixteen.
SINGULAR_CONDITION = 1e13

#: A value below this share of the largest of its range is zero but for rounding.
ROUNDED_ZERO = 1e-12

#: Bounds of states whose moves differ by less than this share are dependent.
DEPENDENT_BOUND = 1e-13


def rounding_rank(matrix: FloatArray) -> int:
    """Return the rank to working precision: what rounding alone leaves of it."""
    return int(np.linalg.matrix_rank(matrix))


def first_independent(directions: FloatArray, count: int) -> list[int]:
    """Return which rows, of unit length or zero, are the first that are independent to working precision, ``count`` of
    them at most."""
    picked: list[int] = []
    for place in range(len(directions)):
        if len(picked) < count and rounding_rank(directions[[*picked, place]]) > len(picked):
            picked.append(place)
    return picked


def independent_directions(rows: FloatArray) -> FloatArray:
    """Return the directions ``(m, r)`` of rows ``(n, m)`` of unit deviations, of which some may be NaN, that do not
    follow from each other: the signals themselves where none does."""
    known = rows[np.isfinite(rows).all(axis=1)]
    sizes, vectors = np.linalg.eigh(known.T @ known / max(len(known), 1))
    significant = sizes > DEPENDENT_SIGNAL_SHARE * sizes.mean()
    return np.eye(len(sizes)) if significant.all() or not significant.any() else np.asarray(vectors[:, significant])


def but_rounding(sums: FloatArray, size_of_terms: FloatArray) -> FloatArray:
    """Return sums without those that cancel down to the rounding of their terms; what is not a number stays that."""
    return np.where(np.abs(sums) <= CANCELLATION_TOLERANCE * size_of_terms, 0.0, sums)


def real_but_rounding(value: complex) -> float:
    """Return the real part of a number, which beside a large imaginary part may be rounding alone: nothing then."""
    return float(but_rounding(np.array(value.real), np.array(abs(value))))


def product_but_rounding(matrix: Any, other: FloatArray, more: FloatArray | None = None) -> FloatArray:
    """Return ``more + matrix other``; where its terms cancel down to their rounding, there is nothing."""
    product, terms = matrix @ other, abs(matrix) @ np.abs(other)
    return but_rounding(product, terms) if more is None else but_rounding(more + product, np.abs(more) + terms)


@dataclass(frozen=True, eq=False)
class RankDecision:
    """A numerical rank with the evidence: all singular values, largest first, as decided upon (rows, columns scaled).

    ``smallest_kept``: relative to the largest; ``gap``: its ratio to the next, infinite when only exact zeros were
    dropped, the distance to the tolerance when the rank is full; ``share``: the last value beside the terms it is a sum
    of.
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
    """Decide whether a matrix has a rank by whichever of two scalings of it shows that better.

    Rounding of the entries is as small beside them in all units, so that no scaling makes a matrix look regular that
    is not; one whose units drift apart, as along a chain of parts that hardly touch, makes it look singular.
    """
    decided = decide_rank(first, expected=expected)
    if decided.full and decided.clear:
        return decided
    other = decide_rank(second, expected=expected)
    return max(decided, other, key=lambda decision: (decision.rank, decision.smallest_kept))


def numerical_rank(values: FloatArray, *, scale: float | None = None, tolerance: float = RANK_TOLERANCE) -> int:
    """Return how many singular values, the largest first, are not zero beside ``scale``: by default the largest."""
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

    Of the correlation matrix, so that variances of 1e-30 beside 1 keep all their digits.
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
    # The root of a rounding error of 1e-16 would be a deviation of 1e-8 in a direction that has none.
    return np.asarray(scale[:, None] * vectors * np.sqrt(np.where(values > rounding * values[-1], values, 0.0)))


def is_definite(covariance: FloatArray, factor: FloatArray) -> bool:
    """Return whether a covariance is positive definite, by its correlations, so that units do not matter."""
    variances = np.diag(covariance)
    if not np.all(variances > 0.0):
        return False
    return not len(factor) or bool(rounding_rank(factor / np.sqrt(variances)[:, None]) == len(factor))
