"""The base class of methods, whose fields are the options, and the result that a method returns."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field, fields
from importlib import import_module
from typing import TYPE_CHECKING, Any, ClassVar, Literal, Self, TypeAlias

import numpy as np

from obsynth.analysis.existence.condition import OPTIONS_PATH, Condition
from obsynth.conditions.options import FUNCTION_TEXT
from obsynth.errors import SpecError
from obsynth.numerics.arguments import field_types, problem_with, without_axes
from obsynth.numerics.arrays import FloatArray
from obsynth.numerics.regions import LMIRegion
from obsynth.numerics.suggestions import suggestion
from obsynth.observers.linear.observer import LinearObserver
from obsynth.plants.descriptor import DescriptorSystem
from obsynth.plants.faults import FaultModel
from obsynth.plants.time_varying import TimeVaryingDescriptorSystem
from obsynth.plants.transformations.recovery import Transformation
from obsynth.results.checks import Check
from obsynth.results.design import Certificate, ObserverDesign
from obsynth.verification.constant_faults import held_faults
from obsynth.verification.error_system import ErrorModel

if TYPE_CHECKING:
    from obsynth.observers.nonlinear.observer import DAEObserver
    from obsynth.observers.nonlinear.region_observer import RegionObserver
    from obsynth.observers.recursive.observer import RecursiveObserver
    from obsynth.observers.scheduled.observer import ScheduledObserver
    from obsynth.observers.window.observer import WindowObserver
    from obsynth.verification.requested_limits import Limits


PlantKind: TypeAlias = Literal["time-invariant", "time-varying", "nonlinear", "polytopic"]

#: What the choice by default (`auto`) takes a method for.
Purpose: TypeAlias = Literal[
    "faults", "faults under the weakest conditions", "state despite unknown inputs", "state despite noise", "parameters"
]

#: Gains from fast errors of a measurement to a fault estimate above this are worth a note.
WARN_AMPLIFICATION = 50.0

#: Options by the names that other libraries have for them; the first that a method has is meant.
_OTHER_NAMES: Mapping[str, tuple[str, ...]] = {
    **dict.fromkeys(("P0", "P", "initial_deviation"), ("initial_covariance",)),
    **dict.fromkeys(("x0", "z0"), ("initial_state",)),
    **dict.fromkeys(("Ts", "h", "sampling_time"), ("dt", "sample_time")),
    **dict.fromkeys(("QN", "W", "process_noise"), ("Q",)),
    **dict.fromkeys(("RN", "V", "measurement_noise"), ("R",)),
    **dict.fromkeys(("rate", "alpha", "convergence_rate"), ("decay",)),
    **dict.fromkeys(("hinf", "level", "gain"), ("gamma",)),
}


@dataclass(frozen=True)
class ClaimMeaning:
    """A number that a method may claim, and the ``row`` that checks it.

    Where no row can, ``row`` is `obsynth.verification.claims.STATED_BY_SEARCH`.
    """

    unit: str  # empty: dimensionless
    meaning: str
    row: str = ""
    side: Literal["", "at most", "at least"] = (
        ""  # from which it bounds what it is said of; printed numbers are rounded so
    )


@dataclass(frozen=True, eq=False)
class Synthesis:
    """The unverified outcome of a method."""

    options: Mapping[str, Any]
    gains: Mapping[str, FloatArray]
    observer: LinearObserver | RecursiveObserver | DAEObserver | WindowObserver | ScheduledObserver | RegionObserver
    certificate: Certificate
    solver: Mapping[str, Any] = field(default_factory=dict)
    notes: tuple[str, ...] = ()
    transformation: Transformation | None = None  # before the design, which is then for its plant, with the way back
    # As the recursive methods see it, where given another kind; or with the noise that the design is for.
    plant: DescriptorSystem | TimeVaryingDescriptorSystem | None = None

    @property
    def linear_observer(self) -> LinearObserver:
        """The observer of a linear method; raise `TypeError` where it is none."""
        if not isinstance(self.observer, LinearObserver):
            raise TypeError(f"{type(self.observer).__name__} is no LinearObserver")
        return self.observer


@dataclass(frozen=True)
class Method(ABC):
    """A method: a frozen dataclass whose fields are its options.

    Annotations of the fields say what each option may be.  The docstring is that of the public function: what each
    option means, what is returned and raised, and the source.  From both follow the public function
    (`obsynth.methods.functions`), the spec's schema and the checks of the two.  What is heavy is imported where it is
    used.
    """

    #: Id of the method, in specs, gain sets and messages.
    id: ClassVar[str]
    #: Kinds of plants that it takes.
    plants: ClassVar[tuple[PlantKind, ...]]
    #: Continuous, discrete or both, in words; ``continuous`` alone: its designs are sampled afterwards.
    time: ClassVar[str]
    #: What it estimates, in a few words.
    summary: ClassVar[str]
    #: The paper whose letters its gains have.
    source: ClassVar[str]
    #: Every number that it may claim.
    claims: ClassVar[Mapping[str, ClaimMeaning]] = {}
    #: Matrices that its certificate may hold.
    witnesses: ClassVar[frozenset[str]] = frozenset()
    #: Its observers add constants to their outputs, which its own checks cover.
    adds_constants: ClassVar[bool] = False
    #: What `auto` takes it for; nothing: only who names it gets it.
    purposes: ClassVar[frozenset[Purpose]] = frozenset()
    #: Claims that say what was imposed and proved, not what was found.
    imposed: ClassVar[frozenset[str]] = frozenset()
    #: Whether an option ``mean`` puts registers behind the observer, which the checks are not about.
    averaged: ClassVar[bool] = False
    #: Whether `synthesise` takes a ``scenario`` where constants of the plant have tolerances.
    over_scenario: ClassVar[bool] = False
    #: Whether its designs are models without feedback: nothing is claimed of their stability, as the verdict says.
    open_loop: ClassVar[bool] = False
    #: What a design of it stores among its options beside these.
    recorded: ClassVar[frozenset[str]] = frozenset()
    #: Which of the options decay, region and poles are about the eigenvalues of its linear observers.
    placed: ClassVar[frozenset[str]] = frozenset()
    #: Values of required options, for questions that do not depend on them.
    placeholders: ClassVar[Mapping[str, Any]] = {}

    def __post_init__(self) -> None:
        kinds = field_types(type(self))
        problems = [text for name, kind in kinds.items() if (text := problem_with(getattr(self, name), name, kind))]
        # Rules across options presume that each of them is of its type.
        problems = problems or list(self.conflicts())
        if problems:
            raise SpecError(f"Options of {self.id}:", path=OPTIONS_PATH, problems=problems)

    @classmethod
    def of(cls, options: Mapping[str, Any]) -> Self:
        """Return the method with these options; raise `SpecError` for unknown names, wrong types and broken rules."""
        unknown = sorted(set(options) - set(field_types(cls)))
        if unknown:
            known = sorted(field_types(cls))
            near = _near(unknown[0], known) if len(unknown) == 1 else ""
            raise SpecError(
                f"{cls.id} has no option {', '.join(map(repr, unknown))}.{near} There are: {', '.join(known)}.",
                path=OPTIONS_PATH,
            )
        return cls(**{name: without_axes(value) for name, value in options.items()})

    def conflicts(self) -> Iterator[str]:
        """Yield a sentence for each rule across options that is broken."""
        yield from ()

    @abstractmethod
    def existence(self, plant: Any, *, exactly: bool = True) -> tuple[Condition, ...]:
        """Return the existence conditions of a plant, with these options, decided exactly or in floating point."""

    def require_stated(self, plant: Any) -> None:
        """Raise an error where a design needs what neither the plant nor the options state."""
        return None

    def require_fitting(self, plant: Any) -> None:
        """Raise `SpecError` where options name signals that a plant does not have, or are matrices of other sizes."""
        return None

    def is_for_states_as_written(self, plant: DescriptorSystem) -> bool:
        """Whether options are about the states of a plant of index 2 or more as written: it is not reduced then."""
        return False

    def for_plant(self, plant: DescriptorSystem) -> Self:
        """Return the method without what a plant of fewer faults makes void."""
        return self

    def synthesise(self, plant: Any, *, progress: Callable[[str], None]) -> Synthesis:
        """Return gains, observer and certificate, not yet verified.

        By default what the function ``synthesise(plant, method, progress=)`` of the module ``synthesis`` in the
        method's own package returns: heavy, and imported only here.
        """
        package = type(self).__module__.rpartition(".")[0]
        synthesis: Synthesis = import_module(f"{package}.synthesis").synthesise(plant, self, progress=progress)
        return synthesis

    @classmethod
    def from_gains(cls, plant: Any) -> Synthesis:
        """Return realisation and certificate of gains that are given by name, in the letters of the paper."""
        raise SpecError(f"Gains of {cls.id} are not read: design it instead.", path="method")

    @classmethod
    def checks(cls, design: ObserverDesign, printed_digits: int | None) -> Iterator[Check]:
        """Yield a row for each claim, from the plant and the shipped realisation alone.

        By default what the function ``checks(design, printed_digits)`` of the module ``checks`` beside the class does.
        """
        package = cls.__module__.rpartition(".")[0]
        rows: Iterator[Check] = import_module(f"{package}.checks").checks(design, printed_digits)
        return rows

    @classmethod
    def requested_limits(cls, design: ObserverDesign) -> Limits:
        """Return, by option, which claims of a design it bounds: `verify` compares them."""
        return {}

    @classmethod
    def fixed_modes(cls, design: ObserverDesign) -> tuple[complex, ...]:
        """Return the eigenvalues of a linear observer that no gain moves, which the option decay is not about."""
        return ()

    @classmethod
    def has_error_model(cls, design: ObserverDesign) -> bool:
        """Whether a linear design follows the plant's state; not one that relies on bounds of it."""
        return True

    @classmethod
    def error_model(cls, design: ObserverDesign) -> ErrorModel | None:
        """Return what the shipped observer follows; ``None`` where it is no linear one, or its certificate lacks it.

        Every linear design that `has_error_model` needs one, and `verify` checks it.
        """
        return None

    @classmethod
    def constant_fault_gain(cls, design: ObserverDesign, model: ErrorModel) -> FloatArray:
        """Return what the estimates ``(nf, nf)`` of constant faults are in the end; NaN columns say nothing.

        By default the faults themselves, where the fault model that the observer holds has a constant."""
        return held_faults(model)

    def as_given(self) -> dict[str, Any]:
        """Return every option by name."""
        return {option.name: getattr(self, option.name) for option in fields(self)}

    def as_plain(self) -> dict[str, Any]:
        """Return every option by name, as lists, mappings, numbers and texts."""
        return {name: plain(value) for name, value in self.as_given().items()}


def _near(unknown: str, known: list[str]) -> str:
    """Return the end of a message on an option that is not known: which one may be meant."""
    ours = next((name for name in _OTHER_NAMES.get(unknown, ()) if name in known), None)
    return suggestion(unknown, known) if ours is None else f" Did you mean {ours!r}?"


def plain(value: Any) -> Any:
    """Return an option as lists, mappings and numbers."""
    if isinstance(value, FaultModel):
        return {"Phi": value.Phi.tolist(), "Cw": value.Cw.tolist()}
    if isinstance(value, LMIRegion):
        return list(value.parts) or {"L": value.L.tolist(), "M": value.M.tolist()}
    if callable(value):
        return f"{FUNCTION_TEXT}{getattr(value, '__name__', type(value).__name__)}"
    if isinstance(value, Mapping):
        return {str(key): plain(part) for key, part in value.items()}
    if isinstance(value, np.ndarray):
        return value.tolist()
    return [plain(part) for part in value] if isinstance(value, (list, tuple)) else value


def silent(_: str) -> None:
    """Progress that does nothing (no-op)."""
