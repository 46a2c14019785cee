"""Schema of the options of a method in a spec, made from the typed fields of its class.

This module imports pydantic, so it is imported only when a spec is read.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import fields
from functools import cache
from typing import Annotated, Any, Literal, get_args

from pydantic import Discriminator, Field, PlainValidator, Tag, ValidationInfo, create_model
from pydantic_core import PydanticCustomError

from obsynth.methods.registry import method_class
from obsynth.numerics.arguments import (
    Count,
    NonNegative,
    OpenUnitInterval,
    Positive,
    WrittenAs,
    field_types,
    is_number,
    problem_with,
)
from obsynth.specs.schema_values import (
    _ROWS,
    FILE_TAG,
    ONE_TAG,
    Covariance,
    Matrix,
    MatrixFile,
    Range,
    Rows,
    Section,
    Text,
    VaryingCovariance,
)

#: The residual weight of Wang's filter: by name, or a matrix.
ResidualWeight = Annotated[
    Annotated[Literal["paper", "free"], Tag(ONE_TAG)] | Rows | Annotated[MatrixFile, Tag(FILE_TAG)],
    Discriminator(lambda value: FILE_TAG if isinstance(value, dict) else _ROWS if isinstance(value, list) else ONE_TAG),
]


class PoleRegion(Section):
    """Where all movable poles must lie."""

    decay: NonNegative | None = None
    radius: Positive | None = None
    damping: OpenUnitInterval | None = None


class NoiseSection(Section):
    """What the Kalman filter believes."""

    measurement: Positive | list[Positive] | dict[Text, Positive] | None = None
    process: Positive = 1.0
    fault: Positive = 1.0


class SensorTimes(Section):
    """When a sensor is sampled, and by how much its values are delayed, in rows."""

    every: Count = 1
    delay: Annotated[int, Field(ge=0)] = 0


def _as_in_python(kind: str) -> Any:
    """Return the type of an option whose value a spec states as a call does: it is refused in the same words."""

    def checked(value: Any, info: ValidationInfo) -> Any:
        problem = problem_with(value, str(info.field_name), Annotated[Any, WrittenAs(kind)])
        if problem is not None:
            raise PydanticCustomError("stated", "{problem}", {"problem": problem})
        return _with_floats(value) if kind == "named bounds" else value

    return Annotated[Any, PlainValidator(checked)]


def _with_floats(value: Any) -> Any:
    """Return a value whose numbers are floating ones, as those of plain options are."""
    if isinstance(value, dict):
        return {name: _with_floats(inner) for name, inner in value.items()}
    if isinstance(value, list):
        return [_with_floats(inner) for inner in value]
    return float(value) if is_number(value) else value


#: What a document may write for an option that is no plain number, text or truth.
OPTION_KINDS: Mapping[str, Any] = {
    "matrix": Matrix | None,
    "residual weight": ResidualWeight | None,
    "covariance": Covariance | None,
    "varying covariance": VaryingCovariance | None,
    "vector": list[float] | None,
    "pair": Range | None,
    "positive numbers": Annotated[list[Positive], Field(min_length=1)] | None,
    "text": Text | None,
    "texts": Annotated[list[Text], Field(min_length=1)] | None,
    "fault model": Text | dict[Text, Any],
    "fault sets": Text | list[Text | list[Text]] | None,
    "poles": list[float | Range] | None,
    "pole sets": list[float | Range] | list[list[float | Range]] | None,
    "pole region": PoleRegion | None,
    "noise weights": NoiseSection | None,
    "named covariance": Positive | Matrix | dict[Text, NonNegative] | None,
    "named bounds": _as_in_python("named bounds"),
    "samples": _as_in_python("samples"),
    "delay": _as_in_python("delay"),
    "reference model": _as_in_python("reference model"),
    "weights": _as_in_python("weights"),
    "free faults": Text | list[Text] | None,
    "named numbers": Positive | dict[Text, Positive] | None,
    "named vector": list[float] | dict[Text, float] | None,
    "named pairs": dict[Text, Range] | None,
    "solver": Text,
    "function": type(None),
    "objective": Literal["h2"] | None,
    "placement objective": Literal["conditioning", "gain"],
    "region": dict[Text, float | Range] | list[dict[Text, float | Range]] | None,
    "solver options": dict[Text, Any] | None,
    "sensor times": dict[Text, SensorTimes] | None,
}


@cache
def options_schema(method: str) -> type[Section]:
    """Return the schema of the options of a method, made from its typed options."""
    options: Any = method_class(method)
    defaults, entries = {field.name: field.default for field in fields(options)}, dict[str, Any]()
    for name, kind in field_types(options).items():
        written = [OPTION_KINDS[mark.kind] for mark in get_args(kind)[1:] if isinstance(mark, WrittenAs)]
        entries[name] = ((written or [kind])[0], defaults[name])
    return create_model(options.__name__, __base__=Section, __doc__=options.__doc__, **entries)
