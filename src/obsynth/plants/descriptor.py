"""Linear descriptor systems with named signals, time-invariant and time-varying, and the exact numbers behind them.

What a plant is made of is checked, and every problem is collected before raising; signals are picked by name.

From what a caller gives for a linear plant to its fields: labelled frames, names for rows, noise of sensors. Matrices
that were rounded when they were made keep their exact numbers, and the plant that they come from.

Matrices of a time-varying plant change with k: callables, stacks or expressions.
"""

from __future__ import annotations

import difflib
import unicodedata
from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from fractions import Fraction
from functools import cached_property, partial
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import ArrayLike

from obsynth.errors import SpecError
from obsynth.numerics.arguments import (
    MAXIMUM_ENTRIES,
    FloatArray,
    arguments_checked,
    as_given,
    as_matrix,
    is_finite_number,
    is_number,
    read_only,
    real_number,
    require_kind,
    require_mapping,
    require_no_overflow,
    shape_problem,
    shown,
    whole_number,
)
from obsynth.numerics.expressions import NAMED_NUMBERS, Expression, parse_expression
from obsynth.numerics.sparse import as_sparse_matrix, dense, is_sparse, same_matrix
from obsynth.plants.constants import UNCERTAIN_MATRICES, Uncertainty, uncertainty_of

#: Control characters, halves of pairs, separators of lines and paragraphs: no table can hold them in a name.
_UNWRITABLE = frozenset({"Cc", "Cs", "Zl", "Zp"})


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


#: Matrix, signal of its rows, signal of its columns.
MATRIX_LAYOUT = (
    ("E", "x", "x"),
    ("A", "x", "x"),
    ("C", "y", "x"),
    ("B", "x", "u"),
    ("D", "y", "u"),
    ("Bf", "x", "f"),
    ("Df", "y", "f"),
    ("Bd", "x", "d"),
    ("Dd", "y", "d"),
    ("Bw", "x", "w"),
    ("Dw", "y", "w"),
)
#: Matrices that tell how many signals of a kind there are.
COUNTED_BY = {"y": ("C",), "u": ("B", "D"), "f": ("Bf", "Df"), "d": ("Bd", "Dd"), "w": ("Bw", "Dw")}


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


#: The matrices on which existence depends.
DECISIVE = ("E", "A", "Bf", "Bd", "C", "Df", "Dd")
#: Rational matrices by name.
RationalRows: TypeAlias = Mapping[str, tuple[tuple[Fraction, ...], ...]]


@dataclass(frozen=True, eq=False)
class ExactNumbers:
    """Rational matrices (`DECISIVE`) of a plant, or of the continuous plant that was sampled."""

    matrices: RationalRows
    sample_time: Fraction | None = None
    own: bool = True  # in the states of the plant; otherwise in other coordinates of them
    computed: bool = False  # some were computed in floating point
    sizes: Mapping[str, FloatArray] | None = None  # of the terms of entries, to which rounding is relative
    states: int = 0  # of the plant as written, 0 where unknown
    # Before what elimination of computed data may have left by rounding was set to zero.
    uncleaned: RationalRows | None = None

    @cached_property
    def content(self) -> tuple[object, ...]:
        """What tells these numbers from others: their hash stands for the rational ones."""
        return self.sample_time, self.computed, hash(tuple(self.matrices[name] for name in DECISIVE))

    def before_cleaning(self) -> ExactNumbers:
        """Return the numbers before any were taken for rounding."""
        return self if self.uncleaned is None else replace(self, matrices=self.uncleaned, uncleaned=None)

    def require_of(self, plant: DescriptorSystem) -> None:
        """Raise `SpecError` where these are not the numbers behind the matrices of a plant."""
        for name in DECISIVE:
            rows, matrix = self.matrices[name], getattr(plant, name)
            if (len(rows), *{len(row) for row in rows}) not in (matrix.shape, matrix.shape[:1]):
                raise SpecError(f"exact has another size of {name} than the plant: leave it out.", path="exact")
            rounded = [value.numerator / value.denominator for row in rows for value in row]
            if self.own and self.sample_time is None and rounded != np.ravel(matrix).tolist():
                raise SpecError(f"exact does not round to {name} of the plant: leave it out.", path="exact")

    def as_dict(self) -> dict[str, Any]:
        """Return the numbers as data, rational ones as text."""
        return {
            "matrices": _texts(self.matrices),
            "sample_time": None if self.sample_time is None else _text(self.sample_time),
            "own": self.own,
            "computed": self.computed,
            "sizes": None if self.sizes is None else dict(self.sizes),
            "states": self.states,
            "uncleaned": None if self.uncleaned is None else _texts(self.uncleaned),
        }

    @classmethod
    def from_dict(cls, data: Mapping[str, Any]) -> ExactNumbers:
        """Return the numbers that `as_dict` described."""
        time, sizes, uncleaned = data["sample_time"], data["sizes"], data["uncleaned"]
        return cls(
            _fractions(data["matrices"]),
            None if time is None else _fraction(time),
            bool(data["own"]),
            bool(data["computed"]),
            None if sizes is None else {name: np.asarray(sizes[name], dtype=np.float64) for name in sizes},
            int(data["states"]),
            None if uncleaned is None else _fractions(uncleaned),
        )


def exact_numbers(data: Any) -> ExactNumbers | None:
    """Return what `ExactNumbers.as_dict` described; `None` and exact numbers stay as they are."""
    if data is None or isinstance(data, ExactNumbers):
        return data
    require_kind(data, Mapping, "exact", "what the exact numbers of a plant are as data (as_dict)")
    missing = [field.name for field in fields(ExactNumbers) if field.name not in data]
    if missing:
        raise SpecError(f"exact has no {missing[0]!r}: give what as_dict() returns, or leave it out.", path="exact")
    return ExactNumbers.from_dict(data)


def _texts(matrices: RationalRows) -> dict[str, list[list[str]]]:
    return {name: [[_text(value) for value in row] for row in rows] for name, rows in matrices.items()}


def _fractions(matrices: Mapping[str, Sequence[Sequence[str]]]) -> RationalRows:
    return {name: tuple(tuple(map(_fraction, row)) for row in matrices[name]) for name in DECISIVE}


