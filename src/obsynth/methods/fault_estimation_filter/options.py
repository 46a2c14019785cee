"""Options of the fault-estimation filter, checked before anything is computed."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Annotated, Any, ClassVar, Literal

from annotated_types import Ge

from obsynth.methods.method_spec import MethodOptions
from obsynth.numerics.arguments import FewSamples, OpenUnitInterval, Positive, WrittenAs

#: The least relative distance to the optimum at which a proof can be expected: less leaves no room for one.
LEAST_MARGIN = 1e-2


@dataclass(frozen=True)
class FilterOptions(MethodOptions):
    """Options of the method as asked for; see `obsynth.fault_estimation_filter`."""

    METHOD: ClassVar[str] = "fault-estimation-filter"

    gamma: Positive | None = None
    gamma_search: Literal["direct", "bisection"] = "direct"
    gamma_margin: Annotated[float, Ge(LEAST_MARGIN)] = 0.05
    free_residual_weight: bool | None = None
    residual_weight_limit: Positive | None = None
    S: Annotated[Any, WrittenAs("matrix")] = None
    engine: Literal["auto", "riccati", "lmi"] = "auto"
    solver: Literal["auto", "SCHUR", "CLARABEL", "SCS"] = "auto"
    tolerance: OpenUnitInterval = 1e-6
    mean: Annotated[FewSamples, Ge(1)] = 1
    model_error: Literal["none", "columns"] = "none"

    def conflicts(self) -> Iterator[str]:
        """Yield a sentence for each rule across options that is broken."""
        if self.residual_weight_limit is not None and self.free_residual_weight is False:
            yield "residual_weight_limit needs free_residual_weight: the weight is fixed otherwise."
        if self.residual_weight_limit is not None and self.engine == "riccati":
            yield "residual_weight_limit is not covered by engine 'riccati': use 'auto' or 'lmi'."
