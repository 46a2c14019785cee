"""The generalised likelihood ratio of a jump of parameters, and the response to an error that they start with."""

from __future__ import annotations

import numpy as np

from obsynth.errors import SpecError
from obsynth.monitoring.thresholds.change_statistics import alone, quantile, tail
from obsynth.numerics.arrays import FloatArray, read_only
from obsynth.observers.detection import Alarm, Decision
from obsynth.observers.estimates import Estimates
from obsynth.observers.recursive.gain_schedule import gain_steps
from obsynth.observers.recursive.observer import RecursiveObserver

#: Onsets that the GLR considers: the choice that its threshold was tried with.
GLR_WINDOW = 40

#: Correlated looks count as this share of independent ones: measured false-alarm rates stay below what is asked.
GLR_LOOKS = 1.0 / 4.0

#: Information below this (parameter units to the power -2) has lost digits to underflow: as good as none.
SMALLEST_INFORMATION = float(np.finfo(np.float64).tiny / np.finfo(np.float64).eps)


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
        ratios = _doubled_log_ratios(information, scores)
        best = int(np.argmax(ratios))
        values[k] = ratios[best]
        if alarm is None and values[k] > threshold:
            confidence = 1.0 - min(1.0, looks * float(tail(np.array(float(nq)), values[k])))
            name = estimates.parameter_names[alone(scores[best], np.diag(information[best]))]
            alarm = Alarm(k, name, max(k + 1 - len(ratios), begin) + best, confidence, float(values[k]))
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
    error_left = np.concatenate([np.zeros(nx if random_walk else 0), error])
    pulls = np.tile(error, (len(estimates.parameters), 1))
    begin = 0 if observer.early_constraints else 1
    for k, gains in enumerate(gain_steps(observer, len(pulls) - 1, received=estimates.received), begin):
        error_left = (
            gains.gain[:, : len(gains.step.A)] @ gains.step.A @ error_left if random_walk else gains.retain @ error_left
        )
        pulls[k] = error_left[-len(error) :]
    return pulls
