r"""The error system of an observer of a nonlinear plant over a region: the corners of its slopes.

By the mean value theorem the error obeys :math:`E e' = (A + \sum_i d_i w_i v_i - L (C + \sum_i d_i w_{y,i} v_i)) e
+ B w` with every slope :math:`d_i` between its bounds, where the observer continues each nonlinearity beyond its box
with a slope between the same bounds.  What is affine in the slopes is proved at their corners.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence

import numpy as np

from obsynth.analysis.existence.nonlinear_region import MOST_CORNER_SLOPES
from obsynth.numerics.arrays import FloatArray
from obsynth.plants.operating_region import Slope
from obsynth.plants.transformations.nonlinear_terms import NonlinearTerms
from obsynth.proofs.extended_balls import Enclosed
from obsynth.proofs.slope_blocks import SlopeBlock
from obsynth.proofs.vertex_inequalities import Proved, Vertex, Witness, prove_decay
from obsynth.verification.error_polytope import driven_by

#: What a difference and a sum of two numbers are rounded by: the middle of bounds and half their width hold them.
_HALF_ROOM = 1.0 + 8.0 * float(np.finfo(np.float64).eps)
#: The slowest rate that is looked for, as a share of the fastest there could be: levels of oil fields and gyroscopes
#: stand in one model.
_SLOWEST_SHARE = 2.0**-60
#: Where the search for a rate ends: the next one that was tried is this much faster.
_NEAR = 1.001


def directions(terms: NonlinearTerms, slopes: Sequence[Slope]) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return w ``(n, q)``, w_y ``(ny, q)`` and v ``(q, n)`` of every slope."""
    W = np.column_stack([terms.W[:, each.nonlinearity] for each in slopes] or [np.zeros((len(terms.A), 0))])
    Wy = np.column_stack([terms.Wy[:, each.nonlinearity] for each in slopes] or [np.zeros((len(terms.C), 0))])
    V = np.array([terms.state_parts[each.argument] for each in slopes]).reshape(len(slopes), len(terms.A))
    return W, Wy, V


def corners_of(bounds: FloatArray) -> list[FloatArray]:
    """Return the corners ``(q,)`` of bounds ``(q, 2)``; the last slope changes first."""
    return [np.array(corner) for corner in itertools.product(*bounds)]


def whole_gain(terms: NonlinearTerms, gain: FloatArray) -> FloatArray:
    """Return the gain ``(n, ny)`` of all equations: none in the algebraic ones."""
    return np.vstack([gain, np.zeros((len(terms.A) - len(gain), gain.shape[1]))])


def corner_errors(
    terms: NonlinearTerms,
    slopes: Sequence[Slope],
    bounds: FloatArray,
    gain: FloatArray,
    drive: tuple[FloatArray, FloatArray, FloatArray],
) -> list[Vertex] | SlopeBlock:
    """Return how the error system is formed at each corner of the slopes; of many slopes that of the middle, with them.

    ``drive``: B ``(n, p)`` and D ``(ny, p)`` of the noise, and the errors that count, Cz ``(q, n)``.
    """
    W, Wy, V = directions(terms, slopes)
    B, D, Cz = drive
    L = whole_gain(terms, gain)

    def vertex_at(corner: FloatArray) -> Vertex:
        def vertex(kind: type[Enclosed]) -> tuple[Enclosed, Enclosed, Enclosed, Enclosed]:
            exact = kind.exact
            shipped, slope = exact(L), exact(np.diag(corner))
            into = exact(W) - shipped @ exact(Wy)
            M = exact(terms.A) - shipped @ exact(terms.C)
            if len(corner):
                M = M + into @ (slope @ exact(V))
            return M, driven_by(kind, B, L, D), exact(Cz), exact(np.zeros((len(Cz), B.shape[1])))

        return vertex

    if len(slopes) <= MOST_CORNER_SLOPES:
        return [vertex_at(corner) for corner in corners_of(bounds)]
    middle, half = middle_and_half(bounds)

    def into_and_out(kind: type[Enclosed]) -> tuple[Enclosed, Enclosed]:
        exact = kind.exact
        return (exact(W) - exact(L) @ exact(Wy)) @ exact(np.diag(half)), exact(V)

    return SlopeBlock(vertex_at(middle), into_and_out, len(slopes))


def middle_and_half(bounds: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return the middles ``(q,)`` of bounds ``(q, 2)`` and half their widths: rounded so that they hold the bounds."""
    middle = 0.5 * (bounds[:, 0] + bounds[:, 1])
    half = np.maximum(bounds[:, 1] - middle, middle - bounds[:, 0]) * _HALF_ROOM
    return middle, np.nextafter(half, np.inf)


def fastest_decay(vertices: Proved, witness: Witness, limit: float) -> float:
    """Return a rate near the fastest that a certificate proves, by halving on a scale of logarithms; 0 without any."""
    low, high = limit * _SLOWEST_SHARE, limit
    if not prove_decay(vertices, witness, low, discrete=False).proved:
        return 0.0
    while high > _NEAR * low:
        middle = float(np.sqrt(low) * np.sqrt(high))
        if prove_decay(vertices, witness, middle, discrete=False).proved:
            low = middle
        else:
            high = middle
    return low
