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

#: The purposes for which the automatic choice (`auto`) considers a method.
Purpose: TypeAlias = Literal[
    "faults", "faults under the weakest conditions", "state despite unknown inputs", "state despite noise", "parameters"
]

#: A note is given if the gain from high-frequency measurement errors to a fault estimate is above this.
WARN_AMPLIFICATION = 50.0

#: Names of options in other libraries, with the corresponding options here; the first one that a method has is
#: suggested.
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
    """A number that a method may claim, and the ``row`` of the verification report that checks it.

    If no row can check it, ``row`` is `obsynth.verification.claims.STATED_BY_SEARCH`.
    """

    unit: str  # empty: dimensionless
    meaning: str
    row: str = ""
    side: Literal["", "at most", "at least"] = ""  # whether it is an upper or a lower bound; it is rounded accordingly


@dataclass(frozen=True, eq=False)
class Synthesis:
    """The unverified outcome of a method."""

    options: Mapping[str, Any]
    gains: Mapping[str, FloatArray]
    observer: LinearObserver | RecursiveObserver | DAEObserver | WindowObserver | ScheduledObserver | RegionObserver
    certificate: Certificate
    solver: Mapping[str, Any] = field(default_factory=dict)
    notes: tuple[str, ...] = ()
    transformation: Transformation | None = None  # of the plant before the design, with the map back to its states
    # The plant that the design is for, if it is of another kind than the given one, or has other noise.
    plant: DescriptorSystem | TimeVaryingDescriptorSystem | None = None

    @property
    def linear_observer(self) -> LinearObserver:
        """The observer, which must be linear; raises `TypeError` otherwise."""
        if not isinstance(self.observer, LinearObserver):
            raise TypeError(f"{type(self.observer).__name__} is no LinearObserver")
        return self.observer


