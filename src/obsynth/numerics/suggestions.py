"""Names that may be meant by a wrong one, and keyword arguments that do not exist."""

from __future__ import annotations

import difflib
from collections.abc import Callable, Iterable, Mapping, Sequence
from functools import wraps
from inspect import Parameter, signature
from typing import Any, ParamSpec, TypeVar

#: A name that misses a wrong one by more than this many times the miss of the closest name is not suggested.
MUCH_FARTHER = 2.5

#: So many letters of a name are taken as its beginning.
LEAST_BEGINNING = 3

#: So many names are listed at most, of a network with hundreds of states for one, and so many letters of each.
MOST_LISTED, MOST_LETTERS = 24, 60

Given = ParamSpec("Given")

Returned = TypeVar("Returned")

Class = TypeVar("Class", bound=type)

#: ``meant(name, known, present)``: a question with the name that is meant, after a blank, or nothing.
Meant = Callable[[str, Iterable[str], Iterable[str]], str]


def suggestion(name: str, names: Iterable[str]) -> str:
    """Return a question with the names closest to a wrong one, beginning with a space; empty where none is close."""
    known = list(names)
    if not _is_number(str(name)):
        # The columns of a table without names are numbered: '1' is no slip of 'y1'.
        known = [other for other in known if not _is_number(other)]
    close = _closest(str(name), known)
    if not close and len(str(name)) >= LEAST_BEGINNING:
        close = [other for other in known if other.startswith(str(name))][:3]
    return f" Did you mean {' or '.join(repr(shortened(other)) for other in close)}?" if close else ""


def not_in_module(module: str, name: str, known: Iterable[str], elsewhere: Mapping[str, str]) -> AttributeError:
    """Return Python's error for a name that a module lacks, with the one that may be meant; ``elsewhere``: of names
    that other libraries use."""
    near = "" if name.startswith("_") else suggestion(name, list(known))
    near = f" Did you mean {elsewhere[name]!r}?" if name in elsewhere else near
    text = f"module {module!r} has no attribute {name!r}"
    # An owner is named, so that Python does not append what it takes to be meant.
    return AttributeError(f"{text}.{near}" if near else text, name=name, obj=None)


def no_attribute(owner: object, name: str, elsewhere: Mapping[str, str]) -> AttributeError:
    """Return Python's error for an attribute that an object lacks, with where it is or which one may be meant.

    ``elsewhere``: what to write instead of an attribute, by name.
    """
    text = f"{type(owner).__name__!r} object has no attribute {name!r}"
    if name.startswith("_"):
        return AttributeError(text)
    if name in elsewhere:
        return AttributeError(f"{text}: write {elsewhere[name]}")
    close = suggestion(name, [other for other in dir(owner) if not other.startswith("_")])
    return AttributeError(f"{text}.{close}" if close else text)


def shortened(name: str) -> str:
    """Return a name, or its beginning where it is as long as the line of a file that has no names."""
    return name if len(name) <= MOST_LETTERS else f"{name[:MOST_LETTERS]}..."


def quoted_names(names: Sequence[str]) -> str:
    """Return names in quotation marks with commas between, long ones shortened, and of many how many more there are."""
    return _listed([repr(shortened(name)) for name in names])


def _listed(words: Sequence[str]) -> str:
    more = f" and {len(words) - MOST_LISTED} more" if len(words) > MOST_LISTED else ""
    return f"{', '.join(words[:MOST_LISTED]) or 'none'}{more}"


def are_numbers(names: Sequence[str]) -> bool:
    """Whether all names are numbers, as those of a table that has no names."""
    return bool(names) and all(map(_is_number, names))


def _is_number(text: str) -> bool:
    try:
        float(text)
    except ValueError:
        return False
    return True


def there_are(name: Any, names: Iterable[Any]) -> str:
    """Return the end of a message: which names there are, and the ones that may be meant by a wrong one."""
    known = list(map(str, names))
    return f"there are: {_listed([shortened(other) for other in known])}.{suggestion(str(name), known)}"


def _closest(name: str, known: Sequence[str]) -> list[str]:
    """Return at most three names that are close to a wrong one, without those that are much farther than the best."""
    alike = [other for other in known if other.casefold() == name.casefold()]
    close = alike or difflib.get_close_matches(name, known, n=3)
    missed = [1.0 - difflib.SequenceMatcher(None, other, name).ratio() for other in close]
    return [other for other, miss in zip(close, missed, strict=True) if miss <= MUCH_FARTHER * missed[0]]


def keyword_names(function: Callable[..., Any]) -> frozenset[str] | None:
    """Return the keyword arguments of a function; ``None`` where it takes any."""
    stated = signature(function).parameters.values()
    if any(each.kind is Parameter.VAR_KEYWORD for each in stated):
        return None
    named = (Parameter.POSITIONAL_OR_KEYWORD, Parameter.KEYWORD_ONLY)
    return frozenset(each.name for each in stated if each.kind in named) - {"self"}


def _arguments_by_name(constructor: Callable[..., Any]) -> tuple[list[str], list[str]] | None:
    """Return the arguments that a constructor takes by position, the object first, and the others; ``None`` where it
    takes any by position."""
    stated = list(signature(constructor).parameters.values())
    if any(each.kind is Parameter.VAR_POSITIONAL for each in stated):
        return None
    by_name = [each.name for each in stated if each.kind is Parameter.KEYWORD_ONLY]
    return [each.name for each in stated if each.name not in by_name], by_name


def require_keywords(
    given: Iterable[str], known: frozenset[str] | None, function: str, meant: Meant | None = None
) -> None:
    """Raise Python's `TypeError` for a keyword argument that is not known, with the name that may be meant."""
    unknown = None if known is None else next((name for name in given if name not in known), None)
    if known is not None and unknown is not None:
        names = sorted(known)
        near = suggestion(unknown, names) if meant is None else meant(unknown, names, given)
        raise TypeError(f"{function} has no argument {unknown!r}.{near or _there_are(names)}")


def _there_are(names: Sequence[str]) -> str:
    return f" There are: {', '.join(names)}." if names else " It takes none by name."


def keywords_suggested(function: Callable[Given, Returned], meant: Meant | None = None) -> Callable[Given, Returned]:
    """Return a function, or constructor, that suggests names for keyword arguments which it does not have."""
    known, of_class = keyword_names(function), function.__name__ == "__init__"
    arguments = _arguments_by_name(function) if of_class else None

    @wraps(function)
    def called(*args: Given.args, **kwargs: Given.kwargs) -> Returned:
        if known is not None and not known.issuperset(kwargs):
            require_keywords(kwargs, known, type(args[0]).__name__ if of_class else function.__name__, meant)
        if arguments is not None and arguments[1] and len(args) > len(arguments[0]):
            first = f"{', '.join(arguments[0][1:])} by position and the others" if arguments[0][1:] else "its arguments"
            raise TypeError(f"{type(args[0]).__name__} takes {first} by name: {', '.join(arguments[1])}.")
        return function(*args, **kwargs)

    return called


def fields_suggested(cls: Class, meant: Meant | None = None) -> Class:
    """Return a class whose constructor suggests names for keyword arguments which it does not have."""
    cls.__init__ = keywords_suggested(cls.__init__, meant)  # type: ignore[misc]
    return cls
