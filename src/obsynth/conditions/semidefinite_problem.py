"""A cvxpy problem that Clarabel solves by default, through a smaller equivalent problem where there is one."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import cvxpy
import numpy as np

from obsynth.conditions.options import VIOLATION_SHARE

#: Arguments of `cvxpy.Problem.solve` that choose how a problem is solved.
CHOICES = ("solver", "solver_path", "method", "gp", "qcp")

#: Settings of Clarabel for smaller problems: its own regularisation costs them digits of gamma, shorter steps stall
#: less, and the last digits of its own tolerances are beyond double precision.
SETTINGS_OF_SMALLER = {
    "max_step_fraction": 0.95,
    "static_regularization_constant": 1e-10,
    "tol_gap_abs": 1e-6,
    "tol_gap_rel": 1e-6,
    "tol_feas": 1e-7,
}


@dataclass(frozen=True, eq=False)
class SmallerProblem:
    """A problem with the same optimum, and how its solution becomes that of the problem it stands for."""

    problem: cvxpy.Problem
    set_values: Callable[[], None]


class SemidefiniteProblem(cvxpy.Problem):  # type: ignore[misc]
    """A `cvxpy.Problem` that is solved by Clarabel where no solver is named.

    cvxpy takes SCS for semidefinite problems by default. What that calls optimal has few digits: for (45) of Wang et
    al. 2015 at 24 states a gamma up to 7 % below the least that exists.

    Parameters
    ----------
    objective, constraints
        Those of `cvxpy.Problem`.
    smaller : callable, optional
        Makes the `SmallerProblem` that is solved instead where no solver and no setting is named.  Its solution counts
        where it keeps the constraints of this problem, which has its status then and no dual values.
    """

    def __init__(
        self, objective: Any, constraints: Sequence[Any], *, smaller: Callable[[], SmallerProblem] | None = None
    ) -> None:
        super().__init__(objective, list(constraints))
        self._make_smaller = smaller

    def solve(self, *args: Any, **options: Any) -> Any:
        """Solve the problem; arguments are those of `cvxpy.Problem.solve`."""
        named = args or any(name in options for name in CHOICES)
        if named or "CLARABEL" not in cvxpy.installed_solvers():
            return super().solve(*args, **options)
        if not options and self._smaller is not None and self._solved_as(self._smaller):
            return self.value
        try:
            return super().solve(solver="CLARABEL", **options)
        except cvxpy.SolverError:
            # An interior-point method may stall where there is no solution; SCS can say that there is none.
            return super().solve(**options)

    @cached_property
    def _smaller(self) -> SmallerProblem | None:
        return None if self._make_smaller is None else self._make_smaller()

    def _solved_as(self, smaller: SmallerProblem) -> bool:
        """Solve the smaller problem; return whether its solution is one of this problem, which then has its values."""
        inner = smaller.problem
        try:
            inner.solve(solver="CLARABEL", **SETTINGS_OF_SMALLER)
            if inner.status not in (cvxpy.OPTIMAL, cvxpy.OPTIMAL_INACCURATE):
                return False
            smaller.set_values()
        except (cvxpy.SolverError, np.linalg.LinAlgError):
            return False
        values = [variable.value for variable in self.variables()]
        if not all(np.all(np.isfinite(value)) for value in values):
            return False
        size = max(float(np.max(np.abs(value), initial=1.0)) for value in values)
        if max(float(np.max(part.violation(), initial=0.0)) for part in self.constraints) > VIOLATION_SHARE * size:
            return False
        for part in self.constraints:
            for dual in part.dual_variables:
                dual.save_value(None)
        self._status, self._solver_stats = inner.status, inner.solver_stats
        self._value = float(self.objective.value)
        return True
