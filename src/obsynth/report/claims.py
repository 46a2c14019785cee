"""What the numbers that a design claims mean, in words."""

from __future__ import annotations

_RECURSIVE = {
    "condition": "largest condition number of [E_k; C_k]",
    "condition_k": "step at which it is",
    "residual_directions": "least rank E_k + ny - nx: what the literal form (18) sees",
    "contraction": "mean factor per step by which an error shrinks",
    "steps": "steps that were looked at",
}
#: Method id -> claim -> meaning.
_MEANINGS = {
    "fault-estimation-filter": {
        "gamma": "l2 gain from the disturbance to the fault error: shipped, proved",
        "gamma_min": "least such gain found",
        "gamma_bracket_low": "lower end of the bisection's bracket",
        "gamma_bracket_high": "upper end of the bisection's bracket",
        "state_lag": "samples by which the state estimate lags",
    },
    "pd-observer": {
        "theorem": "theorem whose inequality is proved",
        "delta": "s, the theorem's parameter in the certificate",
        "decay": "1/s, rate at which errors die out: imposed, proved (0: stability alone)",
        "disk_centre": "1/s, c of the disk |s + c| < r that holds every eigenvalue",
        "disk_radius": "1/s, r of that disk",
        "gain_bound": "bound on the norm of the gains",
        "fault_rate_gain": "s, bound on the l2 gain from the rate of the faults to the fault error: proved",
        "noise_gain": "bound on the l2 gain from noise and its derivative to the fault error: proved",
        "adaptation_low": "stable for every adaptation gain from here, proved",
        "adaptation_high": "to here",
    },
    "ui-pi-observer": {
        "decay": "rate of the slowest pole, 1/s: every error decays at least like this in the end",
        "noise_amplification": "H2 norm from unit white noise on every output to the noisiest fault estimate",
        "noise_price": "noise of the fault estimates against the quietest Kalman filter of the same plant",
        "condition": "condition number of the (generalised) eigenvectors",
    },
    "descriptor-kalman": _RECURSIVE,
    "adaptive-observer": {
        **_RECURSIVE,
        "excitation": "least information on the parameters in a window, per parameter unit squared",
        "excitation_k": "sample that ends that window",
    },
    "dae-adaptive-observer": {
        "index": "index of the plant",
        "condition": "largest condition number of (7) along the nominal run",
        "contraction": "spectral radius of F (I - K H) at its end",
        "steps": "steps of the nominal run",
    },
}

#: Method id -> paper whose letters the gains have.
_SOURCES = {
    "fault-estimation-filter": "Wang, Rodrigues, Theilliol, Shen 2015",
    "pd-observer": "Filasova, Krokavec, Serbak",
    "ui-pi-observer": "Share Pasand, Aliyari, Taghirad",
    "descriptor-kalman": "Nikoukhah, Willsky, Levy 1992",
    "adaptive-observer": "Moussa Ali, Zhang 2013",
    "dae-adaptive-observer": "Moussa Ali, Zhang 2013 (differential-algebraic systems)",
}


def source_of(method: str) -> str:
    """Return the paper that a method comes from; empty for an unknown one."""
    return _SOURCES.get(method, "")


def meaning_of(method: str, claim: str) -> str:
    """Return what a claim means; empty when the method has no such claim."""
    return _MEANINGS.get(method, {}).get(claim, "")
