r"""The norm of a long product of matrices, bounded in outward rounding.

Products of balls grow with the products of absolute values, and say nothing after a few hundred steps.  So a product
:math:`F_N \cdots F_1` is followed in moving coordinates, as Lohner does for initial values: with orthogonal factors of
:math:`F_k U_{k-1} = U_k R_k` found in double precision, :math:`U_k^{-1} F_k U_{k-1}` is near a triangle, and
products of the absolute values of triangles grow no faster than their diagonals, up to powers of N:

.. math::
    |U_N^{-1} F_N \cdots F_1| \le |R_N| \cdots |R_1|, \qquad
    |R_k| \ge |U_k^{-1} F_k U_{k-1}|, \quad U_k^{-1} = (I + \Delta)\, U_k^T, \quad
    \|\Delta\| \le \frac{\delta}{1 - \delta}, \quad \delta \ge \|U_k^T U_k - I\| .
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from obsynth.numerics.arrays import FloatArray
from obsynth.proofs.balls import UNDERFLOW, Ball, gamma, rounded_up

#: So many matrices are multiplied as balls before the coordinates move.
AT_ONCE = 16
#: No standard bounds the rounding of logarithms: a few units in the last place, and more than that.
LOGARITHMS = 1e-14


def logarithm_of_product(factors: Sequence[Ball], units: FloatArray | None = None) -> float:
    """Return an upper bound on ``log |F_N ... F_1|`` (2-norm) of balls ``(n, n)``, the first to act standing first.

    With ``units (n,)``, powers of two, the norm is that of ``F`` in these units: ``diag(1 / units) F diag(units)``.
    """
    if not factors:
        return 0.0
    size = factors[0].shape[0]
    if not size:
        return -np.inf
    axes, left, logarithm, slack = np.eye(size), np.eye(size), 0.0, 0.0
    for factor in factors:
        moved = factor if units is None else _in_units(factor, units)
        if not (np.all(np.isfinite(moved.midpoint)) and np.all(np.isfinite(moved.radius))):
            return np.inf
        following = np.linalg.qr(moved.midpoint @ axes)[0]
        slack = _lack_of_orthogonality(following)
        if not slack < 0.5:
            return np.inf
        near = Ball.exact(following.T) @ moved @ Ball.exact(axes)
        triangle = near.magnitude
        # What the inverse of the axes has beside their transpose.
        triangle = rounded_up(triangle + slack / (1.0 - slack) * triangle.sum(axis=0, keepdims=True), size + 6)
        left = rounded_up(triangle @ left, size + 2)
        largest = float(left.max())
        if not np.isfinite(largest):
            return np.inf
        # A power of two divides exactly.
        exponent = int(np.floor(np.log2(largest)))
        left = np.ldexp(left, -exponent) + UNDERFLOW
        logarithm += exponent
        axes = following
    rows, columns = left.sum(axis=1).max(), left.sum(axis=0).max()
    bound = float(rounded_up(np.asarray(np.sqrt(rows * columns * (1.0 + slack))), 2 * size + 8))
    found = float(np.log(bound))
    return found + logarithm * float(np.log(2.0)) + LOGARITHMS * (abs(found) + abs(logarithm))


def _lack_of_orthogonality(axes: FloatArray) -> float:
    """Return an upper bound on ``|U' U - I|``."""
    gap = Ball.exact(axes.T) @ Ball.exact(axes) - Ball.exact(np.eye(len(axes)))
    return gap.frobenius_norm


def _in_units(ball: Ball, units: FloatArray) -> Ball:
    """Return ``diag(1 / units) X diag(units)`` for powers of two: exact but for underflow."""
    scale = units[None, :] / units[:, None]
    return Ball(ball.midpoint * scale, ball.radius * scale + UNDERFLOW)


def stacked_product(first: tuple[FloatArray, FloatArray], second: tuple[FloatArray, FloatArray]) -> tuple[
    FloatArray, FloatArray
]:  # fmt: skip
    """Return midpoints and radii of the products of two stacks of balls ``(count, rows, n)``, ``(count, n, columns)``.

    As `Ball` multiplies, many at once.
    """
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
