"""What a decision says: a statistic along a run, its threshold, and the first alarm."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from obsynth.numerics.arrays import FloatArray


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


def alone(scores: FloatArray, information: FloatArray) -> int:
    """Return the parameter whose change alone explains most: ``scores (nq,)``, ``information (nq,)``."""
    return int(np.argmax(scores**2 / np.maximum(information, np.finfo(np.float64).tiny)))
