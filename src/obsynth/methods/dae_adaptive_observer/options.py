"""Options of the adaptive observer of nonlinear plants."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Annotated, Any, ClassVar, Literal, TypeAlias

from obsynth.methods.method_spec import MethodOptions
from obsynth.numerics.arguments import Count, ForgettingFactor, Positive, Probability, WrittenAs
from obsynth.observers.dae.settings import Guard, Weight
from obsynth.observers.outliers import Outliers

FormChoice: TypeAlias = Literal["forgetting", "random-walk", "augmented-kalman", "auto"]
IntegrationChoice: TypeAlias = Literal["backward-euler", "radau", "auto"]


@dataclass(frozen=True)
class DaeAdaptiveObserverOptions(MethodOptions):
    """Options of the method as asked for; see `obsynth.dae_adaptive_observer`."""

    METHOD: ClassVar[str] = "dae-adaptive-observer"

    dt: Positive | None = None
    Q: Annotated[Any, WrittenAs("named covariance")] = None
    R: Annotated[Any, WrittenAs("named covariance")] = None
    form: FormChoice = "auto"
    forgetting: ForgettingFactor = 0.98
    guard: Guard = "regularise"
    weight: Weight = "innovation"
    integration: IntegrationChoice = "auto"
    random_walk: Annotated[Any, WrittenAs("named covariance")] = None
    initial_state: Annotated[Any, WrittenAs("named vector")] = None
    initial_covariance: Annotated[Any, WrittenAs("named covariance")] = None
    initial_parameters: Annotated[Any, WrittenAs("named vector")] = None
    initial_parameter_covariance: Annotated[Any, WrittenAs("named covariance")] = None
    bounds: Annotated[Any, WrittenAs("named pairs")] = None
    largest_move: Positive | None = None
    window: Count = 50
    outliers: Outliers = "none"
    outlier_limit: Positive | None = None
    sensors: Annotated[Any, WrittenAs("sensor times")] = None
    state_bounds: Annotated[Any, WrittenAs("named pairs")] = None
    reset: Probability = 0.0

    def conflicts(self) -> Iterator[str]:
        """Yield a sentence for each rule across options that is broken."""
        if self.dt is None:
            yield "dt is missing: give the seconds between samples."
        if self.form == "forgetting" and self.random_walk is not None:
            yield (
                "random_walk belongs to the forms 'random-walk' and 'augmented-kalman': form 'forgetting' forgets "
                "instead."
            )
