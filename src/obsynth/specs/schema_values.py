"""Schema of values in a spec: numbers, times, names and matrices, written out or in a file.

This module imports pydantic, so it is imported only when a spec is read.
"""

from __future__ import annotations

import math
from typing import Annotated, Any, get_args

from pydantic import (
    BaseModel,
    BeforeValidator,
    ConfigDict,
    Discriminator,
    Field,
    Tag,
    ValidationError,
    ValidatorFunctionWrapHandler,
    WrapValidator,
)
from pydantic_core import InitErrorDetails, PydanticCustomError
from pydantic_core.core_schema import ErrorType

from obsynth.errors import counted
from obsynth.numerics.arguments import NonNegative, Positive, is_number, is_whole
from obsynth.numerics.measurement_units import MICRO_SIGNS
from obsynth.specs.quantities import QUANTITY

# Tags of unions appear in the locations of pydantic's errors; the bracket marks them for removal.
_ROWS, FILE_TAG, PICKED, LIST_TAG, _STACK_TAG, _NUMBER_TAG, ONE_TAG = (
    "<rows>",
    "<file>",
    "<pick>",
    "<list>",
    "<stack>",
    "<number>",
    "<one>",
)

Text = Annotated[str, Field(min_length=1)]

Range = Annotated[list[float], Field(min_length=2, max_length=2)]

Variance = Annotated[float, Field(ge=0.0), Tag(_NUMBER_TAG)]

#: By what a number in each unit is multiplied, then divided, for seconds: 1.1 ms are 0.0011 s to the last digit.
_SECONDS = {
    "us": (1.0, 1e6),
    **{f"{sign}s": (1.0, 1e6) for sign in MICRO_SIGNS},
    "ms": (1.0, 1e3),
    "s": (1.0, 1.0),
    "min": (60.0, 1.0),
    "h": (3600.0, 1.0),
}


def in_seconds(value: Any) -> Any:
    """Return a text such as ``10 ms`` in seconds, anything else as it is."""
    match = QUANTITY.fullmatch(value) if isinstance(value, str) else None
    if match is None:
        return value
    number, unit = match.groups()
    if unit not in _SECONDS:
        raise PydanticCustomError("time", "must be a number of seconds, or a time in us, ms, s, min or h")
    times, over = _SECONDS[unit]
    return float(number) * times / over


#: Times in seconds, or as texts with their unit.
PositiveTime = Annotated[Positive, BeforeValidator(in_seconds)]

Time = Annotated[NonNegative, BeforeValidator(in_seconds)]


def _has_decimal_commas(rows: list[Any]) -> bool:
    """Whether the longer rows have twice the entries of the shorter ones, whole numbers all: ``0,9`` is two of them.
    One entry beside two is more likely one that was forgotten."""
    lengths = sorted({len(row) for row in rows if isinstance(row, list)})
    if len(lengths) != 2 or lengths[0] < 2 or lengths[1] != 2 * lengths[0]:
        return False
    return all(is_whole(entry) for row in rows if isinstance(row, list) and len(row) == lengths[1] for entry in row)


def _rectangular(rows: Any, check_entries: ValidatorFunctionWrapHandler) -> Any:
    """Check that rows have one length, besides their entries, so that both kinds of problem are reported; a flat list
    of numbers, and one of empty rows, are one problem each."""
    if isinstance(rows, list) and rows and (all(map(is_number, rows)) or all(row == [] for row in rows)):
        raise PydanticCustomError("list_of_no_rows", "must be a list of rows")
    listed = [(i, len(row)) for i, row in enumerate(rows, 1) if isinstance(row, list)] if isinstance(rows, list) else []
    ragged = next(((i, length) for i, length in listed if length != listed[0][1]), None)
    if ragged is None:
        return check_entries(rows)
    problem = PydanticCustomError(
        "ragged_rows",
        "row {row} has {entries}, but row {first} has {expected}{advice}",
        {
            "row": ragged[0],
            "entries": counted(ragged[1], "entry", "entries"),
            "first": listed[0][0],
            "expected": listed[0][1],
            "advice": "; if commas are decimal ones, write points" if _has_decimal_commas(rows) else "",
        },
    )
    entry_problems: list[InitErrorDetails] = []
    own: Any = get_args(ErrorType)
    try:
        check_entries(rows)
    except ValidationError as error:
        entry_problems = [
            InitErrorDetails(
                # Kinds of our own are unknown to pydantic by name.
                type=item["type"] if item["type"] in own else PydanticCustomError(item["type"], item["msg"]),
                loc=item["loc"],
                input=item["input"],
                ctx=item.get("ctx", {}),
            )
            for item in error.errors()
        ]
    raise ValidationError.from_exception_data("matrix", [*entry_problems, InitErrorDetails(type=problem, input=None)])


