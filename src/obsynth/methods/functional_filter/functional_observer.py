r"""Observers of least order for functionals of the state, ``w = K x``, free of faults and unknown inputs.

On the decoupled plant, ``xi+ = A xi + B v``, ``eta = C xi`` with v = [u; y] and eta known, ``w = R xi`` (up to what is
known) is estimated by ``z+ = N z + J eta + Theta B v`` with ``Theta = R - Ec C``.  Such an observer of the order of R
exists when the rows of ``R A`` are combinations of those of ``[R; C A; C]`` and a pair has no mode that is too slow
(M. Darouach, "Existence and design of functional observers for linear systems", IEEE TAC 45(5), 2000, Theorem 2).
Where it does not, rows are added to R (T. Fernando, H. Trinh, L. Jennings, "Functional observability and the design of
minimum order linear functional observers", IEEE TAC 55(5), 2010), at the latest up to the reduced-order observer.

Unlike there: unknown inputs, faults and any index, by the decoupling; N by a Riccati equation, or from given poles.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from obsynth.analysis.existence.functional_states import StateGoals
from obsynth.errors import SolverError
from obsynth.methods.functional_filter.assembly import FilterPart, OutputRows
from obsynth.methods.functional_filter.kalman_gain import FilterModel
from obsynth.numerics.arrays import SMALLEST, FloatArray
from obsynth.numerics.eigenstructure import place
from obsynth.numerics.matrix_equations import continuous_solution, riccati_solution
from obsynth.numerics.ranks import numerical_rank, product_but_rounding, rank_from
from obsynth.numerics.requested_poles import checked_poles
from obsynth.numerics.spectra import abscissa

#: Beside the wanted rate, modes of the pair within this share of it are too slow: a gain could hardly move them.
AS_SLOW = 1.01


@dataclass(frozen=True, eq=False)
class _Structure:
    """Rows ``R (q, n)`` with ``R A = X [R; C A; C]``, and W, all rows with ``W [R; C A; C] = 0``."""

    R: FloatArray
    X: FloatArray
    W: FloatArray

    @property
    def order(self) -> int:
        return len(self.R)

    @property
    def pair(self) -> tuple[FloatArray, FloatArray]:
        """F and H of ``N = F + Z H``, Z free."""
        return self.X[:, : self.order], self.W[:, : self.order]


def functional_part(
    model: FilterModel, goals: StateGoals, *, rate: float, poles: Sequence[Any] | None, places: Sequence[int]
) -> FilterPart:
    """Return the filter of states ``places`` of the plant, from the model without faults and unknown inputs.

    ``rate``: every error decays at this or faster, 1/s; or as the ``poles`` have it.
    """
    structure = _structure(model, goals.moving, rate, any_pole=poles is not None)
    f, h = structure.pair
    if poles is None:
        z = -_fast_gain(f, h, rate, model.dt)
    else:
        fixed = np.zeros(0, dtype=np.complex128)
        wanted_poles = checked_poles(poles, structure.order, fixed, model.dt, of="functional-filter")
        z = -place(f, h, wanted_poles, dt=model.dt)[0]
    q, p = structure.order, len(model.C)
    rows: FloatArray = np.asarray(structure.X + z @ structure.W)
    n, ec, k0 = np.split(rows, [q, q + p], axis=1)
    theta, j = structure.R - ec @ model.C, k0 + n @ ec
    known = OutputRows(np.zeros((p, q)), model.L, model.T0)
    own = OutputRows(n, product_but_rounding(theta, model.B), product_but_rounding(theta, model.T))
    # moving = p0 R + q0 C
    combined = _combinations(goals.moving, np.vstack([structure.R, model.C]))
    p0, q0 = combined[:, :q], combined[:, q:]
    estimates = OutputRows(p0, goals.known, goals.T0).plus(known.times(p0 @ ec + q0))
    return FilterPart(
        own.plus(known.times(j)),
        estimates,
        OutputRows(np.zeros((0, q)), np.zeros((0, model.L.shape[1])), np.zeros((0, model.T.shape[1]))),
        (),
        0,
        tuple(places),
    )


def _structure(model: FilterModel, moving: FloatArray, rate: float, *, any_pole: bool) -> _Structure:
    """Return the rows to follow: those asked for that are not known, and as many more as it takes."""
    a, c = model.A, model.C
    ca = c @ a
    rows = _rows_beside(moving, c)
    while True:
        sigma = np.vstack([rows, ca, c])
        moved = rows @ a
        more = _rows_beside(moved, sigma)
        if not len(more):
            structure = _Structure(rows, _combinations(moved, sigma), _left_null(sigma))
            if not len(rows) or _assignable(*structure.pair, rate, model.dt, any_pole=any_pole):
                return structure
            # With C A among the rows nothing of the outputs' motion is left unused.
            more = _rows_beside(ca, np.vstack([rows, c]))
            if not len(more):
                more = _rows_beside(np.eye(len(a)), np.vstack([rows, c]))
            if not len(more):
                # What is left moves with zeros of the plant: slower than wished by default, but it decays.
                return structure
        rows = np.vstack([rows, more])


def _rows_beside(rows: FloatArray, spanning: FloatArray) -> FloatArray:
    """Return orthonormal rows that span what ``rows`` have beside the span of ``spanning``."""
    if not rows.size:
        return np.zeros((0, rows.shape[1]))
    sizes = np.linalg.norm(rows, axis=1, keepdims=True)
    rows = rows[sizes[:, 0] > 0.0] / sizes[sizes[:, 0] > 0.0]
    basis = _row_basis(spanning)
    remainder = rows - (rows @ basis.T) @ basis
    remainder = remainder - (remainder @ basis.T) @ basis
    _, values, right = np.linalg.svd(remainder)
    return np.asarray(right[: numerical_rank(values, scale=1.0)])


def _row_basis(matrix: FloatArray) -> FloatArray:
    if not matrix.size:
        return np.zeros((0, matrix.shape[1]))
    sizes = np.linalg.norm(matrix, axis=1, keepdims=True)
    _, values, right = np.linalg.svd(matrix / np.where(sizes > 0.0, sizes, 1.0))
    return np.asarray(right[: rank_from(values, expected=min(matrix.shape)).rank])


def _combinations(rows: FloatArray, sigma: FloatArray) -> FloatArray:
    """Return X with ``X sigma = rows``, the least one."""
    if not rows.size or not sigma.size:
        return np.zeros((len(rows), len(sigma)))
    return np.asarray(np.linalg.lstsq(sigma.T, rows.T, rcond=None)[0].T)


def _left_null(sigma: FloatArray) -> FloatArray:
    """Return an orthonormal basis ``(count, rows)`` of W with ``W sigma = 0``."""
    if not sigma.size:
        return np.eye(len(sigma))
    basis, values, _ = np.linalg.svd(sigma)
    return np.asarray(basis[:, rank_from(values, expected=min(sigma.shape)).rank :].T)


def _assignable(f: FloatArray, h: FloatArray, rate: float, dt: float, *, any_pole: bool) -> bool:
    """Whether every mode of ``F + Z H`` that no Z moves decays faster than at ``rate`` (1/s); or none is there."""
    modes = np.linalg.eigvals(f)
    if not any_pole:
        slow = np.abs(modes) >= np.exp(-AS_SLOW * rate * dt) if dt > 0.0 else modes.real >= -AS_SLOW * rate
        modes = modes[slow]
    size = max(1.0, float(np.linalg.norm(f, 2)))
    for mode in modes:
        pencil = np.vstack([(mode * np.eye(len(f)) - f) / size, h])
        if numerical_rank(np.linalg.svd(pencil, compute_uv=False), scale=1.0) < len(f):
            return False
    return True


def _fast_gain(f: FloatArray, h: FloatArray, rate: float, dt: float) -> FloatArray:
    """Return K with ``F - K H`` at least as fast as ``rate`` (1/s), by a Riccati equation."""
    q, p = len(f), len(h)
    if not q:
        return np.zeros((0, p))
    if not p:
        return np.zeros((q, 0))
    # Modes that no gain moves may be slower than the rate: they get what the rest can have.
    for decay in (rate, 0.5 * rate, 0.1 * rate, 0.0):
        if dt > 0.0:
            growth = float(np.exp(decay * dt))
            covariance = riccati_solution(growth * f, h, np.eye(q), np.eye(p), np.zeros((q, p)))
            gain = (
                None if covariance is None else f @ covariance @ h.T @ np.linalg.inv(h @ covariance @ h.T + np.eye(p))
            )
        else:
            process, shifted = max(rate, SMALLEST) ** 2 * np.eye(q), f + decay * np.eye(q)
            covariance = continuous_solution(shifted, h, process, np.eye(p), np.zeros((q, p)))
            gain = None if covariance is None else covariance @ h.T
        limit = np.exp(-decay * dt) if dt > 0.0 else -decay
        if gain is not None and abscissa(f - gain @ h, dt) < limit:
            return np.asarray(gain)
    raise SolverError(
        "The Riccati equation of the functional observer has no stable solution that double precision could find: give "
        "poles, or a smaller decay."
    )