def _text(value: Fraction) -> str:
    from flint import fmpq

    # Python refuses to write out integers of thousands of digits.
    return str(fmpq(value.numerator, value.denominator))


def _fraction(text: str) -> Fraction:
    from flint import fmpq

    found = fmpq(text)
    return Fraction(int(found.p), int(found.q))


def note_source(source: DescriptorSystem, new: DescriptorSystem, *, sample_time: float | None = None) -> None:
    """Note on a plant that elimination or sampling has just made which plant, as written, it comes from."""
    if new is source:
        return
    written, earlier = getattr(source, "_made_from", (source, None))
    if earlier is None or sample_time is None:
        object.__setattr__(new, "_made_from", (written, earlier if sample_time is None else sample_time))


def carry_source(old: DescriptorSystem, new: DescriptorSystem) -> None:
    """Note on a changed plant which plant, as written, the old one comes from, if nothing has changed that matters."""
    made = getattr(old, "_made_from", None)
    unchanged = old.dt == new.dt and all(
        same_matrix(getattr(old, name), getattr(new, name)) for name in (*DECISIVE, "B", "D")
    )
    if made is not None and unchanged:
        written, time = made
        if not (
            same_matrix(getattr(old, "Bw", None), getattr(new, "Bw", None))
            and same_matrix(getattr(old, "Dw", None), getattr(new, "Dw", None))
        ):
            # The noise was stated anew since: that of the plant as written says nothing about it.
            written = written.replace(Bw=None, Dw=None, noise_names=None)
        object.__setattr__(new, "_made_from", (written, time))


#: Names of the signals of each kind.
_FIELDS = {
    "x": "state_names",
    "u": "input_names",
    "y": "output_names",
    "f": "fault_names",
    "d": "disturbance_names",
    "w": "noise_names",
}


def _without_frames(
    matrices: Mapping[str, Any], names: Mapping[str, Sequence[str] | None]
) -> tuple[dict[str, Any], dict[str, Sequence[str] | None]]:
    """Return matrices and names ``{"state_names": ...}``, labels of frames in one order; numbers are no names."""
    plain, labels = dict(matrices), dict(names)
    # A names the states, C the outputs; the first frame with a label decides on an order.
    for name, rows_of, columns_of in sorted(MATRIX_LAYOUT, key=lambda row: (row[0] != "A", row[0] != "C")):
        frame: Any = plain.get(name)
        if not (hasattr(frame, "columns") and hasattr(frame, "index") and hasattr(frame, "to_numpy")):
            continue
        rows = _order(frame.index, _FIELDS[rows_of], labels, f"the rows of {name}")
        columns = _order(frame.columns, _FIELDS[columns_of], labels, f"the columns of {name}")
        plain[name] = frame.to_numpy()[rows][:, columns] if len(frame) else frame.to_numpy()
    return plain, labels


def _order(labels: Any, kind: str, known: dict[str, Sequence[str] | None], what: str) -> list[int]:
    """Return the positions of labels in the order of the names known so far, which they define where there are none."""
    found = list(labels)
    if not found or not all(isinstance(label, str) for label in found):
        return list(range(len(found)))
    repeated = sorted({label for label in found if found.count(label) > 1})
    if repeated:
        raise SpecError(f"{what[0].upper()}{what[1:]} repeat the label {repeated[0]!r}.", path=kind)
    if known.get(kind) is None:
        known[kind] = found
    wanted = list(known[kind] or ())
    missing, foreign = [name for name in wanted if name not in found], [name for name in found if name not in wanted]
    if missing or foreign:
        texts = [f"lack {', '.join(map(repr, missing))}"] if missing else []
        texts += [f"have {', '.join(map(repr, foreign))}"] if foreign else []
        raise SpecError(
            f"{what[0].upper()}{what[1:]} {' and '.join(texts)}: the {kind} are {', '.join(wanted)}.", path=kind
        )
    return [found.index(name) for name in wanted]


# Where a matrix picked by names names the signal as well.
_NAMED_BY = {"output_names": "C", "fault_names": "Bf", "disturbance_names": "Bd"}


def plant_fields(
    asked: Mapping[str, Any],
    names: Mapping[str, Sequence[str] | None],
    *,
    dt: Any,
    operating_point: Any,
    scales: Any,
    units: Any,
    sensor_noise: Any,
) -> dict[str, Any]:
    """Return every field of a `DescriptorSystem`; raise one `SpecError` with all problems."""
    problems = Problems()
    matrices, labels = _without_frames(asked, names)
    a = problems.collect(lambda: any_matrix(matrices.pop("A"), "A"))
    problems.raise_if_any()
    nx = a.shape[0]
    if nx == 0 or a.shape[1] != nx:
        raise SpecError(f"A is {nx} by {a.shape[1]}, but it must be square (nx by nx, nx >= 1).", path="A")
    states = problems.collect(lambda: checked_names(labels["state_names"], nx, prefix="x", what="state_names"))
    problems.raise_if_any()
    given: dict[str, FloatArray | None] = {"A": a, "E": _identity_like(a) if matrices["E"] is None else None}
    for name, value in matrices.items():
        if value is not None and not (name in SENSOR_PICKS and is_name_list(value)):
            given[name] = problems.collect(partial(matrix_or_picks, value, name, states))
    more = _appended(matrices, labels, given, sensor_noise, problems)
    sizes = {"x": nx, **signal_counts(given)}
    # What depends on a matrix that could not be read is not judged: its own message is enough.
    broken = {name for name, value in matrices.items() if value is not None and given.get(name) is None}
    unknown = {
        signal
        for signal, telling in COUNTED_BY.items()
        if broken.intersection(telling) and all(given.get(name) is None for name in telling)
    }
    values: dict[str, Any] = {
        name: problems.shaped(given.get(name), name, (sizes[rows], sizes[columns]))
        for name, rows, columns in MATRIX_LAYOUT
        if not unknown.intersection((rows, columns))
    }
    values |= {"dt": problems.collect(lambda: checked_dt(dt)), "state_names": states}
    for signal, key in _FIELDS.items():
        if signal in unknown or signal == "x":
            continue
        own = plain_names(labels[key])
        no_names = own is None or (isinstance(own, (list, tuple)) and not own)
        stated = picked_names(matrices.get(_NAMED_BY.get(key, ""))) if no_names else own
        extra = more.get(key, ())
        if (
            extra
            and is_name_list(["-"] if stated is None else stated)
            and (stated is None or len(stated) == sizes[signal] - len(extra))
        ):
            first = checked_names(stated, sizes[signal] - len(extra), prefix=signal, what=key)
            stated = (*first, *extra)
        values[key] = problems.collect(partial(checked_names, stated, sizes[signal], prefix=signal, what=key))
    if any(values.get(field) is None for field in _FIELDS.values()):
        # What refers to signals by name cannot be judged.
        problems.raise_if_any()
    known, measured = {name for field in _FIELDS.values() for name in values[field]}, set(values["input_names"])
    measured |= set(values["output_names"])
    values |= checked_labels(problems, known, measured, operating_point=operating_point, scales=scales, units=units)
    problems.raise_if_any()
    return values


