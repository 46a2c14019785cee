"""Checks of arguments: errors always name the argument, and no raw TypeError reaches the caller.

Types of option values with their ranges: stated once, read by constructors, by options and by the spec's schema.
"""

from __future__ import annotations

import math
import operator
import types
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import fields
from functools import cache, wraps
from inspect import signature, unwrap
from pathlib import Path
from typing import Annotated, Any, Literal, TextIO, TypeVar, Union, get_args, get_origin, get_type_hints

import numpy as np
from annotated_types import Ge, Gt, Le, Lt

from obsynth.errors import SpecError, a_kind, counted
from obsynth.numerics.arrays import FloatArray, Given, as_given, holds_truth
from obsynth.numerics.quantities import require_plain
from obsynth.numerics.suggestions import keyword_names, require_keywords

#: Messages give the number of digits of whole numbers beyond this.
LONGEST_SHOWN = 10**30

#: A larger count of samples, rows or runs is a mistake that would fill the memory.
MOST_COUNTED = 1_000_000


Positive = Annotated[float, Gt(0.0)]

NonNegative = Annotated[float, Ge(0.0)]

#: lambda: 1 weighs all samples alike.
ForgettingFactor = Annotated[float, Gt(0.0), Le(1.0)]

#: Per sample; 0 never.
Probability = Annotated[float, Ge(0.0), Lt(1.0)]

#: Of random numbers.
Seed = Annotated[int, Ge(0)]

OpenUnitInterval = Annotated[float, Gt(0.0), Lt(1.0)]

Count = Annotated[int, Ge(1), Le(MOST_COUNTED)]

#: Samples that are kept as states.
FewSamples = Annotated[int, Ge(0), Le(1000)]

#: Mark -> its attribute, the comparison it stands for, and how a message says it.
_BOUNDS: Mapping[type, tuple[str, Callable[[Any, Any], bool], str]] = {
    Gt: ("gt", operator.gt, "above"),
    Ge: ("ge", operator.ge, "at least"),
    Lt: ("lt", operator.lt, "below"),
    Le: ("le", operator.le, "at most"),
}


#: What makes a plant of the models of other libraries.
_IMPORTERS: Mapping[str, str] = {
    "control": "obsynth.from_control",
    "scipy": "obsynth.from_scipy",
    "casadi": "obsynth.from_casadi",
    "pandas": "obsynth.from_pandas",
    "andes": "obsynth.from_andes",
}

#: How a message asks for what an annotation says, by name; what is not here is called by its own name.
_WORDS: Mapping[str, str] = {
    "bool": "True or False",
    "int": "a whole number",
    "float": "a number",
    "str": "a text",
    "Path": "the name of a file",
    "TextIO": "a text stream",
    "Mapping": "a mapping from names, such as {'speed': 1.0}",
    "Sequence": "a list",
    "Iterable": "a list",
    "Callable": "a function",
    "_Numbers": "real numbers",
    "ObserverDesign": "an ObserverDesign, such as obsynth.load(path)",
    "Scenario": "an obsynth.Scenario",
    "DescriptorSystem": "an obsynth.DescriptorSystem",
    "Monitor": "what obsynth.online_monitor returns",
    "DataRun": "what obsynth.run_on_data returns",
    "Simulation": "what obsynth.simulate returns for a design",
    "Estimates": "the Estimates of a whole run, such as observer.run(y, u), or simulation.estimates",
    "Detection": "what a monitor's watch returns",
    "Decision": "what obsynth.decide returns",
    "ToleranceStudy": "what obsynth.tolerance_study returns",
    "LinearObserver": "design.observer of a linear design",
    "RecursiveObserver": "design.observer of a recursive design",
    "DAEObserver": "design.observer of a nonlinear design",
    "VerificationReport": "what obsynth.verify returns",
    "LMIRegion": "a region, such as obsynth.conditions.disk(0.0, 0.9)",
    "Executor": "an executor of concurrent.futures",
    "Axes": "axes of matplotlib",
}


