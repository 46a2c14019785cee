"""Extreme vertices of a polytope of error systems: only these need an inequality.

With one Lyapunov matrix the inequality at a mean of vertices is the mean of theirs.  With it the same problem has
another centre, and a solver ends at other gains: a redundant vertex shall change no design.  Gains there are the same
mean; what ships is proved at every vertex all the same.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from obsynth.numerics.arrays import FloatArray
from obsynth.numerics.convex_hulls import spanning_points
from obsynth.verification.error_polytope import ErrorPolytope

_PARTS = ("A", "B", "C", "D", "Cz", "Dz")


@dataclass(frozen=True, eq=False)
class ExtremeVertices:
    """A polytope of the vertices that span another, and each of its vertices as their mean.

    Parameters
    ----------
    errors : ErrorPolytope
        Of the vertices that span it.
    weights : FloatArray
        ``(N, used)``: of every vertex.
    given : list of FloatArray, optional
        Given gains at the vertices that span it, or one for all.
    """

    errors: ErrorPolytope
    weights: FloatArray
    given: list[FloatArray] | None = None

    @classmethod
    def of(cls, errors: ErrorPolytope, gains: Sequence[FloatArray] | None = None) -> ExtremeVertices | None:
        """Return the vertices that span a polytope; ``None`` where all of them do, or are too many to examine.

        Given ``gains`` are part of a vertex where each has its own.
        """
        own = [np.asarray(gain, np.float64) for gain in gains or []]
        flat = []
        for i in range(errors.count):
            matrices = [getattr(errors, name)[i] for name in _PARTS] + (own[i : i + 1] if len(own) > 1 else [])
            flat.append(np.concatenate([matrix.ravel() for matrix in matrices]))
        spanning = spanning_points(flat)
        if spanning is None:
            return None
        used, weights = spanning
        parts: dict[str, Any] = {name: [getattr(errors, name)[i] for i in used] for name in _PARTS}
        given = [own[i] for i in used] if len(own) > 1 else own
        return cls(replace(errors, **parts), weights, None if gains is None else given)

    def gains(self, extreme: Sequence[FloatArray]) -> list[FloatArray]:
        """Return the gains at every vertex, of those at the vertices that span the polytope; one for all stays one."""
        if len(extreme) == 1:
            return list(extreme)
        return [
            np.asarray(sum((w * L for w, L in zip(row, extreme, strict=True) if w), 0.0 * extreme[0]))
            for row in self.weights
        ]