def _identity_like(a: Any) -> Any:
    """Return the identity of the size of A, sparse where A is."""
    if not is_sparse(a):
        return np.eye(a.shape[0])
    from scipy.sparse import eye_array

    return as_sparse_matrix(eye_array(a.shape[0], format="csr"), "E")


def _appended(
    matrices: Mapping[str, Any],
    labels: Mapping[str, Sequence[str] | None],
    given: dict[str, FloatArray | None],
    sensor_noise: Any,
    problems: Problems,
) -> dict[str, tuple[str, ...]]:
    """Append what is given by the names of sensors to ``given``; return the names of these signals by field."""
    if sensor_noise is None and not any(is_name_list(matrices[name]) for name in SENSOR_PICKS):
        return {}
    if matrices["C"] is not None and given.get("C") is None:
        return {}
    names = labels["output_names"]
    stated = picked_names(matrices["C"]) if names is None else names
    outputs = problems.collect(
        lambda: checked_names(stated, signal_counts(given)["y"], prefix="y", what="output_names")
    )
    problems.raise_if_any()
    picked = problems.collect(lambda: _with_sensor_picks(matrices, given, outputs)) or {}
    noises = problems.collect(lambda: _noise_of_sensors(sensor_noise, given, outputs)) or ()
    return {"fault_names": picked.get("Df", ()), "disturbance_names": picked.get("Dd", ()), "noise_names": noises}


#: Matrices of outputs that may be given by the names of sensors, each with that of the dynamics beside it.
SENSOR_PICKS = {"Df": "Bf", "Dd": "Bd"}


def _size(given: Mapping[str, Any]) -> int:
    return int(given["A"].shape[0])


def _with_sensor_picks(
    asked: Mapping[str, Any], given: dict[str, FloatArray | None], outputs: Sequence[str]
) -> dict[str, tuple[str, ...]]:
    """Append a column to Df, Bf (Dd, Bd) in ``given`` for each sensor that Df (Dd) names; return these."""
    found = {}
    for name, beside in SENSOR_PICKS.items():
        picked = asked[name]
        if not is_name_list(picked):
            continue
        columns = rows_picking(picked, outputs, what=name).T
        own = given.get(beside)
        dynamics = np.zeros((_size(given), 0)) if own is None else dense(own)
        given[beside] = np.hstack([dynamics, np.zeros((len(dynamics), len(picked)))])
        given[name] = np.hstack([np.zeros((len(outputs), dynamics.shape[1])), columns])
        found[name] = tuple(picked)
    return found


def _noise_of_sensors(
    sensor_noise: Any, given: dict[str, FloatArray | None], outputs: Sequence[str]
) -> tuple[str, ...]:
    """Append a column to Bw, Dw in ``given`` for each sensor with a standard deviation; return their names."""
    if sensor_noise is None:
        return ()
    require_kind(sensor_noise, Mapping, "sensor_noise", "a standard deviation by output, such as {'speed': 0.01}")
    require_picked(sensor_noise, outputs, what="sensor_noise")
    columns = np.zeros((len(outputs), len(sensor_noise)))
    for column, (name, value) in enumerate(sensor_noise.items()):
        deviation = float(any_matrix(value, f"sensor_noise[{name!r}]")[0, 0])
        if deviation <= 0.0:
            raise SpecError(
                f"sensor_noise[{name!r}] is {deviation:g}: give a standard deviation above 0.", path="sensor_noise"
            )
        columns[list(outputs).index(name), column] = deviation
    others = [matrix for name in ("Bw", "Dw") if (matrix := given.get(name)) is not None and 0 not in matrix.shape]
    nw, nx = others[0].shape[1] if others else 0, _size(given)
    for name, rows, more in (("Bw", nx, np.zeros((nx, len(sensor_noise)))), ("Dw", len(outputs), columns)):
        matrix = given.get(name)
        matrix = np.zeros((rows, nw)) if matrix is None or 0 in matrix.shape else dense(matrix)
        if matrix.shape != (rows, nw):
            # Its own message is enough.
            return ()
        given[name] = np.hstack([matrix, more])
    return tuple(f"noise {name}" for name in sensor_noise)


MatrixOrNames = ArrayLike | Sequence[str] | None
SIGNAL_NAMES = ("state_names", "input_names", "output_names", "fault_names", "disturbance_names", "noise_names")
ALL_MATRICES = tuple(name for name, *_ in MATRIX_LAYOUT)


