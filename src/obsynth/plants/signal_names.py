"""Checking what a plant is made of, collecting every problem before raising; names of signals, and picking by name."""

from __future__ import annotations

import difflib
import unicodedata
from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any

import numpy as np

from obsynth.errors import SpecError
from obsynth.numerics.arguments import is_finite_number, is_number, require_mapping, shape_problem, shown
from obsynth.numerics.arrays import FloatArray, as_matrix, require_no_overflow
from obsynth.numerics.ranks import NAMED_SHARE
from obsynth.numerics.sparse import as_sparse_matrix, is_sparse

#: At most this many signals are named in a failed condition.
MOST_NAMES = 4

#: Control characters, halves of pairs, separators of lines and paragraphs: no table can hold them in a name.
_UNWRITABLE = frozenset({"Cc", "Cs", "Zl", "Zp"})

#: Matrices that tell how many signals of a kind there are.
COUNTED_BY = {"y": ("C",), "u": ("B", "D"), "f": ("Bf", "Df"), "d": ("Bd", "Dd"), "w": ("Bw", "Dw")}


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
    given = tuple(names) if isinstance(names, Iterable) else (names,)
    if isinstance(names, str) or not all(isinstance(name, str) and name.strip() for name in given):
        raise SpecError(f"{what} must be a list of non-empty texts.", path=what)
    if len(given) != count:
        raise SpecError(f"{what} has {len(given)} name(s), but there are {count} such signal(s).", path=what)
    unwritable = [
        name
        for name in given
        if not name.isprintable() and any(unicodedata.category(sign) in _UNWRITABLE for sign in name)
    ]
    if unwritable:
        raise SpecError(
            f"{what} has the name {unwritable[0]!r}: use no line ends and no control characters.", path=what
        )
    repeated = sorted(name for name, times in Counter(given).items() if times > 1)
    if repeated:
        raise SpecError(f"{what} repeats {', '.join(map(repr, repeated))}: names must be unique.", path=what)
    return given


def plain_names(names: Any) -> Any:
    """Return names in an array, or in the index of a pandas frame, as a list; anything else as it is."""
    return names.tolist() if hasattr(names, "tolist") else names


def index_of(name: str, names: Sequence[str], *, what: str) -> int:
    """Return the position of ``name``; the error suggests the closest names, or lists what there is."""
    if isinstance(name, str) and name in names:
        return list(names).index(name)
    near = suggestion(name, names) or (f" There are: {listed(names)}." if names else " There are none.")
    raise SpecError(f"{what} has no signal named {name!r}.{near}", path=what)


def listed(texts: Sequence[str], *, most: int = 6) -> str:
    """Return some names or numbers as one text, and how many more there are."""
    more = f" and {len(texts) - most} more" if len(texts) > most else ""
    return f"{', '.join(texts[:most])}{more}"


def suggestion(name: str, names: Iterable[str]) -> str:
    """Return a question with the names closest to a wrong one, beginning with a space; empty where none is close."""
    close = difflib.get_close_matches(str(name), list(names), n=3)
    return f" Did you mean {' or '.join(map(repr, close))}?" if close else ""


def require_known(given: Iterable[Any], known: Iterable[str], *, what: str, kind: str) -> None:
    """Raise one `SpecError` that names every text which is no signal of ``kind``, each with what may be meant."""
    listed = sorted(known)
    told = [
        f"{what} names {name!r}, which is no {kind} of the plant.{suggestion(str(name), listed)}"
        for name in given
        if name not in listed
    ]
    _raise(told, f"{what} names {len(told)} that are no {kind} of the plant:", what)


def require_picked(picked: Iterable[str], names: Sequence[str], *, what: str) -> None:
    """Raise one `SpecError` for all names that are not there, each with what may be meant."""
    wrong = [f"{what} has no signal named {name!r}.{suggestion(name, names)}" for name in picked if name not in names]
    _raise(wrong, f"{what} picks {len(wrong)} signals that do not exist:", what)


def _raise(problems: Sequence[str], heading: str, path: str | None) -> None:
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


