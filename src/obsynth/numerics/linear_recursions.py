"""Linear recursions over many steps: trajectories of a driven state, and impulse responses.

Steps are taken in about as many blocks as each has steps, all blocks at once: two times the square root of the steps in
Python, and the others within products of matrices.
"""

from __future__ import annotations

from collections.abc import Sequence
from math import isqrt

import numpy as np

from obsynth.numerics.arrays import FloatArray

#: Blocks of fewer steps cost more than they save.
SHORTEST_BLOCKS = 16


def driven(a: FloatArray, start: FloatArray, drive: FloatArray) -> FloatArray:
    """Return ``x(0), x(1), ...`` of ``x+ = a x + drive (steps, ..., n)``; infinite where the states overflow."""
    turned, width = np.ascontiguousarray(a.T), isqrt(len(drive))
    with np.errstate(over="ignore", invalid="ignore"):
        if width >= SHORTEST_BLOCKS:
            powers = [np.eye(len(a))]
            for _ in range(width):
                powers.append(powers[-1] @ turned)
            if np.all(np.isfinite(powers[-1])):
                return _driven_in_blocks(powers, start, drive)
        x = np.empty_like(drive)
        x[:1] = start
        for k in range(len(drive) - 1):
            x[k + 1] = x[k] @ turned + drive[k]
    return x


def _driven_in_blocks(powers: Sequence[FloatArray], start: FloatArray, drive: FloatArray) -> FloatArray:
    """Return the same from powers ``0 ... width`` of ``a'``: all blocks of so many steps at once, each from rest, and
    what their starts add."""
    width, shape = len(powers) - 1, drive.shape[1:]
    blocks = -(-len(drive) // width)
    padded = np.zeros((blocks * width, *shape))
    padded[: len(drive)] = drive
    within = padded.reshape(blocks, width, *shape)
    x, end = np.empty_like(within), np.zeros((blocks, *shape))
    for k in range(width):
        x[:, k] = end
        end = end @ powers[1] + within[:, k]
    begin = np.empty((blocks, *shape))
    begin[:1] = start
    for block in range(blocks - 1):
        begin[block + 1] = begin[block] @ powers[-1] + end[block]
    for k in range(width):
        x[:, k] += begin @ powers[k]
    return np.ascontiguousarray(x.reshape(-1, *shape)[: len(drive)])


def impulse_responses(a: FloatArray, b: FloatArray, c: FloatArray, steps: int) -> FloatArray:
    """Return ``c a^k b (steps, rows, columns)`` for ``k = 0 ... steps - 1``; not finite where the states overflow.

    As ``(c a^(i w)) (a^j b)``, one product for all steps: each costs as many rows as there are outputs, not states."""
    width = isqrt(steps)
    with np.errstate(over="ignore", invalid="ignore"):
        block = [b]
        for _ in range(width - 1 if width >= SHORTEST_BLOCKS else 0):
            block.append(a @ block[-1])
        leap = np.linalg.matrix_power(a, len(block))
        if not np.all(np.isfinite(leap)):
            block, leap = [b], a
        rows = [c]
        for _ in range(-(-steps // len(block)) - 1):
            rows.append(rows[-1] @ leap)
        products = np.concatenate(rows) @ np.concatenate(block, axis=1)
        if not np.all(np.isfinite(products)):
            # Rows may overflow by what no input reaches.
            return _responses_of_states(np.stack(block), leap, c, steps)
    parts = products.reshape(len(rows), len(c), len(block), b.shape[1])
    return parts.swapaxes(1, 2).reshape(len(rows) * len(block), len(c), b.shape[1])[:steps]


def _responses_of_states(states: FloatArray, leap: FloatArray, c: FloatArray, steps: int) -> FloatArray:
    """Return the responses from those of the first states ``(width, n, columns)``, so many steps at once."""
    responses = []
    for _ in range(max(-(-steps // len(states)), 1)):
        responses.append(c @ states)
        states = leap @ states
    return np.concatenate(responses)[:steps]