#: What an option is that is written as some kind, and the Python types of it.
_LISTS: Mapping[str, tuple[str, tuple[type, ...]]] = {
    "poles": ("a list of poles", (list, tuple, np.ndarray)),
    "texts": ("a list of names", (str, list, tuple)),
    "fault sets": ("'detect', 'isolate' or lists of names", (str, list, tuple)),
    "named bounds": ("a number, 0 or more, or one for each name", (int, float, np.integer, np.floating, Mapping)),
    "free faults": ("'others', 'none' or a list of names", (str, list, tuple)),
    "text": ("a text", (str,)),
}


Returned = TypeVar("Returned")


def real_number(
    value: Any,
    name: str,
    what: str = "a number",
    *,
    above: float = -math.inf,
    least: float = -math.inf,
    below: float = math.inf,
    path: str | None = None,
) -> float:
    """Return a finite number in a range; raise `SpecError` naming the argument and ``what`` it should be, also for
    a quantity: its unit would be lost."""
    value = require_plain(value, name)
    if not is_finite_number(value) or not (above < value < below and value >= least):
        raise SpecError(f"{name} is {shown(value)}: give {what}.", path=path or name)
    return float(value)


def whole_number(value: Any, name: str, what: str = "a whole number", *, least: int = 1) -> int:
    """Return a whole number; raise `SpecError` naming the argument, ``what`` it should be, and the least one."""
    if not is_whole(value) or value < least:
        raise SpecError(f"{name} is {shown(value)}: give {what}, at least {least}.", path=name)
    return int(value)


def shape_problem(actual: tuple[int, ...], needed: tuple[int, ...], name: str) -> str | None:
    """Return what is wrong with the shape of an array, as a sentence; ``None`` where nothing is."""
    if actual == needed:
        return None
    matrices = len(actual) == len(needed) == 2
    transposed = matrices and (actual[1] == needed[0] != actual[0] or actual[0] == needed[1] != actual[1])
    hint = " Is it transposed?" if transposed or actual == needed[::-1] else ""
    sides = [" by ".join(map(str, shape)) or "a single number" for shape in (actual, needed)]
    return f"{name} is {sides[0]}, but {sides[1]} is needed.{hint}"


def require_shape(actual: tuple[int, ...], needed: tuple[int, ...], name: str) -> None:
    """Raise `SpecError` naming the argument where an array has another shape than is needed."""
    problem = shape_problem(actual, needed, name)
    if problem:
        raise SpecError(problem, path=name)


def truth(value: Any, name: str) -> bool:
    """Return True or False; raise `SpecError` for anything else."""
    if not isinstance(value, (bool, np.bool_)):
        raise SpecError(f"{name} is {shown(value)}: give True or False.", path=name)
    return bool(value)


def real_vector(value: Any, size: int, name: str) -> FloatArray:
    """Return ``(size,)`` finite real numbers; a single one may be given as such."""
    refusal = SpecError(f"{name} must be {counted(size, 'finite number')}.", path=name)
    try:
        vector = np.atleast_1d(real_array(value, name))
    except SpecError:
        raise refusal from None
    if vector.shape != (size,) or not np.isfinite(vector).all():
        raise refusal
    return vector


def real_array(value: Any, name: str) -> FloatArray:
    """Return real numbers of any shape, NaN (masked entries too) and infinities among them; else raise `SpecError`."""
    raw = as_given(value, name, f"{name} has rows of different lengths.")
    if (raw.dtype.kind not in "fiu" and raw.size) or holds_truth(value):
        raise SpecError(f"{name} is {shown(value)}: give real numbers.", path=name)
    return np.asarray(raw, dtype=np.float64) if raw.size else np.zeros(raw.shape)


