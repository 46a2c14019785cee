"""How one signal of a scenario goes with time: steps, ramps, drifts, failing actuators, noise.

A profile acts from the first sample at or after ``start`` until the last one before ``end``.  Between samples of a
continuous plant it is held or linear, as its class says, so that a simulation of it is exact.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, fields
from typing import ClassVar, TypeAlias

import numpy as np

from obsynth.errors import SpecError
from obsynth.numerics.arguments import is_number
from obsynth.numerics.arrays import FloatArray

#: Share of a sample by which rounding may move a start or an end.
SAMPLE_SLACK = 1e-6


@dataclass(frozen=True, kw_only=True)
class Profile:
    """What all profiles have.

    Fields: start, end: When it acts; without end by default.
    """

    #: Whether the signal is held between samples; else it is linear there.
    held: ClassVar[bool] = True
    start: float = 0.0
    end: float = math.inf

    def __post_init__(self) -> None:
        for field in fields(self):
            value = getattr(self, field.name)
            if value is None and field.name == "value":
                continue
            number = is_number(value)
            if not number or math.isnan(value) or (math.isinf(value) and field.name != "end"):
                raise SpecError(f"{field.name} is {value!r}: give a finite number.", path=field.name)
        if not self.end > self.start:
            raise SpecError(f"end ({self.end:g} s) is not after start ({self.start:g} s).", path="end")

    def active(self, steps: int, dt: float) -> np.ndarray:
        """Return which of the samples 0 to ``steps - 1`` it acts on."""
        place = np.arange(steps) + SAMPLE_SLACK
        return np.asarray((place >= self.start / dt) & (place < self.end / dt))


def require(condition: bool, text: str, path: str) -> None:
    """Raise `SpecError` unless the condition holds."""
    if not condition:
        raise SpecError(text, path=path)


@dataclass(frozen=True, kw_only=True)
class Step(Profile):
    """A constant; on a sensor, its bias.

    Parameters
    ----------
    size : float
        In the signal's unit.
    start, end : float, optional, seconds
        When it acts.
    """

    size: float

    def at(self, time: FloatArray) -> FloatArray:
        """Return its values.

        Parameters
        ----------
        time : FloatArray, seconds
            When.
        """
        return np.full(time.shape, float(self.size))


@dataclass(frozen=True, kw_only=True)
class Ramp(Profile):
    """A straight line from zero at ``start``; linear between samples.

    Parameters
    ----------
    rate : float
        Per second.
    start, end : float, optional, seconds
        When it acts.
    """

    held: ClassVar[bool] = False
    rate: float

    def at(self, time: FloatArray) -> FloatArray:
        """Return its values.

        Parameters
        ----------
        time : FloatArray, seconds
            When.
        """
        return np.asarray(self.rate * (time - self.start))


@dataclass(frozen=True, kw_only=True)
class Sine(Profile):
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
    """

    held: ClassVar[bool] = False
    amplitude: float
    frequency: float
    phase: float = 0.0

    def at(self, time: FloatArray) -> FloatArray:
        """Return its values.

        Parameters
        ----------
        time : FloatArray, seconds
            When.
        """
        return np.asarray(self.amplitude * np.sin(self.frequency * time + self.phase))


@dataclass(frozen=True, kw_only=True)
class Drift(Profile):
    """A slow approach to ``size``, with a time constant; linear between samples.

    Parameters
    ----------
    size : float
        Where it ends.
    time_constant : float, seconds
        After which 63 % are reached.
    start, end : float, optional, seconds
        When it acts.
    """

    held: ClassVar[bool] = False
    size: float
    time_constant: float

    def __post_init__(self) -> None:
        super().__post_init__()
        require(self.time_constant > 0.0, "time_constant must be greater than 0.", "time_constant")

    def at(self, time: FloatArray) -> FloatArray:
        """Return its values.

        Parameters
        ----------
        time : FloatArray, seconds
            When.
        """
        # Before the start it is masked; there the exponential must not overflow.
        return np.asarray(-self.size * np.expm1(-np.maximum(time - self.start, 0.0) / self.time_constant))


@dataclass(frozen=True, kw_only=True)
class Intermittent(Profile):
    """A constant that comes and goes.

    Parameters
    ----------
    size : float
        While it is there.
    period : float, seconds
        From one coming to the next.
    duty : float, optional
        Share of the period during which it is there, between 0 and 1.
    start, end : float, optional, seconds
        When it acts.
    """

    size: float
    period: float
    duty: float = 0.5

    def __post_init__(self) -> None:
        super().__post_init__()
        require(self.period > 0.0, "period must be greater than 0.", "period")
        require(0.0 < self.duty < 1.0, "duty must lie between 0 and 1.", "duty")

    def at(self, time: FloatArray) -> FloatArray:
        """Return its values.

        Parameters
        ----------
        time : FloatArray, seconds
            When.
        """
        turn = (time - self.start) / self.period + SAMPLE_SLACK
        return np.where(turn - np.floor(turn) < self.duty, float(self.size), 0.0)


Additive: TypeAlias = Step | Ramp | Sine | Drift | Intermittent
ADDITIVE = (Step, Ramp, Sine, Drift, Intermittent)


def sampled(profile: Additive, steps: int, dt: float) -> tuple[FloatArray, FloatArray]:
    """Return its values at the left and right end of each interval between samples, ``(steps,)`` each."""
    acts, time = profile.active(steps, dt), dt * np.arange(steps + 1, dtype=np.float64)
    values = profile.at(time)
    left = np.where(acts, values[:-1], 0.0)
    return left, left.copy() if profile.held else np.where(acts, values[1:], 0.0)
