"""The options of every method as a spec gives them: its typed options, with what a document may write for each kind.

This module imports pydantic, so it is imported only when a spec is read.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import fields
from functools import cache
from typing import Annotated, Any, get_args, get_origin

from pydantic import Field, create_model

from obsynth.methods.method_spec import option_types
from obsynth.methods.registry import method_spec
from obsynth.numerics.arguments import Count, NonNegative, OpenUnitInterval, Positive, WrittenAs
from obsynth.spec.schema_values import Covariance, Matrix, Section, Text, VaryingCovariance

Two = Annotated[list[float], Field(min_length=2, max_length=2)]


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
    """When a sensor is sampled, and how late its values are, in rows."""

    every: Count = 1
    delay: Annotated[int, Field(ge=0)] = 0


#: What a document may write for an option that is no plain number, text or truth.
KINDS: Mapping[str, Any] = {
    "matrix": Matrix | None,
    "covariance": Covariance | None,
    "varying covariance": VaryingCovariance | None,
    "vector": list[float] | None,
    "pair": Two | None,
    "positive numbers": Annotated[list[Positive], Field(min_length=1)] | None,
    "text": Text | None,
    "texts": Annotated[list[Text], Field(min_length=1)] | None,
    "fault model": Text | dict[Text, Any],
    "fault sets": Text | list[Text | list[Text]] | None,
    "poles": list[float | Two] | None,
    "pole sets": list[float | Two] | list[list[float | Two]] | None,
    "pole region": PoleRegion | None,
    "noise weights": NoiseSection | None,
    "named covariance": Positive | Matrix | dict[Text, NonNegative] | None,
    "named numbers": Positive | dict[Text, Positive] | None,
    "named vector": list[float] | dict[Text, float] | None,
    "named pairs": dict[Text, Two] | None,
    "sensor times": dict[Text, SensorTimes] | None,
}


@cache
def options_schema(method: str) -> type[Section]:
    """Return the schema of the options of a method, made from its typed options."""
    options = method_spec(method).options_type
    types, defaults = option_types(options), {field.name: field.default for field in fields(options)}
    entries: dict[str, Any] = {name: (_in_document(kind), defaults[name]) for name, kind in types.items()}
    return create_model(options.__name__, __base__=Section, __doc__=options.__doc__, **entries)


def _in_document(kind: Any) -> Any:
    if get_origin(kind) is Annotated:
        marks = [mark for mark in get_args(kind)[1:] if isinstance(mark, WrittenAs)]
        if marks:
            return KINDS[marks[0].kind]
    return kind
