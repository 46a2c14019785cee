"""The functional filter as a method."""

from __future__ import annotations

from obsynth.methods.method_spec import ClaimMeaning, MethodSpec

CLAIMS = {
    "order": ClaimMeaning("", "states of the filter", "order"),
    "decay": ClaimMeaning("1/s", "rate of the slowest pole: every error decays at least like this in the end", "decay"),
}

METHOD = MethodSpec(
    id="functional-filter",
    folder=__package__,
    plants=("time-invariant",),
    time="both",
    summary="the faults asked for and nothing else, untouched by any unknown input; needs not the whole state",
    source="ours, after Frisk, Nyberg 2001 and Anderson, Moore 1979",
    options=".options:FunctionalFilterOptions",
    conditions=".conditions:conditions",
    claims=CLAIMS,
    witnesses=frozenset({"T", "T0", "Phi", "Cw", "walks", "stability", "tracking", "deviations"}),
    tracked=".checks:tracked_plant",
)
