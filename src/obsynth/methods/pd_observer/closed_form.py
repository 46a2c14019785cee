"""Gains of a PD observer in closed form, for many states: L = 0 and J of a Kalman filter for unit noise.

The certificate of the theorem comes from a Lyapunov equation of ``A - J C``, for a delta below a limit that it tells.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np

from obsynth.conditions.pd_inequalities import PdSolution, PdTask
from obsynth.errors import SolverError
from obsynth.methods.pd_observer.certificate import coupled_certificate, symmetric_certificate
from obsynth.numerics.arrays import FloatArray
from obsynth.numerics.doubling import continuous_riccati_solution, symmetric
from obsynth.numerics.gain_levels import EQUATION_TOLERANCE
from obsynth.numerics.matrix_equations import continuous_solution
from obsynth.numerics.ranks import NEGLIGIBLE_SHARE
from obsynth.numerics.spectra import abscissa

#: Share of its limit at which delta is taken where it is free.
DELTA_SHARE = 0.5

#: Times that states are changed to those in which a Riccati solution is near one.
MOST_NORMALISATIONS = 4

#: With more states the Riccati equation is solved by doubling first: at 60 states 5 ms for 12 ms of Schur vectors.
SCHUR_METHOD_UP_TO = 60

#: With more still the QZ algorithm is not tried, which is the last way: .7 s at 200 states, growing with their cube.
QZ_METHOD_UP_TO = 200

_WHAT = "a PD observer with L = 0"


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
        change = _normalising(inverse @ a @ states, c @ states)
        if change is None:
            raise failure
        states, inverse = states @ change[0], change[1] @ inverse
        moved = replace(task, plants=((inverse @ a @ states, c @ states),))
        try:
            own, delta = _closed_form(moved, free_delta=free_delta)
        except SolverError:
            continue
        p1, p3 = (inverse.T @ part @ inverse for part in (own.P1[0], own.P3))
        return replace(own, J=states @ own.J, L=states @ own.L, P1=(symmetric(p1),), P3=p3), delta
    raise failure


def _normalising(a: FloatArray, c: FloatArray) -> tuple[FloatArray, FloatArray] | None:
    """Return a change of states, and its inverse, in which the solution of the Riccati equation is near one."""
    p = _doubled(a, c)
    if p is None and len(a) <= QZ_METHOD_UP_TO:
        p = continuous_solution(a, c, np.eye(len(a)), np.eye(len(c)))
    if p is None:
        return None
    sizes, directions = np.linalg.eigh(symmetric(p))
    roots = np.sqrt(np.maximum(sizes, NEGLIGIBLE_SHARE * sizes[-1]))
    return directions * roots, (directions / roots).T


def _closed_form(task: PdTask, *, free_delta: bool) -> tuple[PdSolution, float]:
    a, c = task.plants[0]
    shifted = a + task.decay * np.eye(len(a))
    record = {"what": _WHAT, "solver": "Riccati equation, LAPACK"}
    gain = _riccati_gain(shifted, c, record)
    moving = shifted - gain @ c
    certificate = symmetric_certificate(moving)
    if certificate is None:
        raise SolverError(
            "A Riccati equation gave gains that are not stable: the result is inconclusive.", record=record
        )
    p3, weight, limit = certificate
    delta = min(task.delta, DELTA_SHARE * limit) if free_delta else task.delta
    if delta < limit:
        p1 = p3 + 0.5 * delta * weight
    elif task.theorem == 1:
        p1, p3 = coupled_certificate(moving, delta)
    else:
        raise SolverError(
            "The closed form serves Theorem 2 for smaller delta alone: take engine 'lmi', or leave delta out.",
            record={**record, "delta_limit": limit},
        )
    return PdSolution(gain, np.zeros_like(gain), (symmetric(p1),), p3, record), delta


def _riccati_gain(a: FloatArray, c: FloatArray, record: Mapping[str, Any]) -> FloatArray:
    """Return the gain of a Kalman filter for unit noise: of many states by doubling, else from the Hamiltonian matrix.

    Where that is not found, or not stable, by the QZ algorithm on a pencil, which takes several times as long.
    """
    from scipy.linalg import schur

    n, identity = len(a), np.eye(len(a))
    p = _doubled(a, c)
    if p is not None and abscissa(a - p @ c.T @ c, 0.0) < 0.0:
        return np.asarray(p @ c.T)
    try:
        _, basis, stable = schur(np.block([[a.T, -c.T @ c], [-identity, -a]]), sort="lhp")
        p = np.linalg.solve(basis[:n, :n].T, basis[n:, :n].T)
        gain = np.asarray(0.5 * (p + p.T) @ c.T)
        if stable == n and abscissa(a - gain @ c, 0.0) < 0.0:
            return gain
    except np.linalg.LinAlgError:
        pass
    p = None if n > QZ_METHOD_UP_TO else continuous_solution(a, c, identity, np.eye(len(c)))
    if p is None:
        raise SolverError("The Riccati equation was not solved: the result is inconclusive.", record=record)
    return np.asarray(p @ c.T)


def _doubled(a: FloatArray, c: FloatArray) -> FloatArray | None:
    """Return the solution of the equation of `_riccati_gain` for many states, in half the time of eigenvalues."""
    if len(a) <= SCHUR_METHOD_UP_TO:
        return None
    p = continuous_riccati_solution(a, c, np.eye(len(a)), np.eye(len(c)))
    if p is None:
        return None
    terms = (a @ p, p @ c.T @ c @ p, np.eye(len(a)))
    missed = float(np.linalg.norm(terms[0] + terms[0].T - terms[1] + terms[2]))
    return p if missed <= EQUATION_TOLERANCE * sum(float(np.linalg.norm(term)) for term in terms) else None
