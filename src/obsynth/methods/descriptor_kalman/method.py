"""The descriptor Kalman filter as a method."""

from __future__ import annotations

from obsynth.methods.method_spec import MethodSpec
from obsynth.methods.recursive import RECURSIVE_CLAIMS

METHOD = MethodSpec(
    id="descriptor-kalman",
    plants=("time-invariant", "time-varying"),
    time="discrete, time-varying",
    summary="states with honest deviations",
    source="Nikoukhah, Willsky, Levy 1992",
    public="obsynth.methods.descriptor_kalman.public:descriptor_kalman",
    options="obsynth.methods.descriptor_kalman.options:DescriptorKalmanOptions",
    conditions="obsynth.methods.descriptor_kalman.synthesis:conditions",
    synthesise="obsynth.methods.descriptor_kalman.synthesis:synthesise",
    checks="obsynth.methods.recursive.checks:checks",
    claims=RECURSIVE_CLAIMS,
)
