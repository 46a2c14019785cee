"""The loop that an error closes through the tolerances: largest common tolerance, and whom to blame."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from obsynth.errors import PreconditionError
from obsynth.numerics.arrays import FloatArray
from obsynth.tolerances.error_structure import ErrorStructure, owners
from obsynth.tolerances.responses import Responses, loop_radius, responses_of

#: The largest tolerance is found to this share.
FACTOR_SHARE = 1e-3
#: Factors beyond this are as good as infinite.
LARGEST_FACTOR = 1e6
#: Added to the loop, as a share of its largest entry, so that its eigenvector is positive.
_SHIFT = 1e-12


def largest_factor(structure_at: Callable[[float], ErrorStructure], radius: float) -> float:
    """Return the largest factor on all tolerances for which the loop's radius is below 1; matrices are built anew."""
    known: dict[float, float] = {1.0: radius}

    def radius_at(factor: float) -> float:
        if factor not in known:
            try:
                known[factor] = loop_radius(responses_of(structure_at(factor)))
            except PreconditionError:
                known[factor] = np.inf
        return known[factor]

    if radius == 0.0:
        return np.inf
    low, high = 0.0, min(1.0 / radius, LARGEST_FACTOR)
    while radius_at(high) < 1.0:
        low, high = high, 2.0 * high
        if low >= LARGEST_FACTOR:
            return np.inf
    if low == 0.0 and radius < 1.0:
        low = 1.0
    while high - low > FACTOR_SHARE * high:
        middle = (low + high) / 2.0
        low, high = (middle, high) if radius_at(middle) < 1.0 else (low, middle)
        if high < 1.0 / LARGEST_FACTOR:
            return 0.0
    return low


def blame(responses: Responses) -> FloatArray:
    """Return the share of each constant in the loop's radius, remainders last: its Perron vectors."""
    left, right = _perron(responses.loop)
    count = responses.structure.state.count
    shares = np.zeros(count + 1)
    np.add.at(shares, list(owners(responses.structure)), (left @ responses.loop) * right)
    total = float(shares.sum())
    return np.asarray(shares / total if total > 0.0 else shares)


def blamed_rows(responses: Responses, tracking: FloatArray, parts: tuple[FloatArray, ...]) -> FloatArray:
    """Return the share of each row of the plant ``(nx,)`` in the loop, by what the constants put into it.

    ``parts``: affine parts ``(p, nx, n)`` of E and A.
    """
    structure = responses.structure
    left, right = _perron(responses.loop)
    own = len(structure.owner)
    into = structure.seen(responses.gain(structure.channel_rows @ structure.Cx, tracking))
    shares = np.zeros(tracking.shape[1])
    for i in sorted(set(structure.owner)):
        chosen = [j for j in range(own) if structure.owner[j] == i]
        rows = structure.channel_rows[chosen]
        for part in parts:
            width = part[i].shape[1]
            effect = np.abs(part[i] @ np.linalg.pinv(rows[:, :width]))
            shares += (left @ into) * (effect @ right[chosen])
    total = float(shares.sum())
    return np.asarray(shares / total if total > 0.0 else shares)


def _perron(loop: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return left and right eigenvectors of the spectral radius, nonnegative."""
    size = float(loop.max(initial=0.0))
    if size == 0.0:
        return np.ones(len(loop)), np.ones(len(loop))
    values, right = np.linalg.eig(loop + _SHIFT * size)
    transposed, left = np.linalg.eig(loop.T + _SHIFT * size)
    return (
        np.abs(left[:, int(np.argmax(transposed.real))].real),
        np.abs(right[:, int(np.argmax(values.real))].real),
    )