@dataclass(frozen=True, eq=False, init=False)
class DescriptorSystem:
    r"""A linear descriptor system with faults, unknown inputs and noise.

    .. math::
        E x^+ = A x + B u + B_d d + B_f f + B_w w, \qquad
        y = C x + D u + D_d d + D_f f + D_w w

    where :math:`x^+` is :math:`\dot x` for ``dt == 0`` and :math:`x(k+1)` for ``dt > 0``.

    Parameters
    ----------
    E : array_like, sparse matrix or None
        ``(nx, nx)``, may be singular; ``None`` means the identity.
    A : array_like or sparse matrix
        ``(nx, nx)``.  Sparse matrices of scipy stay sparse, here and wherever else they are given; methods get the
        plant without its algebraic states, which is dense (see `eliminate_algebraic_states` and `dense`).  Any matrix
        may be a labelled ``pandas.DataFrame``: its labels are the names, and rows and columns are put in one order.
    B : array_like, optional
        Known inputs ``(nx, nu)``.
    C : array_like or list of str, optional
        Outputs ``(ny, nx)``, or the names of the states that are measured.
    D : array_like, optional
        Feedthrough of the known inputs ``(ny, nu)``.
    Bf, Df : array_like, optional
        Faults ``(nx, nf)`` and ``(ny, nf)``.  ``Bf`` may be a list of state names: the fault is then
        added to the equation of the same number as that state.  ``Df`` may be a list of output names: each adds a
        fault of that sensor, after those of ``Bf``.
    Bd, Dd : array_like, optional
        Unknown inputs (disturbances) ``(nx, nd)`` and ``(ny, nd)``; by name as faults.
    Bw, Dw : array_like, optional
        Noise ``(nx, nw)`` and ``(ny, nw)``: ``w`` is white with unit covariance, so the columns hold
        standard deviations (per sample for ``dt > 0``, and always per sample in ``Dw``).
    dt : float, optional
        Seconds between samples; 0 for continuous time.
    state_names, input_names, output_names, fault_names, disturbance_names, noise_names : list of str, optional
        Signal names; ``x1, x2, ...`` and so on by default.
    operating_point : mapping, optional
        Value of named signals at the point where a linear model was taken, in the signal's unit.
    scales : mapping, optional
        Factor of named inputs and outputs: what a log holds, times the factor, is in the signal's unit.
    units : mapping, optional
        Unit of named signals, as text.

    sensor_noise : mapping, optional
        Standard deviation of the noise of named outputs, per sample: adds a column to ``Dw`` for each.
    uncertainty : Uncertainty, optional
        Constants with tolerances in the matrices, see `obsynth.uncertain_system`.
    exact : ExactNumbers, optional
        Rational numbers that the matrices were rounded from, on which existence is decided; elimination and sampling
        give them, and `as_dict` has them as data.

    Raises
    ------
    SpecError
        A matrix has the wrong shape, holds something that is no finite number, or a name is unknown
        or repeated; all problems are listed at once.

    Examples
    --------
    >>> plant = DescriptorSystem([[1, 0], [0, 0]], [[0.5, 1], [1, 1]], C=[[1, 0], [0, 1]], Bf=[[1], [0]], dt=1.0)
    >>> plant.nx, plant.ny, plant.nf
    (2, 2, 1)
    """

    E: FloatArray
    A: FloatArray
    B: FloatArray
    C: FloatArray
    D: FloatArray
    Bf: FloatArray
    Df: FloatArray
    Bd: FloatArray
    Dd: FloatArray
    Bw: FloatArray
    Dw: FloatArray
    dt: float
    state_names: tuple[str, ...]
    input_names: tuple[str, ...]
    output_names: tuple[str, ...]
    fault_names: tuple[str, ...]
    disturbance_names: tuple[str, ...]
    noise_names: tuple[str, ...]
    operating_point: Mapping[str, float]
    scales: Mapping[str, float]
    units: Mapping[str, str]
    uncertainty: Uncertainty | None
    exact: ExactNumbers | None

    def __init__(
        self,
        E: ArrayLike | None = None,
        A: ArrayLike | None = None,
        B: ArrayLike | None = None,
        C: MatrixOrNames = None,
        *,
        D: ArrayLike | None = None,
        Bf: MatrixOrNames = None,
        Df: MatrixOrNames = None,
        Bd: MatrixOrNames = None,
        Dd: MatrixOrNames = None,
        Bw: ArrayLike | None = None,
        Dw: ArrayLike | None = None,
        dt: float = 0.0,
        state_names: Sequence[str] | None = None,
        input_names: Sequence[str] | None = None,
        output_names: Sequence[str] | None = None,
        fault_names: Sequence[str] | None = None,
        disturbance_names: Sequence[str] | None = None,
        noise_names: Sequence[str] | None = None,
        operating_point: Mapping[str, float] | None = None,
        scales: Mapping[str, float] | None = None,
        units: Mapping[str, str] | None = None,
        sensor_noise: Mapping[str, float] | None = None,
        uncertainty: Uncertainty | Mapping[str, Any] | None = None,
        exact: ExactNumbers | Mapping[str, Any] | None = None,
    ) -> None:
        if A is None:
            raise SpecError("A is missing: give the matrix (nx, nx) of the dynamics.", path="A")
        asked = {"E": E, "A": A, "B": B, "C": C, "D": D, "Bf": Bf, "Df": Df, "Bd": Bd, "Dd": Dd, "Bw": Bw, "Dw": Dw}
        names = {
            "state_names": state_names,
            "input_names": input_names,
            "output_names": output_names,
            "fault_names": fault_names,
            "disturbance_names": disturbance_names,
            "noise_names": noise_names,
        }
        values = plant_fields(
            asked, names, dt=dt, operating_point=operating_point, scales=scales, units=units, sensor_noise=sensor_noise
        )
        values["uncertainty"] = uncertainty_of(uncertainty)
        values["exact"] = exact_numbers(exact)
        for key, value in values.items():
            object.__setattr__(self, key, read_only(value) if isinstance(value, np.ndarray) else value)
        if self.exact is not None and self.exact is not exact:
            self.exact.require_of(self)

    @property
    def nx(self) -> int:
        """Number of states."""
        return int(self.A.shape[0])

    @property
    def nu(self) -> int:
        """Number of known inputs."""
        return int(self.B.shape[1])

    @property
    def ny(self) -> int:
        """Number of outputs."""
        return int(self.C.shape[0])

    @property
    def nf(self) -> int:
        """Number of faults."""
        return int(self.Bf.shape[1])

    @property
    def nd(self) -> int:
        """Number of unknown inputs."""
        return int(self.Bd.shape[1])

    @property
    def nw(self) -> int:
        """Number of noise inputs."""
        return int(self.Bw.shape[1])

    @property
    def is_sparse(self) -> bool:
        """Whether any matrix of the plant is a sparse one."""
        return any(is_sparse(getattr(self, name)) for name in ALL_MATRICES)

    def dense(self) -> DescriptorSystem:
        """Return the same plant with arrays instead of sparse matrices; a plant without any is returned as it is."""
        if not self.is_sparse:
            return self
        return self.replace(**{name: dense(getattr(self, name)) for name in ALL_MATRICES})

    @property
    def sensor_faults(self) -> tuple[str, ...]:
        """Faults that act on outputs only: their size has no operating point, whatever they are called."""
        acts = abs(self.Bf).sum(axis=0)
        return tuple(name for name, size in zip(self.fault_names, acts, strict=True) if size == 0.0)

    @property
    def is_discrete(self) -> bool:
        """Whether the plant is sampled (``dt > 0``)."""
        return self.dt > 0.0

    def as_dict(self) -> dict[str, Any]:
        """Return every field, as the constructor takes it; `uncertainty` and `exact` only where there are such."""
        found = {field.name: getattr(self, field.name) for field in fields(self)}
        records = {name: found.pop(name) for name in ("uncertainty", "exact")}
        return found | {name: record.as_dict() for name, record in records.items() if record is not None}

    def replace(self, **changes: Any) -> DescriptorSystem:
        """Return a plant with some fields changed, checked again as a whole.

        Tolerances and exact numbers are those of the matrices as they were: with a change of one of these they are
        not carried over, and whatever would use tolerances refuses (``uncertainty=None`` says that the model is exact).
        Units and other labels of signals that are gone, such as those of ``disturbance_names=None``, go with them.

        Parameters
        ----------
        **changes
            Any argument of the constructor.
        """
        kept = {field.name: getattr(self, field.name) for field in fields(self) if field.name != "exact"}
        gone = {name for field in SIGNAL_NAMES if field in changes for name in getattr(self, field)}
        gone -= {name for field in SIGNAL_NAMES for name in (changes[field] or () if field in changes else kept[field])}
        for label in ("operating_point", "scales", "units"):
            kept[label] = {name: value for name, value in kept[label].items() if name not in gone}
        new = DescriptorSystem(**{**kept, **changes})
        if self.uncertainty is not None and "uncertainty" not in changes:
            moved = [
                name
                for name in UNCERTAIN_MATRICES
                if name in changes and not same_matrix(getattr(self, name), getattr(new, name))
            ]
            if moved or self.dt != new.dt:
                what = f"{', '.join(moved or ['dt'])} {'were' if len(moved) > 1 else 'was'} changed"
                object.__setattr__(new, "uncertainty", self.uncertainty.left_behind(what))
        carry_source(self, new)
        same = self.dt == new.dt and all(same_matrix(getattr(self, name), getattr(new, name)) for name in DECISIVE)
        if same and "exact" not in changes:
            object.__setattr__(new, "exact", self.exact)
        return new

    def __repr__(self) -> str:
        time = f"dt={self.dt:g} s" if self.is_discrete else "continuous"
        return (
            f"DescriptorSystem(nx={self.nx}, nu={self.nu}, ny={self.ny}, nf={self.nf}, nd={self.nd}, "
            f"nw={self.nw}, {time})"
        )


