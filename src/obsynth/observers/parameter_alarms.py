"""What a decision says, and the statistics that need the gains of a record again."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from obsynth.errors import SpecError
from obsynth.numerics.arrays import FloatArray, read_only
from obsynth.observers.estimates import Estimates
from obsynth.observers.recursive.gain_schedule import gain_steps
from obsynth.observers.recursive.observer import RecursiveObserver

#: Onsets that the GLR considers: the choice that its threshold was tried with.
GLR_WINDOW = 40

#: Correlated looks count as this share of independent ones: measured false-alarm rates stay below what is asked.
GLR_LOOKS = 1.0 / 4.0

#: Information below this (parameter units to the power -2) has lost digits to underflow: as good as none.
SMALLEST_INFORMATION = float(np.finfo(np.float64).tiny / np.finfo(np.float64).eps)


@dataclass(frozen=True)
class Alarm:
    """The first sample at which a statistic passes its threshold.

    Parameters
    ----------
    k : int
        The sample.
    parameter : str
        The parameter whose change alone explains it best; empty for the NIS, which knows no parameters.
    onset : int
        Estimate of the sample at which the change began.
    confidence : float
        One minus the probability that a whole run without a change reaches this value (at the first alarm, at least one
        minus what was asked).
    value : float
        The statistic there.
    """

    k: int
    parameter: str
    onset: int
    confidence: float
    value: float


@dataclass(frozen=True, eq=False)
class Decision:
    """A statistic along a run, its threshold, and the alarm if there is one.

    Parameters
    ----------
    statistic : str
        Its name.
    values : FloatArray
        ``(samples,)``.
    thresholds : FloatArray
        ``(samples,)``; they differ where samples are missing.
    alarm : Alarm or None
        The first one.
    """

    statistic: str
    values: FloatArray
    thresholds: FloatArray
    alarm: Alarm | None


def tail(degrees: FloatArray, value: FloatArray) -> FloatArray:
    """Return the probability that chi-square passes a value."""
    from scipy.special import chdtrc

    return np.asarray(chdtrc(degrees, value))


def quantile(degrees: FloatArray, probability: float) -> FloatArray:
    """Return what chi-square passes with a probability; infinite where there are no degrees of freedom."""
    from scipy.special import chdtri

    return np.where(degrees > 0.0, chdtri(np.maximum(degrees, 1.0), probability), np.inf)


def two_sided_sums(levels: FloatArray, along: FloatArray, squares: FloatArray, change: FloatArray) -> FloatArray:
    """Return cumulative sums ``(..., 2 n)`` of log likelihood ratios for a change ``(..., n)`` of either sign, one
    sample later: of scores ``along (..., n)`` with variances ``squares``; none falls below zero."""
    signs = np.concatenate([change, -change], axis=-1)
    rise = np.concatenate([along, along], axis=-1) * signs
    rise -= 0.5 * np.concatenate([squares, squares], axis=-1) * signs**2
    return np.asarray(np.maximum(levels + rise, 0.0))


def alone(scores: FloatArray, information: FloatArray) -> int:
    """Return the parameter whose change alone explains most (``scores (nq,)``, ``information (nq,)``)."""
    return int(np.argmax(scores**2 / np.maximum(information, np.finfo(np.float64).tiny)))


def initial_parameter_response(observer: RecursiveObserver, estimates: Estimates, error: FloatArray) -> FloatArray:
    """Return what is left at each sample of an error ``(nq,)`` of the initial parameters, ``(samples, nq)``."""
    adaptation, nx = observer.adaptation, observer.plant.nx
    if adaptation is not None and adaptation.reset:
        raise SpecError(
            "chi-square with reset needs nominal parameters that equal the observer's initial ones: how a reset "
            "changes the response to other initial values is not known. Use glr or cusum, or design with "
            "initial_parameters at their nominal values.",
            path="nominal",
        )
    random_walk = adaptation is not None and adaptation.form == "random-walk"
    left = np.concatenate([np.zeros(nx if random_walk else 0), error])
    pulls = np.tile(error, (len(estimates.parameters), 1))
    begin = 0 if observer.early_constraints else 1
    for k, gains in enumerate(gain_steps(observer, len(pulls) - 1, received=estimates.received), begin):
        left = gains.gain[:, : len(gains.step.A)] @ gains.step.A @ left if random_walk else gains.retain @ left
        pulls[k] = left[-len(error) :]
    return pulls


def likelihood_ratio(
    observer: RecursiveObserver, estimates: Estimates, gaps: FloatArray, false_alarms: float
) -> Decision:
    """Return the generalised likelihood ratio of a jump at any of the last onsets. The signature of a jump starts at
    zero at its onset (the regressor that runs along has another past); where samples are missing it is that of the
    record (``gaps (samples, m)``)."""
    samples, nq = gaps.shape[0], estimates.parameters.shape[1]
    begin = 0 if observer.early_constraints else 1
    looks = max(samples * GLR_WINDOW * GLR_LOOKS, 1.0)
    threshold = float(quantile(np.array(float(nq)), min(false_alarms / looks, 1.0)))
    values, alarm = np.zeros(samples), None
    # Of a change at each onset in the window: the regressor that starts at zero there, and the sums it has gathered.
    signatures = np.zeros((0, observer.plant.nx, nq))
    information, scores = np.zeros((0, nq, nq)), np.zeros((0, nq))
    for k, gains in enumerate(gain_steps(observer, samples - 1, received=estimates.received), begin):
        step = gains.step
        signatures = np.concatenate([signatures, np.zeros((1, observer.plant.nx, nq))])[-GLR_WINDOW:]
        outputs = np.broadcast_to(-step.Psi, (len(signatures), *step.Psi.shape))
        right = np.concatenate([step.A @ signatures + step.Phi, outputs], axis=1)
        if observer.early_constraints:
            # theta(k) acts on x(k) by the early equations alone, and on the others from k + 1 on.
            right[-1, : right.shape[1] - len(step.Dn)] = 0.0
        G = -gains.parity @ right
        information = np.concatenate([information, np.zeros((1, nq, nq))])[-GLR_WINDOW:] + G.transpose(0, 2, 1) @ G
        scores = np.concatenate([scores, np.zeros((1, nq))])[-GLR_WINDOW:] + gaps[k][: G.shape[1]] @ G
        signatures = gains.gain @ right
        found = _doubled_log_ratios(information, scores)
        best = int(np.argmax(found))
        values[k] = found[best]
        if alarm is None and values[k] > threshold:
            confidence = 1.0 - min(1.0, looks * float(tail(np.array(float(nq)), values[k])))
            name = estimates.parameter_names[alone(scores[best], np.diag(information[best]))]
            alarm = Alarm(k, name, max(k + 1 - len(found), begin) + best, confidence, float(values[k]))
    return Decision("glr", read_only(values), read_only(np.full(samples, threshold)), alarm)


def _doubled_log_ratios(information: FloatArray, scores: FloatArray) -> FloatArray:
    """Return ``s' M^+ s`` of each onset; zero where a change leaves less than double precision resolves. Each
    information is scaled first: where excitation decays it underflows, and its inverse would overflow."""
    sizes = np.einsum("oqq->oq", information).max(axis=1, initial=0.0)
    felt = sizes > SMALLEST_INFORMATION
    squares = np.where(felt, sizes, np.inf)
    scaled = scores / np.sqrt(squares)[:, None]
    inverses = np.linalg.pinv(information / squares[:, None, None], hermitian=True)
    return np.asarray(np.einsum("oq,oqr,or->o", scaled, inverses, scaled))
