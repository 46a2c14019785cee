"""What a monitor, or a decision on parameters, saw in one record."""

from __future__ import annotations

from dataclasses import dataclass

from obsynth.numerics.arrays import FloatArray


@dataclass(frozen=True, eq=False)
class Detection:
    """What a monitor saw in one record.

    Parameters
    ----------
    kind, statement : str
        The monitor's, and what its threshold means.
    values, threshold : FloatArray
        ``(steps,)``.
    k : int or None
        First sample at which the threshold is passed.
    time : float or None, seconds
        The same.
    fault : str
        The isolated fault: largest estimate at (or a given number of samples after) the alarm, in its own deviations;
        of guaranteed tests the one that is there, or "one or another"; empty without an alarm.
    """

    kind: str
    statement: str
    values: FloatArray
    threshold: FloatArray
    k: int | None
    time: float | None
    fault: str


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
