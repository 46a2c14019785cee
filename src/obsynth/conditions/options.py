"""Options by which a researcher changes the inequality of a method: constraints, objective, region, solver.

The inequality itself, with these in it, is `obsynth.conditions`; methods ask for it by name.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Annotated, Any, TypeAlias

from obsynth.numerics.arguments import WrittenAs, shown
from obsynth.numerics.regions import LMIRegion

#: A function of the variables by name that returns cvxpy constraints.
OwnConstraints: TypeAlias = Annotated[Any, WrittenAs("function")]

#: Where all eigenvalues must lie: an `LMIRegion`, or as a document writes it.
OwnRegion: TypeAlias = Annotated[Any, WrittenAs("region")]

#: Name of a solver, and its settings.
SolverName: TypeAlias = Annotated[Any, WrittenAs("solver")]

SolverOptions: TypeAlias = Annotated[Any, WrittenAs("solver options")]

#: Solvers of cvxpy that take semidefinite constraints, whether installed or not: a gain set names no other.
SEMIDEFINITE_SOLVERS = (
    "CLARABEL", "COPT", "COSMO", "CVXOPT", "DIFFCP", "KNITRO", "MOREAU", "MOSEK", "SCS", "SDPA"
)  # fmt: skip

#: How what is stored of a function begins.
FUNCTION_TEXT = "a function, "

#: Values satisfy a constraint that they violate by no more than this share of their own size: solvers stop at 1e-8.
VIOLATION_SHARE = 1e-6


def own_terms(method: Any) -> tuple[str, ...]:
    """Return the names of the options that put something of one's own into the inequality."""
    names = []
    for name in ("constraints", "objective", "region"):
        value = getattr(method, name)
        own = callable(value) if name != "region" else isinstance(value, (LMIRegion, list, tuple))
        if own or (name == "objective" and isinstance(value, str) and value == "h2"):
            names.append(name)
    return tuple(names)


def own_term_conflicts(
    method: Any, *, beside: tuple[str, ...], engines: tuple[str, ...] = (), named_regions: bool = False
) -> Iterator[str]:
    """Yield what is wrong with these options; ``beside``: options that the plain inequality knows nothing of;
    ``named_regions``: regions by name are put into it too."""
    if method.constraints is not None and not callable(method.constraints):
        yield (
            f"constraints is {shown(method.constraints)}: give a function of the variables that returns a list of "
            "cvxpy constraints, such as lambda v: [v['P'] << 10 * numpy.eye(4)]."
        )
    if not isinstance(method.solver, str):
        yield f"solver is {shown(method.solver)}: give the name of one of cvxpy.installed_solvers()."
    if method.solver_options is not None and not (
        isinstance(method.solver_options, Mapping) and all(isinstance(key, str) for key in method.solver_options)
    ):
        yield f"solver_options is {shown(method.solver_options)}: give the solver's settings by name."
    terms = own_terms(method)
    if named_regions and isinstance(method.region, Mapping):
        terms += ("region",)
    if not terms:
        return
    listed = " and ".join(terms)
    if getattr(method, "engine", None) in engines:
        yield (
            f"engine {method.engine!r} solves no inequality that {listed} could be put into: leave engine out, or take "
            "'lmi'."
        )
    clash = [name for name in beside if getattr(method, name) not in (None, False)]
    if clash:
        yield f"{listed} cannot be combined with {', '.join(clash)}: leave it out, or write it as a constraint."


class ChosenSolver(str):
    """The name of a solver that knows its settings."""

    options: Mapping[str, Any]

    def __new__(cls, name: str, options: Mapping[str, Any] | None = None) -> ChosenSolver:
        """Return the name, with settings of the solver by name."""
        made = super().__new__(cls, name)
        made.options = dict(options or {})
        return made
