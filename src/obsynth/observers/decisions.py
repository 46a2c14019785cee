"""Deciding that a parameter has changed: four statistics with analytic thresholds for a whole run.

Under the hypothesis that theta is nominal, ``eps_k = v_k - G_k theta`` is white, N(0, I).  Thresholds are chosen such
that a run of N samples raises a false alarm with at most about the stated probability.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from obsynth.errors import SpecError
from obsynth.numerics.arrays import FloatArray, read_only
from obsynth.observers.gain_schedule import gain_steps
from obsynth.observers.recursive import RecursiveObserver
from obsynth.observers.recursive_estimates import RecursiveEstimates

STATISTICS = ("chi-square", "cusum", "glr", "nis")
#: Onsets that the GLR considers, and samples that the NIS sums up: the choices that the thresholds were tried with.
GLR_WINDOW = 40
NIS_WINDOW = 20
#: Correlated looks count as this share of independent ones: measured false-alarm rates stay below what is asked.
GLR_LOOKS = 1.0 / 4.0
NIS_LOOKS = 1.0 / 2.0


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


def decide(
    observer: RecursiveObserver,
    estimates: RecursiveEstimates,
    *,
    statistic: str = "chi-square",
    nominal: ArrayLike | None = None,
    false_alarms: float = 0.01,
    change: ArrayLike = 0.1,
) -> Decision:
    r"""Decide whether a parameter has left its nominal value.

    Parameters
    ----------
    observer : RecursiveObserver
        That gave the estimates, with parameters.
    estimates : RecursiveEstimates
        Of a whole run.
    statistic : {"chi-square", "cusum", "glr", "nis"}, optional
        ``chi-square`` on theta against its nominal value, with its honest covariance (default); ``cusum`` for small
        changes; ``glr`` with restarted signatures for abrupt ones; ``nis`` for all that the model does not explain.
    nominal : array_like, optional
        ``(nq,)``: nominal parameters; the observer's initial ones by default.
    false_alarms : float, optional, dimensionless
        Probability of a false alarm in the whole run.
    change : array_like, optional
        Change that ``cusum`` is tuned for, in parameter units; one number or ``(nq,)``.

    Returns
    -------
    Decision
        The statistic at every sample, its threshold, and the first alarm with parameter, onset and confidence.

    Raises
    ------
    SpecError
        The statistic is unknown or does not go with the observer's form, or an option is out of range.
    """
    adaptation = observer.adaptation
    if adaptation is None:
        raise SpecError("A decision on parameters needs an observer that estimates them.", path="observer")
    if statistic not in STATISTICS:
        raise SpecError(f"statistic is {statistic!r}: use one of {', '.join(STATISTICS)}.", path="statistic")
    if not 0.0 < false_alarms < 1.0:
        raise SpecError(f"false_alarms is {false_alarms}: give a probability between 0 and 1.", path="false_alarms")
    if adaptation.form == "random-walk" and statistic in ("cusum", "glr"):
        raise SpecError(f"{statistic} needs regressors, which the random walk does not have: use form 'innovation'.",
                        path="statistic")  # fmt: skip
    nq = len(adaptation.initial_parameters)
    theta = adaptation.initial_parameters if nominal is None else np.atleast_1d(np.asarray(nominal, dtype=np.float64))
    size = np.broadcast_to(np.asarray(change, dtype=np.float64), (nq,)) if np.ndim(change) == 0 else np.asarray(change)
    if theta.shape != (nq,) or not np.isfinite(theta).all():
        raise SpecError(f"nominal must be {nq} finite number(s).", path="nominal")
    if size.shape != (nq,) or not (size > 0.0).all():
        raise SpecError(f"change must be one positive number, or {nq}.", path="change")
    if statistic == "chi-square":
        return _chi_square(estimates, theta, false_alarms)
    gaps = estimates.innovations
    if adaptation.form != "random-walk":
        gaps = gaps - estimates.regressors @ theta
    if statistic == "nis":
        return _nis(estimates, gaps, false_alarms)
    if statistic == "cusum":
        return _cusum(estimates, gaps, size, false_alarms)
    return _glr(observer, estimates, gaps, false_alarms)


def _tail(degrees: FloatArray, value: FloatArray) -> FloatArray:
    """Return the probability that chi-square with these degrees of freedom passes ``value``."""
    from scipy.special import chdtrc

    return np.asarray(chdtrc(degrees, value))


def _quantile(degrees: FloatArray, probability: float) -> FloatArray:
    """Return what chi-square passes with this probability; infinite where there are no degrees of freedom."""
    from scipy.special import chdtri

    return np.where(degrees > 0.0, chdtri(np.maximum(degrees, 1.0), probability), np.inf)


def _chi_square(estimates: RecursiveEstimates, nominal: FloatArray, false_alarms: float) -> Decision:
    gaps, nq = estimates.parameters - nominal, len(nominal)
    values = np.einsum("ki,kij,kj->k", gaps, _inverses(estimates.parameter_covariances), gaps)
    looks = len(values)
    thresholds = np.full(looks, float(_quantile(np.array(float(nq)), false_alarms / looks)))
    hits = np.flatnonzero(values > thresholds)
    if not hits.size:
        return Decision("chi-square", read_only(values), read_only(thresholds), None)
    k = int(hits[0])
    weights = np.linalg.pinv(estimates.parameter_covariances[k], hermitian=True)
    # The last sample at which the statistic was what it is without a change, on average or less.
    quiet = np.flatnonzero(values[:k] <= nq)
    onset = int(quiet[-1]) + 1 if quiet.size else 0
    confidence = 1.0 - min(1.0, looks * float(_tail(np.array(float(nq)), values[k])))
    alarm = Alarm(
        k, estimates.parameter_names[_alone(weights @ gaps[k], np.diag(weights))], onset, confidence, float(values[k])
    )
    return Decision("chi-square", read_only(values), read_only(thresholds), alarm)


def _inverses(covariances: FloatArray) -> FloatArray:
    """Return pseudo-inverses ``(samples, nq, nq)``."""
    if not covariances.shape[1]:
        return covariances
    return np.asarray(np.linalg.pinv(covariances, hermitian=True))


def _nis(estimates: RecursiveEstimates, gaps: FloatArray, false_alarms: float) -> Decision:
    squares = np.nansum(gaps**2, axis=1)
    samples = len(squares)
    window = np.ones(min(NIS_WINDOW, samples))
    values = np.convolve(squares, window)[:samples]
    degrees = np.convolve(estimates.nis_degrees, window)[:samples]
    looks = max(samples * NIS_LOOKS, 1.0)
    thresholds = _quantile(degrees, min(false_alarms / looks, 1.0))
    hits = np.flatnonzero(values > thresholds)
    alarm = None
    if hits.size:
        k = int(hits[0])
        confidence = 1.0 - min(1.0, looks * float(_tail(degrees[k], values[k])))
        first = max(k - NIS_WINDOW + 1, 0)
        # The split of the window after which the squares are largest against their degrees of freedom.
        excess = np.cumsum((squares - estimates.nis_degrees)[first : k + 1][::-1])[::-1]
        alarm = Alarm(k, "", first + int(np.argmax(excess)), confidence, float(values[k]))
    return Decision("nis", read_only(values), read_only(thresholds), alarm)


def _cusum(estimates: RecursiveEstimates, gaps: FloatArray, change: FloatArray, false_alarms: float) -> Decision:
    samples, nq = len(gaps), len(change)
    signs = np.concatenate([change, -change])
    regressors = np.nan_to_num(estimates.regressors)
    along = np.einsum("kmq,km->kq", regressors, np.nan_to_num(gaps))
    squares = np.einsum("kmq,kmq->kq", regressors, regressors)
    steps = np.hstack([along, along]) * signs - 0.5 * np.hstack([squares, squares]) * signs**2
    threshold = float(np.log(2.0 * nq * samples / false_alarms))
    level, started, values, alarm = np.zeros(2 * nq), np.zeros(2 * nq, dtype=int), np.zeros(samples), None
    for k in range(samples):
        level = np.maximum(level + steps[k], 0.0)
        started[level == 0.0] = k + 1
        values[k] = level.max()
        if alarm is None and values[k] > threshold:
            which = int(np.argmax(level))
            confidence = 1.0 - min(1.0, 2.0 * nq * samples * float(np.exp(-values[k])))
            since = slice(int(started[which]), k + 1)
            name = estimates.parameter_names[_alone(along[since].sum(axis=0), squares[since].sum(axis=0))]
            alarm = Alarm(k, name, int(started[which]), confidence, float(values[k]))
    return Decision("cusum", read_only(values), read_only(np.full(samples, threshold)), alarm)


def _glr(observer: RecursiveObserver, estimates: RecursiveEstimates, gaps: FloatArray, false_alarms: float) -> Decision:
    samples, nq = gaps.shape[0], estimates.parameters.shape[1]
    expected = np.max(estimates.nis_degrees)
    begin = 0 if observer.early_constraints else 1
    if (estimates.nis_degrees[1:] < expected).any():
        raise SpecError("glr needs a complete record: use another statistic where samples are missing.", path="y")
    looks = max(samples * GLR_WINDOW * GLR_LOOKS, 1.0)
    threshold = float(_quantile(np.array(float(nq)), min(false_alarms / looks, 1.0)))
    values, alarm = np.zeros(samples), None
    # Of a change at each onset in the window: the regressor that starts at zero there, and the sums it has gathered.
    signatures = np.zeros((0, observer.plant.nx, nq))
    information, scores = np.zeros((0, nq, nq)), np.zeros((0, nq))
    for k, gains in enumerate(gain_steps(observer, samples - 1), begin):
        step = gains.step
        signatures = np.concatenate([signatures, np.zeros((1, observer.plant.nx, nq))])[-GLR_WINDOW:]
        outputs = np.broadcast_to(-step.Psi, (len(signatures), *step.Psi.shape))
        right = np.concatenate([step.A @ signatures + step.Phi, outputs], axis=1)
        G = -gains.parity @ right
        information = np.concatenate([information, np.zeros((1, nq, nq))])[-GLR_WINDOW:] + G.transpose(0, 2, 1) @ G
        scores = np.concatenate([scores, np.zeros((1, nq))])[-GLR_WINDOW:] + gaps[k][: G.shape[1]] @ G
        signatures = gains.gain @ right
        jumps = (np.linalg.pinv(information, hermitian=True) @ scores[:, :, None])[:, :, 0]
        found = np.einsum("oq,oq->o", scores, jumps)
        best = int(np.argmax(found))
        values[k] = found[best]
        if alarm is None and values[k] > threshold:
            confidence = 1.0 - min(1.0, looks * float(_tail(np.array(float(nq)), values[k])))
            name = estimates.parameter_names[_alone(scores[best], np.diag(information[best]))]
            alarm = Alarm(k, name, max(k + 1 - len(found), begin) + best, confidence, float(values[k]))
    return Decision("glr", read_only(values), read_only(np.full(samples, threshold)), alarm)


def _alone(scores: FloatArray, information: FloatArray) -> int:
    """Return the parameter whose change alone explains most."""
    return int(np.argmax(scores**2 / np.maximum(information, np.finfo(np.float64).tiny)))
