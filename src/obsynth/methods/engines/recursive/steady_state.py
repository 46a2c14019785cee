"""Proofs on the last gains of a recursive observer as constant gains, for plants with constant matrices and noise.

The gains make errors of mean zero, errors decay, and the covariance that they reach is enclosed: the filter's own,
whose gains move on, ends at or below it.
"""

from __future__ import annotations

import warnings
from collections.abc import Iterator, Mapping
from dataclasses import replace

import numpy as np

from obsynth.analysis.existence.recursive import SOURCE
from obsynth.methods.engines.recursive.horizon_proof import (
    definite_by_its_noise,
    largest_bias,
    natural_units,
    noise_is_definite,
)
from obsynth.numerics.arrays import FloatArray
from obsynth.numerics.matrix_equations import discrete_lyapunov
from obsynth.numerics.norms import spectral_radius
from obsynth.observers.recursive.gain_schedule import GainStep
from obsynth.observers.recursive.gain_schedule_summary import CLEARLY_STABLE
from obsynth.observers.recursive.observer import RecursiveObserver
from obsynth.observers.recursive.step_model import StepMatrices
from obsynth.plants.signal_names import listed
from obsynth.proofs.balls import Ball, rounded_up
from obsynth.proofs.contraction import Contraction, column_norms, prove_contraction, proved_rate
from obsynth.proofs.definiteness import prove_positive_definite
from obsynth.results.checks import Check, information, upper_bound_check
from obsynth.verification.identities import EQUALITY_TOLERANCE

#: An enclosure of variances that is wider than this share of the filter's says nothing about definiteness.
WIDEST = 0.1

#: So many deviations are listed in a row.
LISTED_DEVIATIONS = 6

#: Both ends are reported where the upper one is so many times the lower one.
BOTH_ENDS = 1.001


def steady_rows(
    stated: RecursiveObserver, gains: Mapping[str, FloatArray], recomputed: GainStep, condition: float
) -> Iterator[Check]:
    """Yield the rows on the listed gains, were they kept for ever; of a plant and noise that stay the same."""
    plant = stated.plant
    if not (plant.is_time_invariant and stated.Q.is_constant and stated.R.is_constant) or stated.early_constraints:
        return
    E, A, C, ne = plant.E.at(1), plant.A.at(0), plant.C.at(1), plant.ne
    L, K = gains.get("L", recomputed.gain[:, :ne]), gains.get("K", recomputed.gain[:, ne:])
    if L.shape != (plant.nx, ne) or K.shape != (plant.nx, plant.ny):
        return  # the row on the listed gains says so
    step = StepMatrices(np.vstack([E, C]), A, *recomputed.step[2:])
    listed = recomputed._replace(gain=np.hstack([L, K]))
    yield upper_bound_check(
        "steady state: unbiased",
        "L E + K C = I for the listed gains",
        largest_bias([(step, listed)], natural_units(stated)[: plant.nx]),
        EQUALITY_TOLERANCE * condition,
        source=f"{SOURCE}, (10)-(11)",
        kind="proved",
        detail="in units of its terms, outward rounded",
    )
    transition = Ball.exact(L) @ Ball.exact(A)
    contraction = prove_contraction(transition, discrete=True)
    claim = "errors decay with the listed gains, were they kept: modulus per step in a norm"
    source = f"{SOURCE}, (13); Lyapunov inequality of L A"
    rate = None if contraction is None else proved_rate(transition, contraction)
    # A rate that rounding leaves at one is none.
    if contraction is None or rate is None or not rate < 1.0:
        radius = spectral_radius(transition.midpoint)
        if spectral_radius(recomputed.gain[:, :ne] @ A) >= CLEARLY_STABLE:
            yield information(
                "steady state: contraction",
                claim,
                radius,
                source=source,
                detail="the gains of the last step make no steady filter (yet)",
            )
            return
        yield upper_bound_check(
            "steady state: contraction",
            claim,
            radius,
            np.nextafter(1.0, 0.0),
            source=source,
            detail="eigenvalues computed: no inequality was proved",
        )
        return
    yield upper_bound_check(
        "steady state: contraction",
        claim,
        rate,
        np.nextafter(1.0, 0.0),
        source=source,
        kind="proved",
        detail="outward rounded",
    )
    variances = np.einsum("ij,ij->i", recomputed.factor, recomputed.factor)[: plant.nx]
    yield _steady_covariance(stated, transition, (L, K), contraction, variances)


def _steady_covariance(
    stated: RecursiveObserver,
    transition: Ball,
    gains: tuple[FloatArray, FloatArray],
    contraction: Contraction,
    variances: FloatArray,
) -> Check:
    """Return the row on the covariance that errors reach with kept gains; ``variances (nx,)`` after the last step.

    Of X, with ``D = F X F' + L Q L' + K R K' - X``, the true one is ``X + sum F^j D F'^j``; the sum is at most
    ``|Q D Q'| / (1 - rate^2)`` in the norm of the contraction.
    """

    claim = "covariance of the errors that the listed gains lead to, enclosed: positive definite"
    L, K = (Ball.exact(part) for part in gains)
    noise = L @ Ball.exact(stated.Q.at(0)) @ L.T + K @ Ball.exact(stated.R.at(0)) @ K.T
    with warnings.catch_warnings(action="ignore"):
        # The enclosure says what an ill-conditioned equation costs.
        covariance = discrete_lyapunov(transition.midpoint, noise.midpoint)
    X = Ball.exact((covariance + covariance.T) / 2.0)
    norm = Ball.exact(contraction.Q)
    gap = norm @ (transition @ X @ transition.T + noise - X) @ norm.T
    # One minus the rate squared, in a form that does not cancel: three roundings, which the radius below covers.
    share = (1.0 - contraction.rate) * (1.0 + contraction.rate)
    # Every row of the inverse is seen on its own.
    row_sizes = rounded_up(column_norms(Ball.exact(contraction.inverse).T) / (1.0 - contraction.defect), 4)
    radius = rounded_up(np.outer(row_sizes, row_sizes) * gap.frobenius_norm / share, 8)
    enclosed = Ball(X.midpoint, radius)
    middle, spread = np.diag(X.midpoint), np.diag(radius)
    low, high = np.sqrt(np.maximum(middle - spread, 0.0)), np.sqrt(rounded_up(np.abs(middle) + spread, 4))
    proof = prove_positive_definite(enclosed)
    certain = bool(np.all(spread <= WIDEST * variances))
    deviations = [
        f"{name} {low[i]:.4g} to {high[i]:.4g}" if high[i] > low[i] * BOTH_ENDS else f"{name} {high[i]:.4g}"
        for i, name in enumerate(stated.plant.state_names)
    ]
    detail = (
        f"standard deviations {listed(deviations, most=LISTED_DEVIATIONS)}; the filter itself, whose gains change, "
        "ends at or below these"
    )
    source = "P = L A P A' L' + L Q L' + K R K', outward rounded"
    if proof.proved:
        return Check(
            "steady state: covariance", claim, proof.lower_bound, 0.0, proof.lower_bound, True, source, "proved", detail
        )
    if certain and noise_is_definite(stated):
        plant = stated.plant
        H = np.vstack([plant.E.at(1), plant.C.at(1)])
        row = definite_by_its_noise("steady state: covariance", claim, np.hstack(gains), H, natural_units(stated))
        return replace(row, detail=f"{detail}; {row.detail}")
    return information(
        "steady state: covariance",
        "largest standard deviation that the listed gains lead to, enclosed",
        float(np.max(high, initial=0.0)),
        source=source,
        status="proved",
        detail=detail,
    )
