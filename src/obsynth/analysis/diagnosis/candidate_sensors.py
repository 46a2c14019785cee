"""Sensors that could be added to a plant, and the smallest sets of them with which the plant passes a test."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import combinations

import numpy as np
from numpy.typing import NDArray

from obsynth.numerics.arrays import FloatArray
from obsynth.plants.descriptor import DescriptorSystem
from obsynth.plants.transformations.recovery import StateRecovery

#: Pairs of sensors are searched only for plants with at most so many states.
SENSOR_PAIRS_UP_TO = 24

#: Single sensors are searched only for plants with at most so many states.
SENSOR_SEARCH_UP_TO = 120

#: Sensor sets that a sentence lists; further ones are only counted.
MOST_LISTED_CHOICES = 6


@dataclass(frozen=True, eq=False)
class Sensor:
    """A signal that could be measured: its rows of C, D, Dd and Df, and the deviation of its noise where stated."""

    name: str
    C: FloatArray
    D: FloatArray
    Dd: FloatArray
    Df: FloatArray
    deviation: float | None = None


def state_sensors(plant: DescriptorSystem, names: Sequence[str] | None = None) -> tuple[Sensor, ...]:
    """Return a sensor for each of these states; by default for each state that is not an output already."""
    measured = set(plant.output_names)
    chosen = [name for name in plant.state_names if name not in measured] if names is None else list(names)
    zero = (np.zeros(plant.nu), np.zeros(plant.nd), np.zeros(plant.nf))
    eye = np.eye(plant.nx)
    return tuple(Sensor(name, eye[plant.state_names.index(name)], *zero) for name in chosen)


def recovered_sensors(plant: DescriptorSystem, recovery: StateRecovery, dropped: Sequence[str]) -> tuple[Sensor, ...]:
    """Return a sensor for each state of the original plant, as a row on the reduced plant.

    States that are outputs already are left out, and so are the ``dropped`` ones, which the reduced plant does not
    determine.
    """
    measured = {*plant.output_names, *dropped}
    return tuple(
        Sensor(
            name,
            recovery.from_state[row],
            recovery.from_input[row],
            recovery.from_disturbance[row],
            recovery.from_fault[row],
        )
        for row, name in enumerate(recovery.names)
        if name not in measured
    )


def with_sensors(plant: DescriptorSystem, sensors: Sequence[Sensor]) -> DescriptorSystem:
    """Return the plant with these sensors as further outputs; a sensor with a deviation gets its own unit noise."""
    if not sensors:
        return plant

    def stacked(matrix: FloatArray, part: str) -> FloatArray:
        return np.vstack([matrix, *(getattr(sensor, part)[None, :] for sensor in sensors)])

    stated = [i for i, sensor in enumerate(sensors) if sensor.deviation is not None]
    noise = np.zeros((plant.ny + len(sensors), plant.nw + len(stated)))
    noise[: plant.ny, : plant.nw] = plant.Dw
    for column, i in enumerate(stated):
        noise[plant.ny + i, plant.nw + column] = float(sensors[i].deviation or 0.0)
    names = [*plant.noise_names, *(f"noise of {sensors[i].name}" for i in stated)]
    return plant.replace(
        C=stacked(plant.C, "C"),
        D=stacked(plant.D, "D"),
        Dd=stacked(plant.Dd, "Dd"),
        Df=stacked(plant.Df, "Df"),
        Bw=np.hstack([plant.Bw, np.zeros((plant.nx, len(stated)))]),
        Dw=noise,
        noise_names=names,
        output_names=[*plant.output_names, *(sensor.name for sensor in sensors)],
    )


def least_additions(
    plant: DescriptorSystem,
    sensors: Sequence[Sensor],
    is_enough: Callable[[DescriptorSystem], bool],
    *,
    most: tuple[int, int] = (SENSOR_SEARCH_UP_TO, SENSOR_PAIRS_UP_TO),
    promising: Callable[[NDArray[np.int64]], NDArray[np.bool_]] | None = None,
) -> tuple[tuple[str, ...], ...]:
    """Return all single sensors with which the plant passes the test ``is_enough``, or else all such pairs.

    ``most`` are the largest numbers of states for which single sensors and pairs are searched.  ``promising`` takes
    sets ``(N, size)`` of indexes into ``sensors`` and returns which of them are worth the test.
    """
    if plant.nx > most[0]:
        return ()
    for size in (1, 2) if plant.nx <= most[1] else (1,):
        sets = np.array(list(combinations(range(len(sensors)), size)), dtype=np.int64).reshape(-1, size)
        candidates = sets if promising is None else sets[promising(sets)]
        sensor_sets = [[sensors[i] for i in chosen] for chosen in candidates.tolist()]
        helping = [chosen for chosen in sensor_sets if is_enough(with_sensors(plant, chosen))]
        if helping:
            return tuple(tuple(sensor.name for sensor in chosen) for chosen in helping)
    return ()


def listed_sets(sets: Sequence[Sequence[str]]) -> str:
    """Return sensor sets as a text: ``theta l, or omega l with i``."""
    texts = [" with ".join(names) for names in sets[:MOST_LISTED_CHOICES]]
    more = len(sets) - MOST_LISTED_CHOICES
    return ", ".join(texts) + (f", or {more} others" if more > 0 else "")
