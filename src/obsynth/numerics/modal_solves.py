"""Rows times ``(z E - A)^-1`` at many points, by one decomposition for all.

With ``M = (s E - A)^-1 E = V diag(m) V^-1`` at one point s, ``(z E - A)^-1 = V diag(1 / (1 + (z - s) m)) V^-1
(s E - A)^-1``. Eigenvectors may be ill-conditioned: what they miss is measured on the matrices themselves, corrected by
the same formula, and where that is not soon as small as rounding in a factorisation, the point is factored.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from obsynth.numerics import lapack
from obsynth.numerics.arrays import ComplexArray, FloatArray
from obsynth.numerics.modal_response import Modes, resolved

#: From so many states on a decomposition takes less time than a factorisation at each of some tens of points.
STATES_FOR_MODES = 200

#: Corrections, each of which takes as many digits as eigenvectors are good for.
MOST_CORRECTIONS = 5

#: Residual, relative to the norms of what it is the rest of, that is left by a factorisation as well, in roundings.
ROUNDINGS_LEFT = 1.0


@dataclass(frozen=True, eq=False)
class ModalSolves:
    """``x (z E - A) = c`` for rows c at many points z; E ``None`` is the identity.

    ``(z E - A)^-1`` is near ``V diag(weights / (1 + (z - at) m)) V^-1 first``, m the ``values (n,)``, V in ``vectors``
    and ``factors``; ``first`` is left out where E is the identity.
    """

    E: FloatArray | None
    A: FloatArray
    at: float
    values: ComplexArray
    weights: ComplexArray
    vectors: ComplexArray
    factors: tuple[Any, Any]
    first: FloatArray | None

    @classmethod
    def of(cls, e: FloatArray | None, a: FloatArray, *, at: float, modes: Modes | None = None) -> ModalSolves | None:
        """Return what solves for a pencil ``(n, n)``, ``at`` no zero of it; ``None`` where that has no good basis.

        ``modes``: those of A, where E is the identity and they are known."""
        if not np.all(np.isfinite(a)):
            return None
        try:
            if e is None:
                known, first = Modes.of(a) if modes is None else modes, None
                values, vectors = 1.0 / (at - known.values), known.vectors
                weights = values
            else:
                first = np.linalg.inv(at * e - a)
                values, vectors = Modes.of(first @ e)
                weights = np.ones_like(values)
        except np.linalg.LinAlgError:
            return None
        lu, pivots, failed = lapack.zgetrf(vectors)
        if failed or not np.all(np.isfinite(lu)):
            return None
        return cls(e, a, at, values, weights, vectors, (lu, pivots), None if first is None else np.asarray(first))

    def rows(self, points: ComplexArray, right: FloatArray | ComplexArray) -> ComplexArray:
        """Return x ``(count, p, n)`` for rows c, ``(p, n)`` or ``(count, p, n)``.

        Raises
        ------
        numpy.linalg.LinAlgError
            The pencil is singular at a point.
        """
        targets = np.broadcast_to(right, (len(points), *right.shape[-2:])).astype(np.complex128)
        solutions, missed, unsolved = np.zeros_like(targets), targets, np.ones(len(points), dtype=bool)
        with np.errstate(all="ignore"):
            for _ in range(MOST_CORRECTIONS):
                solutions = solutions + self._times_approximate_inverse(points, missed)
                missed = targets - self._applied(points, solutions)
                bound = self._rounding(points, solutions, targets)
                # Where squares overflow nothing is known of either.
                unsolved = ~((np.linalg.norm(missed, axis=(1, 2)) <= bound) & np.isfinite(bound))
                if not unsolved.any():
                    return solutions
        for place in np.flatnonzero(unsolved):
            e = None if self.E is None else self.E.T
            solutions[place] = next(resolved(e, self.A.T, targets[place].T, points[[place]]))[0].T
        return solutions

    def _times_approximate_inverse(self, points: ComplexArray, rows: ComplexArray) -> ComplexArray:
        """Return rows times the inverse, as well as the eigenvectors have it."""
        moved = (rows @ self.vectors) * (self.weights / (1.0 + (points[:, None] - self.at) * self.values))[:, None, :]
        flat = moved.reshape(-1, moved.shape[2])
        solved = lapack.zgetrs(*self.factors, flat.T, trans=1)[0].T
        return np.asarray(solved if self.first is None else solved @ self.first).reshape(rows.shape)

    def _applied(self, points: ComplexArray, rows: ComplexArray) -> ComplexArray:
        moved = rows if self.E is None else rows @ self.E
        return np.asarray(points[:, None, None] * moved - rows @ self.A)

    def _rounding(self, points: ComplexArray, solutions: ComplexArray, targets: ComplexArray) -> FloatArray:
        size = np.sqrt(len(self.A)) if self.E is None else float(np.linalg.norm(self.E))
        terms = (np.abs(points) * size + float(np.linalg.norm(self.A))) * np.linalg.norm(solutions, axis=(1, 2))
        unit = ROUNDINGS_LEFT * float(np.finfo(np.float64).eps)
        return np.asarray(unit * (terms + np.linalg.norm(targets, axis=(1, 2))))
