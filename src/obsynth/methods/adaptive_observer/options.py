"""Options of the adaptive observer of time-varying plants."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Annotated, Any, ClassVar

from obsynth.methods.descriptor_kalman.options import DescriptorKalmanOptions
from obsynth.numerics.arguments import Count, ForgettingFactor, Probability, WrittenAs
from obsynth.observers.recursive.settings import Form, Guard


@dataclass(frozen=True)
class AdaptiveObserverOptions(DescriptorKalmanOptions):
    """Options of the method as asked for; see `obsynth.adaptive_observer`."""

    METHOD: ClassVar[str] = "adaptive-observer"

    forgetting: ForgettingFactor = 0.98
    form: Form = "innovation"
    guard: Guard | None = None
    random_walk: Annotated[Any, WrittenAs("covariance")] = None
    initial_parameters: Annotated[Any, WrittenAs("vector")] = None
    initial_parameter_covariance: Annotated[Any, WrittenAs("covariance")] = None
    window: Count = 50
    reset: Probability = 0.0

    def conflicts(self) -> Iterator[str]:
        """Yield a sentence for each rule across options that is broken."""
        if self.form == "random-walk" and self.random_walk is None:
            yield "form 'random-walk' needs random_walk, the variance of one step of each parameter."
        if self.form != "random-walk" and self.random_walk is not None:
            yield "random_walk belongs to form 'random-walk': the other forms forget instead."
        if self.form == "random-walk" and self.reset:
            yield "reset belongs to the forms that forget: the random walk follows by itself."