#: A matrix, a stack of matrices, a function of k, or rows whose entries may be texts.
MatrixLike: TypeAlias = ArrayLike | Callable[[int], ArrayLike] | Sequence[Sequence[float | str]] | None


#: The name of the time index in expressions.
INDEX_NAME = "k"
#: Numbers of a computed sequence that are kept: two megabytes.
MOST_KEPT_ENTRIES = 2**18


@dataclass(frozen=True, eq=False)
class MatrixSequence:
    """A matrix for each k = 0 ... length - 1, or for every k where ``length`` is None."""

    name: str
    shape: tuple[int, int]
    length: int | None
    values: FloatArray | None = None  # one matrix, or (length, rows, columns)
    function: Callable[[int], ArrayLike] | None = None  # of k
    entries: tuple[tuple[Expression, ...], ...] | None = None  # with ``constants``
    constants: Mapping[str, float] | None = None
    still: FloatArray | None = None  # entries that do not depend on k
    moving: tuple[tuple[int, int], ...] = ()  # places of the others
    computed: dict[int, FloatArray] = field(default_factory=dict, repr=False)  # from entries, by k

    @classmethod
    def of(
        cls, value: Any, name: str, *, first: int = 0, constants: Mapping[str, float] | None = None
    ) -> MatrixSequence:
        """Return the sequence that ``value`` stands for."""
        if isinstance(value, MatrixSequence):
            return value
        if callable(value):
            shape = _named(lambda: as_matrix(value(first), name), name, first).shape
            return cls(name, (int(shape[0]), int(shape[1])), None, function=value)
        if _has_text(value):
            entries = _parsed(value, name, constants or {})
            known = dict(constants or {})
            still, moving = _split(entries, known)
            shape = (len(entries), len(entries[0]))
            return cls(name, shape, None, entries=entries, constants=known, still=still, moving=moving)
        array = _array(value, name)
        if array.ndim != 3:
            matrix = any_matrix(value, name)
            return cls(name, (matrix.shape[0], matrix.shape[1]), None, values=matrix)
        bad = np.argwhere(~np.isfinite(array[first:]))
        if bad.size:
            k = int(bad[0][0]) + first
            as_matrix(array[k], f"{name}({k})")
        if len(array) <= first:
            raise SpecError(f"{name} is a stack of {len(array)} matrices: at least {first + 1} are needed.", path=name)
        return cls(name, (array.shape[1], array.shape[2]), len(array), values=read_only(array))

    @property
    def is_constant(self) -> bool:
        """Whether it is the same matrix for every k: numbers, or expressions none of which contains k."""
        if self.entries is not None:
            return not self.moving
        return self.values is not None and self.values.ndim == 2

    @property
    def is_data(self) -> bool:
        """Whether it can be saved: everything but a callable."""
        return self.function is None

    def at(self, k: int) -> FloatArray:
        """Return the matrix at ``k``."""
        if self.values is not None:
            if self.values.ndim == 2:
                return self.values
            if not 0 <= k < len(self.values):
                raise SpecError(
                    f"{self.name}({k}) is asked for, but the stack ends at {len(self.values) - 1}.",
                    path=f"{self.name}({k})",
                )
            return np.asarray(self.values[k])
        matrix = _named(partial(self._computed, k), self.name, k)
        if matrix.shape != self.shape:
            raise SpecError(
                f"{self.name}({k}) is {matrix.shape[0]} by {matrix.shape[1]}, but {self.name} was {self.shape[0]} by "
                f"{self.shape[1]} before: shapes must not change with k.",
                path=f"{self.name}({k})",
            )
        return matrix

    def _computed(self, k: int) -> FloatArray:
        if self.function is not None:
            return as_matrix(self.function(k), f"{self.name}({k})")
        kept = self.computed.get(k)
        if kept is not None:
            return kept
        values = {**(self.constants or {}), INDEX_NAME: np.float64(k)}
        matrix = np.array(self.still)
        for i, j in self.moving:
            matrix[i, j] = (self.entries or ())[i][j](values)
        found = as_matrix(matrix, f"{self.name}({k})")
        # Design, checks and runs ask for the same k many times; what does not fit is computed again.
        if len(self.computed) * matrix.size < MOST_KEPT_ENTRIES:
            self.computed[k] = found
        return found

    def as_data(self) -> Any:
        """Return an array or rows of texts."""
        if self.function is not None:
            raise SpecError(
                f"{self.name} is a Python function, and only data can be saved: give a stack of matrices, "
                f"or expressions in {INDEX_NAME}.",
                path=self.name,
            )
        return self.values if self.entries is None else [[entry.text for entry in row] for row in self.entries]


