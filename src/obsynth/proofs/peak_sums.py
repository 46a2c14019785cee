r"""Upper bounds on sums over all time of impulse responses, with all rounding bounded.

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

from obsynth.numerics.arrays import FloatArray, largest_singular_value, read_only, remembered
from obsynth.numerics.scaling import balanced_matrix
from obsynth.proofs.balls import UNDERFLOW, Ball, gamma, rounded_up
from obsynth.proofs.contraction import Contraction
from obsynth.proofs.products import exponential

#: Most steps that are summed one by one, and the largest share of the sum that the remaining ones may then have.
MOST_SUMMED_STEPS, REMAINDER_OF_SUM = 65_536, 1e-3

#: Steps of one block; the remainder is bounded again when the number of blocks has grown by one in so many.
BLOCK_STEPS, BLOCKS_PER_CHECK = 64, 8

#: Largest length of a piece of an interval, as a share of one over the norm of A; most pieces.
NORM_PIECE, MOST_PIECES = 0.05, 1_024

#: Above the square root of the largest number whose square underflows.
SQRT_UNDERFLOW = 2.0**-510

#: Length of an interval in units of one over the norm of A, and the largest order, for gains in continuous time.
LENGTH, MOST_CONTINUOUS_STATES = 0.4, 12

#: Share of such a gain that the rest may have, and most steps towards it: what it bounds is a rounding, and slow modes
#: would take a hundred thousand.
REMAINDER_OF_GAINS, MOST_STEPS_OF_GAINS = 0.05, 1_024

#: Most steps for given columns, where another machine's bound is to be found again, whatever its contraction was.
MOST_STEPS_OF_COLUMNS = 2_048


def peak_sums(
    matrix: Ball,
    rows: FloatArray,
    columns: Ball,
    contraction: Contraction,
    *,
    least: int = 0,
    relative_remainder: float = REMAINDER_OF_SUM,
    each: bool = False,
    most: int = MOST_SUMMED_STEPS,
) -> tuple[FloatArray, FloatArray]:
    """Return bounds on the sums over j of ``|c M^j b|`` (Euclidean; ``each``: by row) of columns ``b``, ``c (p, n)``.

    A column per input: on terms ``0 .. k``, ``(steps, ..., m)``, and on all of them, ``(..., m)``.

    From ``least`` to ``most`` terms, in blocks of 64, until the rest is bounded by the share ``relative_remainder``.
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
        done = BLOCK_STEPS * len(terms) >= max(most, least)
        if done or (BLOCK_STEPS * len(terms) >= least and len(terms) >= looked):
            looked = len(terms) + len(terms) // BLOCKS_PER_CHECK + 1
            after = contraction.factor * _row_norms(
                contraction, powers, _missed(matrix, np.abs(block[-1]), growth), each
            )
            after = np.asarray(after * sizes)
            # A column that is nothing but its radius has no terms to compare with.
            if done or np.all((after <= relative_remainder * total) | idle):
                break
    every = np.concatenate(terms)
    count = len(every) + 8
    # Every defect of the rows, and what the columns are off by, in the norm that contracts: sums of norms are at most
    # the sums of all entries.
    defects = rounded_up(_missed(matrix, collected, growth), 3 * n + count)
    added = contraction.factor * _row_norms(contraction, np.zeros_like(rows), defects, each, summed=True) * sizes
    products = rounded_up(growth * (collected @ np.abs(driven)) + count * n * UNDERFLOW, 3 * n + count)
    known = collected @ columns.radius if columns.radius.any() else np.zeros_like(products)
    products = rounded_up(products + known, n + count)
    added = rounded_up(added + (products if each else np.sum(products, axis=0)), len(rows) + 6)
    partial = rounded_up(np.cumsum(every, axis=0), count + 2 * len(rows) + 10) + added
    return rounded_up(partial, 4), rounded_up(partial[-1] + after, 6)


