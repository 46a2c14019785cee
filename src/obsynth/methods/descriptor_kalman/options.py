"""Options of the descriptor Kalman filter."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Any, ClassVar

from obsynth.methods.method_spec import MethodOptions
from obsynth.numerics.arguments import Positive, WrittenAs
from obsynth.observers.outliers import Outliers


@dataclass(frozen=True)
class DescriptorKalmanOptions(MethodOptions):
    """Options of the method as asked for; see `obsynth.descriptor_kalman`."""

    METHOD: ClassVar[str] = "descriptor-kalman"

    Q: Annotated[Any, WrittenAs("varying covariance")] = None
    R: Annotated[Any, WrittenAs("varying covariance")] = None
    initial_state: Annotated[Any, WrittenAs("vector")] = None
    initial_covariance: Annotated[Any, WrittenAs("covariance")] = None
    early_constraints: bool = False
    outliers: Outliers = "none"
    outlier_limit: Positive | None = None
    sensors: Annotated[Any, WrittenAs("sensor times")] = None
    state_bounds: Annotated[Any, WrittenAs("named pairs")] = None
