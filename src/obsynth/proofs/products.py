r"""Exponentials and long products of matrices, as balls of double precision.

Exponentials: a Taylor polynomial with a bounded remainder, squared in balls, or python-flint where the radius is no
share of it.  Products :math:`F_N \cdots F_1` in moving coordinates (Lohner), or their balls say nothing after a few
hundred steps: with orthogonal factors of :math:`F_k U_{k-1} = U_k R_k`, :math:`U_k^{-1} F_k U_{k-1}` is near a
triangle, whose products grow no faster than their diagonals, up to powers of N:

.. math::
    |U_N^{-1} F_N \cdots F_1| \le |R_N| \cdots |R_1|, \qquad
    |R_k| \ge |U_k^{-1} F_k U_{k-1}|, \quad U_k^{-1} = (I + \Delta)\, U_k^T, \quad
    \|\Delta\| \le \frac{\delta}{1 - \delta}, \quad \delta \ge \|U_k^T U_k - I\| .
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import flint
import numpy as np

from obsynth.numerics.arrays import FloatArray
from obsynth.numerics.scaling import balancing_factors
from obsynth.proofs.balls import UNDERFLOW, UNIT_ROUNDOFF, Ball, gamma, rounded_up
from obsynth.proofs.extended_balls import arb_matrix

#: Digits in which exponentials are formed, in bits.
EXPONENTIAL_BITS = 160

#: With more states double precision comes first, where its radius is below this share of the largest entry;
#: with few, where python-flint takes no second, it must be as good as nothing.
EXACT_PRODUCTS_UP_TO, LARGEST_RADIUS_SHARE = 60, 1e-7

FEW_STATES_FOR_BALLS, LARGEST_SHARE_OF_FEW = 8, 1e-12

#: Norm of the shortest interval's exponent, and orders of the Taylor polynomials: what is left is below 1e-18.
SHORT_NORM, ORDER, ENERGY_ORDER = 2.0**-4, 10, 12

#: So many matrices are multiplied as balls before the coordinates move.
AT_ONCE = 16

#: No standard bounds the rounding of logarithms: a few units in the last place, and more than that.
LOGARITHMS = 1e-14

#: Axes further from orthonormal than this have no inverse that is bounded well: the bound has ``1 / (1 - defect)``.
LARGEST_DEFECT = 0.5


def exponential(matrix: FloatArray, time: float) -> Ball:
    """Return a ball that holds ``e^{A t}`` of ``A (n, n)``; its radius is infinite where nothing is known."""
    n = len(matrix)
    if not n:
        return Ball.exact(np.zeros((0, 0)))
    if n > FEW_STATES_FOR_BALLS and (ball := _Doubling(matrix, time).exponential()) is not None:
        return ball
    with flint.ctx.workprec(EXPONENTIAL_BITS):
        return as_ball((arb_matrix(matrix) * flint.arb(float(time))).exp())


def energy(a: FloatArray, b: FloatArray, time: float) -> Ball:
    r"""Return a ball that holds ``\int_0^t e^{A s} B B' e^{A' s} ds`` (Van Loan), for ``A (n, n)``, ``B (n, m)``."""
    n = len(a)
    if n > FEW_STATES_FOR_BALLS and (ball := _Doubling(a, time).energy(b)) is not None:
        return ball
    with flint.ctx.workprec(2 * EXPONENTIAL_BITS):
        block = arb_matrix(np.block([[-a, np.zeros((n, n))], [np.zeros((n, n)), a.T]]))
        square = arb_matrix(b) * arb_matrix(b).transpose()
        for i in range(n):
            for j in range(n):
                block[i, n + j] = square[i, j]
        block = (block * flint.arb(float(time))).exp()
        late = flint.arb_mat([[block[n + j, n + i] for j in range(n)] for i in range(n)])
        upper = flint.arb_mat([[block[i, n + j] for j in range(n)] for i in range(n)])
        return as_ball(late * upper)


def _is_sharp(ball: Ball) -> bool:
    share = LARGEST_RADIUS_SHARE if len(ball.midpoint) > EXACT_PRODUCTS_UP_TO else LARGEST_SHARE_OF_FEW
    return bool(np.max(ball.radius) <= share * np.max(np.abs(ball.midpoint)))


class _Doubling:
    """Exponentials over an interval from those over a short one, in states whose units balance the matrix."""

    def __init__(self, matrix: FloatArray, time: float) -> None:
        units = balancing_factors(matrix)
        self.exponents = np.asarray(np.round(np.log2(units)), dtype=np.int64)
        moved = self._moved(matrix, -1)
        balanced = Ball(moved, np.full(moved.shape, UNDERFLOW))
        norm = float(np.max(np.sum(np.abs(balanced.midpoint), axis=1))) * abs(float(time))
        self.times = max(0, math.ceil(math.log2(norm / SHORT_NORM))) + 1 if 0.0 < norm < math.inf else 0
        self.short = math.ldexp(float(time), -self.times)
        self.x = balanced.scaled(self.short)
        #: Above the norm of the exponent over the short interval.
        self.norm = float(np.max(rounded_up(np.sum(np.abs(self.x.midpoint) + self.x.radius, axis=1), len(matrix) + 2)))

    def _moved(self, matrix: FloatArray, sign: int) -> FloatArray:
        """Return a matrix in the units of the plant (1) or in the balanced ones (-1): exact but for underflow."""
        with np.errstate(over="ignore"):
            return np.asarray(np.ldexp(matrix, sign * (self.exponents[:, None] - self.exponents)))

    def _first(self) -> Ball:
        identity = np.eye(len(self.exponents))
        total = Ball.exact(identity)
        for k in range(ORDER, 0, -1):
            total = Ball.exact(identity) + (self.x @ total).scaled(1.0 / k).widened(UNIT_ROUNDOFF)
        return total.added(_remainder(self.norm, ORDER + 1, ORDER + 1))

    def exponential(self) -> Ball | None:
        """Return a ball that holds the exponential; ``None`` where it is not sharp."""
        power = self._first()
        for _ in range(self.times):
            power = power @ power
        if not _is_sharp(power):
            return None
        return Ball(self._moved(power.midpoint, 1), self._moved(power.radius, 1) + UNDERFLOW)

    def energy(self, b: FloatArray) -> Ball | None:
        """Return a ball that holds the energy of inputs; ``None`` where it is not sharp."""
        inputs = Ball.exact(np.ldexp(b, -self.exponents[:, None]))
        term = (inputs @ inputs.T).scaled(self.short)
        largest = float(np.max(term.magnitude, initial=0.0))
        total = term
        for k in range(2, ENERGY_ORDER + 1):
            through = self.x @ term
            term = (through + through.T).scaled(1.0 / k).widened(UNIT_ROUNDOFF)
            total = total + term
        total = total.added(largest * _remainder(2.0 * self.norm, ENERGY_ORDER, ENERGY_ORDER + 1))
        moving = self._first()
        for _ in range(self.times):
            total = total + moving @ total @ moving.T
            moving = moving @ moving
        return total.congruent(self.exponents) if _is_sharp(total) else None


def _remainder(norm: float, power: int, factorial: int) -> float:
    """Return an upper bound on the sum of ``norm^(power + i) / (factorial + i)!`` over i from 0."""
    return 2.0 * norm**power / math.factorial(factorial) if norm < 1.0 else math.inf


def as_ball(content: flint.arb_mat) -> Ball:
    """Return a matrix of python-flint's balls as a `Ball`: midpoints rounded, radii rounded up."""
    entries, shape = content.entries(), (int(content.nrows()), int(content.ncols()))
    radii = [0.0 if entry.is_exact() else float(entry.rad()) for entry in entries]
    midpoint, radius = (np.array(part, dtype=np.float64).reshape(shape) for part in ([*map(float, entries)], radii))
    unknown = ~(np.isfinite(midpoint) & np.isfinite(radius))
    midpoint[unknown], radius[unknown] = np.nan, np.inf
    # Both conversions round to nearest.
    return Ball(midpoint, radius * (1.0 + 4.0 * UNIT_ROUNDOFF) + UNIT_ROUNDOFF * np.abs(midpoint) + 2.0 * UNDERFLOW)


