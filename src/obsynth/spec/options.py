"""The options of every method as a spec gives them.

This module imports pydantic, so it is imported only when a spec is read.
"""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field

from obsynth.spec.schema import Matrix, Positive, Section, VaryingMatrix


class FaultEstimationFilterOptions(Section):
    """Options of the method ``fault-estimation-filter``."""

    gamma: Positive | None = None
    gamma_search: Literal["direct", "bisection"] = "direct"
    gamma_margin: Positive = 0.05
    free_residual_weight: bool | None = None
    residual_weight_limit: Positive | None = None
    S: Matrix | None = None
    solver: Literal["CLARABEL", "SCS"] = "CLARABEL"
    tolerance: Annotated[float, Field(gt=0.0, lt=1.0)] = 1e-6


class DescriptorKalmanOptions(Section):
    """Options of the method ``descriptor-kalman``."""

    Q: VaryingMatrix | None = None
    R: VaryingMatrix | None = None
    initial_state: list[float] | None = None
    initial_covariance: Matrix | None = None
    early_constraints: bool = False


class AdaptiveObserverOptions(DescriptorKalmanOptions):
    """Options of the method ``adaptive-observer``."""

    forgetting: Annotated[float, Field(gt=0.0, le=1.0)] = 0.98
    form: Literal["innovation", "literal", "random-walk"] = "innovation"
    guard: Literal["regularise", "directional", "none"] | None = None
    random_walk: Matrix | None = None
    initial_parameters: list[float] | None = None
    initial_parameter_covariance: Matrix | None = None
    window: Annotated[int, Field(ge=1)] = 50
    reset: Annotated[float, Field(ge=0.0, lt=1.0)] = 0.0


#: Options of every method, by its identifier.
METHOD_OPTIONS: dict[str, type[Section]] = {
    "fault-estimation-filter": FaultEstimationFilterOptions,
    "descriptor-kalman": DescriptorKalmanOptions,
    "adaptive-observer": AdaptiveObserverOptions,
}
