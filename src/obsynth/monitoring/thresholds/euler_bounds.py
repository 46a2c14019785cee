r"""Bounds of the errors of a scheduled observer in continuous time that runs by steps of implicit Euler.

``s = T E x`` moves from row to row by the integral of ``T (A x + B u + Bd d)``, the observer by h times what that is at
the row.  With h the seconds since the row before, ``e = s - z`` obeys

.. math::
    (I - h A_z(\mu_k)) e_k = e_{k-1} + \int T (A(\mu) x + B(\mu) u - A(\mu_k) x_k - B(\mu_k) u_k) dt
    + \int T B_d(\mu) d \, dt - h B_y(\mu_k) (D_d d_k + D_w w_k).

Where errors of the exact observer decay like :math:`e^{-a t}` in the norm of P for every course, the matrix on the left
makes that norm at least ``1 + a h`` times as large.  The first integral is what a step misses of the plant's own
motion.  It is bounded from the state at the row, which is the estimate but for its error, and that is bounded by e.
Weights of the vertices and known inputs are taken to stay between their values at both rows.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np

from obsynth.numerics.arrays import FloatArray, sums_of_column_norms
from obsynth.verification.over_tolerances.responses import OUTWARD

#: Exponents below which ``e^x - 1 - x - x^2 / 2`` is taken as the first term of its series and a bound of the others:
#: the difference has lost all but six digits there.
SERIES_BELOW = 1e-3
#: Exponents of a step beyond which nothing is known of the plant between rows.
MOST_GROWTH = 50.0


class PlantMotion(NamedTuple):
    """The plant ``v' = A v + B u + Bd d`` at its vertices, and ``v = vhat + S e - N q``: every input in d and q is at
    most one."""

    A: FloatArray  # ``(N, n, n)``
    B: FloatArray  # ``(N, n, nu)``
    Bd: FloatArray  # ``(N, n, nd)``
    estimated: FloatArray  # ``(n, nx)``: vhat of the state estimates
    by_error: FloatArray  # S ``(n, nz)``
    by_noise: FloatArray  # N ``(n, m)``
    units: FloatArray  # ``(n,)``: sizes of the states beside each other


class RowChange(NamedTuple):
    """A row, and by how much its signals may differ from those since the row before."""

    seconds: float
    states: FloatArray  # ``(n,)``: vhat
    inputs: FloatArray  # ``(nu,)``
    moved: FloatArray  # ``(nu,)``: largest change of each input
    weights: FloatArray  # ``(N,)``
    turned: FloatArray  # ``(N,)``: largest change of each weight


@dataclass(frozen=True, eq=False)
class EulerErrorBound:
    """The bound ``|e_k| <= (|e_{k-1}| + added) / (1 + a h - own)`` from row to row, in the norm of one P.

    Parameters
    ----------
    motion : PlantMotion
        The plant.
    tracking : FloatArray
        ``(nz, n)``: the observer's state follows ``tracking @ v``.
    root : FloatArray
        ``(nz, nz)``: ``|e|`` is the norm of ``root @ e``.
    decay : float
        Of the exact observer in that norm, 1/s; proved.
    driven : float
        What disturbances and noise add to ``|e|`` in a second.
    """

    motion: PlantMotion
    tracking: FloatArray
    root: FloatArray
    decay: float
    driven: float

    def after(self, size: float, row: RowChange) -> tuple[float, float]:
        """Return the bound after a row, and the share of an error before it that is left; infinite where none is
        known."""
        h, turned, units = row.seconds, row.turned, self.motion.units
        if not self.growth * h < MOST_GROWTH:
            return np.inf, np.inf
        A, B = (np.tensordot(row.weights, part, 1) for part in (self.motion.A, self.motion.B))
        slope = A @ row.states + B @ row.inputs
        turns = self.A_turns @ row.states + self.B_turns @ row.inputs
        # By how much slopes since the row before may differ from the one that is estimated at the row.
        spread = turned @ _norms(turns / units) + row.moved @ self.slope_of_inputs + self.slope_of_noise
        second, third = 0.5 * h * h, third_order(self.growth, h)
        missed = h * (turned @ (_norms(turns @ self.drive.T) + self.turned_noise) + row.moved @ self.drive_of_inputs)
        missed += second * (_norms(self.drive @ A @ slope) + turned @ _norms(self.A_turns @ slope @ self.drive.T))
        missed += self.drift * ((second + third) * spread + third * _norms(slope / units))
        own = h * (turned @ self.turned_error) + self.drift * (second + third) * self.slope_of_error
        left = 1.0 + self.decay * h - float(own) * OUTWARD
        if not left > 0.0:
            return np.inf, np.inf
        return (size + (float(missed) + h * self.driven) * OUTWARD) / left * OUTWARD, OUTWARD / left

    @cached_property
    def drive(self) -> FloatArray:
        """From slopes of the plant to the norm of e."""
        return np.asarray(self.root @ self.tracking)

    @cached_property
    def error(self) -> FloatArray:
        """From e in its norm to the state of the plant."""
        return np.asarray(self.motion.by_error @ np.linalg.inv(self.root))

    @cached_property
    def A_turns(self) -> FloatArray:
        """``(N, n, n)``: A at each vertex less their mean."""
        return np.asarray(self.motion.A - self.motion.A.mean(axis=0))

    @cached_property
    def B_turns(self) -> FloatArray:
        """``(N, n, nu)``: the same of B."""
        return np.asarray(self.motion.B - self.motion.B.mean(axis=0))

    @cached_property
    def growth(self) -> float:
        """By how much states may grow in a second, in their units."""
        return _largest(self.motion.A * self.motion.units / self.motion.units[:, None])

    @cached_property
    def drift(self) -> float:
        """How much a change of the states, in their units, drives e."""
        return _largest(self.drive @ self.motion.A * self.motion.units)

    @cached_property
    def slope_of_error(self) -> float:
        """How much an error changes the slopes of the states, in their units."""
        return _largest(self.motion.A @ self.error / self.motion.units[:, None])

    @cached_property
    def slope_of_noise(self) -> float:
        """How much disturbances and noise change these."""
        parts = np.concatenate([self.motion.A @ self.motion.by_noise, self.motion.Bd], axis=2)
        return float(np.max(sums_of_column_norms(parts / self.motion.units[:, None]), initial=0.0))

    @cached_property
    def slope_of_inputs(self) -> FloatArray:
        """``(nu,)``: how much each input changes these."""
        return np.asarray(np.max(np.linalg.norm(self.motion.B / self.motion.units[:, None], axis=1), axis=0))

    @cached_property
    def drive_of_inputs(self) -> FloatArray:
        """``(nu,)``: how much each input drives e."""
        return np.asarray(np.max(np.linalg.norm(self.drive @ self.motion.B, axis=1), axis=0))

    @cached_property
    def turned_error(self) -> FloatArray:
        """``(N,)``: how much a turned weight drives e by the error of the state."""
        return np.asarray(np.linalg.norm(self.drive @ self.A_turns @ self.error, 2, axis=(1, 2)))

    @cached_property
    def turned_noise(self) -> FloatArray:
        """``(N,)``: how much it drives e by disturbances and noise."""
        return sums_of_column_norms(self.drive @ self.A_turns @ self.motion.by_noise)


def third_order(growth: float, seconds: float) -> float:
    """Return ``(e^x - 1 - x - x^2 / 2) / growth^2`` for ``x = growth seconds``, or a little more."""
    x = growth * seconds
    if x < SERIES_BELOW:
        return seconds**2 * x / 6.0 * (1.0 + x)
    # Each term of the difference may be rounded, the first of which are x.
    rounded = 8.0 * float(np.finfo(np.float64).eps) * (float(np.expm1(x)) + x)
    return (float(np.expm1(x)) - x - 0.5 * x * x + rounded) / growth**2


def _norms(rows: FloatArray) -> FloatArray:
    """Return the norms of rows."""
    return np.asarray(np.linalg.norm(rows, axis=-1))


def _largest(matrices: FloatArray) -> float:
    """Return the largest spectral norm of matrices ``(N, m, n)``."""
    return float(np.max(np.linalg.norm(matrices, 2, axis=(1, 2)))) if matrices.size else 0.0
