"""Steps of linear systems: the recursion itself, and exact steps of ``x' = A x + B s`` for signals that are linear."""

from __future__ import annotations

import numpy as np

from obsynth.numerics.arrays import FloatArray
from obsynth.numerics.scaling import balanced_matrix, power_of_two_below


def zero_order_hold(a: FloatArray, inputs: FloatArray, step: float) -> tuple[FloatArray, FloatArray]:
    """Return ``exp(A h)`` and its integral times ``inputs``, from one balanced block exponential."""
    from scipy.linalg import expm

    n, m = inputs.shape
    balanced, scale, scaled, sizes = _in_like_sizes(a, inputs)
    block = np.zeros((n + m, n + m))
    block[:n, :n], block[:n, n:] = balanced, scaled
    row = expm(block * step)[:n]
    return scale[:, None] * row[:, :n] / scale, scale[:, None] * row[:, n:] * sizes


def first_order_hold(a: FloatArray, inputs: FloatArray, step: float) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return Phi, Gamma0 and Gamma1 of ``x(h) = Phi x(0) + Gamma0 s(0) + Gamma1 (s(h) - s(0))``.

    Shapes: ``a (n, n)``, ``inputs (n, m)``.
    """
    from scipy.linalg import expm

    n, m = inputs.shape
    balanced, scale, scaled, sizes = _in_like_sizes(a, inputs)
    chain = np.zeros((n + 2 * m, n + 2 * m))
    chain[:n, :n], chain[:n, n : n + m], chain[n : n + m, n + m :] = balanced * step, scaled * step, np.eye(m)
    row = expm(chain)[:n]
    held, ramped = (scale[:, None] * block * sizes for block in (row[:, n : n + m], row[:, n + m :]))
    return scale[:, None] * row[:, :n] / scale, held, ramped


def _in_like_sizes(a: FloatArray, inputs: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    """Return both matrices balanced, with the units of the states between, and of the inputs last."""
    balanced, scale = balanced_matrix(a)
    scaled = inputs / scale[:, None]
    # Large inputs would make the exponential square more often than the dynamics need.
    sizes = power_of_two_below(np.max(np.abs(scaled), axis=0, initial=0.0))
    return balanced, scale, scaled / sizes, sizes


def driven(a: FloatArray, start: FloatArray, drive: FloatArray) -> FloatArray:
    """Return ``x(0), x(1), ...`` of ``x+ = a x + drive`` for one or many runs; infinite where the states overflow.

    Shapes: ``drive (steps, ..., n)``.
    """
    x, turned = np.empty_like(drive), np.ascontiguousarray(a.T)
    x[:1] = start
    with np.errstate(over="ignore", invalid="ignore"):
        for k in range(len(drive) - 1):
            x[k + 1] = x[k] @ turned + drive[k]
    return x
