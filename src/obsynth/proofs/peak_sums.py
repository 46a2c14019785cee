r"""Sums over all time of what a system makes of its inputs, from above, every rounding accounted for.

``v_{j+1} = fl(M v_j)`` misses ``M v_j`` by a defect that is known; with a proved contraction (`Contraction`) the defects
add no more than ``|c Q^-1| sum |Q defect| / (1 - rate)`` to all later terms together, and what follows the last term
that is computed no more than that of ``|Q v_N|``.

Where an input acts for an interval of length h, ``\int_0^h |g(s)| ds`` of ``g(s) = c M^j e^{A s} b`` is the trapezoidal
sum over p pieces of length ``p d = h``, plus ``d^3 / 12`` times the largest second derivative of each piece; that is at
most its value at the left end plus d times the largest third derivative, which the contraction bounds.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from obsynth.numerics.arrays import FloatArray
from obsynth.proofs.balls import UNDERFLOW, Ball, gamma, rounded_up
from obsynth.proofs.contraction import Contraction
from obsynth.proofs.exponentials import exponential

#: Most steps that are summed up one by one, and the share of the sum that the rest may then have.
MOST_STEPS, LEFT = 16_384, 1e-4
#: A piece of an interval is at most this share of one over the norm of A; most pieces.
PIECE, MOST_PIECES = 0.05, 1_024


class PeakSums(NamedTuple):
    """Upper bounds on partial and whole sums of norms, one column for each input.

    ``partial (steps, m)`` holds the terms ``0 .. k``, ``whole (m,)`` all of them.
    """

    partial: FloatArray
    whole: FloatArray


def peak_sums(matrix: Ball, rows: FloatArray, columns: Ball, contraction: Contraction, *, least: int = 0) -> PeakSums:
    """Return bounds on the sums over j of ``|c M^j b|`` (Euclidean) of every column ``b``, for ``c (p, n)``.

    At least ``least`` terms are summed up one by one.
    """
    moving, size, n = matrix.midpoint, np.abs(matrix.midpoint), len(matrix.midpoint)
    held, growth = columns.midpoint.copy(), gamma(n + 2)
    shown, seen = np.abs(rows), contraction.seen(rows)
    # What the columns themselves are off by, and every defect later, in the norm that contracts.
    missed = contraction.sizes(np.zeros_like(held), columns.radius)
    total, terms = np.zeros(held.shape[1]), []
    while True:
        product = rows @ held
        rounding = growth * (shown @ np.abs(held)) + n * UNDERFLOW
        terms.append(_norms(np.abs(product) + rounding))
        total = total + terms[-1]
        if len(terms) >= max(least, 1) and (len(terms) % 64 == 0 or len(terms) >= MOST_STEPS or not held.any()):
            rest = seen * contraction.factor * contraction.sizes(moving @ held, growth * (size @ np.abs(held)))
            if len(terms) >= max(MOST_STEPS, least) or np.all(rest <= LEFT * total):
                break
        following = moving @ held
        defect = growth * (size @ np.abs(held)) + matrix.radius @ np.abs(held) + n * UNDERFLOW
        missed = missed + contraction.sizes(np.zeros_like(held), rounded_up(defect, 3 * n + 6))
        held = following
    rest = seen * contraction.factor * contraction.sizes(
        moving @ held, rounded_up(growth * (size @ np.abs(held)) + matrix.radius @ np.abs(held), 3 * n + 8)
    )
    added = seen * contraction.factor * missed
    partial = np.cumsum(np.array(terms), axis=0) + added
    count = len(terms) + 8
    return PeakSums(rounded_up(partial, count), rounded_up(partial[-1] + rest, count))


def _norms(sizes: FloatArray) -> FloatArray:
    """Return Euclidean norms of columns of upper bounds, rounded up."""
    largest = np.max(sizes, axis=0, initial=0.0)
    safe = np.where((largest > 0.0) & np.isfinite(largest), largest, 1.0)
    return np.asarray(rounded_up(safe * np.sqrt(np.sum((sizes / safe) ** 2, axis=0)), 2 * len(sizes) + 10))


class Pieces(NamedTuple):
    """Columns whose weighted norms, summed up, bound the integral over an interval of what inputs do.

    ``columns (n, k)``, ``weights (k,)``, ``inputs (k,)``: to which input a column belongs.
    """

    columns: Ball
    weights: FloatArray
    inputs: np.ndarray


def interval_pieces(a: FloatArray, b: FloatArray, into: Ball, length: float) -> Pieces:
    """Return the pieces of ``into e^{A s} b``, s from 0 to ``length``, for ``a (n, n)``, ``b (n, m)``, ``into (k, n)``."""
    norm = float(np.linalg.norm(a, 2)) if a.size else 0.0
    count = int(np.clip(np.ceil(length * norm / PIECE), 1, MOST_PIECES))
    step, m = length / count, b.shape[1]
    transition, ball_a = exponential(a, step), Ball.exact(a)
    at = Ball.exact(b)
    first = ball_a @ (ball_a @ Ball.exact(b))
    third = _growth(a, step) @ np.abs(_upper(ball_a @ first))
    parts: list[Ball] = []
    weights: list[float] = []
    largest = np.zeros_like(b)
    for i in range(count + 1):
        parts.append(into @ at)
        weights.append(step * (0.5 if i in (0, count) else 1.0))
        if i < count:
            parts.append(into @ first)
            weights.append(step**3 / 12.0)
            largest = np.maximum(largest, third)
            at, first = transition @ at, transition @ first
            third = _growth(a, step) @ _upper(ball_a @ first)
    # What is left, of any sign, in every coordinate at once: as many columns as coordinates.
    rest = Ball(np.zeros((into.shape[0], m)), rounded_up(_upper(into) @ largest, 2 * len(a) + 6))
    parts.append(rest)
    weights.append(count * step**4 / 12.0)
    joined = Ball(np.hstack([part.midpoint for part in parts]), np.hstack([part.radius for part in parts]))
    scale = rounded_up(np.repeat(np.array(weights), m), 6)
    return Pieces(joined, scale, np.tile(np.arange(m), len(parts)))


def _growth(a: FloatArray, step: float) -> FloatArray:
    """Return an upper bound on ``|e^{A s}|``, entry by entry, for s up to ``step``."""
    return _upper(exponential(np.abs(a), step))


def _upper(ball: Ball) -> FloatArray:
    return np.asarray(rounded_up(np.abs(ball.midpoint) + ball.radius, 2))


def gathered(pieces: Pieces, sums: FloatArray, inputs: int) -> FloatArray:
    """Return the bound of each input, ``(..., inputs)``, from the sums ``(..., k)`` of all pieces."""
    weighted = sums * pieces.weights
    found = np.stack([np.sum(weighted[..., pieces.inputs == i], axis=-1) for i in range(inputs)], axis=-1)
    return np.asarray(rounded_up(found, len(pieces.weights) + 4))
