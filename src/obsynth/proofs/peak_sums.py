r"""Sums over all time of what a system makes of its inputs, from above, every rounding accounted for.

``c_{j+1} = fl(c_j M)`` misses ``c_j M`` by a known defect; with a proved `Contraction` all later terms gain no more
than ``sum |defect Q^-1| |Q b| / (1 - rate)``, and what follows the last computed one is that of ``|c_N Q^-1|``.
``\int_0^h |g(s)| ds`` of ``g(s) = c M^j e^{A s} b`` is the trapezoidal sum over p pieces, ``p d = h``, plus
``d^3 / 12`` times the largest second derivative of each: at most that at its left end plus d times the largest third,
which the contraction bounds.
"""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import numpy as np

from obsynth.numerics.arrays import FloatArray
from obsynth.numerics.scaling import balanced_matrix
from obsynth.proofs.balls import UNDERFLOW, Ball, gamma, rounded_up
from obsynth.proofs.contraction import Contraction
from obsynth.proofs.products import exponential

#: Most steps that are summed up one by one, and the share of the sum that the rest may then have.
MOST_SUMMED_STEPS, LEFT_OF_SUM = 65_536, 1e-3
#: Steps that are taken together; what is left is looked at when their number has grown by one in so many.
STEPS_AT_ONCE, LOOKS = 64, 8
#: A piece of an interval is at most this share of one over the norm of A; most pieces.
NORM_PIECE, MOST_PIECES = 0.05, 1_024
#: More than the square root of what underflows in a square.
LOST_SQUARES = 2.0**-510
#: Length of an interval in units of one over the norm of A, and the largest order, for gains in continuous time.
LENGTH, MOST_CONTINUOUS_STATES = 0.4, 12
#: Share of such a gain that the rest may have, and most steps towards it: what it bounds is a rounding, and slow modes
#: would take a hundred thousand.
LEFT_OF_GAINS, MOST_STEPS_OF_GAINS = 0.05, 1_024


def peak_sums(
    matrix: Ball,
    rows: FloatArray,
    columns: Ball,
    contraction: Contraction,
    *,
    least: int = 0,
    left: float = LEFT_OF_SUM,
    each: bool = False,
    most: int = MOST_SUMMED_STEPS,
) -> tuple[FloatArray, FloatArray]:
    """Return bounds on the sums over j of ``|c M^j b|`` (Euclidean; ``each``: by row) of columns ``b``, ``c (p, n)``.

    A column per input: on terms ``0 .. k``, ``(steps, ..., m)``, and on all of them, ``(..., m)``.

    From ``least`` to ``most`` terms, in blocks of 64, until the rest is bounded by the share ``left``.
    """
    moving, n, growth = matrix.midpoint, len(matrix.midpoint), gamma(len(matrix.midpoint) + 2)
    driven, sizes = columns.midpoint, contraction.sizes(columns.midpoint, columns.radius)
    powers, idle = np.array(rows, dtype=np.float64), ~driven.any(axis=0)
    terms, looked = list[FloatArray](), 1
    collected = np.zeros_like(powers)
    total: FloatArray | float = 0.0
    while True:
        block, powers = _block(powers, moving)
        # Products of many rows at once: one step after the other would take most of its time in Python.
        products = np.abs(block @ driven)
        terms.append(products if each else _norms(products))
        total, collected = total + np.sum(terms[-1], axis=0), collected + np.sum(np.abs(block), axis=0)
        done = STEPS_AT_ONCE * len(terms) >= max(most, least)
        if done or (STEPS_AT_ONCE * len(terms) >= least and len(terms) >= looked):
            looked = len(terms) + len(terms) // LOOKS + 1
            after = contraction.factor * _seen(contraction, powers, _missed(matrix, np.abs(block[-1]), growth), each)
            after = np.asarray(after * sizes)
            # A column that is nothing but its radius has no terms to compare with.
            if done or np.all((after <= left * total) | idle):
                break
    every = np.concatenate(terms)
    count = len(every) + 8
    # Every defect of the rows, and what the columns are off by, in the norm that contracts: sums of norms are at most
    # the sums of all entries.
    defects = rounded_up(_missed(matrix, collected, growth), 3 * n + count)
    added = contraction.factor * _seen(contraction, np.zeros_like(rows), defects, each, summed=True) * sizes
    products = rounded_up(growth * (collected @ np.abs(driven)) + count * n * UNDERFLOW, 3 * n + count)
    known = collected @ columns.radius if columns.radius.any() else np.zeros_like(products)
    products = rounded_up(products + known, n + count)
    added = rounded_up(added + (products if each else np.sum(products, axis=0)), len(rows) + 6)
    partial = rounded_up(np.cumsum(every, axis=0), count + 2 * len(rows) + 10) + added
    return rounded_up(partial, 4), rounded_up(partial[-1] + after, 6)