@dataclass(frozen=True)
class Method(ABC):
    """A method: a frozen dataclass whose fields are its options.

    The annotations of the fields state the type and range of each option.  The docstring of the class is that of the
    public function, with the meaning of each option, the result, the errors and the source.  The public function
    (`obsynth.methods.functions`), the schema of specs and the checks of both follow from these.  Heavy modules are
    imported where they are used.
    """

    #: Id of the method, in specs, gain sets and messages.
    id: ClassVar[str]
    #: Kinds of plants that the method accepts.
    plants: ClassVar[tuple[PlantKind, ...]]
    #: Continuous, discrete or both, as a text; if it is ``continuous`` alone, its designs are sampled afterwards.
    time: ClassVar[str]
    #: What the method estimates, in a few words.
    summary: ClassVar[str]
    #: The paper whose notation the gains have.
    source: ClassVar[str]
    #: All numbers that the method may claim.
    claims: ClassVar[Mapping[str, ClaimMeaning]] = {}
    #: Names of matrices that its certificate may contain.
    witnesses: ClassVar[frozenset[str]] = frozenset()
    #: Whether its observers add constants to their outputs, which its own checks cover.
    adds_constants: ClassVar[bool] = False
    #: Purposes for which `auto` considers the method; without any, it is designed only by its name.
    purposes: ClassVar[frozenset[Purpose]] = frozenset()
    #: Claims that the options impose and that are proved, in contrast to results of a search.
    imposed: ClassVar[frozenset[str]] = frozenset()
    #: Whether an option ``mean`` adds averaging registers to the observer, which the checks leave out.
    averaged: ClassVar[bool] = False
    #: Whether `synthesise` accepts a ``scenario`` for plants whose constants have tolerances.
    over_scenario: ClassVar[bool] = False
    #: Whether its designs are models without feedback, of whose stability nothing is claimed.
    open_loop: ClassVar[bool] = False
    #: Further entries that its designs store among the options.
    recorded: ClassVar[frozenset[str]] = frozenset()
    #: Which of the options decay, region and poles refer to the eigenvalues of its linear observers.
    placed: ClassVar[frozenset[str]] = frozenset()
    #: Values of required options, for existence conditions that do not depend on them.
    placeholders: ClassVar[Mapping[str, Any]] = {}

    def __post_init__(self) -> None:
        kinds = field_types(type(self))
        problems = [text for name, kind in kinds.items() if (text := problem_with(getattr(self, name), name, kind))]
        # Rules that involve several options assume that each of them has its type.
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
        """Yield a sentence for each violated rule that involves several options."""
        yield from ()

    @abstractmethod
    def existence(self, plant: Any, *, exactly: bool = True) -> tuple[Condition, ...]:
        """Return the existence conditions for a plant and these options, decided exactly or in floating point."""

    def require_stated(self, plant: Any) -> None:
        """Raise an error if a design needs data that neither the plant nor the options state."""
        return None

    def require_fitting(self, plant: Any) -> None:
        """Raise `SpecError` if options name signals that the plant does not have, or are matrices of wrong sizes."""
        return None

    def is_for_states_as_written(self, plant: DescriptorSystem) -> bool:
        """Whether options refer to the original states of a plant of index 2 or more, so that it is not reduced."""
        return False

    def for_plant(self, plant: DescriptorSystem) -> Self:
        """Return the method without options that have no meaning for a plant with fewer faults."""
        return self

    def synthesise(self, plant: Any, *, progress: Callable[[str], None]) -> Synthesis:
        """Return gains, observer and certificate, not yet verified.

        By default this calls ``synthesise(plant, method, progress=)`` of the module ``synthesis`` in the method's own
        package, which is heavy and imported only here.
        """
        package = type(self).__module__.rpartition(".")[0]
        synthesis: Synthesis = import_module(f"{package}.synthesis").synthesise(plant, self, progress=progress)
        return synthesis

    @classmethod
    def from_gains(cls, plant: Any) -> Synthesis:
        """Return realisation and certificate of given gains, by their names in the notation of the paper."""
        raise SpecError(f"Gains of {cls.id} are not read: design it instead.", path="method")

    @classmethod
    def checks(cls, design: ObserverDesign, printed_digits: int | None) -> Iterator[Check]:
        """Yield a row for each claim, from the plant and the shipped realisation alone.

        By default this calls ``checks(design, printed_digits)`` of the module ``checks`` in the method's own package.
        """
        package = cls.__module__.rpartition(".")[0]
        rows: Iterator[Check] = import_module(f"{package}.checks").checks(design, printed_digits)
        return rows

    @classmethod
    def requested_limits(cls, design: ObserverDesign) -> Limits:
        """Return, by option, the claims of a design that the option bounds; `verify` compares them."""
        return {}

    @classmethod
    def fixed_modes(cls, design: ObserverDesign) -> tuple[complex, ...]:
        """Return the eigenvalues of a linear observer that no gain can move; the option decay excludes them."""
        return ()

    @classmethod
    def has_error_model(cls, design: ObserverDesign) -> bool:
        """Whether the errors of a linear design have an error model; not if it relies on bounds of the states."""
        return True

    @classmethod
    def error_model(cls, design: ObserverDesign) -> ErrorModel | None:
        """Return the error model of the shipped observer; ``None`` if it is not linear, or the certificate lacks it.

        Every linear design for which `has_error_model` is true needs one, and `verify` checks it.
        """
        return None

    @classmethod
    def constant_fault_gain(cls, design: ObserverDesign, model: ErrorModel) -> FloatArray:
        """Return the steady-state estimates ``(nf, nf)`` of constant faults of size one; NaN columns if unknown.

        By default these are the faults themselves, if the fault model of the observer contains a constant."""
        return held_faults(model)

    def as_given(self) -> dict[str, Any]:
        """Return every option by name."""
        return {option.name: getattr(self, option.name) for option in fields(self)}

    def as_plain(self) -> dict[str, Any]:
        """Return every option by name, as lists, mappings, numbers and texts."""
        return {name: plain(value) for name, value in self.as_given().items()}


def _near(unknown: str, known: list[str]) -> str:
    """Return the end of a message on an unknown option: a similar one that may be meant."""
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
