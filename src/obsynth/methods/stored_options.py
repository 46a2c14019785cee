"""What a gain set stores of how it was asked for: options that the method has, with values that it takes.

A design is printed with its options and with the solver that ran.  No claim rests on most of them, and a reader who is
shown an option believes that the design was made with it.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

from obsynth.conditions.options import FUNCTION_TEXT, SEMIDEFINITE_SOLVERS
from obsynth.errors import SpecError
from obsynth.methods.method import Method
from obsynth.numerics.arguments import field_types, problem_with, shown
from obsynth.numerics.suggestions import suggestion
from obsynth.observers.nonlinear.observer import DAEObserver
from obsynth.observers.recursive.observer import RecursiveObserver
from obsynth.results.design import ObserverDesign

#: How gains may have been computed, as the record of the solver says.
ENGINES = ("lmi", "riccati", "filtering Riccati equation")

#: Options of which a design stores the names of functions.
_FUNCTIONS = ("constraints", "objective")


def wrong_options(method: type[Method], design: ObserverDesign) -> Iterator[str]:
    """Yield what is wrong with the options of a design and with its record of the solver, as sentences.

    Parameters
    ----------
    method : type of Method
        The design's method.
    design : ObserverDesign
        The design, with options as it stores them.

    Yields
    ------
    str
        An option that the method does not have, a value that it does not take, or a solver or an engine that there
        is none of.
    """
    kinds = field_types(method)
    known = {*kinds, *method.recorded}
    for name in sorted(set(design.options) - known):
        yield f"{method.id} has no option {shown(name)}.{suggestion(str(name), sorted(known))}"
    functions = {name for name in _FUNCTIONS if name in kinds and _names_functions(design.options.get(name))}
    stored = {name: value for name, value in design.options.items() if name in kinds and name not in functions}
    if isinstance(design.observer, (RecursiveObserver, DAEObserver)):
        # Resolved options, in forms of their own: rules across options are about what was asked for.
        problems = (problem_with(value, name, kinds[name]) for name, value in stored.items())
        yield from (problem for problem in problems if problem)
    else:
        yield from _refused(method, stored, design)
    yield from _wrong_solvers(design)


def _names_functions(value: Any) -> bool:
    """Whether a value is what is stored of a function, or the names of constraints."""
    if isinstance(value, str):
        return value.startswith(FUNCTION_TEXT)
    return isinstance(value, (list, tuple)) and all(isinstance(name, str) for name in value)


def _refused(method: type[Method], stored: Mapping[str, Any], design: ObserverDesign) -> Iterator[str]:
    """Yield why the method does not take these options, or not for this plant."""
    try:
        method.of(stored).require_fitting(design.plant)
    except SpecError as error:
        yield from [str(problem) for problem in error.problems] or [str(error)]


def _wrong_solvers(design: ObserverDesign) -> Iterator[str]:
    """Yield the solvers and engines that there are none of, of which a reader is told that they ran."""
    runs = design.solver.get("runs", ())
    records = [run for run in runs if isinstance(run, Mapping)] if isinstance(runs, (list, tuple)) else []
    ran = [run.get("solver") for run in records if "settings" in run]
    asked = [design.options["solver"]] if "solver" in design.options else []
    for name in dict.fromkeys(str(name) for name in (*asked, *ran)):
        if name not in SEMIDEFINITE_SOLVERS:
            yield f"there is no solver {shown(name)} that does semidefinite programmes."
    engine = design.solver.get("engine")
    if engine is not None and engine not in ENGINES:
        yield f"there is no engine {shown(engine)}."
