r"""Bernstein form on pieces of [0, 1]: weights that give the coefficients of products and derivatives.

A polynomial :math:`P(t) = \sum_j {d \choose j} t^j (1 - t)^{d - j} P_j` lies, on an interval, in the convex hull of its
coefficients there: a matrix polynomial whose coefficients on every piece are positive definite is so on [0, 1].  All
weights here are exact in double precision: whole numbers over powers of two.

Reference: Farouki, *The Bernstein polynomial basis: a centennial retrospective*, Comput. Aided Geom. Des. 29 (2012).
"""

from __future__ import annotations

from dataclasses import dataclass
from math import comb

import numpy as np

from obsynth.errors import SpecError
from obsynth.numerics.arrays import FloatArray

#: Beyond these the weights would be rounded.
MOST_PIECES, MOST_DEGREE = 64, 5


@dataclass(frozen=True, eq=False)
class ProductCoefficient:
    """One coefficient, on one piece, of what is of degree ``d + 1``; all weights are multiplied by ``scale``.

    Parameters
    ----------
    low, high : FloatArray
        ``(d + 1,)``: ``P(t) (M0 (1 - t) + M1 t)`` has ``sum low_j P_j M0 + high_j P_j M1``.
    slope : FloatArray
        ``(d + 1,)``: the derivative of P has ``sum slope_j P_j``.
    ends : FloatArray
        ``(2,)``: ``M0 (1 - t) + M1 t`` has ``ends_0 M0 + ends_1 M1``.
    scale : float
        What one has.
    place : str
        In words.
    """

    low: FloatArray
    high: FloatArray
    slope: FloatArray
    ends: FloatArray
    scale: float
    place: str


def product_coefficients(degree: int, pieces: int) -> list[ProductCoefficient]:
    """Return the weights of all coefficients of degree ``degree + 1`` on equal pieces of [0, 1].

    Parameters
    ----------
    degree : int
        d, 0 to 5.
    pieces : int
        A power of two, to 64.

    Raises
    ------
    SpecError
        Degree or pieces are others.
    """
    _require(degree, pieces)
    d, k = degree, np.arange(degree + 2)
    low, high = np.zeros((d + 2, d + 1)), np.zeros((d + 2, d + 1))
    low[k[:-1], k[:-1]] = d + 1 - k[:-1]
    high[k[1:], k[:-1]] = k[1:]
    # The derivative, raised once to degree d.
    slope = np.zeros((d + 1, d + 1))
    for i in range(d + 1):
        if i > 0:
            slope[i, i - 1] -= i
            slope[i, i] += i
        if i < d:
            slope[i, i + 1] += d - i
            slope[i, i] -= d - i
    ends = np.column_stack([d + 1 - k, k]).astype(np.float64)
    coefficients = []
    for piece in range(pieces):
        for place, row in enumerate(_subdivision(d + 1, piece, pieces)):
            weights = row @ low, row @ high, row @ (low + high) @ slope, row @ ends
            where = f"piece {piece + 1} of {pieces}, coefficient {place + 1}"
            coefficients.append(ProductCoefficient(*weights, float(d + 1), where))
    return coefficients


def coefficients_on_pieces(degree: int, pieces: int) -> list[tuple[str, FloatArray]]:
    """Return place and weights ``(degree + 1,)`` of the coefficients of a polynomial on equal pieces of [0, 1].

    Parameters
    ----------
    degree, pieces : int
        As for `product_coefficients`.
    """
    _require(degree, pieces)
    return [
        (f"piece {piece + 1} of {pieces}, coefficient {place + 1}", row)
        for piece in range(pieces)
        for place, row in enumerate(_subdivision(degree, piece, pieces))
    ]


def _require(degree: int, pieces: int) -> None:
    if not 0 <= degree <= MOST_DEGREE:
        raise SpecError(f"degree is {degree}: give 0 to {MOST_DEGREE}.", path="degree")
    if not 1 <= pieces <= MOST_PIECES or pieces & (pieces - 1):
        raise SpecError(f"pieces is {pieces}: give a power of two, up to {MOST_PIECES}.", path="pieces")


def _subdivision(degree: int, piece: int, pieces: int) -> FloatArray:
    """Return the weights ``(degree + 1, degree + 1)`` by which coefficients on a piece are means of those on [0, 1]."""
    first, last = piece / pieces, (piece + 1) / pieces
    # The blossom of the Bernstein basis: coefficient k on [a, b] takes d - k arguments a and k arguments b.
    rows = np.zeros((degree + 1, degree + 1))
    for k in range(degree + 1):
        rows[k] = np.convolve(_powers(degree - k, first), _powers(k, last))
    return rows


def _powers(count: int, t: float) -> FloatArray:
    """Return the Bernstein polynomials of a degree at t."""
    return np.array([comb(count, j) * t**j * (1.0 - t) ** (count - j) for j in range(count + 1)])
