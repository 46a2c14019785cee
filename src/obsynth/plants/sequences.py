"""Matrices that change with k (callables, stacks, expressions), and checks of what a time-varying plant is made of."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from obsynth.errors import SpecError
from obsynth.numerics.arguments import real_number, require_mapping, whole_number
from obsynth.numerics.arrays import MAXIMUM_ENTRIES, FloatArray, as_given, as_matrix, read_only
from obsynth.numerics.expressions import NAMED_NUMBERS, Expression, parse_expression
from obsynth.plants.checking import Problems, any_matrix, checked_dt

#: The name of the time index in expressions.
INDEX_NAME = "k"

#: Numbers of a computed sequence that are kept: two megabytes.
MOST_KEPT_ENTRIES = 2**18

#: Matrix, signal of its rows ("e" counts the equations), signal of its columns, first k at which it is needed.
LAYOUT = (
    ("E", "e", "x", 1),
    ("A", "e", "x", 0),
    ("C", "y", "x", 1),
    ("B", "e", "u", 0),
    ("Phi", "e", "p", 0),
    ("Psi", "y", "p", 0),
    ("D", "y", "u", 1),
)

#: E, C and D are needed at k = 1 ... N for N steps: as stacks they have N + 1 entries, of which the first is not used.
_FIRST_INDEX = {name: first for name, *_, first in LAYOUT}


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
        remembered = self.computed.get(k)
        if remembered is not None:
            return remembered
        values = {**(self.constants or {}), INDEX_NAME: np.float64(k)}
        matrix = np.array(self.still)
        for i, j in self.moving:
            matrix[i, j] = (self.entries or ())[i][j](values)
        checked = as_matrix(matrix, f"{self.name}({k})")
        # Design, checks and runs ask for the same k many times; what does not fit is computed again.
        if len(self.computed) * matrix.size < MOST_KEPT_ENTRIES:
            self.computed[k] = checked
        return checked

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
    b, d, phi, psi = (found.get(name) for name in ("B", "D", "Phi", "Psi"))
    inputs = next((m.shape[1] for m in (b, d) if m is not None and 0 not in m.shape), 0)
    columns = next((m.shape[1] for m in (phi, psi) if m is not None and 0 not in m.shape), 0)
    sizes = {"e": a.shape[0], "x": a.shape[1], "y": c.shape[0], "u": inputs, "p": columns}
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
