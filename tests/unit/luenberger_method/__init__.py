"""The declaration: one line in the registry leads here."""

from obsynth.methods.method_spec import ClaimMeaning, MethodSpec

METHOD = MethodSpec(
    id="luenberger-observer",
    folder=__package__,
    plants=("time-invariant",),
    time="discrete",
    summary="states, where every state is measured",
    source="Luenberger 1964",
    public=".synthesis:luenberger_observer",
    options=".options:LuenbergerOptions",
    claims={"radius": ClaimMeaning("", "spectral radius of the error", "radius")},
)
