"""A cvxpy problem that is solved by Clarabel where no solver is named."""

from __future__ import annotations

from typing import Any

import cvxpy

#: Arguments of `cvxpy.Problem.solve` that choose how a problem is solved.
CHOICES = ("solver", "solver_path", "method", "gp", "qcp")


class SemidefiniteProblem(cvxpy.Problem):  # type: ignore[misc]
    """A `cvxpy.Problem` that is solved by Clarabel where no solver is named.

    cvxpy takes SCS for semidefinite problems by default. What that calls optimal has few digits: for (45) of Wang et
    al. 2015 at 24 states a gamma up to 7 % below the least that exists.
    """

    def solve(self, *args: Any, **options: Any) -> Any:
        """Solve the problem; arguments are those of `cvxpy.Problem.solve`."""
        named = args or any(name in options for name in CHOICES)
        if named or "CLARABEL" not in cvxpy.installed_solvers():
            return super().solve(*args, **options)
        try:
            return super().solve(solver="CLARABEL", **options)
        except cvxpy.SolverError:
            # An interior-point method may stall where there is no solution; SCS can say that there is none.
            return super().solve(**options)