def logarithm_of_product(factors: Sequence[Ball], units: FloatArray | None = None) -> float:
    """Return an upper bound on ``log |F_N ... F_1|`` (2-norm), F_1 first; with F in ``units (n,)``, powers of two."""
    if not factors:
        return 0.0
    size = factors[0].shape[0]
    if not size:
        return -np.inf
    axes, product, logarithm, slack = np.eye(size), np.eye(size), 0.0, 0.0
    for factor in factors:
        moved = factor if units is None else _in_units(factor, units)
        if not moved.is_finite:
            return np.inf
        following = np.linalg.qr(moved.midpoint @ axes)[0]
        # An upper bound on |U' U - I|.
        slack = (Ball.exact(following.T) @ Ball.exact(following) - Ball.exact(np.eye(size))).frobenius_norm
        if not slack < LARGEST_DEFECT:
            return np.inf
        near = Ball.exact(following.T) @ moved @ Ball.exact(axes)
        triangle = near.magnitude
        # What the inverse of the axes has beside their transpose.
        triangle = rounded_up(triangle + slack / (1.0 - slack) * triangle.sum(axis=0, keepdims=True), size + 6)
        product = rounded_up(triangle @ product, size + 2)
        largest = float(product.max())
        if not np.isfinite(largest):
            return np.inf
        # A power of two divides exactly.
        exponent = int(np.floor(np.log2(largest)))
        product = np.ldexp(product, -exponent) + UNDERFLOW
        logarithm += exponent
        axes = following
    rows, columns = product.sum(axis=1).max(), product.sum(axis=0).max()
    bound = float(rounded_up(np.asarray(np.sqrt(rows * columns * (1.0 + slack))), 2 * size + 8))
    logarithm_of_bound = float(np.log(bound))
    return logarithm_of_bound + logarithm * float(np.log(2.0)) + LOGARITHMS * (abs(logarithm_of_bound) + abs(logarithm))


