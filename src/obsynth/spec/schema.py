"""The closed, strict, versioned schema of a spec, and readable messages for what does not fit it.

Values and plants (numbers, names, matrices, written out or in a file), methods' options, and what some specs say: of
plants that change with time, of nonlinear ones, and of logs.

This module imports pydantic, so it is imported only when a spec is read.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import fields
from functools import cache
from typing import Annotated, Any, Literal, get_args

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
    create_model,
    model_validator,
)
from pydantic_core import InitErrorDetails, PydanticCustomError
from pydantic_core.core_schema import ErrorType

from obsynth.methods.registry import method_class
from obsynth.numerics.arguments import Count, NonNegative, OpenUnitInterval, Positive, WrittenAs, field_types, is_number
from obsynth.plants.constants import UNCERTAIN_MATRICES, expressions_in
from obsynth.simulation.scenario import PROFILE_KINDS

# Tags of unions appear in the locations of pydantic's errors; the bracket marks them for removal.
_ROWS, FILE_TAG, _PICK, LIST_TAG, _STACK_TAG, _NUMBER_TAG, ONE_TAG = (
    "<rows>",
    "<file>",
    "<pick>",
    "<list>",
    "<stack>",
    "<number>",
    "<one>",
)


def _rectangular(rows: Any, check_entries: ValidatorFunctionWrapHandler) -> Any:
    """Check that rows have one length, besides their entries, so that both kinds of problem are reported."""
    listed = [(i, len(row)) for i, row in enumerate(rows, 1) if isinstance(row, list)] if isinstance(rows, list) else []
    ragged = next(((i, length) for i, length in listed if length != listed[0][1]), None)
    if ragged is None:
        return check_entries(rows)
    problem = PydanticCustomError(
        "ragged_rows",
        "row {row} has {found} entries, but row {first} has {expected}",
        {"row": ragged[0], "found": ragged[1], "first": listed[0][0], "expected": listed[0][1]},
    )
    others: list[InitErrorDetails] = []
    own: Any = get_args(ErrorType)
    try:
        check_entries(rows)
    except ValidationError as error:
        others = [
            InitErrorDetails(
                # Kinds of our own are unknown to pydantic by name.
                type=item["type"] if item["type"] in own else PydanticCustomError(item["type"], item["msg"]),
                loc=item["loc"],
                input=item["input"],
                ctx=item.get("ctx", {}),
            )
            for item in error.errors()
        ]
    raise ValidationError.from_exception_data("matrix", [*others, InitErrorDetails(type=problem, input=None)])


def _kind_of_matrix(value: Any) -> str:
    if isinstance(value, dict):
        return FILE_TAG if "file" in value or not value else _PICK
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


Text = Annotated[str, Field(min_length=1)]
Range = Annotated[list[float], Field(min_length=2, max_length=2)]
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
EquationMatrix = Annotated[
    Rows | Annotated[MatrixFile, Tag(FILE_TAG)] | Annotated[StatePick, Tag(_PICK)], Discriminator(_kind_of_matrix)
]
OutputMatrix = Annotated[
    Rows | Annotated[MatrixFile, Tag(FILE_TAG)] | Annotated[OutputPick, Tag(_PICK)], Discriminator(_kind_of_matrix)
]
#: A fault, or an unknown input, on each sensor that is named.
SensorMatrix = OutputMatrix
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


def _kind_of_varying(value: Any) -> str:
    if isinstance(value, dict):
        return FILE_TAG
    first = value[0] if isinstance(value, list) and value else None
    return _STACK_TAG if isinstance(first, list) and first and isinstance(first[0], list) else _ROWS


VaryingMatrix = Annotated[VaryingRows | Stack | Annotated[VaryingFile, Tag(FILE_TAG)], Discriminator(_kind_of_varying)]


Variance = Annotated[float, Field(ge=0.0), Tag(_NUMBER_TAG)]
#: One variance stands for that multiple of the identity, as from Python.
Covariance = Annotated[
    Variance | Rows | Annotated[MatrixFile, Tag(FILE_TAG)],
    Discriminator(lambda value: _NUMBER_TAG if is_number(value) else FILE_TAG if isinstance(value, dict) else _ROWS),
]
VaryingCovariance = Annotated[
    Variance | VaryingRows | Stack | Annotated[VaryingFile, Tag(FILE_TAG)],
    Discriminator(lambda value: _NUMBER_TAG if is_number(value) else _kind_of_varying(value)),
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


#: What a document may write for an option that is no plain number, text or truth.
OPTION_KINDS: Mapping[str, Any] = {
    "matrix": Matrix | None,
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
    "named bounds": NonNegative | dict[Text, NonNegative | Range] | None,
    "samples": Literal["auto"] | Count,
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


_COLOURED = "<coloured>"


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


SensorNoises = dict[
    Text,
    Annotated[
        Annotated[Positive, Tag(ONE_TAG)] | Annotated[ColouredNoise, Tag(_COLOURED)],
        Discriminator(lambda value: _COLOURED if isinstance(value, dict) else ONE_TAG),
    ],
]
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


SPEC_VERSION = 1

#: Kinds of plants beside those with constant matrices.
RARE_KINDS = ("time-varying", "dae")


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


_PROFILE_KEYS = [item.name for profile in PROFILE_KINDS.values() for item in fields(profile)]
#: How a signal goes with time; which keys belong to which kind is checked when it is built.
ProfileSection: Any = create_model(  # type: ignore[call-overload]
    "ProfileSection",
    __base__=Section,
    kind=(Literal[tuple(PROFILE_KINDS)], ...),
    **dict.fromkeys(_PROFILE_KEYS, (float | None, None)),
)


Profiles = Annotated[
    Annotated[ProfileSection, Tag(ONE_TAG)]
    | Annotated[Annotated[list[ProfileSection], Field(min_length=1)], Tag(LIST_TAG)],
    Discriminator(lambda value: LIST_TAG if isinstance(value, list) else ONE_TAG),
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


#: The sections of a spec that are checked by themselves: those which it has not are not made.
CHECKED_APART = ("plant", "scenario", "inputs", "calibrate")


def section_of(name: str, value: Any) -> type[Section]:
    """Return the schema of one of `CHECKED_APART`."""
    if name == "plant":
        given = value if isinstance(value, dict) else {}
        kind = given.get("kind")
        return PlantReference if "file" in given and kind not in RARE_KINDS else plant_section(kind)
    return ScenarioSection if name == "scenario" else InputsSection if name == "inputs" else CalibrateSection
