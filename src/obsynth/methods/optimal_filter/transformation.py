"""T and T0 of a filter of many states by Sylvester's equation, and whether T and T0 keep the identities.

The identities are linear in T and in S, with ``T0 = S N`` and ``N E = 0``.  Where the filter shares no mode with the
plant, the first of them alone has one solution: the others are only looked at.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np
import scipy.linalg

from obsynth.numerics.arrays import FloatArray
from obsynth.numerics.ranks import RANK_TOLERANCE
from obsynth.numerics.sylvester import pencil_sylvester
from obsynth.verification.error_system import LEAST_ROW

#: The identities of T and T0 hold to this, of the numbers in them: to the second where no realisation keeps the first.
IDENTITIES_LEFT = (1e-9, 1e-8)
#: Entries of T and T0 that are smaller, of the largest, are rounding: by the second share where a decoupled disturbance
#: drives nothing but states that no output shows, of which T must have nothing.
CLEANED_SHARES = (1e-13, 1e-8)
#: Of what a decoupled disturbance does to the filter, by each of its ways, no more than this is left of them together.
DISTURBANCE_LEFT = 1e-8
#: With fewer entries of T all equations together are solved as quickly, and also where the filter shares modes.
FEWEST_ENTRIES = 200
#: With more of them, all equations together take longer than a few seconds.
MOST_ENTRIES = 1200
#: Equations of S are solved so many times, each time for what is left.
SOLUTIONS = 3


class FilterAndPlant(NamedTuple):
    """A filter ``z+ = a z + b y``, ``c z + d y``, and the plant that it follows, with past states; ``N E = 0``."""

    a: FloatArray
    b: FloatArray
    c: FloatArray
    d: FloatArray
    E: FloatArray
    A: FloatArray
    C: FloatArray
    Bd: FloatArray
    Dd: FloatArray
    N: FloatArray

    def heights(self) -> tuple[int, ...]:
        """Return how many equations each of the first three identities is."""
        return len(self.a) * len(self.E), len(self.a) * self.Bd.shape[1], len(self.c) * len(self.E)

    def missed(self, t: FloatArray, s: FloatArray) -> FloatArray:
        """Return what is left of the identities, equation by equation."""
        return np.abs(_sums(self, t, s, -1.0))

    def terms(self, t: FloatArray, s: FloatArray) -> FloatArray:
        """Return the size of what cancels in each equation."""
        return _sums(FilterAndPlant(*map(np.abs, self)), np.abs(t), np.abs(s), 1.0)


def _sums(of: FilterAndPlant, t: FloatArray, s: FloatArray, sign: float) -> FloatArray:
    sums = (
        of.a @ t @ of.E + sign * (t @ of.A) + of.b @ of.C,
        t @ of.Bd + sign * (of.b @ of.Dd),
        of.c @ t @ of.E + sign * (s @ (of.N @ of.A)) + of.d @ of.C,
        s @ (of.N @ of.Bd) + sign * (of.d @ of.Dd),
    )
    return np.concatenate([part.ravel() for part in sums])


class Transformation(NamedTuple):
    """T and S, with ``T0 = S N``, and the share of `IDENTITIES_LEFT` to which they keep the identities."""

    T: FloatArray
    S: FloatArray
    share: float


def by_sylvester(of: FilterAndPlant, units: FloatArray) -> tuple[Transformation | None, bool]:
    """Return T and S, ``None`` where they do not keep the identities, and whether there is no other T than this.

    Parameters
    ----------
    of : FilterAndPlant
        Both systems.
    units : FloatArray
        ``(na,)``: units of the plant's equations, in which entries of a row of T are compared.
    """
    t = pencil_sylvester(of.a, of.A, of.E, -of.b @ of.C)
    if t is None:
        return None, False
    less_exact: Transformation | None = None
    for share in IDENTITIES_LEFT:
        for cleaned in _cleaned(t / units):
            own = cleaned * units
            s = _of_rows(of, own)
            missed, terms = of.missed(own, s), of.terms(own, s)
            if not holds(missed, terms, of.heights(), len(of.E), share):
                continue
            if not shows_a_disturbance(missed, terms, of.heights(), of.Bd.shape[1]):
                return Transformation(own, s, share), True
            less_exact = less_exact or Transformation(own, s, share)
        if less_exact is not None:
            return less_exact, True
    return None, True


def _cleaned(t: FloatArray) -> Iterator[FloatArray]:
    """Yield T without what is rounding of the largest entry of each row, or else of all."""
    sizes = np.abs(t)
    for share in CLEANED_SHARES:
        # Rows are in units of their own: beside a large one a small one is no rounding.
        for largest in (np.max(sizes, axis=1, keepdims=True, initial=0.0), np.max(sizes, initial=0.0)):
            yield np.where(sizes > share * largest, t, 0.0)


def _of_rows(of: FilterAndPlant, t: FloatArray) -> FloatArray:
    """Return S, by least squares: each equation in its own unit, refined."""
    shown = np.hstack([of.N @ of.A, of.N @ of.Bd])
    s = np.zeros((len(of.c), len(of.N)))
    if not s.size:
        return s
    wanted = np.hstack([of.c @ t @ of.E + of.d @ of.C, of.d @ of.Dd])
    sizes = np.max(np.abs(shown), axis=0, initial=0.0)
    scale = 1.0 / np.where(sizes > 0.0, sizes, 1.0)
    for _ in range(SOLUTIONS):
        missed = (wanted - s @ shown) * scale
        s = s + scipy.linalg.lstsq((shown * scale).T, missed.T, lapack_driver="gelsy", cond=RANK_TOLERANCE)[0].T
    return s


def holds(missed: FloatArray, terms: FloatArray, heights: Sequence[int], width: int, share: float) -> bool:
    """Whether equations hold, each to a share of the largest term of its row of the filter, as they are verified.

    Parameters
    ----------
    missed, terms : FloatArray
        What is left of each equation, and the size of what cancels in it.
    heights : sequence of int
        How many equations each of the first three identities is; the last one has the others.
    width : int
        Entries of a row of T.
    share : float
        Of the largest term.
    """
    ends = np.cumsum(heights)
    for part, height in ((slice(0, ends[0]), heights[0]), (slice(ends[1], ends[2]), heights[2])):
        if height:
            largest = np.max(terms[part].reshape(-1, width), axis=1)
            largest = np.maximum(largest, LEAST_ROW * np.max(largest))
            if np.any(np.max(missed[part].reshape(-1, width), axis=1) > share * largest):
                return False
    return bool(np.max(missed, initial=0.0) <= share * (1.0 + np.max(terms, initial=0.0)))


def shows_a_disturbance(missed: FloatArray, terms: FloatArray, heights: Sequence[int], disturbances: int) -> bool:
    """Whether more is left of some decoupled disturbance than a share of what cancels; parameters as of `holds`."""
    ends = np.cumsum(heights)
    own = np.r_[ends[0] : ends[1], ends[2] : len(missed)]
    if not disturbances or not len(own):
        return False
    largest, size = (np.max(part[own].reshape(-1, disturbances), axis=0) for part in (missed, terms))
    return bool(np.any(largest > DISTURBANCE_LEFT * size))
