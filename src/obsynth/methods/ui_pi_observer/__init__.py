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
    "digits": ClaimMeaning(
        "",
        "significant digits in which Ahat has to be kept, where more than 9 are needed",
        "stable with the claimed digits",
    ),
    "condition": ClaimMeaning("", "condition number of the (generalised) eigenvectors", STATED),
}

METHOD = MethodSpec(
    id="ui-pi-observer",
    folder=__package__,
    plants=("time-invariant",),
    time="both",
    summary="state and faults untouched by any unknown input",
    source="Share Pasand, Aliyari, Taghirad",
    options=".options:UiPiOptions",
    claims=CLAIMS,
    witnesses=frozenset({"tracking", "Phi", "Cw", "poles", "stability", "T0"}),
    tracked=".checks:tracked_plant",
)
