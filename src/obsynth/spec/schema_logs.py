"""What a spec says of logs: what a calibration is to find from one, and when inputs of a row act.

This module imports pydantic, so it is imported only when a spec says that.
"""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field

from obsynth.numerics.arguments import Positive
from obsynth.spec.schema_values import Names, Range, Section, Text


class CalibrateSection(Section):
    """The log, and what of the plant it is to find: arguments of `obsynth.calibrate`."""

    log: Text | None = None
    rows: Text | Annotated[list[int], Field(min_length=2, max_length=2)] | None = None
    columns: dict[Text, Text] | None = None
    scales: dict[Text, float] | None = None
    dt: Positive | None = None
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
