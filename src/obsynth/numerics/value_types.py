"""Types of option values with their ranges: stated once, read by constructors, by options and by the spec's schema."""

from __future__ import annotations

import operator
import types
from collections.abc import Callable, Mapping
from typing import Annotated, Any, Literal, Union, get_args, get_origin

import numpy as np
from annotated_types import Ge, Gt, Le, Lt

from obsynth.errors import SpecError
from obsynth.numerics.arguments import is_finite_number, shown

Positive = Annotated[float, Gt(0.0)]
NonNegative = Annotated[float, Ge(0.0)]
#: lambda: 1 forgets nothing.
ForgettingFactor = Annotated[float, Gt(0.0), Le(1.0)]
#: Per sample; 0 never.
Probability = Annotated[float, Ge(0.0), Lt(1.0)]
OpenUnitInterval = Annotated[float, Gt(0.0), Lt(1.0)]
Count = Annotated[int, Ge(1)]

#: Mark -> its attribute, the comparison it stands for, and how a message says it.
_BOUNDS: Mapping[type, tuple[str, Callable[[Any, Any], bool], str]] = {
    Gt: ("gt", operator.gt, "above"), Ge: ("ge", operator.ge, "at least"), Lt: ("lt", operator.lt, "below"),
    Le: ("le", operator.le, "at most"),
}  # fmt: skip


class WrittenAs:
    """Marks an option that is no plain number, text or truth: a spec reads it as this kind, the method checks it."""

    def __init__(self, kind: str) -> None:
        self.kind = kind


def problem_with(value: Any, name: str, kind: Any) -> str | None:
    """Return what is wrong with a value of an annotated type, as a sentence; ``None`` where nothing is."""
    options = get_args(kind) if get_origin(kind) in (Union, types.UnionType) else (kind,)
    if value is None and type(None) in options:
        return None
    plain, *marks = next((get_args(part) for part in options if get_origin(part) is Annotated), (options[0],))
    if plain is Any:
        return None
    if get_origin(plain) is Literal:
        allowed = get_args(plain)
        fits = any(type(value) is type(choice) and value == choice for choice in allowed)
        return None if fits else f"{name} is {shown(value)}: use one of {', '.join(map(str, allowed))}."
    if plain is bool:
        return None if isinstance(value, (bool, np.bool_)) else f"{name} is {shown(value)}: give True or False."
    whole = plain is int
    fits = is_finite_number(value) and (not whole or isinstance(value, (int, np.integer)))
    limits = [(*_BOUNDS[type(mark)][1:], getattr(mark, _BOUNDS[type(mark)][0])) for mark in marks]
    if fits and all(holds(value, limit) for holds, _, limit in limits):
        return None
    bounds = " and ".join(f"{word} {limit:g}" for _, word, limit in limits)
    return f"{name} is {shown(value)}: give a {'whole ' if whole else ''}number{f' {bounds}' if bounds else ''}."


def checked_value(value: Any, name: str, kind: Any) -> Any:
    """Return a value of an annotated type; raise `SpecError` that names it and its range."""
    problem = problem_with(value, name, kind)
    if problem is not None:
        raise SpecError(problem, path=name)
    return value.item() if isinstance(value, np.generic) else value
