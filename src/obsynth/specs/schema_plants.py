"""Schema of plants in a spec: matrices, noise, tolerances of constants, and transformations.

This module imports pydantic, so it is imported only when a spec is read.
"""

from __future__ import annotations

from typing import Annotated, Any, Literal

from pydantic import Discriminator, Field, Tag, model_validator

from obsynth.numerics.arguments import NonNegative, Positive
from obsynth.plants.uncertainty import UNCERTAIN_MATRICES, expressions_in
from obsynth.specs.quantities import with_numbers
from obsynth.specs.schema_values import (
    FILE_TAG,
    ONE_TAG,
    PICKED,
    Matrix,
    MatrixFile,
    Names,
    OutputMatrix,
    PositiveTime,
    Range,
    Rows,
    Section,
    StatePick,
    Text,
    Time,
    kind_of_matrix,
)

#: A fault, or an unknown input, on each sensor that is named.
SensorMatrix = OutputMatrix

EquationMatrix = Annotated[
    Rows | Annotated[MatrixFile, Tag(FILE_TAG)] | Annotated[StatePick, Tag(PICKED)], Discriminator(kind_of_matrix)
]

_COLOURED = "<coloured>"

#: Offsets and walks: a number, or what a calibration is to find.
Sizes = dict[Text, Literal["unknown"] | Positive]


class LineariseSection(Section):
    """Where a nonlinear plant is linearised: arguments of `obsynth.linearise`."""

    at: Literal["equilibrium", "point"] | None = None
    given: dict[Text, float] | None = None
    free: list[Text] | dict[Text, Range] | None = None
    faults: list[Text] | None = None
    disturbances: list[Text] | None = None
    start: dict[Text, float] | None = None
    drift: bool | None = None
    constants: dict[Text, Any] | None = None


class TransformSection(Section):
    """What is done to the plant before a method sees it, in this order."""

    linearise: LineariseSection | None = None
    eliminate_algebraic_states: bool = False
    pade: Annotated[int, Field(ge=1, le=8)] | None = None
    sample_time: PositiveTime | None = None


class EntrySection(Section):
    """One entry of a matrix as an expression in the constants: row and column by name, or by number from 1."""

    row: Text | int
    column: Text | int
    value: Text | float


class SchedulingSection(Section):
    """A measured parameter that the matrices depend on: its range, largest change in a second, and column of a log."""

    range: Annotated[list[float], Field(min_length=2, max_length=2)]
    rate: float | None = None
    column: Text | None = None
    unit: Text | None = None
    measured: bool = True

    @model_validator(mode="before")
    @classmethod
    def _range_alone(cls, data: Any) -> Any:
        """Return a list as the range that it is."""
        return {"range": data} if isinstance(data, list) else data


class BoxSection(Section):
    """Where the tolerances come from: a source, or a file that ``obsynth calibrate --out`` has written."""

    source: Literal["stated", "set-membership", "calibrated"] | None = None
    level: float | None = None
    digest: Text | None = None
    file: Text | None = None


class ColouredNoise(Section):
    """Noise of a sensor that is not white; see `obsynth.with_noise`."""

    deviation: Positive | Literal["unknown"]
    correlation: Positive | Text | None = None
    white: Positive | Literal["unknown"] | None = None


SensorNoises = dict[
    Text,
    Annotated[
        Annotated[Positive, Tag(ONE_TAG)] | Annotated[ColouredNoise, Tag(_COLOURED)],
        Discriminator(lambda value: _COLOURED if isinstance(value, dict) else ONE_TAG),
    ],
]


class PlantSection(Section):
    """A plant, matrix by matrix."""

    dt: Time
    E: Matrix | None = None
    A: Matrix
    B: EquationMatrix | None = None
    C: OutputMatrix
    D: Matrix | None = None
    Bf: EquationMatrix | None = None
    Df: SensorMatrix | None = None
    Bd: EquationMatrix | None = None
    Dd: SensorMatrix | None = None
    Bw: EquationMatrix | None = None
    Dw: Matrix | None = None
    state_names: Names | None = None
    input_names: Names | None = None
    output_names: Names | None = None
    fault_names: Names | None = None
    disturbance_names: Names | None = None
    noise_names: Names | None = None
    operating_point: dict[Text, float] | None = None
    scales: dict[Text, float] | None = None
    units: dict[Text, str] | None = None
    delays: dict[Text, NonNegative | Text] | None = None
    functionals: dict[Text, dict[Text, float]] | None = None
    sensor_noise: SensorNoises | None = None
    offset: Sizes | None = None
    walks: Sizes | None = None
    constants: dict[Text, Any] | None = None
    scheduling: dict[Text, SchedulingSection] | None = None
    entries: dict[Text, list[EntrySection]] | None = None
    tolerance: dict[Text, Text | float] | None = None
    variation: Literal["constant", "varying"] | None = None
    box: BoxSection | None = None
    transform: TransformSection | None = None

    @model_validator(mode="before")
    @classmethod
    def _expressions(cls, data: Any) -> Any:
        """Return a raw plant section with numbers for quantities, and with expressions in rows moved to ``entries``;
        these only where there are constants, or scheduling parameters."""
        data = with_numbers(data)
        known = isinstance(data, dict) and any(isinstance(data.get(name), dict) for name in ("constants", "scheduling"))
        if not isinstance(data, dict) or not known:
            return data
        section, entries = dict(data), data.get("entries")
        entries = dict(entries) if isinstance(entries, dict) else entries
        for name in UNCERTAIN_MATRICES:
            rows, texts = expressions_in(section.get(name))
            if texts and (entries is None or isinstance(entries, dict)):
                section[name] = rows
                more = [{"row": i + 1, "column": j + 1, "value": text} for i, j, text in texts]
                entries = {**(entries or {}), name: [*(entries or {}).get(name, []), *more]}
        if entries is not None:
            section["entries"] = entries
        return section


class PlantReference(Section):
    """A plant in another file: ``{file: plant.yaml}``, whose transform may be replaced, ``{file: plant.mat}``, or
    ``{file: linearized_model.mo}``.

    All but the first two entries are for ``.mat`` and ``.mo`` files, and are arguments of `obsynth.from_matlab` and
    `obsynth.from_modelica`.
    """

    file: Text
    transform: TransformSection | None = None
    variable: Text | None = None
    dt: Time | None = None
    faults: list[Text] | None = None
    disturbances: list[Text] | None = None
    actuator_faults: list[Text] | None = None
    sensor_faults: list[Text] | None = None
    sensor_noise: dict[Text, Positive] | None = None
    operating_point: dict[Text, float] | None = None
    scales: dict[Text, float] | None = None
    units: dict[Text, str] | None = None
    delays: dict[Text, NonNegative | Text] | None = None
