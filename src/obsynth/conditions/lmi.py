"""The LMI layer: the only place that writes matrix inequalities and calls a solver.

Margins are ``margin * I`` (``X >> scalar`` in cvxpy promotes to a full matrix) and every block is symmetrised.
A solver may end in a panic that is no ``Exception``: whatever it does becomes a `SolverError` with a record.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable, Mapping, Sequence
from functools import cache
from typing import Any

import numpy as np

from obsynth.conditions import lazy_cvxpy as cp
from obsynth.conditions.options import SEMIDEFINITE_SOLVERS, ChosenSolver
from obsynth.errors import SolverError, SpecError
from obsynth.numerics.arrays import FloatArray

#: How far inside the cone the inequalities hold by default.
MARGIN = 1e-9

#: Statuses that come with numbers; whether they count is decided by verification, not here.
USABLE_STATUSES = ("optimal", "optimal_inaccurate")

#: Solvers of cvxpy that take semidefinite constraints, and the settings we use.
SOLVER_SETTINGS: dict[str, dict[str, Any]] = {
    "CLARABEL": {},
    "SCS": {"eps_abs": 1e-9, "eps_rel": 1e-9, "max_iters": 20_000},
}

#: What cvxpy itself takes beside a solver's own settings.
_SETTINGS_OF_CVXPY = {"canon_backend", "ignore_dpp", "use_quad_obj", "verbose", "warm_start"}


@cache
def semidefinite_solvers() -> tuple[str, ...]:
    """Return the installed solvers of cvxpy that take semidefinite constraints."""
    from cvxpy.reductions.solvers.defines import SOLVER_MAP_CONIC

    cones_of = {
        name: {cone.__name__ for cone in SOLVER_MAP_CONIC[name].SUPPORTED_CONSTRAINTS}
        for name in cp.installed_solvers()
        if name in SEMIDEFINITE_SOLVERS and name in SOLVER_MAP_CONIC
    }
    # Newer versions know a cone of scaled triangles besides that of matrices.
    return tuple(name for name, cones in cones_of.items() if cones & {"PSD", "SvecPSD"})


def chosen_solver(name: str, options: Mapping[str, Any] | None) -> ChosenSolver:
    """Return a solver with its settings; raise `SpecError` with the list of those installed for another name."""
    if not isinstance(name, str) or (name not in SOLVER_SETTINGS and name not in semidefinite_solvers()):
        listed = ", ".join(semidefinite_solvers())
        raise SpecError(
            f"method.options.solver: there is no solver {name!r} that does semidefinite programmes; "
            f"installed are: {listed}.",
            path="method.options.solver",
        )
    if options and name == "CLARABEL":
        import clarabel

        known = {key for key in dir(clarabel.DefaultSettings()) if not key.startswith("_")} | _SETTINGS_OF_CVXPY
        unknown = sorted(set(options) - known)
        if unknown:
            raise SpecError(f"{name} has no setting {unknown[0]!r}.", path="method.options.solver_options")
    return ChosenSolver(name, options)


def symmetric_variable(size: int) -> Any:
    """Return a symmetric matrix variable ``(size, size)``."""
    return cp.Variable((size, size), symmetric=True)


def matrix_variable(rows: int, columns: int) -> Any:
    """Return a matrix variable ``(rows, columns)``; a constant zero block where a dimension is 0."""
    return cp.Variable((rows, columns)) if rows and columns else np.zeros((rows, columns))


def symmetric_blocks(lower: Sequence[Sequence[Any]]) -> Any:
    """Return a block matrix whose symmetric part has ``lower`` as its lower triangle of blocks; empty ones are dropped.

    `at_least` and `at_most` ask something of the symmetric part: each block stands here once, since cvxpy works through
    an expression as often as it is written.  For the same reason ``2 X`` does for ``X + X'`` on the diagonal.
    """
    nonempty = [i for i, row in enumerate(lower) if row[i].shape[0] > 0]
    return cp.bmat(
        [
            [
                lower[i][j] if j == i else 2.0 * lower[i][j] if j < i else np.zeros(lower[j][i].shape[::-1])
                for j in nonempty
            ]
            for i in nonempty
        ]
    )


def at_least(expression: Any, margin: float = 0.0) -> Any:
    """Return the constraint that the symmetric part of a square matrix expression is ``>= margin * I``."""
    return _symmetric_part(expression) >> margin * np.eye(expression.shape[0])


def at_most(expression: Any, level: float) -> Any:
    """Return the constraint that the symmetric part of a square matrix expression is ``<= level * I``."""
    return _symmetric_part(expression) << level * np.eye(expression.shape[0])


def _symmetric_part(expression: Any) -> Any:
    return expression if expression.is_symmetric() else 0.5 * (expression + expression.T)


def value_of(variable: Any) -> FloatArray:
    """Return the value of a variable or constant block as an array; raise `SolverError` when there is none."""
    value = variable if isinstance(variable, np.ndarray) else variable.value
    if value is None or not np.all(np.isfinite(value)):
        raise SolverError("The solver returned no finite numbers: the result is inconclusive.")
    return np.asarray(value, dtype=np.float64)


def semidefinite_problem(goal: Any, constraints: Sequence[Any], *, smaller: Callable[[], Any] | None = None) -> Any:
    """Return a `cvxpy.Problem` that is solved by Clarabel where no solver is named, by way of a smaller one if any."""
    from obsynth.conditions.semidefinite_problem import SemidefiniteProblem

    return SemidefiniteProblem(goal, list(constraints), smaller=smaller)


def minimise(objective: Any, constraints: Sequence[Any], *, what: str, solver: str = "CLARABEL") -> dict[str, Any]:
    """Minimise a linear or convex objective under the constraints and return the record of the run."""
    problem = cp.Problem(cp.Minimize(0 if objective is None else objective), list(constraints))
    return solved(problem, what, solver)


def solve_again(problem: Any) -> None:
    """Solve a problem by Clarabel with the present values of its parameters: its canonical form is made once.

    What is zero with these values is left out, so that the solver gets what it would without parameters."""
    data, chain, way_back = problem.get_problem_data("CLARABEL", solver_opts={})
    data["A"] = data["A"].copy()  # its indices may be those of the canonical form
    data["A"].eliminate_zeros()
    found = chain.solve_via_data(problem, data, warm_start=False, verbose=False, solver_opts={})
    problem.unpack_results(found, chain, way_back)


def solved(problem: Any, what: str, solver: str, *, run: Callable[[Any], None] | None = None) -> dict[str, Any]:
    """Solve a problem by one solver, or by ``run``, and return the record."""
    settings = {**SOLVER_SETTINGS.get(solver, {}), **getattr(solver, "options", {})}
    record: dict[str, Any] = {"what": what, "solver": str(solver), "version": _version(solver), "settings": settings}
    try:
        with warnings.catch_warnings(action="ignore"):
            # "Solution may be inaccurate": every solution is verified, so the warning tells nobody anything.
            if run is None:
                problem.solve(solver=solver, **settings)
            else:
                run(problem)
        stats = problem.solver_stats
        iterations = None if stats is None or stats.num_iters is None else int(stats.num_iters)
        record |= {"status": str(problem.status), "iterations": iterations}
    except (KeyboardInterrupt, SystemExit):
        raise
    except BaseException as error:  # Rust panics, and memory that ran out inside the solver
        reason = f"{type(error).__name__}: {error}" if str(error) else type(error).__name__
        record |= {"status": "crashed", "reason": reason}
        raise SolverError(
            f"{solver} failed while solving for {what} ({reason}): the result is inconclusive.", record=record
        ) from error
    if record["status"] not in USABLE_STATUSES:
        raise SolverError(
            f"{solver} ended with status {record['status']!r} while solving for {what}: the result is inconclusive.",
            record=record,
        )
    return record


def _version(solver: str) -> str:
    from importlib.metadata import PackageNotFoundError, version

    try:
        return version(solver.lower())
    except PackageNotFoundError:
        return "unknown"
