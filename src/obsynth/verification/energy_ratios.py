"""Lower bound on the gain from one combination of signals near the worst: a ratio of energies, rounded down."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import flint
import numpy as np
import scipy.linalg

from obsynth.proofs.complex_balls import adjoint, columns_of, complex_matrix, middle, rows_of, scaled_columns

#: Steps of inverse iteration towards the worst combination: each gains the digits of the distance of the levels, which
#: is small where the bound is not close to the level (4 steps left two results from levels 1e-6 apart 3e-4 apart).
INVERSE_STEPS = 40
#: Shares by which the level of that iteration lies above the bound that is repeated, and of the noise's energy that is
#: taken off so that what is invisible without noise leaves no singular matrix.
LEVEL_ABOVE, REGULAR_SHARE = 1e-9, 1e-40


def worst_ratio(
    error: Any, noise: Any, level: float | None, enough: float | None = None, *, answered: Any = None
) -> float | None:
    """Return the ratio of two energies for one combination near the worst, rounded down: without a level the largest.

    Nothing is concluded from the level, near which the combination is looked for.  One in double precision is taken
    where its ratio is ``enough``: more digits are a hundred times the work.  ``answered``: the energy of what may be
    taken off the error.
    """
    count = error.nrows()
    if not count:
        return None
    # Energies of the basis differ by many orders: each member in its own unit, without those that only rounding has.
    sizes = [(noise[i, i].real + error[i, i].real).mid() for i in range(count)]
    nothing = max(sizes) * flint.arb(2) ** -(flint.ctx.prec // 2)
    significant = [i for i, size in enumerate(sizes) if size > nothing]
    if not significant:
        return None
    units = [(1 / flint.acb(sizes[i]).sqrt()).mid() for i in significant]
    energies = [
        scaled_columns(
            scaled_columns(columns_of(rows_of(part, significant), significant), units).transpose(), units
        ).transpose()
        for part in (error, noise, answered)
        if part is not None
    ]
    error, noise = energies[:2]
    largest, combination = _largest_ratio(error, noise)
    roughly = _ratio(energies, complex_matrix(combination[:, None]))
    if roughly is not None and enough is not None and roughly >= enough:
        return roughly
    closely = _ratio(energies, _worst_combination(error, noise, largest if level is None else level))
    return max((bound for bound in (roughly, closely) if bound is not None), default=None)


def _ratio(energies: Sequence[Any], combination: Any) -> float | None:
    """Return the ratio of error and noise of a combination, rounded down; ``None`` where one of them may be zero.

    ``energies``: of both, and of what may be taken off the error, where there is a third.
    """
    above, below, *less = ((adjoint(combination) * part * combination)[0, 0].real for part in energies)
    if not (above > 0 and below > 0):
        return None
    # An energy whose ball reaches below zero is none above its upper end.
    taken_off = sum((flint.arb(part.upper()).sqrt() for part in less), flint.arb(0))
    error = (flint.arb(above.lower()).sqrt() - taken_off).lower()
    if not error > 0:
        return None
    ratio = (error / flint.arb(below.upper()).sqrt()).lower()
    value = float(ratio) if ratio.is_finite() else 0.0
    return math.nextafter(value, 0.0) if value > 0.0 else None


def _worst_combination(error: Any, noise: Any, level: float) -> Any:
    """Return the combination whose ratio of energies is near a level, by inverse iteration in all digits."""
    count = error.nrows()
    square = flint.arb(level * (1.0 + LEVEL_ABOVE)) ** 2
    shifted = middle(error - noise * square)
    for i in range(count):
        shifted[i, i] -= flint.arb(REGULAR_SHARE) * (1 + square)
    step = middle(shifted.inv()) * middle(noise)
    vector = flint.acb_mat(count, 1, [1.0 + 0.37 * (i % 7) for i in range(count)])
    for _ in range(INVERSE_STEPS):
        vector = middle(step * vector)
        largest = max(entry.abs_upper() for entry in vector.entries())
        vector = middle(vector * (1 / flint.acb(largest)))
    return vector


def _largest_ratio(error: Any, noise: Any) -> tuple[float, Any]:
    """Return the root of the largest ratio of two energies in double precision, and its combination: no proof."""
    above, below = (np.array([[complex(entry) for entry in row] for row in part.tolist()]) for part in (error, noise))
    below = below + np.finfo(float).eps * np.trace(below).real * np.eye(len(below))
    ratios, combinations = scipy.linalg.eigh(above, below)
    return float(np.sqrt(max(ratios[-1], 0.0))), combinations[:, -1]
