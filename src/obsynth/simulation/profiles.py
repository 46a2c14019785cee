"""Profiles: how one signal of a scenario depends on time; between samples it is held or linear, as exact simulation
needs.

A profile acts from the first sample at or after ``start`` until the last one before ``end``.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from dataclasses import dataclass, fields
from typing import Annotated, ClassVar, Literal

import numpy as np
from annotated_types import Gt, Le
from numpy.typing import ArrayLike

from obsynth.errors import SpecError
from obsynth.numerics.arguments import (
    OpenUnitInterval,
    Positive,
    check_fields,
    is_finite_number,
    is_number,
    real_array,
    shown,
)
from obsynth.numerics.arrays import FloatArray, require_no_overflow
from obsynth.numerics.suggestions import fields_suggested

#: Share of a sample by which rounding may move a start or an end.
SAMPLE_SLACK = 1e-6


@dataclass(frozen=True, kw_only=True)
class Profile:
    """What all profiles have: ``start`` and ``end``, seconds, between which they act; without end by default."""

    #: Whether the signal is held between samples; else it is linear there.
    held: ClassVar[bool] = True
    #: Fields that are no single numbers; a profile checks its own.
    no_numbers: ClassVar[tuple[str, ...]] = ()
    start: float = 0.0
    end: float = math.inf

    def __post_init__(self) -> None:
        for item in fields(self):
            value = getattr(self, item.name)
            if item.name in self.no_numbers or (value is None and item.name == "value"):
                continue
            if not is_finite_number(value) and not (item.name == "end" and is_number(value) and value == math.inf):
                raise SpecError(f"{item.name} is {shown(value)}: give a finite number.", path=item.name)
            if item.name != "end":
                require_no_overflow(value, item.name, item.name)
        check_fields(self, type(self))
        if not self.end > self.start:
            raise SpecError(f"end ({self.end:g} s) is not after start ({self.start:g} s).", path="end")

    def active(self, steps: int, dt: float) -> np.ndarray:
        """Return which of the samples 0 to ``steps - 1`` it acts on."""
        place = np.arange(steps) + SAMPLE_SLACK
        return np.asarray((place >= self.start / dt) & (place < self.end / dt))


class Additive(Profile, ABC):
    """A function of time, which is added to its signal."""

    @abstractmethod
    def _at(self, time: FloatArray) -> FloatArray:
        """Return its values at ``time``, seconds."""

    def _is_held(self) -> bool:
        """Whether this one is held between samples."""
        return self.held

    def sampled(self, steps: int, dt: float) -> tuple[FloatArray, FloatArray]:
        """Return its values at the left and right end of each interval between samples, ``(steps,)`` each."""
        acts, values = self.active(steps, dt), self._at(dt * np.arange(steps + 1, dtype=np.float64))
        at_begin = np.where(acts, values[:-1], 0.0)
        return at_begin, at_begin.copy() if self._is_held() else np.where(acts, values[1:], 0.0)


@fields_suggested
@dataclass(frozen=True, kw_only=True)
class Step(Additive):
    """A constant; on a sensor, its bias.

    Parameters
    ----------
    size : float
        In the signal's unit.
    start, end : float, optional, seconds
        When it acts.

    Raises
    ------
    SpecError
        A number is not finite, or ``end`` is not after ``start``.

    Examples
    --------
    >>> import obsynth
    >>> left, right = obsynth.Step(size=0.5, start=2.0).sampled(4, 1.0)  # at both ends of four intervals of 1 s
    >>> left
    array([0. , 0. , 0.5, 0.5])
    """

    size: float

    def _at(self, time: FloatArray) -> FloatArray:
        return np.full(time.shape, float(self.size))


@fields_suggested
@dataclass(frozen=True, kw_only=True)
class Ramp(Additive):
    """A straight line from zero at ``start``; linear between samples.

    Parameters
    ----------
    rate : float
        In the signal's unit per second.
    start, end : float, optional, seconds
        When it acts.

    Raises
    ------
    SpecError
        A number is not finite, or ``end`` is not after ``start``.

    Examples
    --------
    >>> import obsynth
    >>> left, right = obsynth.Ramp(rate=0.5, start=1.0).sampled(4, 1.0)
    >>> left, right
    (array([0. , 0. , 0.5, 1. ]), array([0. , 0.5, 1. , 1.5]))
    """

    held: ClassVar[bool] = False
    rate: float

    def _at(self, time: FloatArray) -> FloatArray:
        return np.asarray(self.rate * (time - self.start))


@fields_suggested
@dataclass(frozen=True, kw_only=True)
class Sine(Additive):
    """``amplitude sin(frequency t + phase)``, t the scenario's time; linear between samples.

    Parameters
    ----------
    amplitude : float
        In the signal's unit.
    frequency : float, rad/s
        Angular frequency.
    phase : float, optional, rad
        At t = 0.
    start, end : float, optional, seconds
        When it acts.

    Raises
    ------
    SpecError
        A number is not finite, or ``end`` is not after ``start``.

    Examples
    --------
    >>> import obsynth
    >>> left, right = obsynth.Sine(amplitude=2.0, frequency=math.pi / 2).sampled(4, 1.0)
    >>> left.round(6) + 0.0
    array([ 0.,  2.,  0., -2.])
    """

    held: ClassVar[bool] = False
    amplitude: float
    frequency: float
    phase: float = 0.0

    def _at(self, time: FloatArray) -> FloatArray:
        return np.asarray(self.amplitude * np.sin(self.frequency * time + self.phase))


@fields_suggested
@dataclass(frozen=True, kw_only=True)
class Drift(Additive):
    """A slow approach to ``size``, with a time constant; linear between samples.

    Parameters
    ----------
    size : float
        Where it ends, in the signal's unit.
    time_constant : float, seconds
        After which 63 % are reached.
    start, end : float, optional, seconds
        When it acts.

    Raises
    ------
    SpecError
        A number is not finite, ``end`` is not after ``start``, or the time constant is not positive.

    Examples
    --------
    >>> import obsynth
    >>> left, right = obsynth.Drift(size=1.0, time_constant=2.0).sampled(4, 1.0)
    >>> left.round(3)
    array([0.   , 0.393, 0.632, 0.777])
    """

    held: ClassVar[bool] = False
    size: float
    time_constant: Positive

    def _at(self, time: FloatArray) -> FloatArray:
        # Before the start it is masked; there the exponential must not overflow.
        return np.asarray(-self.size * np.expm1(-np.maximum(time - self.start, 0.0) / self.time_constant))


@fields_suggested
@dataclass(frozen=True, kw_only=True)
class Intermittent(Additive):
    """A constant that is there in a part of each period, and zero in the rest.

    Parameters
    ----------
    size : float
        In the signal's unit, while it is there.
    period : float, seconds
        From the start of one part to that of the next.
    duty : float, optional
        Share of the period during which it is there, between 0 and 1.
    start, end : float, optional, seconds
        When it acts.

    Raises
    ------
    SpecError
        A number is not finite or out of its range, or ``end`` is not after ``start``.

    Examples
    --------
    >>> import obsynth
    >>> left, right = obsynth.Intermittent(size=1.0, period=4.0, duty=0.25).sampled(8, 1.0)
    >>> left
    array([1., 0., 0., 0., 1., 0., 0., 0.])
    """

    size: float
    period: Positive
    duty: OpenUnitInterval = 0.5

    def _at(self, time: FloatArray) -> FloatArray:
        turn = (time - self.start) / self.period + SAMPLE_SLACK
        return np.where(turn - np.floor(turn) < self.duty, float(self.size), 0.0)


@fields_suggested
@dataclass(frozen=True, kw_only=True)
class TimeTable(Additive):
    """A course through given points, such as a recorded input or a drive cycle.

    Parameters
    ----------
    times : array_like, seconds
        ``(n,)``, of the scenario's time, increasing.
    values : array_like
        ``(n,)``, in the signal's unit; the first one before the first time, the last one after the last.
    interpolation : {"linear", "held"}, optional
        Straight lines between the points, or each value until the next time; between samples it is linear or held.
    start, end : float, optional, seconds
        When it acts; zero outside.

    Raises
    ------
    SpecError
        The lists are empty, differ in length or hold something that is no finite number, the times do not increase, or
        ``end`` is not after ``start``.

    Examples
    --------
    >>> import obsynth
    >>> left, right = obsynth.TimeTable(times=[0.0, 2.0, 3.0], values=[0.0, 1.0, -1.0]).sampled(5, 1.0)
    >>> left, right
    (array([ 0. ,  0.5,  1. , -1. , -1. ]), array([ 0.5,  1. , -1. , -1. , -1. ]))
    """

    held: ClassVar[bool] = False
    no_numbers: ClassVar[tuple[str, ...]] = ("times", "values", "interpolation")
    times: ArrayLike
    values: ArrayLike
    interpolation: Literal["linear", "held"] = "linear"

    def __post_init__(self) -> None:
        for name in ("times", "values"):
            points = real_array(getattr(self, name), name)
            if points.ndim != 1 or not points.size or not np.isfinite(points).all():
                raise SpecError(f"{name} must be a list of finite numbers, one or more.", path=name)
            require_no_overflow(points, name, name)
            object.__setattr__(self, name, tuple(points.tolist()))
        super().__post_init__()
        times, values = np.asarray(self.times), np.asarray(self.values)
        if len(times) != len(values):
            raise SpecError(f"times has {len(times)} entries, values has {len(values)}: give as many.", path="values")
        falls = np.flatnonzero(np.diff(times) <= 0.0)
        if falls.size:
            k = int(falls[0])
            raise SpecError(f"times must increase: {times[k + 1]:g} s follows {times[k]:g} s.", path="times")

    def _at(self, time: FloatArray) -> FloatArray:
        times, values = np.asarray(self.times, dtype=np.float64), np.asarray(self.values, dtype=np.float64)
        if self.interpolation == "linear":
            return np.interp(time, times, values)
        slack = SAMPLE_SLACK * float(np.min(np.diff(times), initial=1.0))
        return np.asarray(values[np.maximum(np.searchsorted(times, time + slack, side="right") - 1, 0)])

    def _is_held(self) -> bool:
        return self.interpolation == "held"


@fields_suggested
@dataclass(frozen=True, kw_only=True)
class Stuck(Profile):
    """An actuator or a sensor that is stuck at one value.

    Parameters
    ----------
    value : float, optional
        At which value, in the signal's unit; by default the one that it has at ``start``.
    start, end : float, optional, seconds
        When it acts.

    Raises
    ------
    SpecError
        A number is not finite, or ``end`` is not after ``start``.

    Examples
    --------
    >>> import obsynth
    >>> scenario = obsynth.Scenario(horizon=60.0, sample_time=1.0, sensors={"level": obsynth.Stuck(start=20.0)})
    >>> scenario.sensors["level"]
    (Stuck(start=20.0, end=inf, value=None),)
    """

    value: float | None = None


@fields_suggested
@dataclass(frozen=True, kw_only=True)
class LostEffectiveness(Profile):
    """An actuator or a sensor that gives only a share of its signal.

    Parameters
    ----------
    share : float
        What is lost, between 0 (nothing) and 1 (all).
    start, end : float, optional, seconds
        When it acts.

    Raises
    ------
    SpecError
        The share is not above 0 and at most 1, or ``end`` is not after ``start``.

    Examples
    --------
    >>> import obsynth
    >>> lost = obsynth.LostEffectiveness(share=0.3, start=20.0)  # the pump gives 70 % of its command from 20 s on
    >>> obsynth.Scenario(horizon=60.0, sample_time=1.0, faults={"pump": lost}).faults["pump"][0].share
    0.3
    """

    share: Annotated[float, Gt(0.0), Le(1.0)]


class Random(Profile, ABC):
    """Independent samples, held between samples."""

    @abstractmethod
    def _draw(self, rng: np.random.Generator, steps: int) -> FloatArray:
        """Return ``steps`` samples, drawn with ``rng``."""

    @abstractmethod
    def moments(self) -> tuple[float, float, float]:
        """Return the largest absolute value (infinite if there is none), the mean and the variance."""


@fields_suggested
@dataclass(frozen=True, kw_only=True)
class Uniform(Random):
    """Independent samples, uniform between two limits (a bias is their mean), held between samples.

    Parameters
    ----------
    low, high : float
        The limits.
    start, end : float, optional, seconds
        When it acts.

    Raises
    ------
    SpecError
        A number is not finite, ``high`` is not above ``low``, or ``end`` is not after ``start``.

    Examples
    --------
    >>> import obsynth
    >>> obsynth.Uniform(low=-1.0, high=3.0).moments()  # largest absolute value, mean, variance
    (3.0, 1.0, 1.3333333333333333)
    """

    low: float
    high: float

    def __post_init__(self) -> None:
        super().__post_init__()
        if not self.high > self.low:
            raise SpecError("high must be greater than low.", path="high")

    def _draw(self, rng: np.random.Generator, steps: int) -> FloatArray:
        return np.asarray(rng.uniform(self.low, self.high, steps))

    def moments(self) -> tuple[float, float, float]:
        """Return the same as `Random.moments`."""
        return max(abs(self.low), abs(self.high)), (self.low + self.high) / 2, (self.high - self.low) ** 2 / 12


@fields_suggested
@dataclass(frozen=True, kw_only=True)
class Gaussian(Random):
    """Independent normal samples, held between samples.

    Parameters
    ----------
    deviation : float
        Standard deviation.
    mean : float, optional
        Their mean.
    start, end : float, optional, seconds
        When it acts.

    Raises
    ------
    SpecError
        A number is not finite, the deviation is not positive, or ``end`` is not after ``start``.

    Examples
    --------
    >>> import obsynth
    >>> obsynth.Gaussian(deviation=0.5).moments()  # no largest value, mean, variance
    (inf, 0.0, 0.25)
    """

    deviation: Positive
    mean: float = 0.0

    def _draw(self, rng: np.random.Generator, steps: int) -> FloatArray:
        return np.asarray(rng.normal(self.mean, self.deviation, steps))

    def moments(self) -> tuple[float, float, float]:
        """Return the same as `Random.moments`."""
        return math.inf, self.mean, self.deviation**2