def _block(rows: FloatArray, moving: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return rows ``(p, n)`` moved zero times and more, ``(steps, p, n)``, and moved once more than the last."""
    moved = np.empty((BLOCK_STEPS, *rows.shape))
    moved[0] = rows
    for i in range(1, BLOCK_STEPS):
        np.matmul(moved[i - 1], moving, out=moved[i])
    return moved, moved[-1] @ moving


def _missed(matrix: Ball, sizes: FloatArray, growth: float) -> FloatArray:
    """Return what products of rows of these sizes with the midpoint miss of those with any member."""
    n = len(matrix.midpoint)
    return np.asarray(growth * (sizes @ np.abs(matrix.midpoint)) + sizes @ matrix.radius + n * UNDERFLOW)


def _row_norms(
    contraction: Contraction, rows: FloatArray, radius: FloatArray, each: bool, *, summed: bool = False
) -> FloatArray:
    """Return bounds on ``|c Q^-1|``: of each row as a column, or of all; with ``summed`` those of sums of rows."""
    if each:
        return np.array([contraction.row_norm(rows[i : i + 1], radius[i : i + 1], summed) for i in range(len(rows))])[
            :, None
        ]
    return np.array(contraction.row_norm(rows, radius, summed))


def _norms(sizes: FloatArray) -> FloatArray:
    """Return Euclidean norms of columns, up to roundings that the caller counts; what squares lose is added."""
    return np.asarray(np.sqrt(np.sum(sizes * sizes, axis=-2)) + sizes.shape[-2] * SQRT_UNDERFLOW)


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
    remainder = Ball(np.zeros((into.shape[0], m)), rounded_up(into.magnitude @ largest, 2 * len(a) + 6))
    parts.append(remainder)
    weights.append(count * step**4 / 12.0)
    joined = Ball(np.hstack([part.midpoint for part in parts]), np.hstack([part.radius for part in parts]))
    scale = rounded_up(np.repeat(np.array(weights), m), 6)
    return Pieces(joined, scale, np.tile(np.arange(m), len(parts)))


def _natural_norm(a: FloatArray) -> float:
    """Return the norm of a matrix in units that balance it: how fast its motions are, whatever their units."""
    return largest_singular_value(balanced_matrix(a)[0]) if a.size else 0.0


def _growth(a: FloatArray, step: float) -> FloatArray:
    """Return an upper bound on ``|e^{A s}|``, entry by entry, for s up to ``step``."""
    return exponential(np.abs(a), step).magnitude


def gathered(pieces: Pieces, sums: FloatArray, inputs: int) -> FloatArray:
    """Return the bound of each input, ``(..., inputs)``, from the sums ``(..., k)`` of all pieces."""
    weighted = sums * pieces.weights
    bounds = np.stack([np.sum(weighted[..., pieces.inputs == i], axis=-1) for i in range(inputs)], axis=-1)
    return np.asarray(rounded_up(bounds, len(pieces.weights) + 4))


def absolute_gains(
    a: FloatArray, rows: FloatArray, contraction: Contraction, columns: Ball | None = None
) -> FloatArray:
    """Return upper bounds on ``sum_j |c A^j b|`` (the integral of ``|c e^{A t} b|``), for ``c (p, n)``: ``(p, m)``.

    ``b`` are the unit vectors, or ``columns (n, m)``.  Bounds hang on the contraction by what is left of the sum alone:
    where it settles, by `REMAINDER_OF_GAINS` at most, of given columns by `REMAINDER_OF_SUM`."""
    if columns is not None:
        return _absolute_gains(a, rows, contraction, columns)
    # The same sums are asked for on the way to several rows of a report.
    known = _known_gains(contraction)
    for matrix, others, gains in known:
        if np.array_equal(matrix, a) and np.array_equal(others, rows):
            return gains
    known.append((a, rows, read_only(_absolute_gains(a, rows, contraction, None))))
    return known[-1][2]


@remembered
def _known_gains(_contraction: Contraction) -> list[tuple[FloatArray, FloatArray, FloatArray]]:
    """Return matrices, rows and sums of unit vectors under a contraction, as far as they were asked for."""
    return []


def _absolute_gains(a: FloatArray, rows: FloatArray, contraction: Contraction, columns: Ball | None) -> FloatArray:
    n, has_columns = len(a), columns is not None
    into = Ball.exact(np.eye(n)) if columns is None else columns
    loose = contraction.gain(rows, into.midpoint, into.radius)
    if not loose.size or not n or (not contraction.discrete and n > MOST_CONTINUOUS_STATES):
        return loose
    relative_remainder, most = (
        (REMAINDER_OF_SUM, MOST_STEPS_OF_COLUMNS) if has_columns else (REMAINDER_OF_GAINS, MOST_STEPS_OF_GAINS)
    )
    if contraction.discrete:
        return np.asarray(
            np.minimum(
                loose,
                peak_sums(
                    Ball.exact(a), rows, into, contraction, relative_remainder=relative_remainder, each=True, most=most
                )[1],
            )
        )
    length = LENGTH / _natural_norm(a)
    gather = interval_pieces(a, into.midpoint, Ball.exact(np.eye(n)), length)
    # The contraction in continuous time is one of its samples as well.
    rate = float(rounded_up(np.exp(-contraction.rate * length), 4))
    if not rate < 1.0:
        return loose
    sampled = replace(contraction, rate=rate, discrete=True)
    sums = peak_sums(
        exponential(a, length),
        rows,
        gather.columns,
        sampled,
        relative_remainder=relative_remainder,
        each=True,
        most=most,
    )[1]
    bounds = gathered(gather, sums, loose.shape[1])
    if has_columns and into.radius.any():
        bounds = rounded_up(bounds + contraction.gain(rows, np.zeros_like(into.radius), into.radius), 2)
    return np.asarray(np.minimum(loose, bounds))
