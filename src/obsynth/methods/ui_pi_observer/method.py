"""The unknown-input PI observer as a method."""

from __future__ import annotations

from obsynth.methods.method_spec import ClaimMeaning, MethodSpec
from obsynth.verification.claims import STATED

CLAIMS = {
    "decay": ClaimMeaning("1/s", "rate of the slowest pole: every error decays at least like this in the end", "decay"),
    "noise_amplification": ClaimMeaning(
        "", "H2 norm from unit white noise on every output to the noisiest fault estimate", "noise amplification"
    ),
    "noise_price": ClaimMeaning(
        "", "noise of the fault estimates against the quietest Kalman filter of the same plant", STATED
    ),
    "condition": ClaimMeaning("", "condition number of the (generalised) eigenvectors", STATED),
}

METHOD = MethodSpec(
    id="ui-pi-observer",
    plants=("time-invariant",),
    time="both",
    summary="state and faults untouched by any unknown input",
    source="Share Pasand, Aliyari, Taghirad",
    public="obsynth.methods.ui_pi_observer.public:ui_pi_observer",
    options="obsynth.methods.ui_pi_observer.options:UiPiOptions",
    conditions="obsynth.methods.ui_pi_observer.synthesis:conditions",
    synthesise="obsynth.methods.ui_pi_observer.synthesis:synthesise",
    checks="obsynth.methods.ui_pi_observer.checks:checks",
    claims=CLAIMS,
    witnesses=frozenset({"tracking", "Phi", "Cw", "poles", "stability", "T0"}),
    tracked="obsynth.methods.ui_pi_observer.checks:tracked_plant",
)
