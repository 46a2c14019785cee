"""The declaration: one line in the registry leads here."""

from obsynth.methods.method_spec import ClaimMeaning, MethodSpec

METHOD = MethodSpec(
    id="luenberger-observer",
    plants=("time-invariant",),
    time="discrete",
    summary="states, where every state is measured",
    source="Luenberger 1964",
    public="luenberger_method.synthesis:luenberger_observer",
    options="luenberger_method.options:LuenbergerOptions",
    conditions="luenberger_method.synthesis:conditions",
    synthesise="luenberger_method.synthesis:synthesise",
    checks="luenberger_method.checks:checks",
    claims={"radius": ClaimMeaning("", "spectral radius of the error", "radius")},
)
