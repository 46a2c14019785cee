"""What a method is: one declaration, from which schema, checks and lists derive; and what it hands to the pipeline."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, fields
from functools import cache, partial
from importlib import import_module
from inspect import signature
from typing import Any, ClassVar, Literal, TypeAlias, cast, get_type_hints

import numpy as np

from obsynth.analysis.conditions import Condition
from obsynth.analysis.transformations.recovery import Transformation
from obsynth.errors import SpecError
from obsynth.numerics.arguments import problem_with
from obsynth.numerics.arrays import FloatArray
from obsynth.observers.dae.observer import DAEObserver
from obsynth.observers.linear.observer import LinearObserver
from obsynth.observers.recursive.observer import RecursiveObserver
from obsynth.plants.descriptor import DescriptorSystem
from obsynth.plants.fault_models import FaultModel
from obsynth.plants.time_varying import TimeVaryingDescriptorSystem
from obsynth.results.design import Certificate

PlantKind: TypeAlias = Literal["time-invariant", "time-varying", "nonlinear"]


@dataclass(frozen=True)
class MethodOptions:
    """Options of a method: a frozen dataclass whose annotations say what each may be; rules across options besides."""

    #: Id of the method, for messages.
    METHOD: ClassVar[str]

    def __post_init__(self) -> None:
        kinds = option_types(type(self))
        problems = [text for name, kind in kinds.items() if (text := problem_with(getattr(self, name), name, kind))]
        # Rules across options presume that each of them is of its type.
        problems = problems or list(self.conflicts())
        if problems:
            raise SpecError(f"Options of {self.METHOD}:", path="method.options", problems=problems)

    def conflicts(self) -> Iterator[str]:
        """Yield a sentence for each rule across options that is broken."""
        yield from ()

    def as_given(self) -> dict[str, Any]:
        """Return every option by name."""
        return {field.name: getattr(self, field.name) for field in fields(self)}

    def as_plain(self) -> dict[str, Any]:
        """Return every option by name, as lists, mappings, numbers and texts."""
        return {name: plain(value) for name, value in self.as_given().items()}


def plain(value: Any) -> Any:
    """Return an option as lists, mappings and numbers."""
    if isinstance(value, FaultModel):
        return {"Phi": value.Phi.tolist(), "Cw": value.Cw.tolist()}
    if isinstance(value, Mapping):
        return {str(key): plain(part) for key, part in value.items()}
    if isinstance(value, np.ndarray):
        return value.tolist()
    return [plain(part) for part in value] if isinstance(value, (list, tuple)) else value


def option_types(options: type[MethodOptions]) -> dict[str, Any]:
    """Return name -> annotated type of every option."""
    kind: Any = options  # a dataclass is hashable, whatever type checkers say
    return _option_types(kind)


@cache
def _option_types(options: Any) -> dict[str, Any]:
    hints = get_type_hints(options, include_extras=True)
    return {field.name: hints[field.name] for field in fields(options)}


@dataclass(frozen=True)
class ClaimMeaning:
    """A number that a method may claim; ``row`` checks it, or is `obsynth.verification.claims.STATED`: none can."""

    unit: str  # empty: dimensionless
    meaning: str
    row: str = ""


@dataclass(frozen=True)
class MethodSpec:
    """One method; paths ``module:name`` are loaded when used, those with a leading dot from the method's folder."""

    id: str
    plants: tuple[PlantKind, ...]
    time: str  # in words, for lists of methods
    summary: str
    source: str  # the paper whose letters its gains have
    options: str  # a `MethodOptions`
    claims: Mapping[str, ClaimMeaning]
    public: str = ""
    conditions: str = ".synthesis:conditions"  # existence, from the plant
    synthesise: str = ".synthesis:synthesise"  # (plant, options, progress=) -> `Synthesis`
    checks: str = ".checks:checks"  # (design, printed_digits) -> rows
    folder: str | None = None
    witnesses: frozenset[str] = frozenset()  # matrices that its certificate may hold
    tracked: str = ""  # (design) -> `TrackedPlant`, of a linear observer
    averaged: bool = False  # its option ``mean`` puts registers behind the observer, which the checks are not about

    def load(
        self, part: Literal["public", "options", "conditions", "synthesise", "checks", "tracked"]
    ) -> Callable[..., Any]:
        """Return what a path names."""
        path = str(getattr(self, part)) or f".public:{self.id.replace('-', '_')}"
        module, name = path.split(":")
        found: Callable[..., Any] = getattr(import_module(module, self.folder), name)
        return found

    def existence(self, options: Mapping[str, Any]) -> Callable[[Any], Sequence[Condition]]:
        """Return the existence conditions as a function of the plant, with those options that they depend on."""
        judge = self.load("conditions")
        known = signature(judge).parameters
        return partial(judge, **{name: value for name, value in options.items() if name in known})

    @property
    def option_names(self) -> tuple[str, ...]:
        """Names of all options, sorted."""
        return tuple(sorted(option_types(self.options_type)))

    @property
    def options_type(self) -> type[MethodOptions]:
        """The dataclass of its options."""
        loaded: Any = self.load("options")
        return cast(type[MethodOptions], loaded)

    def read_options(self, given: Mapping[str, Any]) -> MethodOptions:
        """Return checked options; raise `SpecError` for unknown names, wrong types and broken rules."""
        unknown = sorted(set(given) - set(self.option_names))
        if unknown:
            raise SpecError(
                f"{self.id} has no option {', '.join(map(repr, unknown))}; there are: {', '.join(self.option_names)}.",
                path="method.options",
            )
        return self.options_type(**given)


@dataclass(frozen=True, eq=False)
class Synthesis:
    """The unverified outcome of a method."""

    options: Mapping[str, Any]
    gains: Mapping[str, FloatArray]
    observer: LinearObserver | RecursiveObserver | DAEObserver
    certificate: Certificate
    solver: Mapping[str, Any] = field(default_factory=dict)
    notes: tuple[str, ...] = ()
    transformation: Transformation | None = None  # before the design, which is then for its plant, with the way back
    # As the recursive methods see it, where given another kind; or with the noise that the design is for.
    plant: DescriptorSystem | TimeVaryingDescriptorSystem | None = None
