"""Names of signals: uniqueness, and selection by name."""

from __future__ import annotations

import itertools
import unicodedata
from collections import Counter
from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np

from obsynth.errors import SpecError, counted
from obsynth.numerics.arrays import FloatArray
from obsynth.numerics.ranks import NAMED_SHARE
from obsynth.numerics.suggestions import suggestion

#: At most this many signals are named in a failed condition.
MOST_NAMES = 4

#: Control characters, halves of pairs, separators of lines and paragraphs: no table can hold them in a name.
_UNWRITABLE = frozenset({"Cc", "Cs", "Zl", "Zp"})

#: Argument with names -> what it names, as a message counts it: one, many.
_COUNTED = {
    "state_names": ("state", "states"),
    "input_names": ("known input", "known inputs"),
    "output_names": ("output", "outputs"),
    "fault_names": ("fault (column of Bf and Df)", "faults (columns of Bf and Df)"),
    "disturbance_names": ("unknown input (column of Bd and Dd)", "unknown inputs (columns of Bd and Dd)"),
    "noise_names": ("noise input (column of Bw and Dw)", "noise inputs (columns of Bw and Dw)"),
}


def leading_names(shares: FloatArray, names: Sequence[str], *, most: int | None = None) -> tuple[str, ...]:
    """Return the names whose share ``(n,)`` is not small beside the largest: the ``most`` largest, in given order."""
    sizes = np.abs(shares)
    largest = float(np.max(sizes, initial=0.0))
    order = np.argsort(-sizes, kind="stable")[:most]
    return tuple(names[i] for i in sorted(order) if sizes[i] > 0.0 and sizes[i] >= NAMED_SHARE * largest)


def checked_names(names: Sequence[str] | None, count: int, *, prefix: str, what: str) -> tuple[str, ...]:
    """Return ``count`` unique names; ``prefix1, prefix2, ...`` when none are given."""
    if names is None:
        return tuple(f"{prefix}{i + 1}" for i in range(count))
    names = plain_names(names)
    listed = tuple(names) if isinstance(names, Iterable) else (names,)
    if isinstance(names, str) or not all(isinstance(name, str) and name.strip() for name in listed):
        remedy = f" Give [{names!r}]." if isinstance(names, str) and names.strip() and count == 1 else ""
        raise SpecError(f"{what} must be a list of non-empty texts.{remedy}", path=what)
    if len(listed) != count:
        there = counted(count, *_COUNTED[what]) if what in _COUNTED else f"{count}"
        raise SpecError(f"{what} has {counted(len(listed), 'name')}, but the plant has {there}.", path=what)
    unwritable = [
        name
        for name in listed
        if not name.isprintable() and any(unicodedata.category(sign) in _UNWRITABLE for sign in name)
    ]
    if unwritable:
        raise SpecError(
            f"{what} has the name {unwritable[0]!r}: use no line ends and no control characters.", path=what
        )
    repeated = sorted(name for name, times in Counter(listed).items() if times > 1)
    if repeated:
        raise SpecError(f"{what} repeats {', '.join(map(repr, repeated))}: names must be unique.", path=what)
    return listed


def unused_names(names: Sequence[str], used: Iterable[str]) -> tuple[str, ...]:
    """Return names of signals that are added to a plant: with a number behind each that is used already."""
    taken, free = set(used), list[str]()
    for name in names:
        new = next(
            one for one in itertools.chain([name], (f"{name} ({i})" for i in itertools.count(2))) if one not in taken
        )
        taken.add(new)
        free.append(new)
    return tuple(free)


def plain_names(names: Any) -> Any:
    """Return names in an array, or in the index of a pandas frame, as a list; anything else as it is."""
    return names.tolist() if hasattr(names, "tolist") else names


def index_of(name: str, names: Sequence[str], *, what: str) -> int:
    """Return the position of ``name``; the error suggests the closest names, or lists what there is."""
    if isinstance(name, str) and name in names:
        return list(names).index(name)
    near = suggestion(name, names) or _there_are(names)
    raise SpecError(f"{what} has no signal named {name!r}.{near}", path=what)


def listed(texts: Sequence[str], *, most: int = 6) -> str:
    """Return some names or numbers as one text, and how many more there are."""
    more = f" and {len(texts) - most} more" if len(texts) > most else ""
    return f"{', '.join(texts[:most])}{more}"


def _there_are(names: Sequence[str]) -> str:
    return f" There are: {listed(names)}." if names else " There are none."


def require_known(names: Iterable[Any], known: Iterable[str], *, what: str, kind: str) -> None:
    """Raise one `SpecError` that names every text which is no signal of ``kind``, each with what may be meant."""
    present = sorted(known)
    problems = [
        f"{what} names {name!r}, which is no {kind} of the plant.{suggestion(str(name), present)}"
        for name in names
        if name not in present
    ]
    if len(problems) == 1 and problems[0].endswith("plant."):
        problems[0] += _there_are(present)
    raise_problems(problems, f"{what} names {len(problems)} that are no {kind} of the plant:", what)


def require_picked(picked: Iterable[str], names: Sequence[str], *, what: str) -> None:
    """Raise one `SpecError` for all names that are not there, each with what may be meant."""
    wrong = [f"{what} has no signal named {name!r}.{suggestion(name, names)}" for name in picked if name not in names]
    if len(wrong) == 1 and not wrong[0].endswith("?"):
        wrong[0] += _there_are(names)
    raise_problems(wrong, f"{what} picks {len(wrong)} signals that do not exist:", what)


def raise_problems(problems: Sequence[str], heading: str, path: str | None) -> None:
    """Raise one `SpecError` with all problems, if there are any."""
    if len(problems) == 1:
        raise SpecError(problems[0], path=path)
    if problems:
        raise SpecError(heading, path=path, problems=problems)


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
    # Not rows of an identity, which takes 800 MB with 10,000 names.
    rows = np.zeros((len(picked), len(names)))
    rows[np.arange(len(picked)), [list(names).index(name) for name in picked]] = 1.0
    return rows