def _named(make: Callable[[], FloatArray], name: str, k: int) -> FloatArray:
    try:
        return make()
    except SpecError as error:
        raise SpecError(f"At k = {k}: {error}", path=f"{name}({k})") from error
    except Exception as error:
        # A function of the user may raise anything: say for which k it did.
        raise SpecError(
            f"The function for {name} fails at k = {k}: {type(error).__name__}: {error}.", path=f"{name}({k})"
        ) from error


def _has_text(value: Any) -> bool:
    return isinstance(value, str) or (isinstance(value, (list, tuple)) and any(map(_has_text, value)))


def _array(value: Any, name: str) -> FloatArray:
    array = as_given(value, name, f"{name} has matrices or rows of different sizes: shapes must not change with k.")
    if array.ndim != 3:
        return np.zeros((0, 0))
    if array.dtype.kind not in "fiu":
        raise SpecError(f"{name} holds entries that are no real numbers.", path=name)
    return array.astype(np.float64)


def _parsed(value: Any, name: str, constants: Mapping[str, float]) -> tuple[tuple[Expression, ...], ...]:
    rows = [[value]] if isinstance(value, str) else value
    listed = [row if isinstance(row, (list, tuple)) else [row] for row in rows]
    if len({len(row) for row in listed}) != 1:
        raise SpecError(f"{name} has rows of different lengths: give a full matrix.", path=name)
    parsed = []
    for i, row in enumerate(listed, 1):
        expressions = []
        for j, entry in enumerate(row, 1):
            where = f"{name}, row {i}, column {j}"
            if isinstance(entry, bool) or not isinstance(entry, (str, int, float)):
                raise SpecError(f"{where}: {entry!r} is neither a number nor an expression.", path=name)
            try:
                expression = parse_expression(entry if isinstance(entry, str) else repr(float(entry)))
            except SpecError as error:
                raise SpecError(f"{where}: {error}", path=name) from error
            unknown = sorted(expression.names - {INDEX_NAME} - set(constants))
            if unknown:
                known = ", ".join(sorted([INDEX_NAME, *constants, *NAMED_NUMBERS]))
                raise SpecError(f"{where}: {unknown[0]!r} is unknown; the known names are: {known}.", path=name)
            expressions.append(expression)
        parsed.append(tuple(expressions))
    return tuple(parsed)


def _split(
    entries: tuple[tuple[Expression, ...], ...], constants: Mapping[str, float]
) -> tuple[FloatArray, tuple[tuple[int, int], ...]]:
    """Evaluate once what does not depend on k; return it with the places of what does."""
    still, moving = np.zeros((len(entries), len(entries[0]))), []
    for i, row in enumerate(entries):
        for j, entry in enumerate(row):
            if INDEX_NAME in entry.names:
                moving.append((i, j))
            else:
                still[i, j] = entry(constants)
    return still, tuple(moving)


#: Matrix, signal of its rows ("e" counts the equations), signal of its columns, first k at which it is needed.
LAYOUT = (
    ("E", "e", "x", 1),
    ("A", "e", "x", 0),
    ("C", "y", "x", 1),
    ("B", "e", "u", 0),
    ("Phi", "e", "p", 0),
    ("Psi", "y", "p", 0),
)
#: E and C are needed at k = 1 ... N for N steps: as stacks they have N + 1 entries, of which the first is not used.
_FIRST_INDEX = {name: first for name, *_, first in LAYOUT}


def positive_dt(dt: Any) -> float:
    """Return a sampling time in seconds that is not zero."""
    checked = checked_dt(dt)
    if checked == 0.0:
        raise SpecError(
            "dt is 0: a time-varying plant is discrete in time, give the seconds between samples.", path="dt"
        )
    return checked


def checked_constants(constants: Mapping[str, float] | None) -> dict[str, float]:
    """Return names and finite values that expressions may use."""
    checked: dict[str, float] = {}
    require_mapping(constants, "constants")
    for name, value in (constants or {}).items():
        if not (isinstance(name, str) and name.isidentifier()) or name == "k" or name in NAMED_NUMBERS:
            raise SpecError(f"constants names {name!r}: use letters, digits and '_', not k or pi.", path="constants")
        checked[name] = real_number(value, f"The constant {name!r}", "a finite number", path=f"constants.{name}")
    return checked


