"""The closed, strict, versioned schema of a spec, and readable messages for what does not fit it.

This module imports pydantic, so it is imported only when a spec is read.
"""

from __future__ import annotations

from typing import Annotated, Any, Literal

from pydantic import Discriminator, Field, Tag, create_model, model_validator

from obsynth.numerics.arguments import Positive
from obsynth.plants.uncertainty import UNCERTAIN_MATRICES, expressions_in
from obsynth.spec.schema_values import (
    FILE_TAG,
    LIST_TAG,
    EquationMatrix,
    Matrix,
    Names,
    OutputMatrix,
    Range,
    Section,
    SensorMatrix,
    Text,
    VaryingMatrix,
)

SPEC_VERSION = 1

# Tags of unions appear in the locations of pydantic's errors; the bracket marks them for removal.
_INLINE, _VARYING_TAG, _ONE, _NONLINEAR = "<inline>", "<varying>", "<one>", "<dae>"
_COLOURED = "<coloured>"


def _kind_of_plant(value: Any) -> str:
    if isinstance(value, dict) and value.get("kind") == "time-varying":
        return _VARYING_TAG
    if isinstance(value, dict) and value.get("kind") == "dae":
        return _NONLINEAR
    return FILE_TAG if isinstance(value, dict) and "file" in value else _INLINE


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
    sample_time: Positive | None = None


class EntrySection(Section):
    """One entry of a matrix as an expression in the constants: row and column by name, or by number from 1."""

    row: Text | int
    column: Text | int
    value: Text | float


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


def _kind_of_noise(value: Any) -> str:
    return _COLOURED if isinstance(value, dict) else _ONE


SensorNoises = dict[
    Text, Annotated[Annotated[Positive, Tag(_ONE)] | Annotated[ColouredNoise, Tag(_COLOURED)],
                    Discriminator(_kind_of_noise)]
]  # fmt: skip
#: Offsets and walks: a number, or what a calibration is to find.
Sizes = dict[Text, Literal["unknown"] | Positive]


class PlantSection(Section):
    """A plant, matrix by matrix."""

    dt: Annotated[float, Field(ge=0.0)]
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
    sensor_noise: SensorNoises | None = None
    offset: Sizes | None = None
    walks: Sizes | None = None
    constants: dict[Text, Any] | None = None
    entries: dict[Text, list[EntrySection]] | None = None
    tolerance: dict[Text, Text | float] | None = None
    variation: Literal["constant", "varying"] | None = None
    box: BoxSection | None = None
    transform: TransformSection | None = None

    @model_validator(mode="before")
    @classmethod
    def _expressions(cls, data: Any) -> Any:
        """Return a raw plant section with expressions in rows moved to ``entries``; only where there are constants."""
        if not isinstance(data, dict) or not isinstance(data.get("constants"), dict):
            return data
        found, entries = dict(data), data.get("entries")
        entries = dict(entries) if isinstance(entries, dict) else entries
        for name in UNCERTAIN_MATRICES:
            rows, texts = expressions_in(found.get(name))
            if texts and (entries is None or isinstance(entries, dict)):
                found[name] = rows
                more = [{"row": i + 1, "column": j + 1, "value": text} for i, j, text in texts]
                entries = {**(entries or {}), name: [*(entries or {}).get(name, []), *more]}
        if entries is not None:
            found["entries"] = entries
        return found


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


#: A plant in a file of its own, by its kind.
PLANT_DOCUMENTS: dict[object, type[Section]] = {
    kind: create_model(f"{section.__name__}Document", __base__=section, schema_version=(int, ...))
    for kind, section in ((None, PlantSection), ("time-varying", TimeVaryingSection), ("dae", DAESection))
}


class PlantReference(Section):
    """A plant in another file: ``{file: plant.yaml}``, whose transform may be replaced, or ``{file: plant.mat}``.

    All but the first two entries are for ``.mat`` files, and are arguments of `obsynth.from_matlab`.
    """

    file: Text
    transform: TransformSection | None = None
    variable: Text | None = None
    dt: Annotated[float, Field(ge=0.0)] | None = None
    faults: list[Text] | None = None
    disturbances: list[Text] | None = None
    actuator_faults: list[Text] | None = None
    sensor_faults: list[Text] | None = None
    sensor_noise: dict[Text, Positive] | None = None
    operating_point: dict[Text, float] | None = None
    scales: dict[Text, float] | None = None
    units: dict[Text, str] | None = None


class MethodSection(Section):
    """The method and its options; the options have a schema per method."""

    id: Text = "auto"
    options: dict[str, Any] = Field(default_factory=dict)


def _kind_of_profiles(value: Any) -> str:
    return LIST_TAG if isinstance(value, list) else _ONE


class ProfileSection(Section):
    """How a signal goes with time; which keys belong to which kind is checked when it is built."""

    kind: Literal["step", "ramp", "sine", "drift", "intermittent", "stuck", "lost-effectiveness", "uniform", "gaussian"]
    start: float | None = None
    end: float | None = None
    size: float | None = None
    rate: float | None = None
    amplitude: float | None = None
    frequency: float | None = None
    phase: float | None = None
    time_constant: float | None = None
    period: float | None = None
    duty: float | None = None
    value: float | None = None
    share: float | None = None
    low: float | None = None
    high: float | None = None
    deviation: float | None = None
    mean: float | None = None


Profiles = Annotated[
    Annotated[ProfileSection, Tag(_ONE)]
    | Annotated[Annotated[list[ProfileSection], Field(min_length=1)], Tag(LIST_TAG)],
    Discriminator(_kind_of_profiles),
]


class ScenarioSection(Section):
    """What happens in a simulation of the design."""

    horizon: Positive
    sample_time: Positive | None = None
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


class SpecDocument(Section):
    """A whole spec."""

    schema_version: int
    name: Annotated[str, Field(pattern=r"^[A-Za-z0-9][A-Za-z0-9._-]{0,99}$")]
    description: str | None = None
    plant: Annotated[
        Annotated[PlantReference, Tag(FILE_TAG)]
        | Annotated[PlantSection, Tag(_INLINE)]
        | Annotated[TimeVaryingSection, Tag(_VARYING_TAG)]
        | Annotated[DAESection, Tag(_NONLINEAR)],
        Discriminator(_kind_of_plant),
    ]
    method: MethodSection = Field(default_factory=MethodSection)
    scenario: ScenarioSection | None = None
    inputs: InputsSection | None = None
    calibrate: CalibrateSection | None = None
