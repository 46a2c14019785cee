"""Names of signals: checking them, making default ones, and picking signals by name."""

from __future__ import annotations

import difflib
import unicodedata
from collections import Counter
from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np

from obsynth.errors import SpecError
from obsynth.numerics.arrays import FloatArray

#: Control characters, halves of pairs, separators of lines and paragraphs: no table can hold them in a name.
_UNWRITABLE = frozenset({"Cc", "Cs", "Zl", "Zp"})


def checked_names(names: Sequence[str] | None, count: int, *, prefix: str, what: str) -> tuple[str, ...]:
    """Return ``count`` unique names; ``prefix1, prefix2, ...`` when none are given."""
    if names is None:
        return tuple(f"{prefix}{i + 1}" for i in range(count))
    given = tuple(names) if isinstance(names, Iterable) else (names,)
    if isinstance(names, str) or not all(isinstance(name, str) and name.strip() for name in given):
        raise SpecError(f"{what} must be a list of non-empty texts.", path=what)
    if len(given) != count:
        raise SpecError(f"{what} has {len(given)} names, but there are {count} such signals.", path=what)
    unwritable = [
        name
        for name in given
        if not name.isprintable() and any(unicodedata.category(sign) in _UNWRITABLE for sign in name)
    ]
    if unwritable:
        raise SpecError(f"{what} has the name {unwritable[0]!r}: use no line ends and no control characters.",
                        path=what)  # fmt: skip
    repeated = sorted(name for name, times in Counter(given).items() if times > 1)
    if repeated:
        raise SpecError(f"{what} repeats {', '.join(map(repr, repeated))}: names must be unique.", path=what)
    return given


def index_of(name: str, names: Sequence[str], *, what: str) -> int:
    """Return the position of ``name``; the error suggests the closest names."""
    if name in names:
        return list(names).index(name)
    raise SpecError(f"{what} has no signal named {name!r}.{suggestion(name, names)}", path=what)


def suggestion(name: str, names: Iterable[str]) -> str:
    """Return a question with the names closest to a wrong one, beginning with a space; empty where none is close."""
    close = difflib.get_close_matches(name, list(names), n=3)
    return f" Did you mean {' or '.join(map(repr, close))}?" if close else ""


def require_known(given: Iterable[Any], known: Iterable[str], *, what: str, kind: str) -> None:
    """Raise one `SpecError` that names every text which is no signal of ``kind``, each with what may be meant."""
    listed = sorted(known)
    wrong = [name for name in given if name not in listed]
    if not wrong:
        return
    told = [f"{what} names {name!r}, which is no {kind} of the plant.{suggestion(str(name), listed)}" for name in wrong]
    if len(wrong) == 1:
        raise SpecError(told[0], path=what)
    raise SpecError(f"{what} names {len(wrong)} that are no {kind} of the plant:", path=what, problems=told)


def require_picked(picked: Iterable[str], names: Sequence[str], *, what: str) -> None:
    """Raise one `SpecError` for all names that are not there, each with what may be meant."""
    wrong = [f"{what} has no signal named {name!r}.{suggestion(name, names)}" for name in picked if name not in names]
    if len(wrong) == 1:
        raise SpecError(wrong[0], path=what)
    if wrong:
        raise SpecError(f"{what} picks {len(wrong)} signals that do not exist:", path=what, problems=wrong)


def is_name_list(value: Any) -> bool:
    """Whether ``value`` is a non-empty list of texts: a pick by name, not a matrix."""
    return (
        isinstance(value, Sequence)
        and not isinstance(value, str)
        and len(value) > 0
        and all(isinstance(item, str) for item in value)
    )


def rows_picking(picked: Sequence[str], names: Sequence[str], *, what: str) -> FloatArray:
    """Return the selection matrix ``(len(picked), len(names))`` with a one for each picked name."""
    require_picked(picked, names, what=what)
    selection = np.zeros((len(picked), len(names)))
    for row, name in enumerate(picked):
        selection[row, index_of(name, names, what=what)] = 1.0
    return selection
