"""Inputs that move the state but not the outputs, and the system without them.

From x = 0 the inputs reach, with outputs of zero throughout, the largest output-nulling reachable subspace R* (H.
Trentelman, A. Stoorvogel, M. Hautus, *Control Theory for Linear Systems*, 2001, section 8.1).  The state modulo R*, and
the inputs modulo those that act on R* alone, have the same outputs, from which the latter can be told.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from obsynth.numerics.arrays import FloatArray
from obsynth.numerics.ranks import WINDOW_RANK_TOLERANCE, decide_rank

#: Where transfer matrices are looked at, beyond all poles: a zero there is an accident.
GENERIC_POINT = 1.3717


class SeenPart(NamedTuple):
    """Rows ``states (q, n)`` of the state and columns ``inputs (nh, k)`` that are left, both orthonormal; ``unseen``:
    columns that span all inputs of trajectories that no output shows."""

    states: FloatArray
    inputs: FloatArray
    unseen: FloatArray


def normal_rank(a: FloatArray, b: FloatArray, c: FloatArray, d: FloatArray) -> int:
    """Return the rank of a transfer matrix at a point that is a pole or a zero only by accident."""
    n = len(a)
    point = GENERIC_POINT * (1.0 + float(np.max(np.abs(np.linalg.eigvals(a)), initial=0.0)))
    return decide_rank(np.block([[point * np.eye(n) - a, -b], [c, d]])).rank - n


def seen_part(a: FloatArray, b: FloatArray, c: FloatArray, d: FloatArray) -> SeenPart:
    """Return what the outputs show of the state and of the inputs.

    R* is spanned by the states, at n + 1 points, of exponentials ``(x, h) s^t`` that no output shows.
    """
    n, inputs = b.shape
    hidden = inputs - normal_rank(a, b, c, d)
    if not hidden:
        return SeenPart(np.eye(n), np.eye(inputs), np.zeros((inputs, 0)))
    radius = GENERIC_POINT * (float(np.max(np.abs(np.linalg.eigvals(a)), initial=0.0)) or 1.0)
    points = radius * np.exp(1j * np.pi * (np.arange(n + 1) + 0.5) / (n + 1))
    vectors = []
    for point in points:
        pencil = np.block([[point * np.eye(n) - a, -b], [c, d]])
        kernel = np.conj(np.linalg.svd(pencil)[2][-hidden:].T)
        vectors += [kernel.real, kernel.imag]
    both = np.hstack(vectors)
    basis, values, _ = np.linalg.svd(both[:n])
    states = basis[:, int(np.sum(values > WINDOW_RANK_TOLERANCE)) :].T
    visible_inputs = np.linalg.svd(np.vstack([d, states @ b]))[2][: inputs - hidden].T
    return SeenPart(states, visible_inputs, both[n:])