def completed(found: Mapping[str, MatrixSequence | None], problems: Problems) -> dict[str, MatrixSequence]:
    """Return all matrices, zeros or the identity where none is given; note wrong shapes."""
    a, c = found["A"], found["C"]
    if a is None or c is None:
        return {}
    b, phi, psi = found.get("B"), found.get("Phi"), found.get("Psi")
    columns = next((m.shape[1] for m in (phi, psi) if m is not None and 0 not in m.shape), 0)
    sizes = {"e": a.shape[0], "x": a.shape[1], "y": c.shape[0], "u": 0 if b is None else b.shape[1], "p": columns}
    if 0 in (sizes["e"], sizes["x"]):
        problems.note(f"A is {a.shape[0]} by {a.shape[1]}, but at least 1 by 1 is needed.", "A")
    completed = {}
    for name, rows, cols, _ in LAYOUT:
        shape, matrix = (sizes[rows], sizes[cols]), found.get(name)
        if name == "E" and matrix is None:
            matrix = MatrixSequence.of(np.eye(sizes["x"]), "E")
        if matrix is None or (0 in matrix.shape and 0 in shape):
            matrix = MatrixSequence(name, shape, None, values=read_only(np.zeros(shape)))
        problems.require_shape(matrix.shape, name, shape)
        completed[name] = matrix
    return completed


def checked_horizon(horizon: int | None, values: Mapping[str, MatrixSequence]) -> int | None:
    """Return the number of steps that all stacks are good for, or ``None`` without any limit."""
    if horizon is not None:
        whole_number(horizon, "horizon", "the number of steps")
    lengths = {name: m.length - _FIRST_INDEX[name] for name, m in values.items() if m.length is not None}
    if not lengths:
        return None if horizon is None else int(horizon)
    shortest = min(lengths, key=lambda name: lengths[name])
    if horizon is None and len(set(lengths.values())) > 1:
        listed = ", ".join(f"{name} for {steps}" for name, steps in lengths.items())
        raise SpecError(
            f"The stacks are good for different numbers of steps: {listed}. For N steps E and C need N + 1 matrices, "
            "A, B, Phi and Psi need N; or give the horizon.",
            path="horizon",
        )
    if horizon is not None and horizon > lengths[shortest]:
        raise SpecError(
            f"horizon is {horizon}, but the stack {shortest} is good for {lengths[shortest]} steps only.",
            path="horizon",
        )
    return lengths[shortest] if horizon is None else int(horizon)


def check_every_k(values: Mapping[str, MatrixSequence], horizon: int | None) -> None:
    """Evaluate callables and expressions along the horizon, so that a bad k is found before anything runs."""
    if horizon is None:
        return
    moving = {name: matrix for name, matrix in values.items() if matrix.values is None}
    if horizon * sum(matrix.shape[0] * matrix.shape[1] for matrix in moving.values()) > MAXIMUM_ENTRIES:
        raise SpecError(
            f"a horizon of {horizon} steps is too long for {', '.join(moving)}: more than {MAXIMUM_ENTRIES:,} entries "
            "are to be evaluated before anything runs. Leave the horizon out: a step is then evaluated when it comes.",
            path="horizon",
        )
    for name, matrix in moving.items():
        for k in range(_FIRST_INDEX[name], horizon + _FIRST_INDEX[name]):
            matrix.at(k)


