"""Profiles that are no plain function of time: failing actuators and sensors, and random signals."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TypeAlias

import numpy as np

from obsynth.numerics.arrays import FloatArray
from obsynth.simulation.profiles import Drift, Intermittent, Profile, Ramp, Sine, Step, require


@dataclass(frozen=True, kw_only=True)
class Stuck(Profile):
    """An actuator or a sensor that stays where it is.

    Parameters
    ----------
    value : float, optional
        Where; by default where it is when this begins.
    start, end : float, optional, seconds
        When it acts.
    """

    value: float | None = None


@dataclass(frozen=True, kw_only=True)
class LostEffectiveness(Profile):
    """An actuator or a sensor that gives only a part.

    Parameters
    ----------
    share : float
        What is lost, between 0 (nothing) and 1 (all).
    start, end : float, optional, seconds
        When it acts.
    """

    share: float

    def __post_init__(self) -> None:
        super().__post_init__()
        require(0.0 < self.share <= 1.0, "share must be greater than 0 and at most 1.", "share")


@dataclass(frozen=True, kw_only=True)
class Uniform(Profile):
    """Independent samples, uniform between two limits (a bias is their mean), held between samples.

    Parameters
    ----------
    low, high : float
        The limits.
    start, end : float, optional, seconds
        When it acts.
    """

    low: float
    high: float

    def __post_init__(self) -> None:
        super().__post_init__()
        require(self.high > self.low, "high must be greater than low.", "high")

    def draw(self, rng: np.random.Generator, steps: int) -> FloatArray:
        """Return its samples.

        Parameters
        ----------
        rng : numpy.random.Generator
            Source of the numbers.
        steps : int
            How many.
        """
        return np.asarray(rng.uniform(self.low, self.high, steps))


@dataclass(frozen=True, kw_only=True)
class Gaussian(Profile):
    """Independent normal samples, held between samples.

    Parameters
    ----------
    deviation : float
        Standard deviation.
    mean : float, optional
        Their mean.
    start, end : float, optional, seconds
        When it acts.
    """

    deviation: float
    mean: float = 0.0

    def __post_init__(self) -> None:
        super().__post_init__()
        require(self.deviation > 0.0, "deviation must be greater than 0.", "deviation")

    def draw(self, rng: np.random.Generator, steps: int) -> FloatArray:
        """Return its samples.

        Parameters
        ----------
        rng : numpy.random.Generator
            Source of the numbers.
        steps : int
            How many.
        """
        return np.asarray(rng.normal(self.mean, self.deviation, steps))


Random: TypeAlias = Uniform | Gaussian
RANDOM = (Uniform, Gaussian)

#: Names of the profiles in a spec.
KINDS: dict[str, type[Profile]] = {
    "step": Step, "ramp": Ramp, "sine": Sine, "drift": Drift, "intermittent": Intermittent, "stuck": Stuck,
    "lost-effectiveness": LostEffectiveness, "uniform": Uniform, "gaussian": Gaussian,
}  # fmt: skip
