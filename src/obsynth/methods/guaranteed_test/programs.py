"""The linear programmes of a window: the largest fault that nothing tells from none, by HiGHS; only their answers are
proved.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from obsynth.conditions import lazy_cvxpy as cp
from obsynth.errors import SolverError
from obsynth.methods.guaranteed_test.windows import Window
from obsynth.numerics.arrays import FloatArray

#: Tightest tolerance that HiGHS takes.
TOLERANCE = 1e-10

_TIGHT = {"primal_feasibility_tolerance": TOLERANCE, "dual_feasibility_tolerance": TOLERANCE}

#: What is asked of HiGHS in turn: its tightest answer; one without presolve; what it has of its own accord, which large
#: networks need; an interior point.
ATTEMPTS: tuple[tuple[str, dict[str, Any]], ...] = (
    ("highs", _TIGHT),
    ("highs", {**_TIGHT, "presolve": False}),
    ("highs", {}),
    ("highs-ipm", {}),
    ("highs-ipm", {"presolve": False}),
)

#: Statuses of `scipy.optimize.linprog`.
SOLVED_STATUS, UNBOUNDED = 0, 3


@dataclass(frozen=True, eq=False)
class Optimum:
    """A solution as the solver gives it: ``multipliers (rows,)``, ``point (columns,)``; neither where unbounded.

    ``size`` is 0 or more: zero is a point of every window, and solvers give -1e-17 for an optimum of zero.
    """

    size: float
    multipliers: FloatArray | None = None
    point: FloatArray | None = None


def largest_hidden_fault(window: Window) -> Optimum:
    """Return the largest theta of the equations with zero right sides."""
    if window.test_problem.ellipsoid:
        return _in_ellipsoids(window)
    from scipy.optimize import linprog
    from scipy.sparse import diags_array

    rows, columns = window.scales
    matrix = diags_array(np.ldexp(1.0, rows)) @ window.matrix @ diags_array(np.ldexp(1.0, columns))
    cost = np.zeros(len(window.bar))
    cost[0] = -1.0
    ends = np.ldexp(window.bar, -columns)

    programme = {"A_eq": matrix.tocsr(), "b_eq": np.zeros(window.rows), "bounds": np.stack([-ends, ends], axis=1)}
    for method, options in ATTEMPTS:
        solution = linprog(cost, method=method, options=options, **programme)
        if solution.status in (SOLVED_STATUS, UNBOUNDED):
            break
    if solution.status == UNBOUNDED:
        return Optimum(np.inf)
    if solution.status != SOLVED_STATUS:
        raise SolverError(
            f"HiGHS has no answer for the linear programme of {window.test_problem.samples} samples (status "
            f"{solution.status}): the result is inconclusive. "
            "Fewer samples, or signals in units in which they are near one, may help."
        )
    multipliers = np.ldexp(-np.asarray(solution.eqlin.marginals), rows)
    scale = float(window.matrix[:, [0]].toarray().ravel() @ multipliers)
    point = np.ldexp(np.asarray(solution.x), columns)
    if abs(scale) > 0.0:
        multipliers = multipliers / scale
    return Optimum(max(float(point[0]), 0.0), multipliers, point)


def _in_ellipsoids(window: Window) -> Optimum:
    """Return the same where noise and disturbances of each sample lie in an ellipsoid, by Clarabel."""
    rows, columns = window.scales
    from scipy.sparse import csr_array, diags_array

    matrix = csr_array(diags_array(np.ldexp(1.0, rows)) @ window.matrix @ diags_array(np.ldexp(1.0, columns)))
    x = cp.Variable(len(window.bar))
    ends = np.ldexp(window.bar, -columns)
    limits = [
        cp.norm(cp.multiply(1.0 / ends[window.group == group], x[np.flatnonzero(window.group == group)])) <= 1.0
        for group in np.unique(window.group[window.group >= 0])
    ]
    boxed = np.flatnonzero(window.bounded & (window.group < 0))
    if boxed.size:
        limits.append(cp.abs(x[boxed]) <= ends[boxed])
    equations = matrix @ x == 0.0
    problem = cp.Problem(cp.Maximize(x[0]), [equations, *limits])
    problem.solve(solver=cp.CLARABEL)
    if problem.status in ("unbounded", "unbounded_inaccurate"):
        return Optimum(np.inf)
    if x.value is None or equations.dual_value is None:
        raise SolverError(f"Clarabel has no answer ({problem.status}): the result is inconclusive.")
    multipliers = np.ldexp(np.asarray(equations.dual_value).ravel(), rows)
    scale = float(window.matrix[:, [0]].toarray().ravel() @ multipliers)
    point = np.ldexp(np.asarray(x.value), columns)
    return Optimum(max(float(point[0]), 0.0), multipliers / scale if scale else multipliers, point)
