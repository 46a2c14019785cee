"""What the numbers that a design claims mean, in words."""

from __future__ import annotations

#: Method id -> claim -> meaning.
_MEANINGS = {
    "fault-estimation-filter": {
        "gamma": "l2 gain from the disturbance to the fault error: shipped, proved",
        "gamma_min": "least such gain found",
        "gamma_bracket_low": "lower end of the bisection's bracket",
        "gamma_bracket_high": "upper end of the bisection's bracket",
        "state_lag": "samples by which the state estimate lags",
    },
    "ui-pi-observer": {
        "decay": "rate of the slowest pole, 1/s: every error decays at least like this in the end",
        "noise_amplification": "H2 norm from unit white noise on every output to the noisiest fault estimate",
        "noise_price": "noise of the fault estimates against the quietest Kalman filter of the same plant",
        "condition": "condition number of the (generalised) eigenvectors",
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
