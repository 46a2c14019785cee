"""Score and information of each sample on parameters that are random walks, and likelihood ratios of their changes.

After a fault the innovations of a filter return to zero, because its estimate follows the fault.  A test of the
innovations therefore misses slow faults.  The information that one sample adds is recovered from its update: ``J = P^-1
- M^-1`` and ``s = P^-1 theta - M^-1 theta_before``, with the covariances M before and P after the update.  The sum of
``s - J c`` over the latest rows is the score of a change away from c.  Its square in units of the information is twice
the log likelihood ratio of a jump of that age (Willsky & Jones 1976).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np

from obsynth.monitoring.thresholds.monitor import NOT_DISTINGUISHED, Evidence
from obsynth.numerics.arrays import SMALLEST, FloatArray
from obsynth.numerics.autoregression import Autoregression, fitted_autoregression
from obsynth.numerics.ranks import DIRECTION_SHARE, rounding_rank
from obsynth.observers.nonlinear.observer import DAEObserver
from obsynth.observers.recursive.observer import RecursiveObserver

#: A fault is named where twice the log likelihood of a change of it alone exceeds that of every other fault by the
#: first number (odds of 90) and by the second as a share of itself.  The share allows for an inexact model: an effect
#: that is wrong by 10 % of its size lowers twice the log likelihood by less than 1 %, the square of that.
DISTINGUISHED, MODEL_SHARE = 9.0, 0.01

#: Least share of the earlier information that a sample adds: less is rounding of the difference.
LEAST_ADDED = 1e-9


def parameter_walk(observer: Any) -> FloatArray | None:
    """Return the covariance ``(nf, nf)`` of the steps of the parameters' random walk.

    `None` where the observer does not model parameters as a random walk, or samples arrive late.
    """
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
    """Scores and information of samples, and the estimates after them.

    Parameters
    ----------
    score : FloatArray
        ``s (..., nf)`` at parameters of zero; zero for a sample without information.
    information : FloatArray
        ``J (..., nf, nf)``.
    theta, deviations : FloatArray
        Estimates ``(..., nf)`` and their standard deviations; NaN where they do not count.
    """

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
        """Return the most likely values ``(nf,)`` of parameters that never change."""
        return np.asarray(np.linalg.solve(self.information.sum(axis=-3), self.score.sum(axis=-2)[..., None])[..., 0])

    def away(self, centre: FloatArray) -> FloatArray:
        """Return the scores ``(..., nf)`` of a change away from ``centre``."""
        return np.asarray(self.score - (self.information @ centre[..., None])[..., 0])

    def chosen(self, rows: Any) -> Scores:
        """Return the scores of some rows."""
        return Scores(self.score[rows], self.information[rows], self.theta[rows], self.deviations[rows])

    def followed(self, centre: FloatArray, bands: FloatArray | float = 0.0) -> FloatArray:
        """Return by how much the estimates leave ``centre`` beyond ``bands (nf,)``, in units of their deviations."""
        return beyond(self.theta - centre, bands) / self.deviations


def before_any(faults: int) -> FloatArray:
    """Return estimate and covariance before the first sample, one below the other ``(1 + nf, nf)``: NaN, not known."""
    return np.full((1 + faults, faults), np.nan)


def sample_score(before: FloatArray, evidence: Evidence, walk: FloatArray, rows: int) -> tuple[FloatArray, Scores]:
    """Return estimate and covariance after a sample, and the score and information of the sample alone.

    Parameters
    ----------
    before : FloatArray
        Estimate and covariance, one below the other ``(1 + nf, nf)``, after the sample ``rows`` earlier.
    evidence : Evidence
        Of the sample.
    walk : FloatArray
        Covariance ``(nf, nf)`` of one step of the random walk.
    rows : int
        Steps since the earlier sample.
    """
    theta, spread = evidence.theta, evidence.parameter_covariance
    after = np.vstack([theta, spread])
    nothing = Scores(np.zeros_like(theta), np.zeros_like(spread), theta, np.sqrt(np.diag(spread)))
    if not (np.isfinite(before[0]).all() and np.isfinite(theta).all()):
        return after, nothing
    known = precisions(before[1:], spread, walk, rows)
    if known is None or not (np.diag(known.after - known.before) > LEAST_ADDED * np.diag(known.after)).any():
        return after, nothing
    with np.errstate(all="ignore"):
        score = known.after @ theta - known.before @ before[0]
    return after, replace(nothing, score=score, information=known.added)


class Precisions(NamedTuple):
    """Inverse covariances ``(nf, nf)`` of parameters before and after a sample, ``M^-1`` and ``P^-1``."""

    before: FloatArray
    after: FloatArray

    @property
    def added(self) -> FloatArray:
        """The information that the sample adds, ``J``."""
        added = self.after - self.before
        return np.asarray(0.5 * (added + added.T))


def precisions(before: FloatArray, after: FloatArray, walk: FloatArray, rows: int) -> Precisions | None:
    """Return the precisions of parameters before and after a sample.

    ``None`` where a covariance is not known or singular, or the observer has started again between the samples.

    Parameters
    ----------
    before, after : FloatArray
        Covariances ``(nf, nf)`` after the sample ``rows`` earlier, and after this one.
    walk : FloatArray
        Covariance ``(nf, nf)`` of one step of the random walk.
    rows : int
        Steps since the earlier sample.
    """
    if not (np.isfinite(before).all() and np.isfinite(after).all()):
        return None
    with np.errstate(all="ignore"):
        try:
            found = Precisions(*(np.asarray(np.linalg.inv(part)) for part in (before + rows * walk, after)))
        except np.linalg.LinAlgError:
            return None
        added = found.after - found.before
        # A covariance that grows by more than the walk belongs to an observer that has started again.
        has_gone_on = np.isfinite(added).all() and (np.diag(added) >= -LEAST_ADDED * np.diag(found.after)).all()
    return found if has_gone_on else None


def roots(information: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return square roots ``(n, nf, nf)`` of information matrices, symmetric in the mean units of each parameter, and
    pseudo-inverses of these roots."""
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
    """Return twice the log likelihood ratio ``(nf, n)`` of a change of each parameter alone, the largest over ages.

    Parameters
    ----------
    away : FloatArray
        Scores ``(n, nf)`` of a change.
    own : FloatArray
        Information ``(n, nf)`` on each parameter.
    ages : tuple of int
        Ages in rows.
    bands : FloatArray, optional
        ``(nf,)``: changes up to this size do not count.
    """
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
    """Return the fault whose change alone explains the most at the likeliest age, or `NOT_DISTINGUISHED`.

    ``ratios``: twice the log likelihood ratios ``(ages, nf)`` of a change of each fault.
    """
    of_age = ratios[int(np.argmax(ratios.max(axis=1)))]
    best = int(np.argmax(of_age))
    lead = of_age[best] - np.delete(of_age, best).max(initial=0.0)
    return best if lead > max(DISTINGUISHED, MODEL_SHARE * of_age[best]) else NOT_DISTINGUISHED