def _block(rows: FloatArray, moving: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return rows ``(p, n)`` moved zero times and more, ``(steps, p, n)``, and moved once more than the last."""
    found = np.empty((STEPS_AT_ONCE, *rows.shape))
    found[0] = rows
    for i in range(1, STEPS_AT_ONCE):
        np.matmul(found[i - 1], moving, out=found[i])
    return found, found[-1] @ moving


def _missed(matrix: Ball, sizes: FloatArray, growth: float) -> FloatArray:
    """Return what products of rows of these sizes with the midpoint miss of those with any member."""
    n = len(matrix.midpoint)
    return np.asarray(growth * (sizes @ np.abs(matrix.midpoint)) + sizes @ matrix.radius + n * UNDERFLOW)


def _seen(
    contraction: Contraction, rows: FloatArray, radius: FloatArray, each: bool, *, summed: bool = False
) -> FloatArray:
    """Return bounds on ``|c Q^-1|``: of each row as a column, or of all; with ``summed`` those of sums of rows."""
    if each:
        return np.array([contraction.seen(rows[i : i + 1], radius[i : i + 1], summed) for i in range(len(rows))])[
            :, None
        ]
    return np.array(contraction.seen(rows, radius, summed))


def _norms(sizes: FloatArray) -> FloatArray:
    """Return Euclidean norms of columns, up to roundings that the caller counts; what squares lose is added."""
    return np.asarray(np.sqrt(np.sum(sizes * sizes, axis=-2)) + sizes.shape[-2] * LOST_SQUARES)


class Pieces(NamedTuple):
    """Columns ``(n, k)`` whose weighted norms bound the integral over an interval of what ``inputs (k,)`` do."""

    columns: Ball
    weights: FloatArray
    inputs: np.ndarray


def interval_pieces(a: FloatArray, b: FloatArray, into: Ball, length: float) -> Pieces:
    """Return the pieces of ``into e^{A s} b``, s from 0 to ``length``: ``a (n, n)``, ``b (n, m)``, ``into (k, n)``."""
    norm = _natural_norm(a)
    count = int(np.clip(np.ceil(length * norm / NORM_PIECE), 1, MOST_PIECES))
    step, m = length / count, b.shape[1]
    transition, ball_a = exponential(a, step), Ball.exact(a)
    at = Ball.exact(b)
    first = ball_a @ (ball_a @ Ball.exact(b))
    growth = _growth(a, step)
    third = growth @ (ball_a @ first).magnitude
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
            third = growth @ (ball_a @ first).magnitude
    # What is left, of any sign, in every coordinate at once: as many columns as coordinates.
    rest = Ball(np.zeros((into.shape[0], m)), rounded_up(into.magnitude @ largest, 2 * len(a) + 6))
    parts.append(rest)
    weights.append(count * step**4 / 12.0)
    joined = Ball(np.hstack([part.midpoint for part in parts]), np.hstack([part.radius for part in parts]))
    scale = rounded_up(np.repeat(np.array(weights), m), 6)
    return Pieces(joined, scale, np.tile(np.arange(m), len(parts)))


def _natural_norm(a: FloatArray) -> float:
    """Return the norm of a matrix in units that balance it: how fast its motions are, whatever their units."""
    return float(np.linalg.norm(balanced_matrix(a)[0], 2)) if a.size else 0.0


def _growth(a: FloatArray, step: float) -> FloatArray:
    """Return an upper bound on ``|e^{A s}|``, entry by entry, for s up to ``step``."""
    return exponential(np.abs(a), step).magnitude


def gathered(pieces: Pieces, sums: FloatArray, inputs: int) -> FloatArray:
    """Return the bound of each input, ``(..., inputs)``, from the sums ``(..., k)`` of all pieces."""
    weighted = sums * pieces.weights
    found = np.stack([np.sum(weighted[..., pieces.inputs == i], axis=-1) for i in range(inputs)], axis=-1)
    return np.asarray(rounded_up(found, len(pieces.weights) + 4))


def absolute_gains(a: FloatArray, rows: FloatArray, contraction: Contraction) -> FloatArray:
    """Return upper bounds on ``sum_j |c A^j|`` (the integral of ``|c e^{A t}|``), entry by entry, for ``c (p, n)``."""
    n = len(a)
    loose = contraction.gain(rows, np.eye(n))
    if not n or (not contraction.discrete and n > MOST_CONTINUOUS_STATES):
        return loose
    if contraction.discrete:
        moving, columns, gather = Ball.exact(a), Ball.exact(np.eye(n)), None
        held: Contraction | None = contraction
    else:
        length = LENGTH / _natural_norm(a)
        gather = interval_pieces(a, np.eye(n), Ball.exact(np.eye(n)), length)
        moving, columns = exponential(a, length), gather.columns
        # The contraction in continuous time is one of its samples as well.
        rate = float(rounded_up(np.exp(-contraction.rate * length), 4))
        held = replace(contraction, rate=rate, discrete=True) if rate < 1.0 else None
    if held is None:
        return loose
    whole = peak_sums(moving, rows, columns, held, left=LEFT_OF_GAINS, each=True, most=MOST_STEPS_OF_GAINS)[1]
    return np.asarray(np.minimum(loose, whole if gather is None else gathered(gather, whole, n)))
