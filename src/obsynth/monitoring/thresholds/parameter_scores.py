"""Score and information of each sample on parameters that walk, and likelihood ratios of a change of one of them.

A filter follows a fault, and its innovations return to zero.  What a sample alone says of the parameters is what its
update added to their information: ``J = P^-1 - M^-1`` and ``s = P^-1 theta - M^-1 theta_before``, with the covariance P
after and M before it.  Sums of ``s - J c`` over the latest rows are the score of a change from c; their square in units
of the information is twice the log likelihood ratio of a jump at this age (Willsky & Jones 1976).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from obsynth.monitoring.thresholds.monitor import NOT_DISTINGUISHED, Evidence
from obsynth.numerics.arrays import SMALLEST, FloatArray
from obsynth.numerics.autoregression import Autoregression, fitted_autoregression
from obsynth.numerics.ranks import DIRECTION_SHARE, rounding_rank
from obsynth.observers.nonlinear.observer import DAEObserver
from obsynth.observers.recursive.observer import RecursiveObserver

#: A fault is named where a change of it alone is more likely than one of any other by so much in twice the log
#: likelihood (odds of 90), and by this share of its own: where the effect of another fault on the innovations is off by
#: less than 10 % of its size, that one lies behind by less than the square of it (the sine of the angle between them).
DISTINGUISHED, MODEL_SHARE = 9.0, 0.01

#: Share of the information before it that a sample adds at least: less is what rounding leaves of the difference.
LEAST_ADDED = 1e-9


def parameter_walk(observer: Any) -> FloatArray | None:
    """Return the covariance ``(nf, nf)`` by which parameters walk between samples; `None` where estimates do not follow
    from such a walk, or samples arrive late."""
    if not observer.fault_names:
        return None
    if isinstance(observer, DAEObserver) and not observer.timing.longest:
        walks = observer.form == "augmented-kalman" or (
            observer.form == "random-walk" and observer.weight == "innovation"
        )
        return observer.random_walk if walks else None
    if isinstance(observer, RecursiveObserver) and not observer.timing.longest and observer.adaptation is not None:
        return observer.adaptation.walk if observer.form == "random-walk" else None
    return None


@dataclass(frozen=True, eq=False)
class Scores:
    """Scores ``s (..., nf)`` at parameters of zero and information ``J (..., nf, nf)`` of samples, zero where a sample
    says nothing; and estimates after them with their deviations ``(..., nf)``, NaN where they do not count."""

    score: FloatArray
    information: FloatArray
    theta: FloatArray
    deviations: FloatArray

    @property
    def determine(self) -> bool:
        """Whether all samples ``(n, nf)`` together determine every parameter, whatever its unit."""
        total = self.information.sum(axis=0)
        units = np.sqrt(np.maximum(np.diag(total), 0.0))
        if not (np.isfinite(total).all() and (units > 0.0).all()):
            return False
        return rounding_rank(total / np.outer(units, units)) == len(units)

    def centre(self) -> FloatArray:
        """Return the parameters that the samples make most likely ``(nf,)``, if they never change."""
        return np.asarray(np.linalg.solve(self.information.sum(axis=-3), self.score.sum(axis=-2)[..., None])[..., 0])

    def away(self, centre: FloatArray) -> FloatArray:
        """Return the scores ``(..., nf)`` of a change from there."""
        return np.asarray(self.score - (self.information @ centre[..., None])[..., 0])

    def chosen(self, rows: Any) -> Scores:
        """Return those of some rows."""
        return Scores(self.score[rows], self.information[rows], self.theta[rows], self.deviations[rows])

    def followed(self, centre: FloatArray, bands: FloatArray | float = 0.0) -> FloatArray:
        """Return how far the estimates are further from there than ``bands (nf,)``, in units of their deviations."""
        return beyond(self.theta - centre, bands) / self.deviations


def before_any(faults: int) -> FloatArray:
    """Return what is known of ``faults`` parameters before the first sample, ``(1 + nf, nf)``: nothing."""
    return np.full((1 + faults, faults), np.nan)


def sample_score(before: FloatArray, evidence: Evidence, walk: FloatArray, rows: int) -> tuple[FloatArray, Scores]:
    """Return what is known after a sample, and what it says; ``before (1 + nf, nf)``: estimate and covariance after the
    one ``rows`` earlier, since which parameters have walked."""
    theta, spread = evidence.theta, evidence.parameter_covariance
    after = np.vstack([theta, spread])
    nothing = Scores(np.zeros_like(theta), np.zeros_like(spread), theta, np.sqrt(np.diag(spread)))
    if not (np.isfinite(before).all() and np.isfinite(after).all()):
        return after, nothing
    with np.errstate(all="ignore"):
        try:
            own, prior = np.linalg.inv(spread), np.linalg.inv(before[1:] + rows * walk)
        except np.linalg.LinAlgError:
            return after, nothing
        added = own - prior
        score_of_sample = replace(nothing, score=own @ theta - prior @ before[0], information=0.5 * (added + added.T))
        # A covariance that has grown beside its walk has started again: what it was before says nothing of this.
        if not (np.isfinite(added).all() and (np.diag(added) >= -LEAST_ADDED * np.diag(own)).all()):
            return after, nothing
    return after, score_of_sample if (np.diag(added) > LEAST_ADDED * np.diag(own)).any() else nothing


def roots(information: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return roots ``(n, nf, nf)`` of matrices, symmetric in the usual units of each parameter, and their inverses in
    the directions where they are not zero."""
    units = np.sqrt(np.einsum("kii->ki", information).mean(axis=0))
    sizes, vectors = np.linalg.eigh(information / np.outer(units, units))
    sizes = np.maximum(sizes, 0.0)
    determined = sizes > DIRECTION_SHARE * np.maximum(sizes[:, -1:], SMALLEST)
    lengths = np.sqrt(np.where(determined, sizes, 0.0))
    with np.errstate(divide="ignore"):
        inverse = np.where(determined, 1.0 / lengths, 0.0)
    turned = np.swapaxes(vectors, 1, 2)
    return units[:, None] * ((vectors * lengths[:, None, :]) @ turned), (vectors * inverse[:, None, :]) @ turned / units


