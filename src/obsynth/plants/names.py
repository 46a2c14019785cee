"""Names of signals: checking them, making default ones, and picking signals by name."""

from __future__ import annotations

import difflib
from collections import Counter
from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np

from obsynth.errors import SpecError
from obsynth.numerics.arrays import FloatArray


def checked_names(names: Sequence[str] | None, count: int, *, prefix: str, what: str) -> tuple[str, ...]:
    """Return ``count`` unique names; ``prefix1, prefix2, ...`` when none are given."""
    if names is None:
        return tuple(f"{prefix}{i + 1}" for i in range(count))
    given = tuple(names) if isinstance(names, Iterable) else (names,)
    if isinstance(names, str) or not all(isinstance(name, str) and name.strip() for name in given):
        raise SpecError(f"{what} must be a list of non-empty texts.", path=what)
    if len(given) != count:
        raise SpecError(f"{what} has {len(given)} names, but there are {count} such signals.", path=what)
    repeated = sorted(name for name, times in Counter(given).items() if times > 1)
    if repeated:
        raise SpecError(f"{what} repeats {', '.join(map(repr, repeated))}: names must be unique.", path=what)
    return given


def index_of(name: str, names: Sequence[str], *, what: str) -> int:
    """Return the position of ``name``; the error suggests the closest names."""
    if name in names:
        return list(names).index(name)
    close = difflib.get_close_matches(name, list(names), n=3)
    hint = f" Did you mean {' or '.join(map(repr, close))}?" if close else ""
    raise SpecError(f"{what} has no signal named {name!r}.{hint}", path=what)


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
    selection = np.zeros((len(picked), len(names)))
    for row, name in enumerate(picked):
        selection[row, index_of(name, names, what=what)] = 1.0
    return selection
