"""Schema of further sections of a spec: time-varying plants, nonlinear plants, and logs.

This module imports pydantic, so it is imported only when a spec has such a section.
"""

from __future__ import annotations

from typing import Annotated, Any, Literal

from pydantic import Discriminator, Field, Tag, model_validator

from obsynth.numerics.arguments import Positive
from obsynth.specs.quantities import with_numbers
from obsynth.specs.schema_plants import BoxSection, SensorNoises, Sizes, TransformSection
from obsynth.specs.schema_values import (
    FILE_TAG,
    Names,
    PositiveTime,
    Range,
    Section,
    Stack,
    Text,
    VaryingFile,
    VaryingRows,
    kind_of_varying_matrix,
)

VaryingMatrix = Annotated[
    VaryingRows | Stack | Annotated[VaryingFile, Tag(FILE_TAG)], Discriminator(kind_of_varying_matrix)
]


class TimeVaryingSection(Section):
    """A plant whose matrices change with k: rows of numbers and expressions."""

    kind: Literal["time-varying"]
    dt: PositiveTime
    horizon: Annotated[int, Field(ge=1)] | None = None
    constants: dict[Text, float] | None = None
    E: VaryingMatrix | None = None
    A: VaryingMatrix
    B: VaryingMatrix | None = None
    C: VaryingMatrix
    Phi: VaryingMatrix | None = None
    Psi: VaryingMatrix | None = None
    D: VaryingMatrix | None = None
    state_names: Names | None = None
    input_names: Names | None = None
    output_names: Names | None = None
    parameter_names: Names | None = None
    operating_point: dict[Text, float] | None = None
    scales: dict[Text, float] | None = None
    units: dict[Text, str] | None = None


class DAESection(Section):
    """A nonlinear plant: equations and outputs as texts, signals with nominal values and units."""

    kind: Literal["dae"]
    equations: dict[Text, Text]
    outputs: dict[Text, Text]
    states: dict[Text, float]
    units: dict[Text, str] | None = None
    inputs: dict[Text, float] | None = None
    parameters: dict[Text, float] | None = None
    constants: dict[Text, Any] | None = None
    variation: Literal["constant", "varying"] | None = None
    box: BoxSection | None = None
    definitions: dict[Text, Text] | None = None
    sensor_noise: SensorNoises | None = None
    offset: Sizes | None = None
    walks: Sizes | None = None
    process_noise: dict[Text, Positive] | None = None
    transform: TransformSection | None = None

    @model_validator(mode="before")
    @classmethod
    def _quantities(cls, data: Any) -> Any:
        """Return a raw section with numbers for quantities."""
        return with_numbers(data)


class CalibrateSection(Section):
    """The log, and what of the plant it is to find: arguments of `obsynth.calibrate`."""

    log: Text | None = None
    rows: Text | Annotated[list[int], Field(min_length=2, max_length=2)] | None = None
    columns: dict[Text, Text] | None = None
    scales: dict[Text, float] | None = None
    dt: PositiveTime | None = None
    unknown: dict[Text, Range] = Field(default_factory=dict)
    priors: dict[Text, Range] | None = None
    noisy: Names | None = None
    Q: dict[Text, Positive] | None = None
    R: dict[Text, Positive] | None = None
    initial_state: dict[Text, float] | None = None
    initial_covariance: Positive | dict[Text, Annotated[float, Field(ge=0.0)]] | None = None
    input_delay: int | Literal["auto"] | None = None
    method: Literal["innovations", "simulation"] | None = None
    integration: Literal["auto", "backward-euler", "radau"] | None = None
    substeps: Annotated[int, Field(ge=1)] | None = None
    level: Annotated[float, Field(gt=0.0, lt=1.0)] | None = None
    starts: Annotated[int, Field(ge=1)] | None = None
    seed: Annotated[int, Field(ge=0)] | None = None
    sensor_noise: dict[Text, dict[Text, float | Text]] | None = None
    offset: dict[Text, Literal["unknown"]] | None = None
    walks: dict[Text, Literal["unknown"]] | None = None
    digest: Text | None = None


class InputsSection(Section):
    """When the known inputs of a row act."""

    hold: Literal["begins", "ends"] | None = None
    delay: Annotated[int, Field(ge=-10_000, le=10_000)] = 0
