"""Checks of a plant's fields, which collect all problems into one error."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np

from obsynth.errors import SpecError
from obsynth.numerics.arguments import is_finite_number, is_number, require_mapping, shape_problem, shown
from obsynth.numerics.arrays import FloatArray, as_matrix, require_no_overflow
from obsynth.numerics.quantities import in_seconds
from obsynth.numerics.sparse import as_sparse_matrix, is_sparse
from obsynth.plants.signal_names import is_name_list, raise_problems, require_known, rows_picking

#: Matrices that tell how many signals of a kind there are.
COUNTED_BY = {"y": ("C",), "u": ("B", "D"), "f": ("Bf", "Df"), "d": ("Bd", "Dd"), "w": ("Bw", "Dw")}


class Problems:
    """Collects every problem of one plant, to raise them together."""

    def __init__(self) -> None:
        self.messages: list[str] = []
        self._shapes = 0
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
            # Before the others: names of signals that are missing follow from matrices of the wrong size.
            self.messages.insert(self._shapes, problem)
            self.first_path = name if self._shapes == 0 else self.first_path
            self._shapes += 1

    def raise_if_any(self) -> None:
        """Raise one `SpecError` with all problems noted so far."""
        raise_problems(self.messages, "The plant is not well formed:", self.first_path)

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


def signal_counts(matrices_by_name: Mapping[str, FloatArray | None], nx: int) -> dict[str, int]:
    """Return the number of signals of each kind of a plant with ``nx`` states, from the first matrix that has some.

    Where only the transpose of this matrix fits the states, its rows count: the transposed matrix alone is refused."""

    def columns(*names: str) -> int:
        shapes = [
            (name, matrix.shape)
            for name in names
            if (matrix := matrices_by_name.get(name)) is not None and 0 not in matrix.shape
        ]
        if not shapes:
            return 0
        name, (rows, width) = shapes[0]
        is_transposed = name.startswith("B") and len(shapes) == 1 and rows != nx == width
        return int(rows if is_transposed else width)

    outputs = matrices_by_name.get("C")
    counts = {signal: columns(*names) for signal, names in COUNTED_BY.items()}
    if outputs is None:
        return counts | {"y": 0}
    rows, width = outputs.shape
    return counts | {"y": width if width != nx == rows else rows}


def checked_dt(dt: Any) -> float:
    """Return a sampling time in seconds, 0 for continuous time."""
    dt = in_seconds(dt, "dt")
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


def checked_units(units: Mapping[str, str] | None, known: set[str]) -> dict[str, str]:
    """Return units whose signals all exist."""
    require_mapping(units, "units")
    require_known(units or {}, known, what="units", kind="signal")
    for name, value in (units or {}).items():
        if not isinstance(value, str):
            raise SpecError(f"The unit of {name!r} must be a text.", path="units")
    return dict(units or {})


def _values(values: Mapping[str, float] | None, known: set[str], what: str, kind: str) -> dict[str, float]:
    """Return numbers of signals, which all exist; a scale is not zero."""
    require_mapping(values, what)
    require_known(values or {}, known, what=what, kind=kind)
    checked = {name: float(as_matrix(value, f"{what}[{name!r}]")[0, 0]) for name, value in (values or {}).items()}
    for name, value in checked.items():
        require_no_overflow(value, f"{what}[{name!r}]", what)
        if what == "scales" and value == 0.0:
            raise SpecError(f"The scale of {name!r} is 0: give a factor that is not zero.", path="scales")
    return checked
