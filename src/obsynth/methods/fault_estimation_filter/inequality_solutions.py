"""Solving a normalised `GainProblem` by the bounded real inequality in P, ``Y = P R`` and V, with g the gain level,

``[P, *, *, *; 0, g^2 I, *, *; PA - YC, PB - YD, P, *; Z + VC, Zd + VD, 0, I] > 0``. Its *eliminated* form, with N a
basis of null M, ``M = [C D]``, ``G = [A B]``, ``H = [Z Zd]``, has no Y: ``N'(diag(P, g^2 I) - G'PG - H'H) N > 0``,
``diag(P, g^2 I) - (H + VM)'(H + VM) > 0``; V is zero when fixed, a variable when it has a limit, and eliminated as well
when it is free, which leaves P > 0 of the second condition.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from obsynth.errors import SolverError
from obsynth.methods.conic import lmi
from obsynth.methods.fault_estimation_filter.injection_problem import GainProblem, Injection, WeightLimit
from obsynth.numerics.arrays import FloatArray

#: Strictness of the inequalities, in normalised coordinates where every block is of size one.
MARGIN = 1e-9
#: Bounds on P in normalised coordinates: they keep P away from singular and the gains from running away.
P_FLOOR = 1e-4
P_CEILING = 1e4
#: Relative room in P and in the squared level for the gains of the eliminated form.
RECOVERY_ROOM = 1e-5


@dataclass(frozen=True, eq=False)
class GainSolution:
    """A solution in normalised coordinates: the level g of the inequality, P ``(n, n)``, and the gains."""

    gain: float
    P: FloatArray
    injection: Injection
    record: dict[str, Any]


def null_basis(matrix: FloatArray) -> FloatArray:
    """Return an orthonormal basis ``(cols, cols - rows)`` of the null space of a matrix of full row rank."""
    rows, columns = matrix.shape
    if rows == 0:
        return np.eye(columns)
    return np.asarray(np.linalg.qr(matrix.T, mode="complete")[0][:, rows:])


@dataclass(frozen=True, eq=False)
class _Inequality:
    """The bounded real inequality with its variables; ``y`` is ``None`` in the eliminated form."""

    p: Any
    y: Any
    v: Any
    constraints: list[Any]

    def gains(self, problem: GainProblem, level: float) -> Injection:
        """Return the gains that the solved variables stand for."""
        solution, limit = lmi.value_of(self.p), problem.weight_limit
        v = np.zeros((problem.Z.shape[0], problem.measured)) if self.v is None else lmi.value_of(self.v)
        v = v if limit is None else limit.kept(v)
        if self.y is None:
            # Both conditions stay true, strictly, when P and g^2 grow by the same factor: the gains stay of a natural
            # size where a solution lies on the boundary.
            room = 1.0 + RECOVERY_ROOM
            given = None if self.v is None else v
            return injection_for(problem, room * solution, float(np.sqrt(room)) * level, v=given)
        if problem.measured == 0:
            return Injection(np.zeros((problem.order, 0)), v)
        return Injection(np.asarray(np.linalg.solve(solution, lmi.value_of(self.y))), v)


def _eliminated_inequality(problem: GainProblem, squared: Any, *, ceiling: float) -> _Inequality:
    n, m, q, nd = problem.order, problem.measured, problem.Z.shape[0], problem.disturbances
    p = lmi.symmetric_variable(n)
    measured, outputs = np.hstack([problem.C, problem.D]), np.hstack([problem.Z, problem.Zd])
    basis = null_basis(measured)
    top, bottom, image = basis[:n], basis[n:], np.hstack([problem.A, problem.B]) @ basis
    # Each cone costs its size to the sixth: the trace bounds P from above, and P > Z'Z from below where it is asked.
    constraints = [lmi.at_most(lmi.scalar_block(lmi.trace(p)), ceiling * n)] if n else []
    if basis.shape[1]:
        reduced = top.T @ p @ top - image.T @ p @ image - (outputs @ basis).T @ (outputs @ basis)
        constraints.append(lmi.at_least(reduced + squared * (bottom.T @ bottom) if nd else reduced, MARGIN))
    limit = problem.weight_limit
    if problem.weight_is_free and limit is None:
        return _Inequality(p, None, None, [*constraints, lmi.at_least(p, P_FLOOR)])
    blocks = [[p]]
    if np.any(problem.Zd) or (limit is not None and np.any(problem.D)):
        blocks.append([np.zeros((nd, n)), squared * np.eye(nd)])
    else:
        measured, outputs = problem.C, problem.Z
    if limit is None:
        weight = lmi.symmetric_blocks(blocks)
        return _Inequality(p, None, None, [*constraints, lmi.at_least(weight - outputs.T @ outputs, MARGIN)])
    v = lmi.matrix_variable(q, m)
    shown = [outputs[:, part] + v @ measured[:, part] for part in (slice(n), slice(n, None))[: len(blocks)]]
    whole = lmi.symmetric_blocks([*blocks, [*shown, np.eye(q)]])
    return _Inequality(p, None, v, [*constraints, lmi.at_least(whole, MARGIN), _weight_constraint(limit, v)])


def _weight_constraint(limit: WeightLimit, v: Any) -> Any:
    weight = limit.fixed / limit.bound + v @ (limit.free / limit.bound)
    return lmi.at_least(lmi.symmetric_blocks([[np.eye(weight.shape[1])], [weight, np.eye(weight.shape[0])]]))


def _full_inequality(problem: GainProblem, p: Any, squared: Any, *, decay: float = 1.0) -> _Inequality:
    n, m, q, nd = problem.order, problem.measured, problem.Z.shape[0], problem.disturbances
    y = lmi.matrix_variable(n, m)
    v = lmi.matrix_variable(q, m) if problem.weight_is_free else np.zeros((q, m))
    whole = lmi.symmetric_blocks(
        [
            [p],
            [np.zeros((nd, n)), squared * np.eye(nd)],
            [(p @ problem.A - y @ problem.C) / decay, p @ problem.B - y @ problem.D, p],
            [problem.Z + v @ problem.C, problem.Zd + v @ problem.D, np.zeros((q, n)), np.eye(q)],
        ]
    )
    constraints = [lmi.at_least(p, P_FLOOR), lmi.at_most(p, P_CEILING), lmi.at_least(whole, MARGIN)]
    if problem.weight_limit is not None:
        constraints.append(_weight_constraint(problem.weight_limit, v))
    return _Inequality(p, y, v, constraints)


def injection_for(problem: GainProblem, p: FloatArray, gain: float, *, v: FloatArray | None = None) -> Injection:
    """Return the gains that P allows at level ``gain``, in closed form, with the given V or the best there is.

    ``(G - R M) S^-1 (G - R M)' < P^-1`` is least, in the Loewner order, at ``R = G S^-1 M' (M S^-1 M')^-1``; S is
    diag(P, g^2 I), less ``(H + V M)'(H + V M)`` when V is given or zero; a free V comes out likewise with H stacked
    under G.
    """
    n, m, q = problem.order, problem.measured, problem.Z.shape[0]
    if m == 0:
        return Injection(np.zeros((n, 0)), np.zeros((q, 0)))
    measured, through = np.hstack([problem.C, problem.D]), np.hstack([problem.A, problem.B])
    outputs = np.hstack([problem.Z, problem.Zd])
    weight = np.zeros((n + problem.disturbances,) * 2)
    weight[:n, :n] = p
    weight[n:, n:] = gain**2 * np.eye(problem.disturbances)
    free = problem.weight_is_free and v is None
    stacked = np.vstack([through, outputs]) if free else through
    if not free:
        given = np.zeros((q, m)) if v is None else v
        outputs = outputs + given @ measured
        weight = weight - outputs.T @ outputs
    lifted = np.linalg.solve(0.5 * (weight + weight.T), measured.T)
    gains = np.linalg.solve(measured @ lifted, (stacked @ lifted).T).T
    return Injection(gains[:n], -gains[n:] if free else given)


def least_gain(problem: GainProblem, *, solver: str, ceiling: float = P_CEILING) -> GainSolution:
    """Minimise the gain by the eliminated inequality."""
    squared = lmi.scalar_variable()
    inequality = _eliminated_inequality(problem, squared, ceiling=ceiling)
    record = lmi.minimise(squared, inequality.constraints, what="least gain", solver=solver)
    gain = float(np.sqrt(max(float(lmi.value_of(squared)), 0.0)))
    return GainSolution(gain, lmi.value_of(inequality.p), inequality.gains(problem, gain), record)


def feasible_point(problem: GainProblem, gain: float, *, solver: str) -> GainSolution | None:
    """Look for a filter at level ``gain`` and return it when its true norm is below; ``None`` otherwise.

    The slack is maximised (up to one): bare feasibility ends in solver errors below the optimum.
    """
    slack = lmi.scalar_variable()
    # A slack of t is the same as asking for the level g^2 - t in the disturbance block.
    inequality = _eliminated_inequality(problem, gain**2 - slack, ceiling=P_CEILING)
    try:
        record = lmi.minimise(-slack, inequality.constraints, what=f"feasibility at {gain:.6g}", solver=solver)
        level = float(np.sqrt(max(gain**2 - float(lmi.value_of(slack)), 0.0)))
        found = GainSolution(gain, lmi.value_of(inequality.p), inequality.gains(problem, 0.5 * (level + gain)), record)
    except (SolverError, np.linalg.LinAlgError):
        return None
    return found if problem.achieved_gain(found.injection) < gain else None


def small_gains(problem: GainProblem, gain: float, *, solver: str, decay: float = 1.0) -> GainSolution:
    """Return gains of least size (or least noise) at level ``gain``, by the full inequality.

    The trace of a bound on ``(Bn - R Dn)' P (Bn - R Dn) + (Zn + V Dn)'(Zn + V Dn)``, the variance of xi, is minimised;
    unit noise on the free measurements makes it the size of R (and V) itself.
    """
    n, q, nw = problem.order, problem.Z.shape[0], problem.Bn.shape[1]
    p, x = lmi.symmetric_variable(n), lmi.symmetric_variable(nw)
    inequality = _full_inequality(problem, p, gain**2, decay=decay)
    noise = p @ problem.Bn - inequality.y @ problem.Dn
    variance = lmi.symmetric_blocks(
        [
            [x],
            [noise, p],
            [problem.Zn + inequality.v @ problem.Dn, np.zeros((q, n)), np.eye(q)],
        ]
    )
    constraints = [*inequality.constraints, lmi.at_least(variance)]
    record = lmi.minimise(lmi.trace(x), constraints, what="small gains", solver=solver)
    return GainSolution(gain, lmi.value_of(p), inequality.gains(problem, gain), record)
