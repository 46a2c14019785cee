"""What a spec says of plants that change with time, and of nonlinear ones.

This module imports pydantic, so it is imported only when a spec has such a plant.
"""

from __future__ import annotations

from typing import Annotated, Any, Literal

from pydantic import Field

from obsynth.numerics.arguments import Positive
from obsynth.spec.schema_plants import BoxSection, SensorNoises, Sizes, TransformSection
from obsynth.spec.schema_values import Names, Section, Text, VaryingMatrix


class TimeVaryingSection(Section):
    """A plant whose matrices change with k: rows of numbers and expressions."""

    kind: Literal["time-varying"]
    dt: Positive
    horizon: Annotated[int, Field(ge=1)] | None = None
    constants: dict[Text, float] | None = None
    E: VaryingMatrix | None = None
    A: VaryingMatrix
    B: VaryingMatrix | None = None
    C: VaryingMatrix
    Phi: VaryingMatrix | None = None
    Psi: VaryingMatrix | None = None
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
