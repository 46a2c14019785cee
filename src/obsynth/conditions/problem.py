"""The public class of conditions: a cvxpy problem to read, change and solve, and the design of its solution."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from inspect import signature
from types import MappingProxyType
from typing import TYPE_CHECKING, Any

import numpy as np

from obsynth.analysis.existence.condition import Condition
from obsynth.conditions import lazy_cvxpy as cp
from obsynth.conditions import lmi
from obsynth.conditions.bisection import Answer, Bisection, bisected
from obsynth.conditions.options import VIOLATION_SHARE
from obsynth.errors import SolverError, SpecError, VerificationError, a_kind
from obsynth.numerics.arguments import arguments_checked, real_number, require_kind, shown
from obsynth.numerics.arrays import FloatArray, freeze, read_only
from obsynth.numerics.suggestions import fields_suggested, suggestion, there_are
from obsynth.results.design import ObserverDesign
from obsynth.results.registered import registered
from obsynth.results.verification_report import VerificationReport, failed_rows
from obsynth.verification.plant import condition_rows

if TYPE_CHECKING:
    import cvxpy

#: Solver with settings for levels of a bisection at which Clarabel has no result.  Where SCS proves that (45) is
#: infeasible at four states, hundreds of iterations suffice; next to the least level no number of them does.
SECOND_OPINION: tuple[str, Mapping[str, Any]] = ("SCS", {"max_iters": 5000})

#: Beginning of the names of constraints that a user gives without a name; a number follows.
OWN = "own "

#: Numbers by name, such as the values of variables.
Values = Mapping[str, FloatArray]


@fields_suggested
@dataclass(frozen=True, eq=False, repr=False)
class Conditions:
    """The conditions of a paper as a `cvxpy.Problem`, with everything in it by name.

    Parameters
    ----------
    source : str
        Paper, theorem, equations.
    problem : cvxpy.Problem
        Solve it with any solver: ``problem.solve(solver=...)``; by default Clarabel, which finds more digits than SCS,
        cvxpy's own choice.
    variables : mapping of str to cvxpy.Variable
        By the paper's letters.
    parameters : mapping of str to cvxpy.Parameter
        Numbers that may change between two solutions, such as ``gamma_squared`` in a bisection.
    data : mapping of str to FloatArray
        The matrices of the inequalities, by the paper's letters.
    constraints : mapping of str to cvxpy.Constraint
        By name, so that one can be dropped or replaced.
    weight : cvxpy.Expression, optional
        The residual weight, where it is a variable.
    """

    source: str
    problem: cvxpy.Problem
    variables: Mapping[str, cvxpy.Variable]
    parameters: Mapping[str, cvxpy.Parameter]
    data: Mapping[str, FloatArray]
    constraints: Mapping[str, cvxpy.Constraint]
    _examined: Callable[[], Sequence[Condition]]
    _gains: Callable[[Values], dict[str, FloatArray]]
    _design: Callable[[dict[str, FloatArray], str], ObserverDesign]
    weight: Any = None
    _added: frozenset[str] = frozenset()  # names of the constraints by which these conditions have been changed
    _values_before: Mapping[str, Any] = field(default_factory=dict)  # of the variables, when they were changed

    def __post_init__(self) -> None:
        data = {name: read_only(value) for name, value in self.data.items()}
        freeze(self, "variables", "parameters", "constraints", data=data)
        for kind in ("variables", "parameters", "constraints", "data"):
            named = _ByName(kind.removesuffix("s"), getattr(self, kind))
            object.__setattr__(self, kind, MappingProxyType(named))

    @cached_property
    def existence(self) -> VerificationReport:
        """The checks of whether a solution exists, with the reason if none does; no inequality is solved for them."""
        return VerificationReport.of(condition_rows(self._examined()))

    def gains(self) -> dict[str, FloatArray]:
        """Return the gain matrices for the present values of the variables, by the paper's letters.

        Raises
        ------
        SpecError
            A variable has no value yet, or these conditions have been `changed` and not solved since.
        SolverError
            The solver left none, or the values do not determine the gains.
        """
        self._require_solved_since()
        used = set(self.problem.variables())
        values = {name: self._value(name, variable) for name, variable in self.variables.items() if variable in used}
        try:
            gains = self._gains(values)
        except np.linalg.LinAlgError as error:
            raise SolverError(f"The values of {', '.join(self.variables)} determine no gains: {error}.") from error
        if not all(np.isfinite(gain).all() for gain in gains.values()):
            raise SolverError("The values of the variables determine no finite gains: the result is inconclusive.")
        return gains

    def design(self, *, name: str = "design") -> ObserverDesign:
        """Return the verified design for the present values of the variables.

        Parameters
        ----------
        name : str, optional
            Name of the design.

        Raises
        ------
        SpecError, SolverError
            As for `gains`; the values do not satisfy a constraint that `changed` has added.
        PreconditionError
            No such observer exists for this plant.
        VerificationError
            The gains fail a check, which is named.
        """
        gains = self.gains()
        self.require_satisfied(self._added)
        design = self._design(gains, name)
        if not design.report.passed:
            raise VerificationError(
                f"The gains of this solution fail: {failed_rows(design.report)}. Solve to more digits, or leave more "
                "room in the constraints.",
                report=design.report,
            )
        return design.replace(solver={**design.solver, "conditions": self.source, "status": str(self.problem.status)})

    def require_satisfied(self, names: Iterable[str]) -> None:
        """Raise `SolverError` if the present values violate constraints; verification only checks those of the paper.

        Parameters
        ----------
        names : iterable of str
            Names of constraints.

        Raises
        ------
        SolverError
            One is violated by more than solvers leave.
        """
        room = VIOLATION_SHARE * self._size_of_values()
        for name in sorted(names):
            violation = float(np.max(self.constraints[name].violation(), initial=0.0))
            if not violation <= room:
                raise SolverError(
                    f"The values of {', '.join(self.variables)} do not satisfy {_called(name)}, "
                    f"{self.constraints[name]} (by {violation:.3g}): solve the problem, problem.solve(), or to more "
                    "digits where it has been solved."
                )

    @arguments_checked
    def solve(self, *, solver: str | None = None, settings: Mapping[str, Any] | None = None) -> float:
        """Solve the problem as ``problem.solve()`` does, but raise `SolverError` for any failure of the solver.

        Parameters
        ----------
        solver : str, optional
            One of ``cvxpy.installed_solvers()``.  By default Clarabel, and cvxpy's own choice where that has no answer.
        settings : mapping, optional
            Settings of the solver by its own names.

        Returns
        -------
        float
            The least value of the objective: 0 without an objective, infinite if the solver reports that there is no
            solution.  ``problem.status`` is the status of the solver.

        Raises
        ------
        SpecError
            No such solver is installed.
        SolverError
            The solver failed.

        Examples
        --------
        >>> import obsynth
        >>> plant = obsynth.DescriptorSystem(
        ...     A=[[0.9, 0.1], [0.0, 0.8]], C=[[1, 0], [0, 1]], Bf=[[1], [0]], Bd=[[0.1], [1]], dt=1.0
        ... )
        >>> paper = obsynth.conditions.wang2015(plant)
        >>> gamma_squared = paper.solve()
        >>> paper.problem.status
        'optimal'
        """
        if solver is not None and solver not in cp.installed_solvers():
            raise SpecError(
                f"There is no solver {solver!r}; {there_are(solver, cp.installed_solvers())}", path="solver"
            )
        named = {} if solver is None else {"solver": solver}
        try:
            with warnings.catch_warnings(action="ignore"):
                # The status says the same.
                self.problem.solve(**named, **(settings or {}))
        except (KeyboardInterrupt, SystemExit):
            raise
        except BaseException as error:  # Rust panics, and memory that ran out inside the solver
            raise SolverError(
                f"{solver or 'The solver'} failed while solving {self.source} ({error}): the result is inconclusive."
            ) from error
        value = self.problem.value
        return np.nan if value is None else float(value)

    @arguments_checked
    def bisect(
        self,
        parameter: str,
        feasible: float,
        infeasible: float,
        *,
        solver: str | None = None,
        settings: Mapping[str, Any] | None = None,
        tolerance: float = 1e-3,
    ) -> Bisection:
        """Return the value of a parameter at which the conditions change from feasible to infeasible.

        Levels at which a solver fails are listed as unknown, and others near them are tried.  A level counts as
        feasible only if the values satisfy the constraints.

        Parameters
        ----------
        parameter : str
            Name of a parameter, such as ``"gamma_squared"`` of ``wang2015(plant, gamma=1.0)``.
        feasible : float
            A level at which there is a solution.
        infeasible : float
            The other end of the interval, above or below.
        solver : str, optional
            One of ``cvxpy.installed_solvers()``.  By default Clarabel, and SCS at levels where that has no answer: an
            interior-point method may stall where there is no solution.
        settings : mapping, optional
            Settings of the solver by its own names; without one those of Clarabel.
        tolerance : float, optional
            The bisection ends when the interval is below this share of the feasible level.

        Returns
        -------
        Bisection
            ``feasible`` (the variables have its values), ``infeasible`` and the levels that are ``unknown``.

        Raises
        ------
        SpecError
            There is no such parameter, or the level ``feasible`` is infeasible according to the solver.
        SolverError
            The solver has no result at the level ``feasible``: inconclusive.

        Examples
        --------
        >>> import obsynth
        >>> plant = obsynth.DescriptorSystem(
        ...     A=[[0.9, 0.1], [0.0, 0.8]], C=[[1, 0], [0, 1]], Bf=[[1], [0]], Bd=[[0.1], [1]], dt=1.0
        ... )
        >>> paper = obsynth.conditions.wang2015(plant, gamma=10.0)
        >>> found = paper.bisect("gamma_squared", 100.0, 0.0)
        >>> print(f"least gamma {found.feasible**0.5:.2f}")
        least gamma 0.10
        """
        if parameter not in self.parameters:
            listed = (
                there_are(parameter, self.parameters)
                if self.parameters
                else "there are none: give wang2015 a gamma, for one."
            )
            raise SpecError(f"There is no parameter {parameter!r}; {listed}", path="parameter")
        first, last = real_number(feasible, "feasible", "a number"), real_number(infeasible, "infeasible", "a number")
        share = real_number(tolerance, "tolerance", "a positive number", above=0.0)

        tried = [(solver or "CLARABEL", settings or {})] + ([SECOND_OPINION] if solver is None else [])
        names = " and ".join(name for name, _ in tried)

        def answer(level: float) -> Answer:
            given = (self._answer(parameter, level, name, own) for name, own in tried)
            return next((verdict for verdict in given if verdict != "unknown"), "unknown")

        start = answer(first)
        if start == "infeasible":
            raise SpecError(
                f"At {parameter} = {first:g}, given as feasible, there is no solution ({names}): give one that has.",
                path="feasible",
            )
        if start == "unknown":
            raise SolverError(
                f"There is no answer at {parameter} = {first:g} ({names}, status {self.problem.status}): the result is "
                "inconclusive. Give a level further inside."
            )
        bisection = bisected(answer, first, last, share)
        # The variables have the values of whatever was tried last.
        answer(bisection.feasible)
        return bisection

    def _answer(self, parameter: str, level: float, solver: str, settings: Mapping[str, Any]) -> Answer:
        """Return what a solver finds at a level; whatever is neither a solution nor a plain no is unknown."""
        self.parameters[parameter].value = level
        try:
            self.solve(solver=solver, settings=settings)
        except SolverError:
            return "unknown"
        if self.problem.status == "infeasible":
            return "infeasible"
        if self.problem.status != "optimal":
            return "unknown"
        values = [variable.value for variable in self.problem.variables()]
        if any(value is None or not np.all(np.isfinite(value)) for value in values):
            return "unknown"
        size = self._size_of_values()
        worst = max(
            (float(np.max(constraint.violation(), initial=0.0)) for constraint in self.problem.constraints), default=0.0
        )
        return "feasible" if worst <= VIOLATION_SHARE * size else "unknown"

    def letters(self) -> Letters:
        """Return variables and data by their letters in the paper, as functions of them (``constraints=``) get them.

        Returns
        -------
        dict
            Variables first; a letter that does not exist raises `SpecError` with those that do.
        """
        return Letters({**self.data, **self.variables})

    def changed(
        self,
        *,
        constraints: Iterable[Any] | Mapping[str, Any] | Callable[[Letters], Any] = (),
        drop: Iterable[str] = (),
        objective: Any = None,
    ) -> Conditions:
        """Return the same conditions with more or fewer constraints, or another objective; the variables are shared.

        Parameters
        ----------
        constraints : iterable or mapping of cvxpy.Constraint, or callable, optional
            Added; one of a name that is there already replaces it, and those without a name are ``own 1``, ``own 2``
            and so on.  A function takes `letters` and returns them.
        drop : iterable of str, optional
            Names of constraints to leave out.
        objective : cvxpy.Minimize, cvxpy.Maximize, cvxpy.Expression or callable, optional
            Instead of the present one; an expression is minimised.  A function takes `letters` and returns it.

        Raises
        ------
        SpecError
            Something is no constraint or no objective, or there is no constraint of a name to drop.
        """
        unknown = [key for key in drop if key not in self.constraints]
        if unknown:
            raise SpecError(
                f"There is no constraint {unknown[0]!r}; {there_are(unknown[0], self.constraints)}",
                path="drop",
            )
        remaining = {key: value for key, value in self.constraints.items() if key not in set(drop)}
        added = of_the_letters(constraints, self.letters(), "constraints") if callable(constraints) else constraints
        new = named_constraints(added, sum(name.startswith(OWN) for name in remaining))
        remaining |= new
        goal = self.problem.objective
        if objective is not None:
            given = of_the_letters(objective, self.letters(), "objective") if callable(objective) else objective
            goal = checked_objective(given)
        return replace(
            self,
            problem=lmi.semidefinite_problem(goal, list(remaining.values())),
            constraints=remaining,
            _added=(self._added | set(new)) & set(remaining),
            _values_before={name: variable.value for name, variable in self.variables.items()},
        )

    def _require_solved_since(self) -> None:
        """Raise where the variables, which changed conditions share, still have the values of before the change."""
        before = {name: value for name, value in self._values_before.items() if value is not None}
        if self.problem.status is None and before:
            now = {name: self.variables[name].value for name in before}
            if all(now[name] is not None and np.array_equal(now[name], before[name]) for name in before):
                raise SpecError(
                    "These conditions have been changed and not solved since: the variables have the values that they "
                    "had before. Solve the problem first, problem.solve().",
                    path="problem",
                )

    def _size_of_values(self) -> float:
        """Return the size of the largest entry of the variables, at least one."""
        values = [variable.value for variable in self.problem.variables()]
        return max((float(np.max(np.abs(value), initial=1.0)) for value in values), default=1.0)

    def _value(self, name: str, variable: Any) -> FloatArray:
        value = variable.value
        if value is None and self.problem.status is None:
            raise SpecError(f"{name} has no value: solve the problem first, problem.solve().", path=name)
        if value is None or not np.all(np.isfinite(value)):
            raise SolverError(
                f"{name} has no value: the solver ended with status {str(self.problem.status)!r}. Whether there is a "
                "solution at all, see existence."
            )
        return np.asarray(value, dtype=np.float64)

    def __repr__(self) -> str:
        listed = ", ".join(f"{name} {variable.shape}" for name, variable in self.variables.items())
        return (
            f"Conditions of {self.source}\n  variables    {listed}\n  constraints  {', '.join(self.constraints)}"
            f"\n  data         {', '.join(self.data)}\n  status       {self.problem.status or 'not solved yet'}"
        )


def design_of(source: str, *arguments: Any) -> Callable[[dict[str, FloatArray], str], ObserverDesign]:
    """Return how gains of these conditions become a verified design: a function that `obsynth.methods` provides.

    ``source`` names the conditions, and ``arguments`` is what their designs need beside the gains: the plant, first.
    """
    return lambda gains, name: registered("design_of_conditions")(source, *arguments, gains, name)


class _ByName(dict[str, Any]):
    """Parts of conditions by name; one that does not exist is refused with those that do."""

    def __init__(self, kind: str, parts: Mapping[str, Any]) -> None:
        super().__init__(parts)
        self.kind = kind

    def __missing__(self, name: str) -> Any:
        raise KeyError(f"no {self.kind} named {name!r}; {there_are(name, self)}")


class Letters(dict[str, Any]):
    """Variables and data of a condition by letter; one that does not exist is refused with those that do."""

    def __missing__(self, name: str) -> Any:
        variables = [letter for letter, value in self.items() if isinstance(value, cp.Variable)]
        data = [letter for letter in self if letter not in variables]
        raise SpecError(
            f"There is no variable {name!r}: there are {', '.join(variables)}"
            + (f", and the data {', '.join(data)}." if data else ".")
            + suggestion(name, self),
            path="constraints",
        )


def _called(name: str) -> str:
    """Return how a message calls a constraint of the user."""
    return f"your constraint {name.removeprefix(OWN)}" if name.startswith(OWN) else f"the constraint {name!r}"


def of_the_letters(function: Callable[..., Any], letters: Mapping[str, Any], name: str) -> Any:
    """Return what a user's function makes of the letters; raise `SpecError` where it does not take them."""
    try:
        signature(function).bind(letters)
    except TypeError:
        raise SpecError(
            f"{name} is a function that does not take one argument: it is called with the letters of the problem, as "
            f"{name}=lambda letters: {'...' if name == 'objective' else '[...]'}.",
            path=name,
        ) from None
    except ValueError:
        pass  # a function of another language tells no arguments
    return function(letters)


