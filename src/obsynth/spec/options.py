"""The options of every method as a spec gives them.

This module imports pydantic, so it is imported only when a spec is read.
"""

from __future__ import annotations

from typing import Annotated, Any, Literal

from pydantic import Field

from obsynth.spec.schema_values import Covariance, Matrix, Positive, Section, Text, VaryingCovariance


class FaultEstimationFilterOptions(Section):
    """Options of the method ``fault-estimation-filter``."""

    gamma: Positive | None = None
    gamma_search: Literal["direct", "bisection"] = "direct"
    gamma_margin: Positive = 0.05
    free_residual_weight: bool | None = None
    residual_weight_limit: Positive | None = None
    S: Matrix | None = None
    engine: Literal["auto", "riccati", "lmi"] = "auto"
    solver: Literal["auto", "SCHUR", "CLARABEL", "SCS"] = "auto"
    tolerance: Annotated[float, Field(gt=0.0, lt=1.0)] = 1e-6


Two = Annotated[list[float], Field(min_length=2, max_length=2)]


class PdObserverOptions(Section):
    """Options of the method ``pd-observer``."""

    theorem: Literal[1, 2] = 1
    delta: Positive | None = None
    decay: Annotated[float, Field(ge=0.0)] | None = None
    disk: Two | None = None
    gain_bound: Positive | None = None
    fault_rate_gain: Positive | None = None
    noise_gain: Positive | None = None
    adaptation_gain: Matrix | None = None
    adaptation_range: Two | None = None
    delta_scan: Annotated[list[Positive], Field(min_length=1)] | None = None
    engine: Literal["auto", "lmi", "reduced-lmi", "riccati"] = "auto"
    solver: Literal["CLARABEL", "SCS"] = "CLARABEL"


class PoleRegion(Section):
    """Where all movable poles must lie."""

    decay: Annotated[float, Field(ge=0.0)] | None = None
    radius: Positive | None = None
    damping: Annotated[float, Field(gt=0.0, lt=1.0)] | None = None


class NoiseSection(Section):
    """What the Kalman filter believes."""

    measurement: Positive | list[Positive] | dict[Text, Positive] | None = None
    process: Positive = 1.0
    fault: Positive = 1.0


class UiPiObserverOptions(Section):
    """Options of the method ``ui-pi-observer``; the fault model is checked by `obsynth.plants.fault_models`."""

    fault_model: Text | dict[Text, Any] = "step"
    poles: list[float | Annotated[list[float], Field(min_length=2, max_length=2)]] | None = None
    decay: Annotated[float, Field(ge=0.0)] | None = None
    region: PoleRegion | None = None
    noise: NoiseSection | None = None
    objective: Literal["conditioning", "gain"] = "conditioning"
    joint: bool = False
    E_sharp: Matrix | None = None
    C_sharp: Matrix | None = None
    G: Matrix | None = None
    solver: Literal["CLARABEL", "SCS"] = "CLARABEL"


class DescriptorKalmanOptions(Section):
    """Options of the method ``descriptor-kalman``."""

    Q: VaryingCovariance | None = None
    R: VaryingCovariance | None = None
    initial_state: list[float] | None = None
    initial_covariance: Covariance | None = None
    early_constraints: bool = False


class AdaptiveObserverOptions(DescriptorKalmanOptions):
    """Options of the method ``adaptive-observer``."""

    forgetting: Annotated[float, Field(gt=0.0, le=1.0)] = 0.98
    form: Literal["innovation", "literal", "random-walk"] = "innovation"
    guard: Literal["regularise", "directional", "none"] | None = None
    random_walk: Covariance | None = None
    initial_parameters: list[float] | None = None
    initial_parameter_covariance: Covariance | None = None
    window: Annotated[int, Field(ge=1)] = 50
    reset: Annotated[float, Field(ge=0.0, lt=1.0)] = 0.0


Named = Positive | Matrix | dict[Text, Annotated[float, Field(ge=0.0)]]
NamedVector = list[float] | dict[Text, float]


class DaeAdaptiveObserverOptions(Section):
    """Options of the method ``dae-adaptive-observer``: covariances as matrices, or variances by name."""

    dt: Positive | None = None
    Q: Named | None = None
    R: Named | None = None
    form: Literal["forgetting", "random-walk", "augmented-kalman"] = "forgetting"
    forgetting: Annotated[float, Field(gt=0.0, le=1.0)] = 0.98
    guard: Literal["regularise", "none"] = "regularise"
    weight: Literal["innovation", "paper"] = "innovation"
    integration: Literal["backward-euler", "radau"] = "backward-euler"
    random_walk: Named | None = None
    initial_state: NamedVector | None = None
    initial_covariance: Named | None = None
    initial_parameters: NamedVector | None = None
    initial_parameter_covariance: Named | None = None
    bounds: dict[Text, Two] | None = None
    largest_move: Positive | None = None
    window: Annotated[int, Field(ge=1)] = 50


#: Options of every method, by its identifier.
METHOD_OPTIONS: dict[str, type[Section]] = {
    "fault-estimation-filter": FaultEstimationFilterOptions,
    "pd-observer": PdObserverOptions,
    "ui-pi-observer": UiPiObserverOptions,
    "descriptor-kalman": DescriptorKalmanOptions,
    "adaptive-observer": AdaptiveObserverOptions,
    "dae-adaptive-observer": DaeAdaptiveObserverOptions,
}