def chosen(value: Any, name: str, choices: tuple[str, ...]) -> str:
    """Return a text that is one of ``choices``; raise `SpecError` listing them."""
    if not isinstance(value, str) or value not in choices:
        raise SpecError(f"{name} is {shown(value)}: use one of {', '.join(choices)}.", path=name)
    return value


def without_axes(value: Any) -> Any:
    """Return the entry of an array without axes, as ``numpy.array(2.0)``, by name too; anything else as it is."""
    if isinstance(value, Mapping) and any(isinstance(entry, np.ndarray) for entry in value.values()):
        return {name: without_axes(entry) for name, entry in value.items()}
    return value.item() if isinstance(value, np.ndarray) and not value.ndim else value


def number_in_text(text: str) -> float:
    """Return the number that a text holds; raise `ValueError` where it holds none, as ``1_000`` of Python is none."""
    if "_" in text:
        raise ValueError(f"{text!r} is no number")
    return float(text)


def is_number(value: Any) -> bool:
    """Whether ``value`` is a single real number, of Python or numpy."""
    # A length of time is a whole number for numpy, whatever its unit.
    number = isinstance(value, (int, float, np.integer, np.floating))
    return number and not isinstance(value, (bool, np.timedelta64))


def is_whole(value: Any) -> bool:
    """Whether ``value`` is a single whole number, of Python or numpy."""
    return isinstance(value, (int, np.integer)) and not isinstance(value, (bool, np.timedelta64))


def require_kind(
    value: Any, kinds: type | tuple[type, ...], name: str, expected: str, *, path: str | None = None
) -> None:
    """Raise `SpecError` unless an argument is of some kind."""
    if not isinstance(value, kinds):
        raise SpecError(f"{name} is {a_kind(value)}: give {expected}.", path=path or name)


def require_mapping(value: Any, name: str) -> None:
    """Raise `SpecError` unless an optional argument is a mapping from names."""
    if value is not None:
        require_kind(value, Mapping, name, "a mapping from names, such as {'speed': 1.0}")


def is_finite_number(value: Any) -> bool:
    """Whether ``value`` is a single finite real number."""
    return is_number(value) and math.isfinite(_as_float(value))


def _as_float(value: Any) -> float:
    """Return a number in double precision; infinity for whole numbers beyond it."""
    try:
        return float(value)
    except OverflowError:
        return math.inf


def shown(value: Any) -> str:
    """Return a value as it may stand in a message: short, and on one line."""
    if value is None:
        return "missing"
    if is_whole(value) and abs(value) > LONGEST_SHOWN:
        # Python refuses to print whole numbers of more than 4300 digits.
        return f"a whole number of about {int(int(value).bit_length() * math.log10(2.0)) + 1} digits"
    text = repr(value.item() if isinstance(value, np.generic) else value)
    return text if len(text) <= 60 and "\n" not in text else a_kind(value)


class WrittenAs:
    """Marks an option that is no plain number, text or truth: a spec reads it as this kind, the method checks it."""

    def __init__(self, kind: str) -> None:
        self.kind = kind


class _Numbers:
    """Stands for ``ArrayLike`` in annotations, whose own parts tell nothing apart."""


class _ByName:
    """Base class of what stands for a class that the module of an annotation imports for types only."""