def named_constraints(constraints: Any, count: int = 0) -> dict[str, Any]:
    """Return constraints by name, the others numbered after ``count``; raise `SpecError` for what is none."""
    from cvxpy.constraints.constraint import Constraint

    if isinstance(constraints, Constraint):
        constraints = [constraints]
    if not isinstance(constraints, Mapping) and not isinstance(constraints, Iterable):
        raise SpecError(f"constraints are {shown(constraints)}: give a list of cvxpy constraints.", path="constraints")
    pairs = (
        dict(constraints)
        if isinstance(constraints, Mapping)
        else {f"{OWN}{i}": part for i, part in enumerate(constraints, count + 1)}
    )
    for name, part in pairs.items():
        expected = "cvxpy constraints, such as P >> numpy.eye(n)"
        require_kind(part, Constraint, f"Constraint {name!r}", expected, path="constraints")
        if not part.is_dcp():
            called = _called(name)
            raise SpecError(f"{called[0].upper()}{called[1:]} is not convex: {part}", path="constraints")
    return pairs


def checked_objective(objective: Any) -> Any:
    """Return a cvxpy objective, minimising an expression; raise `SpecError` for anything else."""
    if isinstance(objective, (cp.Minimize, cp.Maximize)):
        return objective
    if not isinstance(objective, cp.Expression) or objective.size != 1:
        raise SpecError(
            f"The objective is {a_kind(objective)}: give cvxpy.Minimize(...), or a scalar expression.",
            path="objective",
        )
    return cp.Minimize(objective)


def require_data(conditions: Sequence[Condition], *, solvers: tuple[str, ...]) -> None:
    """Raise for the first failing condition without which the inequality cannot be written.

    Those whose names begin with one of ``solvers`` leave a problem that is infeasible.
    """
    for condition in conditions:
        if not condition.holds and not condition.name.startswith(solvers):
            condition.require()