@dataclass(frozen=True, eq=False, init=False)
class TimeVaryingDescriptorSystem:
    r"""A time-varying descriptor system with constant or slowly changing parameters.

    .. math::
        E_{k+1} x(k+1) = A_k x(k) + B_k u(k) + \Phi_k \theta + \mu(k), \qquad
        y(k+1) = C_{k+1} x(k+1) + \Psi_k \theta + \nu(k)

    Each matrix is a constant, a stack (a three-dimensional array, one matrix per k), a callable from k to a matrix
    (``E(k)`` is :math:`E_k`), or rows of numbers and expressions in ``k`` such as ``"k / (k + 1)"``.

    Parameters
    ----------
    E : MatrixLike or None
        ``(ne, nx)``, may be singular or rectangular; ``None`` means the identity.  Needed at k = 1 ... N.
    A : MatrixLike
        ``(ne, nx)``.  Needed at k = 0 ... N - 1, as B, Phi and Psi.
    B : MatrixLike, optional
        Known inputs ``(ne, nu)``.
    C : MatrixLike
        Outputs ``(ny, nx)``.  Needed at k = 1 ... N.
    Phi, Psi : MatrixLike, optional
        Parameters in the equations ``(ne, nq)`` and in the outputs ``(ny, nq)``.
    dt : float
        Seconds between samples, positive.
    horizon : int, optional
        Number of steps N the model is good for: k = 0 ... N.  Taken from the stacks where there are some; without
        stacks ``None`` means for ever.
    constants : mapping, optional
        Names and values that expressions may use besides ``k``.
    state_names, input_names, output_names, parameter_names : list of str, optional
        Signal names; ``x1, x2, ...``, ``u1``, ``y1`` and ``theta1`` by default.
    operating_point : mapping, optional
        Value of named signals at the point of which the signals are deviations, in the signal's unit.
    scales : mapping, optional
        Factor of named inputs and outputs: what a log holds, times the factor, is in the signal's unit.
    units : mapping, optional
        Unit of named signals, as text.

    Raises
    ------
    SpecError
        A matrix has the wrong shape or one that changes with k, holds something that is no finite number (k is
        named), stacks have different lengths, or names are wrong; as many problems as can be found at once.

    Examples
    --------
    >>> plant = TimeVaryingDescriptorSystem(
    ...     E=[[0, 0], [-1, "(k - 1) / k"]], A=[[1, "-(k + 1) / (k + 0.5)"], [0, "1 / (k + 1)"]],
    ...     C=[[1, 0], [0, 1]], Phi=[[1], [1]], dt=1.0, horizon=100,
    ... )
    >>> plant.nx, plant.ny, plant.nq, plant.E.at(2).tolist()
    (2, 2, 1, [[0.0, 0.0], [-1.0, 0.5]])
    """

    E: MatrixSequence
    A: MatrixSequence
    B: MatrixSequence
    C: MatrixSequence
    Phi: MatrixSequence
    Psi: MatrixSequence
    dt: float
    horizon: int | None
    constants: Mapping[str, float]
    state_names: tuple[str, ...]
    input_names: tuple[str, ...]
    output_names: tuple[str, ...]
    parameter_names: tuple[str, ...]
    operating_point: Mapping[str, float]
    scales: Mapping[str, float]
    units: Mapping[str, str]

    def __init__(
        self,
        E: MatrixLike,
        A: MatrixLike,
        B: MatrixLike = None,
        C: MatrixLike = None,
        *,
        Phi: MatrixLike = None,
        Psi: MatrixLike = None,
        dt: float,
        horizon: int | None = None,
        constants: Mapping[str, float] | None = None,
        state_names: Sequence[str] | None = None,
        input_names: Sequence[str] | None = None,
        output_names: Sequence[str] | None = None,
        parameter_names: Sequence[str] | None = None,
        operating_point: Mapping[str, float] | None = None,
        scales: Mapping[str, float] | None = None,
        units: Mapping[str, str] | None = None,
    ) -> None:
        problems = Problems()
        known = problems.collect(lambda: checked_constants(constants))
        problems.raise_if_any()
        asked = {"E": E, "A": A, "B": B, "C": C, "Phi": Phi, "Psi": Psi}
        found: dict[str, MatrixSequence | None] = {}
        for name, _, _, first in LAYOUT:
            if asked[name] is not None:
                make = partial(MatrixSequence.of, asked[name], name, first=first, constants=known)
                found[name] = problems.collect(make)
            elif name in ("A", "C"):
                problems.note(f"{name} is missing: a plant needs A and C.", name)
        problems.raise_if_any()
        values = completed(found, problems)
        problems.raise_if_any()
        sizes = {
            "x": values["A"].shape[1],
            "u": values["B"].shape[1],
            "y": values["C"].shape[0],
            "theta": values["Phi"].shape[1],
        }
        fields: dict[str, Any] = dict(values)
        fields |= {"dt": problems.collect(lambda: positive_dt(dt)), "constants": known}
        fields["horizon"] = problems.collect(lambda: checked_horizon(horizon, values))
        named = {
            "state_names": (state_names, "x"),
            "input_names": (input_names, "u"),
            "output_names": (output_names, "y"),
            "parameter_names": (parameter_names, "theta"),
        }
        for item, (names, signal) in named.items():
            fields[item] = problems.collect(partial(checked_names, names, sizes[signal], prefix=signal, what=item))
        problems.raise_if_any()
        signals = {name for field in named for name in fields[field]}
        measured = {*fields["input_names"], *fields["output_names"]}
        fields |= checked_labels(
            problems, signals, measured, operating_point=operating_point, scales=scales, units=units
        )
        problems.collect(lambda: check_every_k(values, fields["horizon"]))
        problems.raise_if_any()
        for item, value in fields.items():
            object.__setattr__(self, item, value)

    @classmethod
    @arguments_checked
    def from_descriptor(cls, plant: DescriptorSystem) -> TimeVaryingDescriptorSystem:
        """Return a time-invariant plant as a time-varying one: its faults become parameters, its noise is left out.

        Parameters
        ----------
        plant : DescriptorSystem
            Discrete time, without feedthrough of inputs (D) and without disturbances.

        Raises
        ------
        SpecError
            It is continuous in time, has feedthrough, or has disturbances.
        """
        if not plant.is_discrete:
            raise SpecError("The plant is continuous in time: discretise it first (transform.sample_time).", path="dt")
        if np.any(plant.D):
            raise SpecError("The plant has feedthrough: pass y - D u as its output, with D = 0.", path="D")
        if plant.nd:
            raise SpecError(
                "The plant has unknown disturbances, which this method does not cover: remove Bd and Dd, or make them "
                "faults.",
                path="Bd",
            )
        signals = {*plant.state_names, *plant.input_names, *plant.output_names, *plant.fault_names}
        return cls(
            plant.E,
            plant.A,
            plant.B,
            plant.C,
            Phi=plant.Bf,
            Psi=plant.Df,
            dt=plant.dt,
            state_names=plant.state_names,
            input_names=plant.input_names,
            output_names=plant.output_names,
            parameter_names=plant.fault_names,
            operating_point={name: value for name, value in plant.operating_point.items() if name in signals},
            scales=plant.scales,
            units={name: unit for name, unit in plant.units.items() if name in signals},
        )

    @property
    def nx(self) -> int:
        """Number of states."""
        return self.A.shape[1]

    @property
    def ne(self) -> int:
        """Number of equations."""
        return self.A.shape[0]

    @property
    def nu(self) -> int:
        """Number of known inputs."""
        return self.B.shape[1]

    @property
    def ny(self) -> int:
        """Number of outputs."""
        return self.C.shape[0]

    @property
    def nq(self) -> int:
        """Number of parameters."""
        return self.Phi.shape[1]

    @property
    def matrices(self) -> dict[str, MatrixSequence]:
        """The matrices by name."""
        return {name: getattr(self, name) for name, *_ in LAYOUT}

    @property
    def is_time_invariant(self) -> bool:
        """Whether every matrix is the same for every k, as far as what is given tells: no stack, no function, no k."""
        return all(matrix.is_constant for matrix in self.matrices.values())

    def as_dict(self) -> dict[str, Any]:
        """Return every field as data, as the constructor takes it.

        Raises
        ------
        SpecError
            A matrix is a callable.
        """
        return {**{name: matrix.as_data() for name, matrix in self.matrices.items()}, **self._labels()}

    def replace(self, **changes: Any) -> TimeVaryingDescriptorSystem:
        """Return a plant with some fields changed, checked again as a whole.

        Parameters
        ----------
        **changes
            Any argument of the constructor.
        """
        return TimeVaryingDescriptorSystem(**{**self.matrices, **self._labels(), **changes})

    def _labels(self) -> dict[str, Any]:
        names = ("state_names", "input_names", "output_names", "parameter_names")
        labels = {name: list(getattr(self, name)) for name in names}
        return {
            **labels,
            "dt": self.dt,
            "horizon": self.horizon,
            "constants": self.constants,
            "operating_point": self.operating_point,
            "scales": self.scales,
            "units": self.units,
        }

    def __repr__(self) -> str:
        steps = "no horizon" if self.horizon is None else f"{self.horizon} steps"
        return (
            f"TimeVaryingDescriptorSystem(ne={self.ne}, nx={self.nx}, nu={self.nu}, ny={self.ny}, nq={self.nq}, "
            f"dt={self.dt:g} s, {steps})"
        )
