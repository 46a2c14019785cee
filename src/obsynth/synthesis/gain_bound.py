"""What no filter can reach: a lower bound on the gain from a dual point that passes our own check."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from obsynth.errors import InfeasibleError, SolverError
from obsynth.numerics.arrays import FloatArray
from obsynth.numerics.ranks import RANK_TOLERANCE
from obsynth.synthesis import lmi
from obsynth.synthesis.gain_problem import GainProblem, normalise

#: A dual point must be positive definite, and beat the level, by these relative margins.
DUAL_MARGIN = 1e-8
BOUND_MARGIN = 1e-6


def proved_lower_bound(problem: GainProblem, *, solver: str) -> float:
    """Return a lower bound on the gain of every filter, from a dual point that passes our own check; 0 without one.

    For ``Z1 >= 0`` in the null basis N of [C D] with ``Q = G N Z1 N'G' - Nx Z1 Nx' >= 0`` and, for a fixed weight,
    ``Z2 = [Q, *; *, *] >= 0``: multiplying the two eliminated inequalities by Z1 and Z2 cancels P, and leaves
    ``g^2 (tr Nd Z1 Nd' + tr Z2_22) > tr H N Z1 N'H' + tr H Z2 H'`` (for a free weight without Z2).  The check is in
    floating point with margins, on the normalised data.
    """
    normalised = normalise(problem, rotate=solver not in lmi.FIRST_ORDER_SOLVERS)
    work = disturbed_part(normalised.problem)
    n, nd = work.order, work.disturbances
    if nd == 0:
        return 0.0
    basis = _null_space(np.hstack([work.C, work.D]))
    top, bottom, image = basis[:n], basis[n:], np.hstack([work.A, work.B]) @ basis
    outputs = np.hstack([work.Z, work.Zd])
    z1 = lmi.symmetric_variable(basis.shape[1])
    corner, last = lmi.matrix_variable(nd, n), lmi.symmetric_variable(nd)
    q = image @ z1 @ image.T - top @ z1 @ top.T
    shown = lmi.trace(outputs @ basis @ z1 @ basis.T @ outputs.T)
    size = lmi.trace(bottom @ z1 @ bottom.T)
    if work.weight_is_free:
        second = q
    else:
        second = lmi.symmetric_blocks([[q], [corner, last]])
        shown, size = shown + lmi.trace(outputs @ second @ outputs.T), size + lmi.trace(last)
    constraints = [
        lmi.at_least(z1, DUAL_MARGIN * 2),
        lmi.at_least(second, DUAL_MARGIN * 2),
        lmi.at_most(lmi.scalar_block(size), 1.0),
    ]
    try:
        lmi.minimise(-shown, constraints, what="lower bound on the gain", solver=solver)
        point = lmi.value_of(z1)
        corner_value = np.zeros((nd, n)) if work.weight_is_free else lmi.value_of(corner)
        last_value = np.zeros((nd, nd)) if work.weight_is_free else lmi.value_of(last)
    except SolverError:
        return 0.0
    return normalised.gain * _checked_bound(work, basis, point, corner_value, last_value)


def disturbed_part(problem: GainProblem) -> GainProblem:
    """Return the problem on the states that the disturbance reaches whatever the gains.

    That is the least subspace W with ``A x + B d`` in W for every x in W and d with ``C x + D d = 0``.  Outside it
    the dual inequalities have no strict solution; restricted to it they lose nothing.
    """
    n = problem.order
    subspace = np.zeros((n, 0))
    while True:
        hidden = _null_space(np.hstack([problem.C @ subspace, problem.D]))
        image = np.hstack([problem.A @ subspace, problem.B]) @ hidden
        left, values, _ = np.linalg.svd(np.hstack([subspace, image]))
        rank = int(np.sum(values > RANK_TOLERANCE * max(1.0, float(values[0])))) if values.size else 0
        if rank == subspace.shape[1]:
            break
        subspace = left[:, :rank]
    t = subspace.T
    return replace(
        problem,
        A=t @ problem.A @ subspace,
        C=problem.C @ subspace,
        Z=problem.Z @ subspace,
        B=t @ problem.B,
        Bn=t @ problem.Bn,
    )


def _null_space(matrix: FloatArray) -> FloatArray:
    """Return an orthonormal null basis of a matrix of any rank."""
    _, values, right = np.linalg.svd(matrix)
    rank = int(np.sum(values > RANK_TOLERANCE * max(1.0, float(values[0])))) if values.size else 0
    return np.asarray(right[rank:].T)


def _checked_bound(work: GainProblem, basis: FloatArray, z1: FloatArray, corner: FloatArray, last: FloatArray) -> float:
    """Recompute the bound of a dual point from the data; 0 unless it is strictly feasible."""
    n = work.order
    top, bottom, image = basis[:n], basis[n:], np.hstack([work.A, work.B]) @ basis
    outputs = np.hstack([work.Z, work.Zd])
    z1 = 0.5 * (z1 + z1.T)
    q = image @ z1 @ image.T - top @ z1 @ top.T
    second = q if work.weight_is_free else np.block([[q, corner.T], [corner, 0.5 * (last + last.T)]])
    for matrix in (z1, second):
        values = np.linalg.eigvalsh(0.5 * (matrix + matrix.T))
        if values[0] < DUAL_MARGIN * min(1.0, float(values[-1])):
            return 0.0
    shown = float(np.trace(outputs @ basis @ z1 @ basis.T @ outputs.T))
    size = float(np.trace(bottom @ z1 @ bottom.T))
    if not work.weight_is_free:
        shown += float(np.trace(outputs @ second @ outputs.T))
        size += float(np.trace(last))
    return float(np.sqrt(max(shown, 0.0) / size)) * (1.0 - BOUND_MARGIN) if size > 0.0 else 0.0


def require_reachable(problem: GainProblem, best: float, gain: float, *, solver: str) -> None:
    """Raise unless ``gain`` is within reach of the best filter found.

    Parameters
    ----------
    problem : GainProblem
        In the original coordinates.
    best : float
        True norm of the best filter found.
    gain : float
        Level asked for.
    solver : str
        Name of the solver.

    Raises
    ------
    InfeasibleError
        A checked lower bound lies above ``gain``.
    SolverError
        Neither a filter nor a proof was found.
    """
    if problem.disturbances == 0 or best <= gain:
        return
    # Without free measurements there is one filter, and its norm is attained at a frequency.
    bound = best * (1.0 - BOUND_MARGIN) if problem.measured == 0 else proved_lower_bound(problem, solver=solver)
    choice = "for this T and N" if problem.free_weight else "for this T, N and W"
    if bound > gain:
        remedy = "" if problem.free_weight else ", or set free_residual_weight: true"
        raise InfeasibleError(
            f"No filter reaches gamma = {gain:.6g} {choice}: a checked certificate proves gamma >= {bound:.6g}, and "
            f"the best filter found has {best:.6g}. Ask for a larger gamma, leave it out for the least{remedy}.",
            necessary=False,
            lower_bound=bound,
        )
    raise SolverError(
        f"gamma = {gain:.6g} was not reached (best found {best:.6g}), and the proved lower bound {bound:.6g} does not "
        f"rule it out: nothing is known {choice}. Ask for a slightly larger gamma."
    )
