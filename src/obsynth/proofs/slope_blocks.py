r"""One matrix in place of all corners of slopes: order n + q, with a diagonal multiplier, in continuous time.

``E e' = (M + F diag(d) V) e + B w``, ``z = Cz e + Dz w``, every ``|d_k| <= 1`` as it likes.  With ``T >= 0`` diagonal

.. math::
    -\begin{bmatrix} G^T M + M^T G + 2 a P + C_z^T C_z + V^T T V & G^T F & G^T B + C_z^T D_z \\ * & -T & 0 \\
    * & * & D_z^T D_z - g I \end{bmatrix} > 0

proves of every d what the inequality without F proves of M: multiply by ``[e; diag(d) V e; w]``, where
``sum T_k (|V_k e|^2 - |d_k V_k e|^2) >= 0`` (S-procedure).  Decay has no Cz and no w; the
mean square no w, and a trace.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from obsynth.numerics.arrays import FloatArray
from obsynth.proofs.extended_balls import Enclosed, block


class _Formed(Protocol):
    """Forms a matrix in a kind of arithmetic."""

    def __call__(self, kind: type[Enclosed], /) -> Enclosed: ...


@dataclass(frozen=True, eq=False)
class SlopeBlock:
    """An error system with slopes between -1 and 1.

    Parameters
    ----------
    nominal : callable
        As a vertex: of a kind of arithmetic to M ``(n, n)``, B ``(n, p)``, Cz ``(q, n)`` and Dz ``(q, p)``.
    slopes : callable
        Of a kind of arithmetic to F ``(n, q)`` and V ``(q, n)``.
    count : int
        Number of slopes q.
    """

    nominal: Callable[[type[Enclosed]], tuple[Enclosed, Enclosed, Enclosed, Enclosed]]
    slopes: Callable[[type[Enclosed]], tuple[Enclosed, Enclosed]]
    count: int

    def problem(self, multiplier: FloatArray | None) -> str:
        """Return why a multiplier is none; empty where it is one."""
        if multiplier is None or np.shape(multiplier) != (self.count,):
            return f"there are no multipliers of {self.count} slopes"
        if not np.isfinite(multiplier).all() or (multiplier < 0.0).any():
            return "a multiplier of a slope is negative, or no number"
        return ""

    def formulas(
        self,
        P: FloatArray,
        G: FloatArray,
        differential: int,
        multiplier: FloatArray,
        *,
        gain: float | None,
        decay: float | None,
        power: float | None,
    ) -> Iterator[tuple[str, _Formed]]:
        """Yield the matrices that must be positive definite, with their names."""
        yield "P", lambda kind: kind.exact(P[:differential, :differential])
        if gain is not None or power is not None:
            yield "block", self._flow(P, G, multiplier, gain, 0.0, with_outputs=True)
        if decay is not None:
            yield "block", self._flow(P, G, multiplier, None, decay, with_outputs=False)
        if power is not None:
            yield "mean square", self._trace(P, power)

    def _flow(
        self,
        P: FloatArray,
        G: FloatArray,
        multiplier: FloatArray,
        gain: float | None,
        rate: float,
        *,
        with_outputs: bool,
    ) -> _Formed:
        def formula(kind: type[Enclosed]) -> Enclosed:
            m, b, cz, dz = self.nominal(kind)
            into, V = self.slopes(kind)
            g, T = kind.exact(G), kind.exact(np.diag(multiplier))
            moved = g.T @ m
            first = -(moved + moved.T) - kind.exact(P).scaled(2.0).scaled(rate) - V.T @ (T @ V)
            first = first - cz.T @ cz if with_outputs else first
            across = -(g.T @ into)
            if gain is None:
                return block([[first, across], [across.T, T]])
            driven, p = -(g.T @ b + cz.T @ dz), dz.shape[1]
            level = kind.exact(np.eye(p)).scaled(gain).scaled(gain) - dz.T @ dz
            nothing = kind.exact(np.zeros((self.count, p)))
            return block([[first, across, driven], [across.T, T, nothing], [driven.T, nothing.T, level]])

        return formula

    def _trace(self, P: FloatArray, power: float) -> _Formed:
        def formula(kind: type[Enclosed]) -> Enclosed:
            _, b, _, dz = self.nominal(kind)
            return mean_square_form(kind, kind.exact(P), b, dz, power)

        return formula


def mean_square_form(kind: type[Enclosed], lyapunov: Enclosed, b: Enclosed, dz: Enclosed, level: float) -> Enclosed:
    """Return ``level^2 - |Dz|^2 - tr B'PB``, positive where the mean of ``|z|^2`` is below ``level^2``."""
    total = kind.exact(np.ones((1, 1))).scaled(level).scaled(level)
    for unit in np.eye(b.shape[1])[:, :, None]:
        column, direct = b @ kind.exact(unit), dz @ kind.exact(unit)
        total = total - column.T @ (lyapunov @ column) - direct.T @ direct
    return total