def kind_of_matrix(value: Any) -> str:
    """Return which form of a matrix a value of a spec has."""
    if isinstance(value, dict):
        return FILE_TAG if "file" in value or not value else PICKED
    return _ROWS


def _file_or(other: str) -> Discriminator:
    return Discriminator(lambda value: FILE_TAG if isinstance(value, dict) else other)


class Section(BaseModel):
    """A part of a document: strict types, no unknown keys, finite numbers."""

    # Options may be called model_...: older releases of pydantic keep that for themselves.
    # Validators are made at the first use: most sections are only ever parts of another one.
    model_config = ConfigDict(
        strict=True, extra="forbid", allow_inf_nan=False, frozen=True, protected_namespaces=(), defer_build=True
    )


Rows = Annotated[
    list[Annotated[list[float], Field(min_length=1)]], Field(min_length=1), WrapValidator(_rectangular), Tag(_ROWS)
]


class MatrixFile(Section):
    """A matrix in a file: ``{file: A.mtx}``, or ``{file: plant.mat, variable: A}``."""

    file: Text
    variable: Text | None = None


class NamesFile(Section):
    """Names in a JSON file: ``{file: names.json}``."""

    file: Text


class OutputPick(Section):
    """Outputs by state name: ``{outputs: [omega 1, v 3]}``."""

    outputs: Annotated[list[Text], Field(min_length=1)]


class StatePick(Section):
    """Equations by state name: ``{states: [tm 1]}``."""

    states: Annotated[list[Text], Field(min_length=1)]


Matrix = Annotated[Rows | Annotated[MatrixFile, Tag(FILE_TAG)], _file_or(_ROWS)]

OutputMatrix = Annotated[
    Rows | Annotated[MatrixFile, Tag(FILE_TAG)] | Annotated[OutputPick, Tag(PICKED)], Discriminator(kind_of_matrix)
]

Names = Annotated[Annotated[list[Text], Tag(LIST_TAG)] | Annotated[NamesFile, Tag(FILE_TAG)], _file_or(LIST_TAG)]


def _number_or_expression(value: Any) -> Any:
    """Check one entry of a matrix that may change with k; expressions are parsed later, with the plant's constants."""
    if isinstance(value, bool) or not isinstance(value, (int, float, str)):
        raise PydanticCustomError("entry_of_k", "must be a number or an expression in k")
    if isinstance(value, float) and not math.isfinite(value):
        raise PydanticCustomError("finite_number", "must be finite")
    return value


VaryingRows = Annotated[
    list[Annotated[list[Annotated[Any, BeforeValidator(_number_or_expression)]], Field(min_length=1)]],
    Field(min_length=1),
    WrapValidator(_rectangular),
    Tag(_ROWS),
]


def _same_shapes(stack: Any, check_entries: ValidatorFunctionWrapHandler) -> Any:
    """Check that the matrices of a stack have as many rows and columns as the first one."""
    checked = check_entries(stack)
    shapes = [(len(matrix), len(matrix[0])) for matrix in checked]
    k = next((k for k, shape in enumerate(shapes) if shape != shapes[0]), None)
    if k is None:
        return checked
    raise PydanticCustomError(
        "stack_shapes",
        "matrix {number} of the stack is {rows} by {columns}, but the first is {wanted}",
        {"number": k + 1, "rows": shapes[k][0], "columns": shapes[k][1], "wanted": "{} by {}".format(*shapes[0])},
    )


Stack = Annotated[list[Rows], Field(min_length=1), WrapValidator(_same_shapes), Tag(_STACK_TAG)]


class VaryingFile(MatrixFile):
    """A matrix, or a stack of them, in a file; ``stack: 60`` tells that 60 matrices stand one below the other."""

    stack: Annotated[int, Field(ge=1)] | None = None


def kind_of_varying_matrix(value: Any) -> str:
    """Return which form of a time-varying matrix a value of a spec has."""
    if isinstance(value, dict):
        return FILE_TAG
    first = value[0] if isinstance(value, list) and value else None
    return _STACK_TAG if isinstance(first, list) and first and isinstance(first[0], list) else _ROWS


#: One variance stands for that multiple of the identity, as from Python.
Covariance = Annotated[
    Variance | Rows | Annotated[MatrixFile, Tag(FILE_TAG)],
    Discriminator(lambda value: _NUMBER_TAG if is_number(value) else FILE_TAG if isinstance(value, dict) else _ROWS),
]


VaryingCovariance = Annotated[
    Variance | VaryingRows | Stack | Annotated[VaryingFile, Tag(FILE_TAG)],
    Discriminator(lambda value: _NUMBER_TAG if is_number(value) else kind_of_varying_matrix(value)),
]
