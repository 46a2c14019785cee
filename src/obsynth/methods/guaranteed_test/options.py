"""The options of a guaranteed test, each with its range; the method's docstring has their meaning."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Any, Literal

from annotated_types import Ge, Le

from obsynth.numerics.arguments import FewSamples, Positive, WrittenAs


@dataclass(frozen=True)
class TestOptions:
    """Options as asked for."""

    fault: Annotated[Any, WrittenAs("text")] = None
    samples: Annotated[Any, WrittenAs("samples")] = "auto"
    course: Literal["step", "constant", "any", "ramp", "rate"] = "step"
    lag: FewSamples | None = None
    before: FewSamples = 10
    after: Annotated[int, Ge(1), Le(1000)] | None = None
    disturbance_bounds: Annotated[Any, WrittenAs("named bounds")] = None
    noise_bound: Annotated[Any, WrittenAs("named bounds")] = None
    disturbance: Literal["any", "jump", "held", "rate"] = "any"
    disturbance_rate: Annotated[Any, WrittenAs("named bounds")] = None
    fault_rate: Positive | None = None
    state_bounds: Annotated[Any, WrittenAs("named bounds")] = None
    initial_bounds: Annotated[Any, WrittenAs("named bounds")] = None
    free: Annotated[Any, WrittenAs("free faults")] = "others"
    free_course: Literal["any", "constant"] = "any"
    norm: Literal["box", "ellipsoid"] = "box"
    isolate: bool = False
    exact: bool = False
    missing: Literal["wait", "solve"] = "wait"
    region: Annotated[Any, WrittenAs("named pairs")] = None
    sample_time: Positive | None = None
    given: Annotated[Any, WrittenAs("named vector")] = None
    model: Annotated[Any, WrittenAs("function")] = None
