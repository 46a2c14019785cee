"""Sensor noise as a plant states it: white, coloured and offsets; its variance per sample, names of its states."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from obsynth.errors import SpecError
from obsynth.numerics.arguments import real_number, require_mapping
from obsynth.numerics.measurement_units import MICRO_SIGNS
from obsynth.numerics.quantities import in_seconds
from obsynth.plants.dae_functions import BUTCHER
from obsynth.plants.dead_times import SECONDS_IN_UNIT
from obsynth.plants.signal_names import index_of

#: Stands for a number that `obsynth.calibrate` is to find.
UNKNOWN_NUMBER = "unknown"

#: White noise beside coloured noise whose size is not stated, as a share of its deviation: no sensor is without any.
DEFAULT_WHITE_SHARE = 0.01

#: An offset that is unknown, in deviations of its sensor; and by how many it walks in a sample, or per root of a
#: second: so that filters with a steady state follow it within a thousand samples.
OFFSET_SIZE, OFFSET_WALK = 10.0, 1e-3

#: How noise is called that a method assumes on each output where none is stated.
ASSUMED = "assumed noise"


def assumed_noise_names(outputs: Sequence[str]) -> list[str]:
    """Return the names of noise that a method assumes on each output, as nobody stated any."""
    return [f"{ASSUMED} {name}" for name in outputs]


def is_noise_assumed(noise_names: Sequence[str]) -> bool:
    """Whether the noise of a plant is assumed by a method, and not stated."""
    return bool(noise_names) and all(name.startswith(f"{ASSUMED} ") for name in noise_names)


def noise_words(noise_names: Sequence[str]) -> str:
    """Return the words for the noise of a plant: stated, or assumed."""
    return f"the {ASSUMED} (none is stated)" if is_noise_assumed(noise_names) else "the stated noise"


def require_noise(noise_bound: float | None, *, noisy: bool) -> None:
    """Refuse a bound of noise in deviations where no noise is stated: zero deviations, however many, stay zero."""
    if noise_bound and not noisy:
        raise SpecError(
            "noise_bound is a number of standard deviations, but no noise is stated that reaches the monitored "
            "signals, so there is nothing to multiply: state the noise of the sensors (sensor_noise of the plant, or "
            "Bw and Dw, and noise: 1 in a scenario), or leave noise_bound out.",
            path="noise_bound",
        )


def noise_state(output: str) -> str:
    """Return the name of the state of an output's coloured noise."""
    return re.sub(r"\W", "_", f"noise_{output}")


def offset_state(output: str) -> str:
    """Return the name of the state of a sensor's offset."""
    return re.sub(r"\W", "_", f"offset_{output}")


def successive_correlation(correlation: float, dt: float, integration: str) -> float:
    """Return the correlation of successive samples of coloured noise, as an integration method makes it, or exactly."""
    if integration not in BUTCHER:
        return float(np.exp(-dt / correlation))
    stages = len(BUTCHER[integration])
    # The last stage is the end of the step.
    whole = np.eye(stages) + dt / correlation * BUTCHER[integration]
    return float(np.linalg.solve(whole, np.ones(stages))[-1])


def process_variance(variance: float, correlation: float, dt: float, integration: str) -> float:
    """Return the variance per step on the equation of coloured noise, so that the noise has the stated variance."""
    share = successive_correlation(correlation, dt, integration)
    if integration not in BUTCHER:
        return variance * (1.0 - share**2)
    return variance * (1.0 + share) / (correlation**2 * (1.0 - share))


def noise_variance(process: float, correlation: float, dt: float, integration: str) -> float:
    """Return the variance of coloured noise from that of its equation per step: the inverse of `process_variance`."""
    return process / process_variance(1.0, correlation, dt, integration)


@dataclass(frozen=True)
class SensorNoise:
    """Noise of one sensor: deviations of its coloured and white parts, correlation time in s (0: all white)."""

    deviation: float
    correlation: float
    white: float

    @property
    def size(self) -> float:
        """Deviation of both together."""
        return float(np.hypot(self.deviation, self.white))


def seconds(value: Any, path: str) -> float:
    """Return a time in s from a number or a text such as ``5 s``, ``200 ms`` or ``3 min``."""
    text = re.sub(f"[{''.join(MICRO_SIGNS)}]s", "us", value) if isinstance(value, str) else ""
    match = re.fullmatch(r"\s*([0-9.]+(?:[eE][+-]?\d+)?)\s*([a-z]+)\s*", text)
    if match is not None and match[2] in SECONDS_IN_UNIT:
        try:
            return stated_number(float(match[1]) * SECONDS_IN_UNIT[match[2]], path)
        except ValueError:
            pass
    return stated_number(in_seconds(value, path), path)


def stated_number(value: Any, path: str) -> float:
    """Return a positive number; what is still unknown is to be found first."""
    if value == UNKNOWN_NUMBER:
        raise SpecError(
            f"{path} is unknown: find it from normal rows (obsynth calibrate --write-spec), or state a number.",
            path=path,
        )
    return real_number(value, path, f"a number above 0 ({', '.join(SECONDS_IN_UNIT)} for times)", above=0.0)


def sensor_noises(entries: Mapping[str, Any] | None, outputs: Sequence[str]) -> dict[str, SensorNoise]:
    """Return the noise of each sensor of which something is stated."""
    require_mapping(entries, "sensor_noise")
    noises = {}
    for name, item in (entries or {}).items():
        index_of(name, outputs, what="sensor_noise")
        path = f"sensor_noise.{name}"
        if not isinstance(item, Mapping):
            noises[name] = SensorNoise(0.0, 0.0, stated_number(item, path))
            continue
        wrong = [key for key in item if key not in ("deviation", "correlation", "white")]
        if wrong or "deviation" not in item:
            problem = f"has no {wrong[0]!r}" if wrong else "needs a deviation"
            raise SpecError(f"{path} {problem}: it takes deviation, correlation and white.", path=path)
        deviation = stated_number(item["deviation"], f"{path}.deviation")
        if item.get("correlation") is None:
            noises[name] = SensorNoise(0.0, 0.0, deviation)
            continue
        white = item.get("white")
        noises[name] = SensorNoise(
            deviation,
            seconds(item["correlation"], f"{path}.correlation"),
            DEFAULT_WHITE_SHARE * deviation if white is None else stated_number(white, f"{path}.white"),
        )
    return noises
