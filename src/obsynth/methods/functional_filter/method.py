"""The functional filter as a method."""

from __future__ import annotations

from obsynth.methods.method_spec import ClaimMeaning, MethodSpec

CLAIMS = {
    "order": ClaimMeaning("", "states of the filter", "order"),
    "decay": ClaimMeaning("1/s", "rate of the slowest pole: every error decays at least like this in the end", "decay"),
}

METHOD = MethodSpec(
    id="functional-filter",
    plants=("time-invariant",),
    time="both",
    summary="the faults asked for and nothing else, untouched by any unknown input; needs not the whole state",
    source="ours, after Frisk, Nyberg 2001 and Anderson, Moore 1979",
    public="obsynth.methods.functional_filter.public:functional_filter",
    options="obsynth.methods.functional_filter.options:FunctionalFilterOptions",
    conditions="obsynth.methods.functional_filter.conditions:conditions",
    synthesise="obsynth.methods.functional_filter.synthesis:synthesise",
    checks="obsynth.methods.functional_filter.checks:checks",
    claims=CLAIMS,
    witnesses=frozenset({"T", "T0", "Phi", "Cw", "walks", "stability", "tracking", "deviations"}),
    tracked="obsynth.methods.functional_filter.checks:tracked_plant",
)
