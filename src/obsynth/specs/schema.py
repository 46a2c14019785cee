"""The closed, strict, versioned schema of a spec, and readable messages for what does not fit it.

This module imports pydantic, so it is imported only when a spec is read.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import fields
from functools import cache
from typing import Annotated, Any, Literal

from pydantic import BeforeValidator, Discriminator, Field, Tag, create_model

from obsynth.simulation.scenario import PROFILE_KINDS
from obsynth.specs.schema_plants import PlantReference, PlantSection
from obsynth.specs.schema_sections import CalibrateSection, DAESection, InputsSection, TimeVaryingSection
from obsynth.specs.schema_values import LIST_TAG, ONE_TAG, PositiveTime, Section, Text, in_seconds

SPEC_VERSION = 1

#: Kinds of plants beside those with constant matrices.
RARE_KINDS = ("time-varying", "dae")

_PROFILE_KEYS = [item.name for profile in PROFILE_KINDS.values() for item in fields(profile)]

#: Keys of profiles that are times; they may be negative.
_PROFILE_TIMES = ("start", "end", "time_constant", "period")
_ProfileTime = Annotated[float | None, BeforeValidator(in_seconds)]

#: Keys of profiles that are no single numbers.
_PROFILE_LISTS: Mapping[str, Any] = {
    "times": list[float] | None,
    "values": list[float] | None,
    "interpolation": Literal["linear", "held"] | None,
}

#: How a signal goes with time; which keys belong to which kind is checked when it is built.
ProfileSection: Any = create_model(  # type: ignore[call-overload]
    "ProfileSection",
    __base__=Section,
    kind=(Literal[tuple(PROFILE_KINDS)], ...),
    **{
        name: (_PROFILE_LISTS.get(name, _ProfileTime if name in _PROFILE_TIMES else float | None), None)
        for name in _PROFILE_KEYS
    },
)

#: The sections of a spec that are checked by themselves: those which it has not are not made.
CHECKED_APART = ("plant", "scenario", "inputs", "calibrate")

#: A profile, or several whose sum is taken.
Profiles = Annotated[
    Annotated[ProfileSection, Tag(ONE_TAG)]
    | Annotated[Annotated[list[ProfileSection], Field(min_length=1)], Tag(LIST_TAG)],
    Discriminator(lambda value: LIST_TAG if isinstance(value, list) else ONE_TAG),
]


def plant_section(kind: object) -> type[Section]:
    """Return the section of a plant of this kind."""
    return TimeVaryingSection if kind == "time-varying" else DAESection if kind == "dae" else PlantSection


@cache
def plant_document(kind: object) -> type[Section]:
    """Return the schema of a plant in a file of its own, by its kind."""
    section = plant_section(kind)
    return create_model(f"{section.__name__}Document", __base__=section, schema_version=(int, ...))


class MethodSection(Section):
    """The method and its options; the options have a schema per method."""

    id: Text = "auto"
    options: dict[str, Any] = Field(default_factory=dict)


class ScenarioSection(Section):
    """What happens in a simulation of the design."""

    horizon: PositiveTime
    sample_time: PositiveTime | None = None
    inputs: dict[Text, Profiles] = Field(default_factory=dict)
    faults: dict[Text, Profiles] = Field(default_factory=dict)
    disturbances: dict[Text, Profiles] = Field(default_factory=dict)
    sensors: dict[Text, Profiles] = Field(default_factory=dict)
    noise: Annotated[float, Field(ge=0.0)] = 0.0
    sensor_noise: dict[Text, Annotated[float, Field(ge=0.0)]] = Field(default_factory=dict)
    seed: Annotated[int, Field(ge=0)] = 0
    initial_state: dict[Text, float] = Field(default_factory=dict)
    observer_state: Annotated[list[float], Field(min_length=1)] | None = None
    stabilise: bool = False
    scheduling: dict[Text, Profiles] = Field(default_factory=dict)


class SpecDocument(Section):
    """A whole spec; its larger sections are checked by themselves, as `section_of` has them."""

    schema_version: int
    name: Annotated[str, Field(pattern=r"^[A-Za-z0-9][A-Za-z0-9._-]{0,99}$")]
    description: str | None = None
    plant: Any
    method: MethodSection = Field(default_factory=MethodSection)
    scenario: Any = None
    inputs: Any = None
    calibrate: Any = None


def section_of(name: str, value: Any) -> type[Section]:
    """Return the schema of one of `CHECKED_APART`."""
    if name == "plant":
        keys = value if isinstance(value, dict) else {}
        kind = keys.get("kind")
        return PlantReference if "file" in keys and kind not in RARE_KINDS else plant_section(kind)
    return ScenarioSection if name == "scenario" else InputsSection if name == "inputs" else CalibrateSection
