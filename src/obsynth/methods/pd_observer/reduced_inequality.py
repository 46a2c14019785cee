r"""PD observers of plants with many states: a smaller inequality with the way back in closed form, or none at all.

By the elimination lemma, where ``C = [0 R]``, R of full column rank, what is left is ``P1 > 0`` and the same inequality
with Z = 0 for ``(A11, A21)`` (blocks of ``A + alpha I``): a reduced-order observer with gain G.  The way back,

.. math::
    L = 0, \qquad J = \begin{bmatrix} A_{12} + (A_{11} + \kappa I) G \\ A_{22} + A_{21} G + \kappa I \end{bmatrix} R^+

leaves ``[F, 0; A21, -kappa I]``, ``F = A11 - G A21``, in the states ``[x1 - G x2; x2]``.  With second blocks
``p (1 + delta kappa) I``, ``p I`` of block diagonal P1, P3, the inequality is that of F beside
``-2 p diag(kappa, delta)``, coupled by ``p [A21; delta A21]``: negative when ``p h (1 / kappa + delta) < 2``, h the
norm of ``A21 K A21'``, K the leading block of the inverse of minus the inequality of F.  Gains do not depend on p.
(The general formula of the lemma gives gains 40 to 100 times larger than those of the whole inequality.)
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from obsynth.errors import SolverError
from obsynth.methods.pd_observer.certificate import coupled_certificate, symmetric_certificate
from obsynth.methods.pd_observer.inequalities import PdSolution, PdTask, solve
from obsynth.methods.riccati import continuous_solution
from obsynth.numerics.arrays import FloatArray
from obsynth.numerics.continuous import spectral_abscissa
from obsynth.numerics.doubling import EQUATION_TOLERANCE, continuous_riccati_solution
from obsynth.numerics.ranks import NEGLIGIBLE_SHARE, decide_rank

#: Share of its limit at which p, and delta where it is free, is taken.
SHARE = 0.5
#: Times that states are changed to those in which a Riccati solution is near one.
MOST_NORMALISATIONS = 4
#: With more states the Riccati equation is solved by doubling first.
MANY_STATES = 60
#: With more still, the QZ algorithm would take minutes.
MOST_STATES_FOR_QZ = 200


@dataclass(frozen=True, eq=False)
class ReducedPlant:
    """A plant in coordinates in which its outputs show the last states alone."""

    A: FloatArray  # (n, n), of the shifted plant
    hidden: int  # leading states that the outputs do not show
    basis: FloatArray  # (n, n), orthogonal: old states = basis times new
    inverse: FloatArray  # (n - hidden, ny), pseudoinverse of R

    @classmethod
    def of(cls, a: FloatArray, c: FloatArray) -> ReducedPlant:
        """Return the plant ``a (n, n)``, ``c (ny, n)`` in such coordinates."""
        rank = decide_rank(c).rank
        left, values, right = np.linalg.svd(c)
        basis = np.vstack([right[rank:], right[:rank]]).T
        inverse = left[:, :rank].T / values[:rank, None]
        return cls(basis.T @ a @ basis, len(a) - rank, basis, inverse)

    def blocks(self) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
        """Return A11, A12, A21, A22."""
        k = self.hidden
        return self.A[:k, :k], self.A[:k, k:], self.A[k:, :k], self.A[k:, k:]


def reduced_lmi(task: PdTask, *, solver: str) -> PdSolution:
    """Return gains by the smaller inequality, for a task of stability and a decay rate."""
    a, c = task.plants[0]
    plant = ReducedPlant.of(a + task.decay * np.eye(len(a)), c)
    a11, _, a21, _ = plant.blocks()
    if plant.hidden == 0:
        none = np.zeros((0, 0))
        return _lifted(task, plant, np.zeros((0, len(a21))), none, none, {"what": _WHAT, "solver": "none needed"})
    smaller = replace(task, plants=((a11, a21),), decay=0.0, has_derivative=False)
    found = solve(smaller, solver=solver)
    return _lifted(task, plant, found.J, found.P1[0], found.P3, found.record)


def closed_form(task: PdTask, *, free_delta: bool, once: bool = False) -> tuple[PdSolution, float]:
    """Return gains for unit noise from a Riccati equation, L = 0, their certificate, and the delta that it is for."""
    try:
        return _closed_form(task, free_delta=free_delta)
    except SolverError as error:
        if once or "delta_limit" in error.record:
            raise
        failure = error
    a, c = task.plants[0]
    states = inverse = np.eye(len(a))
    for _ in range(MOST_NORMALISATIONS):
        found = _normalising(inverse @ a @ states, c @ states)
        if found is None:
            raise failure
        states, inverse = states @ found[0], found[1] @ inverse
        moved = replace(task, plants=((inverse @ a @ states, c @ states),))
        try:
            own, delta = _closed_form(moved, free_delta=free_delta)
        except SolverError:
            continue
        p1, p3 = (inverse.T @ part @ inverse for part in (own.P1[0], own.P3))
        return replace(own, J=states @ own.J, L=states @ own.L, P1=(0.5 * (p1 + p1.T),), P3=p3), delta
    raise failure


def _normalising(a: FloatArray, c: FloatArray) -> tuple[FloatArray, FloatArray] | None:
    """Return a change of states, and its inverse, in which the solution of the Riccati equation is near one."""
    p = _doubled(a, c)
    if p is None and len(a) <= MOST_STATES_FOR_QZ:
        p = continuous_solution(a, c, np.eye(len(a)), np.eye(len(c)))
    if p is None:
        return None
    sizes, directions = np.linalg.eigh(0.5 * (p + p.T))
    roots = np.sqrt(np.maximum(sizes, NEGLIGIBLE_SHARE * sizes[-1]))
    return directions * roots, (directions / roots).T


def _closed_form(task: PdTask, *, free_delta: bool) -> tuple[PdSolution, float]:
    a, c = task.plants[0]
    shifted = a + task.decay * np.eye(len(a))
    record = {"what": _WHAT, "solver": "Riccati equation, LAPACK"}
    gain = _riccati_gain(shifted, c, record)
    moving = shifted - gain @ c
    found = symmetric_certificate(moving)
    if found is None:
        raise SolverError(
            "A Riccati equation gave gains that are not stable: the result is inconclusive.", record=record
        )
    delta = min(task.delta, SHARE * found.limit) if free_delta else task.delta
    if delta < found.limit:
        p1, p3 = found.P1(delta), found.P3
    elif task.theorem == 1:
        p1, p3 = coupled_certificate(moving, delta)
    else:
        raise SolverError(
            "The closed form serves Theorem 2 for smaller delta alone: take engine 'reduced-lmi', or leave delta out.",
            record={**record, "delta_limit": found.limit},
        )
    return PdSolution(gain, np.zeros_like(gain), (0.5 * (p1 + p1.T),), p3, record), delta


_WHAT = "a PD observer with L = 0"


def _riccati_gain(a: FloatArray, c: FloatArray, record: Mapping[str, Any]) -> FloatArray:
    """Return the gain of a Kalman filter for unit noise: of many states by doubling, else from the Hamiltonian matrix.

    Where that is not found, or not stable, by the QZ algorithm on a pencil, which takes several times as long.
    """
    from scipy.linalg import schur

    n, one = len(a), np.eye(len(a))
    p = _doubled(a, c)
    if p is not None and spectral_abscissa(a - p @ c.T @ c) < 0.0:
        return np.asarray(p @ c.T)
    try:
        _, basis, stable = schur(np.block([[a.T, -c.T @ c], [-one, -a]]), sort="lhp")
        p = np.linalg.solve(basis[:n, :n].T, basis[n:, :n].T)
        gain = np.asarray(0.5 * (p + p.T) @ c.T)
        if stable == n and spectral_abscissa(a - gain @ c) < 0.0:
            return gain
    except np.linalg.LinAlgError:
        pass
    p = None if n > MOST_STATES_FOR_QZ else continuous_solution(a, c, one, np.eye(len(c)))
    if p is None:
        raise SolverError("The Riccati equation was not solved: the result is inconclusive.", record=record)
    return np.asarray(p @ c.T)


def _doubled(a: FloatArray, c: FloatArray) -> FloatArray | None:
    """Return the solution of the equation of `_riccati_gain` for many states, in a tenth of the time of eigenvalues."""
    if len(a) <= MANY_STATES:
        return None
    p = continuous_riccati_solution(a, c, np.eye(len(a)), np.eye(len(c)))
    if p is None:
        return None
    terms = (a @ p, p @ c.T @ c @ p, np.eye(len(a)))
    left = float(np.linalg.norm(terms[0] + terms[0].T - terms[1] + terms[2]))
    return p if left <= EQUATION_TOLERANCE * sum(float(np.linalg.norm(term)) for term in terms) else None


def _lifted(
    task: PdTask, plant: ReducedPlant, gain: FloatArray, p1: FloatArray, p3: FloatArray, record: Mapping[str, Any]
) -> PdSolution:
    """Return the gains and the certificate of the whole inequality; see the module's text."""
    a11, a12, a21, a22 = plant.blocks()
    k, shown, delta = plant.hidden, len(a22), task.delta
    moving = a11 - gain @ a21
    kappa = -spectral_abscissa(moving) if k else 1.0 / delta
    form = _inequality(moving, p1, p3, delta)
    try:
        np.linalg.cholesky(-form)
        coupling = a21 @ np.linalg.solve(-form, np.eye(2 * k)[:, :k])[:k] @ a21.T
    except np.linalg.LinAlgError as error:
        raise SolverError("The smaller inequality does not hold for what was found.", record=record) from error
    size = float(np.linalg.norm(coupling, 2)) if k else 0.0
    p = 2.0 * SHARE / (size * (1.0 / kappa + delta)) if size > 0.0 else 1.0
    whole = np.block([[np.eye(k), -gain], [np.zeros((shown, k)), np.eye(shown)]]) @ plant.basis.T
    middle = [
        np.block([[leading, np.zeros((k, shown))], [np.zeros((shown, k)), last * np.eye(shown)]])
        for leading, last in ((p1, p * (1.0 + delta * kappa)), (p3, p))
    ]
    first, third = (whole.T @ part @ whole for part in middle)
    inner = np.vstack([a12 + (a11 + kappa * np.eye(k)) @ gain, a22 + a21 @ gain + kappa * np.eye(shown)])
    gain_j = plant.basis @ inner @ plant.inverse
    return PdSolution(gain_j, np.zeros_like(gain_j), (0.5 * (first + first.T),), third, record)


def _inequality(a: FloatArray, p1: FloatArray, p3: FloatArray, delta: float) -> FloatArray:
    """Return the matrix of the theorem for gains in hand with L = 0."""
    moving = p3.T @ a
    lower = p1 - p3 + delta * moving
    return np.block([[moving + moving.T, lower.T], [lower, -delta * (p3 + p3.T)]])
