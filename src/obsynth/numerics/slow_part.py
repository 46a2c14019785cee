"""Powers of a stable matrix that have lost rank, down to rounding: the rest of a doubling takes place in fewer states.

With ``P = U V'``, ``X = H + P (X^-1 + G)^-1 P'`` is solved by ``X = H + U Z U'``, ``Z = h + p (Z^-1 + g)^-1 p'``, with
``p = V' M^-1 U``, ``g = U' G M^-1 U``, ``h = V' M^-1 H V``, ``M = I + H G``; so is the sum ``X = H + P X P'``, where G
is zero.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from obsynth.numerics.arrays import FloatArray
from obsynth.numerics.scaling import power_of_two_below

#: Below so many states a whole step costs less than to look.
FEWEST_STATES = 200
#: The first power that is looked at.
FIRST_POWER = 3
#: Share of the directions that must be enough.
SHARE = 0.5
#: What they leave of a power, relative to it, that counts as rounding; its logarithm tells when to look
#: again, since each squaring doubles it.
ROUNDING = 4e-15
#: Diagonal entries of a solution are taken to be at least this share of the largest when they set units.
LEAST_SIZE = 1e-20
#: Directions in which that is measured, beside those that make the basis.
PROBES = 6


class SlowPart(NamedTuple):
    """A power as ``basis (n, s) @ rows (s, n)``, with an orthonormal basis."""

    basis: FloatArray
    rows: FloatArray


class RankWatch:
    """Says when fewer directions of a power are enough, with as few looks as its decay allows."""

    def __init__(self) -> None:
        self.wait = FIRST_POWER

    def slow_part(self, power: FloatArray) -> SlowPart | None:
        """Return a power ``(n, n)`` in fewer directions, or ``None``; to be asked once for each squaring."""
        n = len(power)
        if n < FEWEST_STATES:
            return None
        if self.wait:
            self.wait -= 1
            return None
        kept = int(SHARE * n)
        directions = np.random.default_rng(0).normal(size=(n, kept + PROBES))
        images = power @ directions
        if not np.all(np.isfinite(images)):
            return None
        basis = np.linalg.qr(images[:, :kept])[0]
        probes = images[:, kept:]
        left = float(np.linalg.norm(probes - basis @ (basis.T @ probes)))
        share = left / max(float(np.linalg.norm(probes)), float(np.finfo(np.float64).tiny))
        if share <= ROUNDING:
            return SlowPart(np.asarray(basis), basis.T @ power)
        self.wait = max(0, math.ceil(math.log2(math.log(ROUNDING) / math.log(share))) - 1) if share < 1.0 else 1
        return None


def slow_equation(
    part: SlowPart, power: FloatArray, back: FloatArray, solution: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray] | None:
    """Return p, g and h ``(s, s)`` of the equation in the lower order, all in C order; ``None`` where M is singular."""
    from scipy.linalg.lapack import dgesv

    u, rows = part
    matrix = solution.dot(back)
    matrix.reshape(-1)[:: len(power) + 1] += 1.0
    _, _, found, failed = dgesv(matrix.T, np.concatenate([rows, u.T.dot(back)]).T, overwrite_a=1)
    if failed:
        return None
    through, returned = found.T[: len(rows)], found.T[len(rows) :]
    return np.ascontiguousarray(through.dot(u)), returned.dot(u), through.dot(solution.dot(rows.T))


class Lifts:
    """The way back to all states: ``X = D (H + U Z U') D``, once for each time that the order became less."""

    def __init__(self) -> None:
        self.steps: list[tuple[FloatArray, FloatArray]] = []
        self.units: FloatArray | None = None

    def balanced(
        self, power: FloatArray, back: FloatArray, solution: FloatArray
    ) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return the matrices in units in which the solution's diagonal is near one, so that rounding has one size."""
        sizes = np.abs(np.diagonal(solution))
        least = LEAST_SIZE * float(np.max(sizes, initial=0.0))
        if not 0.0 < least < np.inf:
            return power, back, solution
        units = power_of_two_below(np.sqrt(np.maximum(sizes, least)))
        self.units = units if self.units is None else self.units * units
        column = units[:, None]
        return power / column * units, column * back * units, solution / column / units

    def add(self, solution: FloatArray, basis: FloatArray) -> None:
        """Note the solution H ``(n, n)`` and the basis U ``(n, s)`` of one reduction."""
        self.steps.append((solution, basis))

    def full(self, solution: FloatArray) -> FloatArray:
        """Return what a solution ``(s, s)`` of the smallest equation is in all states."""
        for base, basis in reversed(self.steps):
            solution = base + basis.dot(solution).dot(basis.T)
        return solution if self.units is None else self.units[:, None] * solution * self.units
