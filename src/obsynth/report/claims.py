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
    "descriptor-kalman": _RECURSIVE,
    "adaptive-observer": {
        **_RECURSIVE,
        "excitation": "least information on the parameters in a window, per parameter unit squared",
        "excitation_k": "sample that ends that window",
    },
}


def meaning_of(method: str, claim: str) -> str:
    """Return what a claim means; empty when the method has no such claim.

    Parameters
    ----------
    method : str
        Method id.
    claim : str
        Name of the claim.
    """
    return _MEANINGS.get(method, {}).get(claim, "")