def _is_one_of(value: Any, kind: Any) -> bool:
    """Whether a value is of one of the kinds that an annotation says; what is not known here is not judged."""
    origin, inner = get_origin(kind) or kind, get_args(kind)
    if origin in (Union, types.UnionType):
        return any(_is_one_of(value, part) for part in inner)
    if origin in (bool, int, float):
        tell = {bool: lambda item: isinstance(item, (bool, np.bool_)), int: is_whole, float: is_number}
        return bool(tell[origin](value))
    if origin in (Sequence, Iterable):
        # What can be gone through only once is not looked into, and what has no order may hold names only.
        once = origin is Iterable and isinstance(value, Iterator)
        listed = isinstance(value, Collection) and not isinstance(value, (str, bytes, Mapping))
        listed = listed and not (isinstance(value, np.ndarray) and value.ndim == 0)
        ordered = inner[0] is str or not isinstance(value, (set, frozenset))
        return once or (listed and ordered and all(_is_one_of(item, inner[0]) for item in value))
    if origin is _Numbers:
        try:
            return real_array(value, "") is not None
        except SpecError:
            return False
    if origin is Callable:
        return callable(value)
    if origin is TextIO:
        return hasattr(value, "write") or hasattr(value, "read")
    if not isinstance(origin, type) or origin is Any:
        return True
    if issubclass(origin, _ByName):
        return any(known.__name__ == origin.__name__ for known in type(value).__mro__)
    return isinstance(value, origin)


def _problem_with_kind(value: Any, name: str, kind: Any) -> str | None:
    """Return what is wrong with a value of the wrong kind, as a sentence."""
    if _is_one_of(value, kind):
        return None
    options = get_args(kind) if get_origin(kind) in (Union, types.UnionType) else (kind,)
    expected = []
    for option in options:
        plain = (get_origin(option) or option).__name__
        if plain in ("Sequence", "Iterable") and get_args(option)[0] is str:
            expected.append("a list of names")
        elif plain != "NoneType" and not (option is str and Path in options):
            expected.append(_WORDS.get(plain, f"an obsynth.{plain}"))
    hint = _suggestion(value, [(get_origin(option) or option).__name__ for option in options])
    first, *more = dict.fromkeys(expected)
    # The prefix once: an obsynth.DescriptorSystem, DAEModel or PolytopicSystem.
    kinds = [first, *(text.removeprefix("an obsynth.") if "an obsynth." in first else text for text in more)]
    listing = ", ".join(kinds[:-1]) + " or " + kinds[-1] if more else first
    return f"{name} is {a_kind(value)}: give {listing}.{hint}"


def _suggestion(value: Any, expected: Sequence[str]) -> str:
    """Return what may have been meant by a value of another kind, as a sentence after a blank; or nothing."""
    if "DescriptorSystem" in expected and isinstance(value, (str, Path)):
        return f" The plant of a spec is obsynth.load_spec({str(value)!r}).plant."
    if "DescriptorSystem" in expected and type(value).__name__ == "Spec":
        return " The plant of a spec is spec.plant."
    if "DescriptorSystem" in expected and isinstance(value, Mapping):
        return " Of its arguments a mapping makes one: obsynth.DescriptorSystem(**plant)."
    library = type(value).__module__.partition(".")[0]
    if "DescriptorSystem" in expected and library in _IMPORTERS:
        return f" A model of {library} becomes one by {_IMPORTERS[library]}(model)."
    if expected == ["str"] and hasattr(value, "__name__"):
        return f" Did you mean {value.__name__.replace('_', '-')!r}?"
    return ""


def problem_with(value: Any, name: str, kind: Any) -> str | None:
    """Return what is wrong with a value of an annotated type, as a sentence; ``None`` where nothing is."""
    options = get_args(kind) if get_origin(kind) in (Union, types.UnionType) else (kind,)
    if value is None and type(None) in options:
        return None
    kinds = [option for option in options if option is not type(None)]
    if not any(get_origin(option) in (Annotated, Literal) for option in kinds) and (
        len(kinds) > 1 or kinds[0] not in (bool, int, float)
    ):
        return _problem_with_kind(value, name, kind)
    plain, *marks = next((get_args(part) for part in options if get_origin(part) is Annotated), (options[0],))
    if plain is Any:
        return _problem_with_written(
            value, name, next((mark.kind for mark in marks if isinstance(mark, WrittenAs)), "")
        )
    if get_origin(plain) is Literal:
        allowed = get_args(plain)
        fits = any(type(value) is type(choice) and value == choice for choice in allowed)
        return None if fits else f"{name} is {shown(value)}: use one of {', '.join(map(str, allowed))}."
    if plain is bool:
        return None if isinstance(value, (bool, np.bool_)) else f"{name} is {shown(value)}: give True or False."
    is_integer = plain is int
    fits = is_finite_number(value) and (not is_integer or is_whole(value))
    limits = [(*_BOUNDS[type(mark)][1:], getattr(mark, _BOUNDS[type(mark)][0])) for mark in marks]
    if fits and all(holds(value, limit) for holds, _, limit in limits):
        return None
    bounds = " and ".join(f"{word} {limit:g}" for _, word, limit in limits)
    return f"{name} is {shown(value)}: give a {'whole ' if is_integer else ''}number{f' {bounds}' if bounds else ''}."


