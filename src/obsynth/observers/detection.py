"""The result of a monitor, or of a decision on parameters, over one record: statistic, threshold, first alarm."""

from __future__ import annotations

from dataclasses import dataclass

from obsynth.numerics.arrays import FloatArray


@dataclass(frozen=True, eq=False)
class Detection:
    """The outcome of a monitor over one record: its statistic, its threshold, and the first alarm.

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

    Examples
    --------
    >>> import obsynth
    >>> plant = obsynth.DescriptorSystem(
    ...     A=[[0.9, 0.1], [0.0, 0.8]], C=[[1, 0], [0, 1]], Bf=[[1], [0]], Bd=[[0], [1]], dt=1.0
    ... )
    >>> design = obsynth.fault_estimation_filter(plant)
    >>> scenario = obsynth.Scenario(
    ...     horizon=30,
    ...     faults={"f1": obsynth.Step(size=1.0, start=10)},
    ...     disturbances={"d1": obsynth.Uniform(low=-0.1, high=0.1)},
    ... )
    >>> monitor = obsynth.monitor(design, scenario)
    >>> detection = monitor.watch(obsynth.simulate(design, scenario).estimates)
    >>> detection.fault, detection.k, detection.time
    ('f1', 11, 11.0)
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

    Examples
    --------
    >>> import obsynth
    >>> plant = obsynth.TimeVaryingDescriptorSystem(
    ...     E=None, A=[[0.9]], C=[[1.0]], Phi=[[1.0]], dt=1.0, horizon=50, parameter_names=["leak"]
    ... )
    >>> design = obsynth.adaptive_observer(plant, Q=1e-4, R=1e-2, forgetting=0.95)
    >>> scenario = obsynth.Scenario(horizon=49, faults={"leak": obsynth.Step(size=0.5, start=20)}, noise=1.0)
    >>> estimates = obsynth.simulate(design, scenario).estimates
    >>> alarm = obsynth.decide(design.observer, estimates, nominal=[0.0], false_alarms=0.01).alarm
    >>> alarm.parameter, 20 <= alarm.k <= 30, alarm.confidence >= 0.99
    ('leak', True, True)
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

    Examples
    --------
    >>> import obsynth
    >>> plant = obsynth.TimeVaryingDescriptorSystem(
    ...     E=None, A=[[0.9]], C=[[1.0]], Phi=[[1.0]], dt=1.0, horizon=50, parameter_names=["leak"]
    ... )
    >>> design = obsynth.adaptive_observer(plant, Q=1e-4, R=1e-2, forgetting=0.95)
    >>> scenario = obsynth.Scenario(horizon=49, faults={"leak": obsynth.Step(size=0.5, start=20)}, noise=1.0)
    >>> estimates = obsynth.simulate(design, scenario).estimates
    >>> decision = obsynth.decide(design.observer, estimates, nominal=[0.0], false_alarms=0.01)
    >>> decision.values.shape, decision.alarm.parameter
    ((50,), 'leak')
    """

    statistic: str
    values: FloatArray
    thresholds: FloatArray
    alarm: Alarm | None
