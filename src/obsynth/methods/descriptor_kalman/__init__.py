"""The descriptor Kalman filter as a method."""

from __future__ import annotations

from obsynth.methods.method_spec import MethodSpec
from obsynth.methods.recursive import RECURSIVE_CLAIMS

METHOD = MethodSpec(
    id="descriptor-kalman",
    folder=__package__,
    plants=("time-invariant", "time-varying"),
    time="discrete, time-varying",
    summary="states with honest deviations",
    source="Nikoukhah, Willsky, Levy 1992",
    options=".options:DescriptorKalmanOptions",
    checks="obsynth.methods.recursive.checks:checks",
    claims=RECURSIVE_CLAIMS,
)