def change_ratios(
    away: FloatArray, own: FloatArray, ages: tuple[int, ...], bands: FloatArray | None = None
) -> FloatArray:
    """Return twice the largest log likelihood ratio over ages of a change of each parameter alone ``(nf, n)`` by more
    than ``bands (nf,)``, from scores ``(n, nf)`` of a change and the information ``own (n, nf)`` on each."""
    widths = np.zeros((away.shape[1], 1)) if bands is None else bands[:, None]
    n, nf = away.shape
    sums, powers = (np.vstack([np.zeros((1, nf)), np.cumsum(part, axis=0)]) for part in (away, own))
    ratios = np.zeros((nf, n))
    for age in ages:
        if age > n:
            break
        power = (powers[age:] - powers[:-age]).T
        with np.errstate(divide="ignore", invalid="ignore"):
            far = beyond((sums[age:] - sums[:-age]).T, widths * power)
            ratio = np.where(power > 0.0, far**2 / power, 0.0)
        np.maximum(ratios[:, age - 1 :], ratio, out=ratios[:, age - 1 :])
    return ratios


def most_likely_change(ratios: FloatArray) -> int:
    """Return the fault of which a change alone explains the most, from twice the log likelihood ratios of changes of
    each age ``(ages, nf)``, at the most likely age; or that this does not tell the faults apart."""
    of_age = ratios[int(np.argmax(ratios.max(axis=1)))]
    best = int(np.argmax(of_age))
    lead = of_age[best] - np.delete(of_age, best).max(initial=0.0)
    return best if lead > max(DISTINGUISHED, MODEL_SHARE * of_age[best]) else NOT_DISTINGUISHED


@dataclass(frozen=True, eq=False)
class ScoreModel:
    """Normal scores and estimates in units of their deviations, as autoregressions have them, to be drawn again.

    ``whites (n, nf)``: innovations of scores and of estimates, NaN where a sample says nothing or one before it is
    missing; ``root`` and ``information (n, nf, nf)`` are those of the samples.
    """

    model: Autoregression
    followed: Autoregression
    whites: tuple[FloatArray, FloatArray]
    root: FloatArray
    information: FloatArray

    @classmethod
    def of(cls, scores: Scores) -> ScoreModel:
        """Return that of normal rows ``(n, nf)``."""
        root, inverse = roots(scores.information)
        centre = scores.centre()
        units = (inverse @ scores.away(centre)[..., None])[..., 0]
        informed = np.asarray(np.einsum("kii->k", scores.information) > 0.0)
        units = np.where(informed[:, None], units, np.nan)
        estimates = scores.followed(centre)
        models = fitted_autoregression(units), fitted_autoregression(estimates)
        whites = models[0].whitened(units), models[1].whitened(estimates)
        return cls(*models, whites, root, scores.information)

    def drawn(self, whites: Sequence[FloatArray], places: Any) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return streams of scores ``(runs, n, nf)``, information and estimates, from innovations and the places that
        they are of."""
        units = self.model.simulated(whites[0])
        score = (self.root[places] @ units[..., None])[..., 0]
        return score, self.information[places], self.followed.simulated(whites[1])


def beyond(values: FloatArray, bands: FloatArray | float) -> FloatArray:
    """Return by how much values are further from zero than bands, with their signs."""
    return np.asarray(np.sign(values) * np.maximum(np.abs(values) - bands, 0.0))
