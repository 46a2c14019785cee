"""Proofs that a pencil ``K - z M`` is regular at every z on the unit circle: weighted diagonal dominance in balls.

With X of approximate deflating subspaces, and Y near the inverse of what they are mapped to, ``Y (K - z M) X`` is
nearly ``diag(a) - z diag(b)``. For weights ``w > 0`` it is regular on the circle if every row has ``||a_i| - |b_i||
w_i > sum_j (|(Y K X)_ij| + |(Y M X)_ij|) w_j`` over the other entries. No matrix is inverted but Y, which may be any:
pencils with infinite eigenvalues, and such as are nearly singular, lose no digits. Eigenvectors of close eigenvalues
are nearly parallel: Schur vectors of such a group span its subspace, and weights that fall along it take what is
above the diagonal.
"""

from __future__ import annotations

from typing import Any

import flint
import numpy as np
import scipy.linalg
from numpy.typing import NDArray

from obsynth.numerics.arrays import ComplexArray, FloatArray
from obsynth.proofs.extended_balls import middles

#: Chordal distances of eigenvalues of a group, tried in turn: rounding parts a triple eigenvalue by eps^(1/3).
GROUP_DISTANCES = (1e-6, 1e-4, 1e-2)


def distance_from_circle(first: Any, second: Any) -> float:
    """Return a lower bound, above 0, on ``||a| - |b||`` of the discs of ``first - z second``; 0 where none is proved.

    Both: an ``arb_mat (n, n)``, of which every member is meant.
    """
    matrices = middles(first), middles(second)
    if not all(np.all(np.isfinite(matrix)) for matrix in matrices):
        return 0.0
    try:
        values, images, vectors = _eigenvectors(*matrices)
    except np.linalg.LinAlgError:
        return 0.0
    chordal = np.abs(np.outer(values[0], values[1]) - np.outer(values[1], values[0]))
    tried: set[bytes] = set()
    for distance in GROUP_DISTANCES:
        linked = np.linalg.matrix_power((chordal <= distance).astype(float), len(chordal)) > 0.0
        if linked.tobytes() in tried:
            continue
        tried.add(linked.tobytes())
        try:
            x, u = _with_subspaces(matrices, (values, images, vectors), linked, distance)
            y = np.asarray(np.linalg.inv(u), dtype=np.complex128)
        except np.linalg.LinAlgError:
            continue
        if np.all(np.isfinite(y)):
            nearest = _nearest(first, second, x, y)
            if nearest > 0.0:
                return nearest
    return 0.0


def _nearest(first: Any, second: Any, x: ComplexArray, y: ComplexArray) -> float:
    size = len(x)
    left_factor, right_factor = (flint.acb_mat(size, size, part.ravel().tolist()) for part in (y, x))
    tables = [(left_factor * (flint.acb_mat(part) * right_factor)).tolist() for part in (first, second)]
    centres = [abs(abs(tables[0][i][i]) - abs(tables[1][i][i])).lower() for i in range(size)]
    zero = flint.arb(0)
    rows = [
        [zero if i == j else a.abs_upper() + b.abs_upper() for j, (a, b) in enumerate(zip(*pair, strict=True))]
        for i, pair in enumerate(zip(*tables, strict=True))
    ]
    others = flint.arb_mat(rows)
    distances = np.array([float(centre) for centre in centres])
    # The equation of an M-matrix: its solution is positive where any weights do.
    try:
        weights = np.linalg.solve(np.diag(distances) - middles(others), distances)
    except np.linalg.LinAlgError:
        return 0.0
    if not np.all(np.isfinite(weights)) or not np.all(weights > 0.0):
        return 0.0
    column = flint.arb_mat(size, 1, weights.tolist())
    beside = others * column
    nearest = min(float((centres[i] - beside[i, 0] / column[i, 0]).lower()) for i in range(size))
    return nearest if 0.0 < nearest < np.inf else 0.0


def _eigenvectors(first: FloatArray, second: FloatArray) -> tuple[ComplexArray, ComplexArray, ComplexArray]:
    """Return pairs ``(a, b)`` of norm one as columns, u and x: nearly, ``first x = a u`` and ``second x = b u``."""
    values, vectors = scipy.linalg.eig(first, second, homogeneous_eigvals=True)
    values = values / np.maximum(np.linalg.norm(values, axis=0), np.finfo(float).tiny)
    vectors = vectors.astype(complex)
    images = (first @ vectors) * np.conj(values[0]) + (second @ vectors) * np.conj(values[1])
    sizes = np.linalg.norm(images, axis=0)
    if not np.all(np.isfinite(sizes)) or not np.all(sizes > 0.0):
        raise np.linalg.LinAlgError("the pencil is singular")
    return values, images / sizes, vectors / sizes


def _with_subspaces(
    matrices: tuple[FloatArray, FloatArray],
    eigenvectors: tuple[ComplexArray, ComplexArray, ComplexArray],
    linked: NDArray[np.bool_],
    distance: float,
) -> tuple[ComplexArray, ComplexArray]:
    """Return X and U with Schur vectors in place of the eigenvectors of each group of close eigenvalues."""
    values, images, vectors = eigenvectors
    x, u = vectors.copy(), images.copy()
    for group in np.unique(linked, axis=0):
        count = int(np.sum(group))
        if count == 1:
            continue
        members = values[:, group]

        def is_member(a: ComplexArray, b: ComplexArray, members: ComplexArray = members) -> Any:
            size = np.hypot(np.abs(a), np.abs(b))
            apart = np.abs(np.outer(a, members[1]) - np.outer(b, members[0])) / size[:, None]
            return np.min(apart, axis=1) <= 0.5 * distance

        complex_ones = [matrix.astype(complex) for matrix in matrices]
        _, _, a, b, left_vectors, right_vectors = scipy.linalg.ordqz(*complex_ones, sort=is_member, output="complex")
        if int(np.sum(is_member(a, b))) != count:
            raise np.linalg.LinAlgError("a group of eigenvalues is not apart from the others")
        x[:, group], u[:, group] = right_vectors[:, :count], left_vectors[:, :count]
    return x, u