class Problems:
    """Collects every problem of one plant, to raise them together."""

    def __init__(self) -> None:
        self.messages: list[str] = []
        self.first_path: str | None = None

    def collect(self, make: Callable[[], Any]) -> Any:
        """Return what ``make`` returns; note its `SpecError` and return ``None`` otherwise."""
        try:
            return make()
        except SpecError as error:
            for problem in error.problems or (str(error),):
                self.note(problem, error.path)
            return None

    def shaped(self, value: FloatArray | None, name: str, shape: tuple[int, int]) -> FloatArray:
        """Return ``value``, or zeros of ``shape`` where it is missing or empty; note a wrong shape."""
        if value is None or (0 in value.shape and 0 in shape):
            return np.zeros(shape)
        self.require_shape(value.shape, name, shape)
        return value

    def require_shape(self, found: tuple[int, ...], name: str, shape: tuple[int, int]) -> None:
        """Note a wrong shape."""
        problem = shape_problem(found, shape, name)
        if problem:
            self.note(problem, name)

    def raise_if_any(self) -> None:
        """Raise one `SpecError` with all problems noted so far."""
        _raise(self.messages, "The plant is not well formed:", self.first_path)

    def note(self, message: str, path: str | None) -> None:
        """Note one problem."""
        self.messages.append(message)
        self.first_path = self.first_path or path


def any_matrix(value: Any, name: str) -> Any:
    """Return a checked read-only matrix: sparse where a sparse one was given, else an array."""
    matrix = as_sparse_matrix(value, name) if is_sparse(value) else as_matrix(value, name)
    require_no_overflow(matrix.data if is_sparse(matrix) else matrix, name, name)
    return matrix


def matrix_or_picks(value: Any, name: str, states: Sequence[str]) -> Any:
    """Return a matrix, or the selection that a list of state names stands for (rows of C, columns of inputs)."""
    if not is_name_list(value):
        return any_matrix(value, name)
    rows = rows_picking(value, states, what=name)
    return rows if name == "C" else rows.T


def picked_names(value: Any) -> tuple[str, ...] | None:
    """Return the names when signals were picked by name, else ``None``."""
    return tuple(value) if is_name_list(value) else None


def signal_counts(given: Mapping[str, FloatArray | None]) -> dict[str, int]:
    """Return the number of signals of each kind, from the first matrix that tells."""

    def columns(*names: str) -> int:
        found = (given.get(name) for name in names)
        return next((m.shape[1] for m in found if m is not None and 0 not in m.shape), 0)

    outputs = given.get("C")
    counts = {signal: columns(*names) for signal, names in COUNTED_BY.items()}
    return counts | {"y": 0 if outputs is None else outputs.shape[0]}


def checked_dt(dt: Any) -> float:
    """Return a sampling time in seconds, 0 for continuous time."""
    if not is_number(dt):
        raise SpecError(f"dt is {dt!r}: give the sampling time in seconds, or 0 for continuous time.", path="dt")
    if not is_finite_number(dt) or dt < 0:
        raise SpecError(f"dt is {shown(dt)}: give a sampling time >= 0 in seconds (0 for continuous time).", path="dt")
    require_no_overflow(dt, "dt", "dt")
    return float(dt)


def checked_labels(
    problems: Problems, known: set[str], measured: set[str], *, operating_point: Any, scales: Any, units: Any
) -> dict[str, Any]:
    """Return operating point, factors of measured signals and units as fields of a plant; note what is wrong."""
    return {
        "operating_point": problems.collect(lambda: _values(operating_point, known, "operating_point", "signal")),
        "scales": problems.collect(lambda: _values(scales, measured, "scales", "input or output")),
        "units": problems.collect(lambda: checked_units(units, known)),
    }


def _values(given: Mapping[str, float] | None, known: set[str], what: str, kind: str) -> dict[str, float]:
    """Return numbers of signals, which all exist; a scale is not zero."""
    require_mapping(given, what)
    require_known(given or {}, known, what=what, kind=kind)
    checked = {name: float(as_matrix(value, f"{what}[{name!r}]")[0, 0]) for name, value in (given or {}).items()}
    for name, value in checked.items():
        require_no_overflow(value, f"{what}[{name!r}]", what)
        if what == "scales" and value == 0.0:
            raise SpecError(f"The scale of {name!r} is 0: give a factor that is not zero.", path="scales")
    return checked


def checked_units(units: Mapping[str, str] | None, known: set[str]) -> dict[str, str]:
    """Return units whose signals all exist."""
    require_mapping(units, "units")
    require_known(units or {}, known, what="units", kind="signal")
    for name, value in (units or {}).items():
        if not isinstance(value, str):
            raise SpecError(f"The unit of {name!r} must be a text.", path="units")
    return dict(units or {})
