"""The adaptive observer of nonlinear plants as a method."""

from __future__ import annotations

from obsynth.methods.method_spec import ClaimMeaning, MethodSpec

CLAIMS = {
    "index": ClaimMeaning("", "index of the plant", "claims"),
    "condition": ClaimMeaning("", "largest condition number of (7) along the nominal run", "claims"),
    "contraction": ClaimMeaning("", "spectral radius of F (I - K H) at its end", "claims"),
    "steps": ClaimMeaning("samples", "steps of the nominal run", "claims"),
}

METHOD = MethodSpec(
    id="dae-adaptive-observer",
    folder=__package__,
    plants=("nonlinear",),
    time="discrete, nonlinear",
    summary="states and parameters of nonlinear plants",
    source="Moussa Ali, Zhang 2013 (differential-algebraic systems)",
    options=".options:DaeAdaptiveObserverOptions",
    claims=CLAIMS,
)
