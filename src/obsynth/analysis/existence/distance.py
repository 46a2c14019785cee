"""Distance of a pencil from losing rank in the unstable region: its least singular value there, in scaled units.

Estimated, not proved: the least that is found on the boundary, near all zeros and, for tall pencils, at the unstable
points where a random compression of the rows loses rank, which are close to where the pencil nearly does.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from obsynth.numerics.arrays import FloatArray
from obsynth.numerics.invariant_zeros import equilibrated_at, size_of_point
from obsynth.numerics.lapack import eigenvalues
from obsynth.numerics.modal_response import MOST_ENTRIES_AT_ONCE
from obsynth.numerics.scaling import equilibrate_pencil

#: Below this distance, relative to the data, rounding of the data is as large as what a unit fault moves: gains of its
#: inverse would be needed, which is below rounding in double precision.
ROUNDING_LEVEL = 2e-14

#: Zeros closer than this, relative to their size, may be one that rounding has moved.
SAME_ZERO_DISTANCE = 1e-3

#: Points on the stability boundary; in continuous time between these magnitudes of the own rates.
BOUNDARY_POINTS = 33

#: Further out a pencil is close to what it is at infinity, where other conditions decide.
FARTHEST_OUT, FASTEST = 1e-3, 1e3

#: Compressions of a tall pencil, at most so many points of each.
COMPRESSIONS = 2

MOST_POINTS = 40


def distance_to_loss(
    E: FloatArray,
    A: FloatArray,
    *,
    nx: int,
    discrete: bool,
    zeros: tuple[complex, ...] = (),
    sizes: FloatArray | None = None,
) -> tuple[float, complex]:
    """Return how far ``A - s E (m, n)`` is from losing column rank on or outside the stability boundary: the least
    singular value found, relative to the largest, and where.
    ``sizes (m, n)`` of the terms of A: what rounding of the data behind it may change is relative to those."""
    candidates = [*_boundary(E, A, discrete), *(_to_boundary(zero, discrete) for zero in zeros)]
    if A.shape[0] > A.shape[1]:
        candidates += _compressed_points(E, A, discrete)
    values = relative_singular_values(E, A, candidates, nx=nx)
    if sizes is not None:
        values = np.minimum(values, relative_singular_values(E, A, candidates, nx=nx, sizes=sizes))
    least = int(np.argmin(values))
    return float(values[least]), candidates[least]


def zeros_at_rounding_level(
    E: FloatArray, A: FloatArray, computed: Iterable[complex], exact: Sequence[complex], *, nx: int
) -> list[complex]:
    """Return those zeros found in floating point that the exact ones lack only by rounding of the data."""
    return [
        value
        for value in map(complex, computed)
        if not any(abs(value - other) <= SAME_ZERO_DISTANCE * max(1.0, abs(other)) for other in exact)
        and relative_singular_values(E, A, [value], nx=nx)[0] <= ROUNDING_LEVEL
    ]


def relative_singular_values(
    E: FloatArray, A: FloatArray, points: Sequence[complex], *, nx: int, sizes: FloatArray | None = None
) -> FloatArray:
    """Return the least singular value over the largest at each point, in units of A or of ``sizes`` of its terms."""
    shares = np.full(len(points), 0.0 if A.shape[1] else np.inf)
    if A.shape[0] < A.shape[1] or not A.size:
        return shares
    groups: dict[tuple[float, bool], list[int]] = {}
    for place, point in enumerate(points):
        groups.setdefault((size_of_point(point), point.imag != 0.0), []).append(place)
    at_once = max(1, MOST_ENTRIES_AT_ONCE // A.size)
    for (size, turning), places in groups.items():
        pencil = equilibrated_at(E, A if sizes is None else sizes, complex(size), nx=nx)
        scaled = pencil.A if sizes is None else pencil.rows[:, None] * A * pencil.columns
        for start in range(0, len(places), at_once):
            some = places[start : start + at_once]
            chosen = np.array([points[place] for place in some])[:, None, None]
            matrices: NDArray[Any] = scaled - (chosen if turning else chosen.real) * pencil.E
            values = np.linalg.svd(matrices, compute_uv=False)
            largest = values[:, 0]
            if sizes is not None:
                largest = np.linalg.norm(pencil.A + np.abs(chosen) * np.abs(pencil.E), 2, axis=(1, 2))
            nonzero = values[:, 0] > 0.0
            shares[some] = np.where(nonzero, values[:, -1] / np.where(nonzero, largest, 1.0), 0.0)
    return shares


def least_share(matrix: NDArray[Any], sizes: FloatArray, *, rank: int | None = None) -> float:
    """Return the last singular value of a matrix ``(m, n)`` of a rank (full) relative to the terms of its entries."""
    pencil = equilibrate_pencil(np.zeros_like(sizes), sizes)
    values = np.linalg.svd(pencil.rows[:, None] * matrix * pencil.columns, compute_uv=False)
    rank = matrix.shape[1] if rank is None else rank
    if not 0 < rank <= len(values):
        return 0.0 if rank else np.inf
    return float(values[rank - 1] / (np.linalg.norm(pencil.A, 2) or 1.0))


def _boundary(E: FloatArray, A: FloatArray, discrete: bool) -> list[complex]:
    if discrete:
        return [complex(np.exp(1j * angle)) for angle in np.linspace(0.0, np.pi, BOUNDARY_POINTS)]
    rate = _typical_rate(E, A)
    return [0j, *(complex(0.0, rate * size) for size in np.geomspace(FARTHEST_OUT, FASTEST, BOUNDARY_POINTS))]


def _typical_rate(E: FloatArray, A: FloatArray) -> float:
    """Return the size of s at which both matrices weigh the same."""
    size_e, size_a = float(np.linalg.norm(E)), float(np.linalg.norm(A))
    return size_a / size_e if size_e > 0.0 and size_a > 0.0 else 1.0


def _to_boundary(value: complex, discrete: bool) -> complex:
    if discrete:
        return value / abs(value) if value else 1.0 + 0j
    return complex(max(value.real, 0.0), abs(value.imag))


def _compressed_points(E: FloatArray, A: FloatArray, discrete: bool) -> list[complex]:
    rng, points = np.random.default_rng(1), list[complex]()
    for _ in range(COMPRESSIONS):
        compression = rng.standard_normal((A.shape[1], A.shape[0]))
        # LAPACK gives up on a few pencils: their points are left out.
        try:
            values = eigenvalues(compression @ A, compression @ E)
        except np.linalg.LinAlgError:
            continue
        finite = values[np.abs(values) <= FASTEST * (1.0 if discrete else _typical_rate(E, A))]
        outside = finite[np.abs(finite) >= 1.0] if discrete else finite[finite.real >= 0.0]
        upper = outside[outside.imag >= 0.0]
        points += [complex(value) for value in upper[np.argsort(np.abs(upper))][:MOST_POINTS]]
    return points
