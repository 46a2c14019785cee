"""The adaptive observer as a method."""

from __future__ import annotations

from obsynth.methods.method_spec import ClaimMeaning, MethodSpec
from obsynth.methods.recursive import RECURSIVE_CLAIMS

CLAIMS = {
    **RECURSIVE_CLAIMS,
    "excitation": ClaimMeaning(
        "", "least information on the parameters in a window, per parameter unit squared", "claims"
    ),
    "excitation_k": ClaimMeaning("samples", "sample that ends that window", "claims"),
}

METHOD = MethodSpec(
    id="adaptive-observer",
    folder=__package__,
    plants=("time-invariant", "time-varying"),
    time="discrete, time-varying",
    summary="states and parameters with honest deviations",
    source="Moussa Ali, Zhang 2013",
    options=".options:AdaptiveObserverOptions",
    checks="obsynth.methods.recursive.checks:checks",
    claims=CLAIMS,
)