def _problem_with_written(value: Any, name: str, kind: str) -> str | None:
    expected, kinds = _LISTS.get(kind, ("numbers", ()))
    if kind == "samples":
        fits = (isinstance(value, str) and value == "auto") or (is_whole(value) and 1 <= value <= MOST_COUNTED)
        expected = f"a whole number of samples, 1 to {MOST_COUNTED}, or 'auto'"
        return None if fits else f"{name} is {shown(value)}: give {expected}."
    if kind == "named bounds" and isinstance(value, Mapping):
        return next(
            filter(None, (_problem_with_bound(bound, f"{name} of {key}") for key, bound in value.items())), None
        )
    if kind == "named bounds" and is_number(value):
        return _problem_with_bound(value, name)
    if kind == "residual weight":
        fits = value is None or (isinstance(value, str) and value in ("paper", "free")) or _is_one_of(value, _Numbers)
        fits = fits and not is_number(value) and not isinstance(value, (bool, np.bool_))
        return None if fits else f"{name} is {shown(value)}: give 'paper', 'free' or a matrix (nf, ny)."
    if kind == "delay":
        each = value.values() if isinstance(value, Mapping) else value
        each = [value] if isinstance(each, str) or not isinstance(each, Iterable) else [*each]
        fits = all(
            (isinstance(one, str) and one == "auto") or (is_whole(one) and 0 <= one <= MOST_COUNTED) for one in each
        )
        wanted = "a whole number of samples, at least 0, or 'auto', or one of these for each fault"
        return None if fits else f"{name} is {shown(value)}: give {wanted}."
    if kind == "reference model":
        fits = value is None or isinstance(value, Mapping) or hasattr(value, "dt")
        fits = fits or (isinstance(value, (list, tuple)) and len(value) == 4)
        expected = (
            "{'bandwidth': 10}, {'num': [...], 'den': [...]}, matrices {'A': ..., 'B': ..., 'C': ..., 'D': ...} or a "
            "system of python-control or scipy.signal"
        )
        return None if fits else f"{name} is {shown(value)}: give {expected}."
    if kind == "weights":
        fits = value is None or isinstance(value, Mapping)
        wanted = "{'errors': {'fault': weight}, 'inputs': {'noise': weight}}"
        return None if fits else f"{name} is {shown(value)}: give {wanted}."
    fits = not isinstance(value, (bool, np.bool_)) and (not kinds or value is None or isinstance(value, kinds))
    if fits and kind == "fault sets" and not isinstance(value, (str, type(None))):
        fits = all(isinstance(entry, (str, list, tuple)) for entry in value)
    return None if fits else f"{name} is {shown(value)}: give {expected}."


def _problem_with_bound(bound: Any, name: str) -> str | None:
    """Return what is wrong with a bound, which is a number, 0 or more, or an interval."""
    if not isinstance(bound, (list, tuple, np.ndarray)):
        fits = is_finite_number(bound) and bound >= 0.0
        return None if fits else f"{name} is {shown(bound)}: give a finite number, 0 or more."
    if len(bound) == 2 and all(map(is_finite_number, bound)) and bound[0] <= bound[1]:
        return None
    return f"{name} is {bound!r}: give one number, or two finite ones, [low, high], low first."


