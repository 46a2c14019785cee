r"""Integrals of the absolute value of a response over an interval, as sums of absolute values, for all rows at once.

.. math::
    \int_0^h |c\, e^{A s} b|\, ds \le \sum_j |c\, v_j| + |c|\, r \qquad \text{for every row } c

Over a piece of length w, a straight line between the ends has an absolute value of at most that of the trapezoidal
rule.  What is left is :math:`\int \frac{t (w - t)}{2} |c\, A^2 e^{A t} b|\, dt`, again such an integral, with a weight:
it is bounded in the same way, and what that leaves, of fourth order, by the largest entries.  So nothing loses its sign
but the last remainder: the bound is as tight for rows to which b is nearly invisible as for others.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple

import flint
import numpy as np

from obsynth.numerics.arrays import FloatArray
from obsynth.numerics.scaling import balanced_matrix
from obsynth.proofs.affine import AffineMatrix, affine_exponential, affine_inverse
from obsynth.proofs.balls import Ball, rounded_up
from obsynth.proofs.contraction import Contraction, column_norms, prove_contraction
from obsynth.proofs.extended_balls import arb_matrix
from obsynth.proofs.products import as_ball, exponential

#: An interval is cut at least into so many pieces, and into no more than so many times these.
LEAST_PIECES, MOST_TIMES = 16, 8

#: Pieces are halved until curvature adds no more than this share to what a mode does in the interval.
CURVATURE_SHARE = 1e-2

#: The last remainder, entry by entry, is taken for so many times what it is for rows of one mode alone.
LOOSENESS = 10.0

#: Pieces of one length that share the columns of their second derivatives.
SHARED_PIECES = 4

#: A mode that may grow, or decays slowly, is bounded over a piece after so fast a decay, per interval, is added.
ADDED_DECAY = 0.1

#: Modes that a column excites by less than this share of the others have no say in how an interval is cut.
UNMOVED_MODE = 1e-9

#: Modes are rounded to so many bits before they decide, so that every machine cuts in the same places.
MODE_BITS = 10

#: Condition of eigenvectors, in balanced units, up to which they serve as coordinates.
MOST_DEPENDENT = 1e6

#: Bits in which motions of a plant without tolerances are followed, and the most states for it.
BITS_OF_MOTIONS, PRECISE_MOTIONS_UP_TO = 256, 40

#: Covers the rounding of the largest eigenvalue of a symmetric matrix of two rows, as a share of its entries.
GROWTH_ROUNDING = 1e-14

#: Covers the rounding of a weight, a sum of a few products.
ROUNDED = 1.0 + 1e-14


class IntervalColumns(NamedTuple):
    """``int |c e^{A s} b_i| ds <= sum_j |c v_ji| + sum_k |c t_k| rest_ki``: blocks of one time each ``(n, m)``, and a
    remainder of any sign: directions ``(n, n)`` and sizes ``(n, m)``."""

    blocks: list[AffineMatrix]
    directions: FloatArray
    rest: FloatArray


def interval_columns(
    a: AffineMatrix, b: AffineMatrix, length: float, *, pieces: int = LEAST_PIECES, shared: int = SHARED_PIECES
) -> IntervalColumns:
    """Return what bounds ``int_0^length |c e^{A s} b_i| ds``, for every row c and every member of the families.

    Parameters
    ----------
    a, b : AffineMatrix
        ``A (n, n)``, ``b (n, m)``: with unknowns that are the same over the interval.
    length : float
        Of the interval.
    pieces : int, optional
        Into which it is cut at least: with p of them the bound is above the integral by about ``1 / p^2``.
    shared : int, optional
        So many neighbouring pieces share the columns of their second derivatives.

    Returns
    -------
    IntervalColumns
        For several inputs at once, of which the weighted squares stay below one at
        each time, the columns of a block belong together: the same holds with ``|c v_j|`` as a norm.
    """
    cuts = halvings(a.center, b.center, length, pieces=pieces, shared=shared)
    modes = _modes(a, length, apart=len(set(cuts)) > 1)
    widths = [length * 2.0 ** -int(level) for level in cuts]
    reached = _reached_states(a, b)
    nodes, second, fourth = (
        [_within(matrix, reached) for matrix in ones] for ones in zip(*_motions(a, b, widths), strict=True)
    )
    blocks = [
        node.scaled(0.5 * (before + after) * ROUNDED)
        for node, before, after in zip(nodes, [0.0, *widths], [*widths, 0.0], strict=True)
    ]
    weights, rest = np.zeros(len(nodes)), np.zeros(b.shape)
    for first, last in _groups(cuts, shared):
        # In units of the pieces of this group, which all have one length: masses w^3 / 12 at their middles.
        width, count = widths[first], last - first
        middles = np.arange(count) + 0.5
        mass = width**3 / 12.0
        weights[last] += mass * float(middles.sum()) / count
        weights[first] += mass * float((count - middles).sum()) / count
        fourth_order = mass * width**2 * float((middles * (count - middles)).sum()) / 2.0
        largest = modes.largest(fourth[first], width * count)
        rest += rounded_up(fourth_order * largest, 12)
    blocks += [block.scaled(weight * ROUNDED) for block, weight in zip(second, weights, strict=True) if weight]
    rest = rounded_up(rest, len(widths) + 8)
    if np.array_equal(modes.T, np.diag(np.diag(modes.T))):
        rest = np.where(reached, rest, 0.0)
    return IntervalColumns(blocks, modes.T, rest)


def _within(matrix: AffineMatrix, reached: np.ndarray) -> AffineMatrix:
    """Return a matrix whose other entries are zero for want of terms, whatever was rounded up there."""
    return AffineMatrix(
        np.where(reached, matrix.center, 0.0),
        np.where(reached, matrix.parts, 0.0),
        np.where(reached, matrix.radius, 0.0),
    )


def halvings(
    a: FloatArray, b: FloatArray, length: float, *, pieces: int, shared: int = 1, times: int = MOST_TIMES
) -> list[int]:
    """Return how often an interval is halved for each piece of it, first piece first, so that the modes that ``b``
    excites are near straight lines in each: ``pieces`` at least, and at most so many ``times`` these."""
    level = max(int(np.ceil(np.log2(pieces))), 0)
    cuts = [(level, k) for k in range(2**level)]
    values = _excited(a, b)
    while len(cuts) < times * pieces and values.size:
        levels, places = (np.array(part, dtype=np.float64) for part in zip(*cuts, strict=True))
        widths = length * 2.0**-levels
        with np.errstate(over="ignore", invalid="ignore", under="ignore"):
            sizes = np.exp(np.clip(np.outer(places * widths, values.real), -700.0, 700.0))
            total = widths @ sizes
            turns = (widths[:, None] * np.abs(values)) ** 2
            lost = LOOSENESS * (shared * turns) ** 2 / 96.0
            curved = (widths[:, None] * (turns / 12.0 + lost) * sizes / total).max(axis=1)
        if not float(curved.sum()) > CURVATURE_SHARE:
            break
        worst = int(np.argmax(np.round(curved / np.max(curved), MODE_BITS)))
        depth, place = cuts[worst]
        cuts[worst : worst + 1] = [(depth + 1, 2 * place), (depth + 1, 2 * place + 1)]
    return [depth for depth, _ in cuts]


def _excited(a: FloatArray, b: FloatArray) -> np.ndarray:
    """Return the modes that the columns excite, to some bits; all of them where eigenvectors tell nothing."""
    balanced, scale = balanced_matrix(a)
    values, vectors = np.linalg.eig(balanced)
    balanced_b = b / scale[:, None]
    try:
        sizes = np.abs(np.linalg.solve(vectors, balanced_b.astype(complex))).max(axis=1, initial=0.0)
        values = values[sizes > UNMOVED_MODE * np.max(sizes, initial=0.0)]
    except np.linalg.LinAlgError:
        pass
    size = np.abs(values)
    values, size = values[size > 0.0], size[size > 0.0]
    mantissa, exponent = np.frexp(size)
    real = np.round(values.real / size, 3)
    turned = real + 1j * np.sqrt(1.0 - real**2)
    return np.asarray(np.ldexp(np.round(np.ldexp(mantissa, MODE_BITS)), exponent - MODE_BITS) * turned)


def _groups(cuts: list[int], shared: int) -> list[tuple[int, int]]:
    """Return first and last node of neighbouring pieces of one length, at most ``shared`` of them."""
    groups, first = [], 0
    for k in range(1, len(cuts) + 1):
        if k == len(cuts) or cuts[k] != cuts[first] or k - first == shared:
            groups.append((first, k))
            first = k
    return groups


def _reached_states(a: AffineMatrix, b: AffineMatrix) -> np.ndarray:
    """Return which states each column can reach at all ``(n, m)``."""
    moving = (a.magnitude > 0.0).astype(np.float64)
    reached = b.magnitude > 0.0
    for _ in range(len(moving)):
        more = reached | (moving @ reached > 0.0)
        if np.array_equal(more, reached):
            break
        reached = more
    return np.asarray(reached)


def _motions(
    a: AffineMatrix, b: AffineMatrix, widths: list[float]
) -> Iterator[tuple[AffineMatrix, AffineMatrix, AffineMatrix]]:
    """Yield ``e^{A s} b`` at both ends of each piece, with its second and fourth derivatives."""
    certain = a.is_certain and b.is_certain and len(a.center) <= PRECISE_MOTIONS_UP_TO
    # Of fast modes that have decayed nothing is left but rounding, which derivatives would magnify: many bits.
    if not certain:
        moves = {width: _transition(a, width) for width in set(widths)}
        node = b
        for width in [0.0, *widths]:
            node = moves[width] @ node if width else node
            second = a @ (a @ node)
            yield node, second, a @ (a @ second)
        return
    with flint.ctx.workprec(BITS_OF_MOTIONS):
        matrix, vectors = arb_matrix(a.center), arb_matrix(b.center)
        exact = {width: (matrix * flint.arb(width)).exp() for width in set(widths)}
        motions = []
        for width in [0.0, *widths]:
            vectors = exact[width] * vectors if width else vectors
            twice = matrix * (matrix * vectors)
            motions.append((vectors, twice, matrix * (matrix * twice)))
        balls = [tuple(_as_affine(as_ball(part), a.count) for part in parts) for parts in motions]
    for node, second, last in balls:
        yield node, second, last


def _as_affine(ball: Ball, count: int) -> AffineMatrix:
    return AffineMatrix(ball.midpoint, np.zeros((count, *ball.shape)), ball.radius)


def _transition(a: AffineMatrix, width: float) -> AffineMatrix:
    """Return ``e^{A w}``."""
    return (
        affine_exponential(a.scaled(width)) if not a.is_certain else _as_affine(exponential(a.center, width), a.count)
    )


class _Modes(NamedTuple):
    """Coordinates ``T`` in which modes are apart, as far as they can be, and two bounds of motions there.

    Of groups of these coordinates ``|z_k(s)|`` is at most an entry of ``e^{M s} |z(0)|``: M holds the growth of each
    group alone, and couplings.  And all motions together contract in a norm, after a decay is added.
    """

    T: FloatArray
    inverse: AffineMatrix
    groups: list[list[int]]
    M: FloatArray  # without what decays, so that the bound grows with s
    contraction: Contraction | None
    growth: float
    rows: FloatArray  # ``(n,)``: norms of the rows of the inverse of ``Q T``

    def largest(self, columns: AffineMatrix, width: float) -> FloatArray:
        """Return upper bounds on the entries of ``T^-1 e^{A s}`` times columns, ``(n, m)``, for s up to ``width``."""
        size = (self.inverse @ columns).magnitude
        norms = np.array([rounded_up(np.sqrt(np.sum(size[group] ** 2, axis=0)), 6) for group in self.groups])
        with np.errstate(over="ignore", invalid="ignore"):
            grown = exponential(self.M, width).magnitude @ norms
        bounds = np.empty_like(size)
        for group, bound in zip(self.groups, rounded_up(np.nan_to_num(grown, nan=np.inf), len(norms) + 2), strict=True):
            bounds[group] = bound
        if self.contraction is None:
            return bounds
        spread = rounded_up(columns.spread + columns.radius, 3)
        contracted = self.contraction.sizes(columns.center, spread) * np.exp(self.growth * width) * ROUNDED
        return np.asarray(np.minimum(bounds, rounded_up(self.rows[:, None] * contracted[None, :], 6)))


def _modes(a: AffineMatrix, length: float, *, apart: bool) -> _Modes:
    """Return coordinates for a family; ``apart``: those of its modes, where they are well conditioned."""
    T, groups = _coordinates(a.center) if apart else (np.diag(balanced_matrix(a.center)[1]), None)
    groups = [[k] for k in range(len(T))] if groups is None else groups
    inverse = affine_inverse(AffineMatrix.exact(T, a.count))
    moved = inverse @ (a @ T)
    size = moved.magnitude
    M = np.zeros((len(groups), len(groups)))
    for i, group in enumerate(groups):
        for j, other in enumerate(groups):
            if i != j:
                M[i, j] = rounded_up(np.sqrt(np.sum(size[np.ix_(group, other)] ** 2)), 8)
        own = moved.center[np.ix_(group, group)]
        spread = float((moved.spread + moved.radius)[np.ix_(group, group)].sum())
        fastest = float(np.linalg.eigvalsh(own + own.T)[-1]) / 2.0
        M[i, i] = max(fastest + spread + GROWTH_ROUNDING * float(np.abs(own).sum()), 0.0)
    values = np.linalg.eigvals(a.center)
    growth = max(float(np.max(values.real, initial=-np.inf)) + ADDED_DECAY / length, 0.0)
    shifted = Ball(a.center, rounded_up(a.spread + a.radius, 3)) - Ball.exact(growth * np.eye(len(a.center)))
    contraction = prove_contraction(shifted, discrete=False)
    if contraction is None:
        return _Modes(T, inverse, groups, M, None, growth, np.zeros(len(T)))
    sizes = Ball(inverse.center, inverse.radius) @ Ball.exact(contraction.inverse)
    rows = rounded_up(column_norms(sizes.T) / (1.0 - contraction.defect), 4)
    return _Modes(T, inverse, groups, M, contraction, growth, rows)


def _coordinates(a: FloatArray) -> tuple[FloatArray, list[list[int]] | None]:
    """Return eigenvectors, real and imaginary parts side by side, with the places of each mode; and units that balance
    the matrix, without places, where these are nearly dependent."""
    balanced, scale = balanced_matrix(a)
    values, vectors = np.linalg.eig(balanced)
    columns, groups = list[FloatArray](), list[list[int]]()
    for value, vector in zip(values, vectors.T, strict=True):
        if value.imag < 0.0:
            continue
        groups.append([len(columns)] if value.imag == 0.0 else [len(columns), len(columns) + 1])
        columns += [vector.real] if value.imag == 0.0 else [vector.real, vector.imag]
    basis = np.array(columns).T
    if np.linalg.cond(basis) > MOST_DEPENDENT:
        return np.diag(scale), None
    return scale[:, None] * basis, groups
