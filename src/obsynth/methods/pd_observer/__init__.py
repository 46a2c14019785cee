"""The PD observer as a method."""

from __future__ import annotations

from obsynth.methods.method_spec import ClaimMeaning, MethodSpec

CLAIMS = {
    "theorem": ClaimMeaning("", "theorem whose inequality is proved", "LMI"),
    "delta": ClaimMeaning("s", "the theorem's parameter in the certificate", "LMI"),
    "decay": ClaimMeaning("1/s", "rate at which errors die out: imposed, proved (0: stability alone)", "LMI"),
    "disk_centre": ClaimMeaning("1/s", "c of the disk |s + c| < r that holds every eigenvalue", "disk"),
    "disk_radius": ClaimMeaning("1/s", "r of that disk", "disk"),
    "gain_bound": ClaimMeaning("", "bound on the norm of the gains", "gain bound"),
    "fault_rate_gain": ClaimMeaning(
        "s", "bound on the l2 gain from the rate of the faults to the fault error: proved", "LMI, rate"
    ),
    "noise_gain": ClaimMeaning(
        "", "bound on the l2 gain from noise and its derivative to the fault error: proved", "LMI, noise"
    ),
    "adaptation_low": ClaimMeaning("", "stable for every adaptation gain from here, proved", "adaptation range"),
    "adaptation_high": ClaimMeaning("", "to here", "adaptation range"),
}

METHOD = MethodSpec(
    id="pd-observer",
    folder=__package__,
    plants=("time-invariant",),
    time="continuous",
    summary="states and faults by proportional and derivative action, no derivative taken",
    source="Filasova, Krokavec, Serbak",
    options=".options:PdOptions",
    claims=CLAIMS,
    witnesses=frozenset({"P1", "P3", "P_rate", "P_noise", "P1_low", "P1_high", "T0"}),
    tracked=".checks:tracked_plant",
)