def checked_value(value: Any, name: str, kind: Any) -> Any:
    """Return a value of an annotated type; raise `SpecError` that names it and its range."""
    problem = problem_with(value, name, kind)
    if problem is not None:
        raise SpecError(problem, path=name)
    return value.item() if isinstance(value, np.generic) else value


@cache
def field_types(kind: Any) -> dict[str, Any]:
    """Return name -> annotated type of every field of a dataclass."""
    hints = get_type_hints(kind, include_extras=True)
    return {field.name: hints[field.name] for field in fields(kind)}


def check_fields(made: Any, kind: Any) -> None:
    """Check each field of a dataclass ``kind`` whose type states a range or choices; numbers become plain ones."""
    for name, stated in field_types(kind).items():
        parts = get_args(stated) if get_origin(stated) in (Union, types.UnionType) else (stated,)
        if any(get_origin(part) in (Annotated, Literal) for part in parts):
            object.__setattr__(made, name, checked_value(getattr(made, name), name, stated))


@cache
def argument_kinds(function: Callable[..., Any]) -> dict[str, Any]:
    """Return name -> kind of the arguments of a function, as its annotations say them."""
    known: dict[str, Any] = {"ArrayLike": _Numbers}
    kinds = {}
    for name, parameter in signature(function).parameters.items():
        annotation = parameter.annotation
        while isinstance(annotation, str) and parameter.kind is not parameter.VAR_KEYWORD and name not in kinds:
            try:
                kinds[name] = eval(annotation, unwrap(function).__globals__, known)
            except NameError as missing:
                known[str(missing.name)] = type(str(missing.name), (_ByName,), {})
    return kinds


def arguments_checked(function: Callable[Given, Returned]) -> Callable[Given, Returned]:
    """Make a public function raise `SpecError` for arguments that are not of the kinds that its annotations say."""
    return arguments_worded()(function)


def arguments_worded(**words: str) -> Callable[[Callable[Given, Returned]], Callable[Given, Returned]]:
    """Return `arguments_checked` with what to give for some arguments in words of the function's own."""

    def checked(function: Callable[Given, Returned]) -> Callable[Given, Returned]:
        stated, known = signature(function), keyword_names(function)

        @wraps(function)
        def called(*args: Given.args, **kwargs: Given.kwargs) -> Returned:
            require_keywords(kwargs, known, function.__name__)
            kinds = argument_kinds(function)
            arguments = dict(zip(stated.parameters, args, strict=False)) | kwargs
            wrong = {
                name: f"{name} is {a_kind(value)}: give {words[name]}." if name in words else text
                for name, value in arguments.items()
                if name in kinds and (text := problem_with(value, name, kinds[name]))
            }
            if wrong:
                first = next(iter(wrong))
                message = wrong[first] if len(wrong) == 1 else f"Arguments of {function.__name__}:"
                raise SpecError(message, path=first, problems=tuple(wrong.values()) if len(wrong) > 1 else ())
            given = [_without_numpy(v, kinds.get(name)) for name, v in zip(stated.parameters, args, strict=False)]
            named = {name: _without_numpy(value, kinds.get(name)) for name, value in kwargs.items()}
            called_with: Callable[..., Returned] = function
            return called_with(*given, *args[len(given) :], **named)

        return called

    return checked


def _without_numpy(value: Any, kind: Any) -> Any:
    """Return a number of numpy as one of Python, whose products do not overflow, and an array for a list as a list."""
    if isinstance(value, (np.number, np.bool_)):
        return value.item()
    options = get_args(kind) if get_origin(kind) in (Union, types.UnionType) else (kind,)
    lists = any(option in (Sequence[str], Sequence[float], Sequence[int]) for option in options)
    return value.tolist() if isinstance(value, np.ndarray) and lists else value
