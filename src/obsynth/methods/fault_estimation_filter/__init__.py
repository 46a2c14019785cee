"""The fault-estimation filter as a method."""

from __future__ import annotations

from obsynth.methods.fault_estimation_filter.least_gain_proof import WITNESSES
from obsynth.methods.method_spec import ClaimMeaning, MethodSpec

CLAIMS = {
    "gamma": ClaimMeaning("", "l2 gain from the disturbance to the fault error: shipped, proved", "LMI"),
    "gamma_min": ClaimMeaning("", "least such gain found; proved where a row says so", "least gain"),
    "gamma_bracket_low": ClaimMeaning("", "lower end of the bisection's bracket", "claimed gains"),
    "gamma_bracket_high": ClaimMeaning("", "upper end of the bisection's bracket", "claimed gains"),
    "state_lag": ClaimMeaning("samples", "samples by which the state estimate lags", "unbiased: state"),
}

METHOD = MethodSpec(
    id="fault-estimation-filter",
    folder=__package__,
    plants=("time-invariant",),
    time="discrete",
    summary="fault estimates with a bounded gain from the disturbances",
    source="Wang, Rodrigues, Theilliol, Shen 2015",
    options=".options:FilterOptions",
    claims=CLAIMS,
    witnesses=WITNESSES | {"P_factor", "tracking", "T0"},
    tracked=".checks:tracked_plant",
    averaged=True,
)