def _in_units(ball: Ball, units: FloatArray) -> Ball:
    """Return ``diag(1 / units) X diag(units)`` for powers of two: exact but for underflow."""
    scale = units[None, :] / units[:, None]
    return Ball(ball.midpoint * scale, ball.radius * scale + UNDERFLOW)


def stacked_product(
    first: tuple[FloatArray, FloatArray], second: tuple[FloatArray, FloatArray]
) -> tuple[FloatArray, FloatArray]:
    """Return the products of two stacks of balls ``(count, rows, n)``, ``(count, n, columns)``, as `Ball` does."""
    (a, ra), (b, rb) = first, second
    length = a.shape[2]
    size, other = np.abs(a), np.abs(b)
    radius = gamma(length + 1) * (size @ other) + size @ rb + ra @ (other + rb)
    return a @ b, rounded_up(radius, 2 * length + 8) + 3 * length * UNDERFLOW


def product_of_stack(midpoints: FloatArray, radii: FloatArray) -> Ball:
    """Return the ball of ``F_count ... F_1`` of a stack ``(count, n, n)``, the first to act standing first."""
    stack = midpoints, radii
    while len(stack[0]) > 1:
        count = len(stack[0])
        pairs = stacked_product(
            (stack[0][1::2], stack[1][1::2]), (stack[0][0 : count - 1 : 2], stack[1][0 : count - 1 : 2])
        )
        if count % 2:
            pairs = np.concatenate([pairs[0], stack[0][-1:]]), np.concatenate([pairs[1], stack[1][-1:]])
        stack = pairs
    return Ball(stack[0][0], stack[1][0])
