"""Units in which the entries of several matrices are near one, by robust least squares on their logarithms.

Changing the units of the data only shifts the unknowns, and every pass keeps it at that, so that the scaled matrices
are the same whatever units the data came in.  Rounding the factors to powers of two makes the scaling exact, at the
price of a factor of two in that.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from obsynth.numerics.arrays import FloatArray

#: Makes the factors unique where nothing determines them; too small to move them elsewhere.
RIDGE = 1e-11
#: Weight of a wish, which decides only what the entries leave open.
WISH_WEIGHT = 1e-8
#: An entry this many bits below one has half a say: what is far below is coupling that hardly counts, or rounding.
HALF_SAY = 10.0
#: Passes in which small entries lose their say.
PASSES = 3


@dataclass(eq=False)
class LogBalance:
    """Minimise ``log2 abs(M[i, j]) + row[i] + column[j] + common`` over all nonzero entries of matrices.

    Fields: count: Number of unknowns: binary logarithms of factors.
    """

    count: int
    _terms: list[_Term] = field(default_factory=list)
    _wishes: list[tuple[int, float]] = field(default_factory=list)

    def add(
        self,
        matrix: FloatArray,
        rows: Sequence[int],
        columns: Sequence[int],
        *,
        signs: tuple[int, int] = (1, 1),
        common: int | None = None,
        weight: float = 1.0,
    ) -> None:
        """Ask for entries near one.

        Shapes: ``matrix (m, n)``.
        """
        i, j = np.nonzero(matrix)
        unknowns = [np.array(rows, dtype=np.int64)[i], np.array(columns, dtype=np.int64)[j]]
        if common is not None:
            unknowns.append(np.full(len(i), common))
        self._terms.append(_Term(np.log2(np.abs(matrix[i, j])), tuple(unknowns), (*signs, 1)[: len(unknowns)], weight))

    def wish(self, unknown: int, exponent: float) -> None:
        """Ask for a value where the entries leave the unknown open."""
        self._wishes.append((unknown, exponent))

    def solve(self) -> FloatArray:
        """Return the exponents ``(count,)``, not rounded."""
        found = self._solved([np.full(len(term.sizes), term.weight) for term in self._terms])
        for _ in range(PASSES):
            found = self._solved([term.weight * term.say(found) for term in self._terms])
        return found

    def _solved(self, weights: Sequence[FloatArray]) -> FloatArray:
        n = self.count
        normal, right = RIDGE * np.eye(n), np.zeros(n)
        for term, weight in zip(self._terms, weights, strict=True):
            for p, sign in zip(term.unknowns, term.signs, strict=True):
                right -= sign * np.bincount(p, weight * term.sizes, n)
                for q, other in zip(term.unknowns, term.signs, strict=True):
                    normal += sign * other * np.bincount(p * n + q, weight, n * n).reshape(n, n)
        for unknown, exponent in self._wishes:
            normal[unknown, unknown] += WISH_WEIGHT
            right[unknown] += WISH_WEIGHT * exponent
        return np.asarray(np.linalg.solve(normal, right), dtype=np.float64)


@dataclass(frozen=True, eq=False)
class _Term:
    """The nonzero entries of one matrix, and the unknowns that scale each of them."""

    sizes: FloatArray
    unknowns: tuple[NDArray[np.int64], ...]
    signs: tuple[int, ...]
    weight: float

    def say(self, exponents: FloatArray) -> FloatArray:
        """Return the say of each entry: all of it above one, less the further it is below."""
        sizes = self.sizes.copy()
        for unknown, sign in zip(self.unknowns, self.signs, strict=True):
            sizes += sign * exponents[unknown]
        return np.asarray(1.0 / (1.0 + (np.minimum(sizes, 0.0) / HALF_SAY) ** 2))