@dataclass(frozen=True, eq=False)
class ScoreModel:
    """Autoregressions of the scores and of the estimates in normal rows, from which a bootstrap draws new ones.

    Parameters
    ----------
    model, followed : Autoregression
        Of the scores in units of the roots of their information, and of the estimates in units of their deviations.
    whites : pair of FloatArray
        Innovations ``(n, nf)`` of the two; NaN where a sample has no information or an earlier one is missing.
    root, information : FloatArray
        ``(n, nf, nf)``: of the samples.
    """

    model: Autoregression
    followed: Autoregression
    whites: tuple[FloatArray, FloatArray]
    root: FloatArray
    information: FloatArray

    @classmethod
    def of(cls, scores: Scores) -> ScoreModel:
        """Return the model of normal rows ``(n, nf)``."""
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
        """Return streams of scores ``(runs, n, nf)``, information and estimates.

        ``whites``: innovations of both models; ``places``: the rows from which they were drawn.
        """
        units = self.model.simulated(whites[0])
        score = (self.root[places] @ units[..., None])[..., 0]
        return score, self.information[places], self.followed.simulated(whites[1])


def beyond(values: FloatArray, bands: FloatArray | float) -> FloatArray:
    """Return by how much values leave bands about zero, with their signs."""
    return np.asarray(np.sign(values) * np.maximum(np.abs(values) - bands, 0.0))
