"""Which sensors, one at a time or two, would let a fault be detected or estimated."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import combinations

import numpy as np

from obsynth.analysis.diagnosis.columns import Question
from obsynth.numerics.arrays import FloatArray
from obsynth.plants.descriptor import DescriptorSystem

#: Plants with more states are not searched for pairs.
MOST_FOR_PAIRS = 24
#: Plants with more states are not searched for suggestions at all.
MOST_FOR_ONE = 120


@dataclass(frozen=True, eq=False)
class Sensor:
    """A signal that could be measured: rows of C, D, Dd and Df."""

    name: str
    C: FloatArray
    D: FloatArray
    Dd: FloatArray
    Df: FloatArray
    deviation: float | None = None


def state_sensors(plant: DescriptorSystem, names: Sequence[str] | None = None) -> tuple[Sensor, ...]:
    """Return a sensor for each state that is not an output already."""
    measured = set(plant.output_names)
    chosen = [name for name in plant.state_names if name not in measured] if names is None else list(names)
    zero = (np.zeros(plant.nu), np.zeros(plant.nd), np.zeros(plant.nf))
    eye = np.eye(plant.nx)
    return tuple(Sensor(name, eye[plant.state_names.index(name)], *zero) for name in chosen)


def with_sensors(plant: DescriptorSystem, sensors: Sequence[Sensor]) -> DescriptorSystem:
    """Return the plant with more outputs; a stated deviation adds a noise of its own."""
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
        C=stacked(plant.C, "C"), D=stacked(plant.D, "D"), Dd=stacked(plant.Dd, "Dd"), Df=stacked(plant.Df, "Df"),
        Bw=np.hstack([plant.Bw, np.zeros((plant.nx, len(stated)))]), Dw=noise, noise_names=names,
        output_names=[*plant.output_names, *(sensor.name for sensor in sensors)],
    )  # fmt: skip


def least_additions(
    plant: DescriptorSystem, sensors: Sequence[Sensor], reached: Callable[[DescriptorSystem], bool],
    *, most: tuple[int, int] = (MOST_FOR_ONE, MOST_FOR_PAIRS),
) -> tuple[tuple[str, ...], ...]:  # fmt: skip
    """Return all single sensors that do it, or else all pairs; nothing where none of them does.

    Plants of more than ``most`` states are not searched for one, and not for pairs.
    """
    if plant.nx > most[0]:
        return ()
    for size in (1, 2) if plant.nx <= most[1] else (1,):
        found = [
            tuple(sensor.name for sensor in chosen)
            for chosen in combinations(sensors, size)
            if reached(with_sensors(plant, chosen))
        ]
        if found:
            return tuple(found)
    return ()


def estimable(fault: int, *, step: bool) -> Callable[[DescriptorSystem], bool]:
    """Return the goal that a fault can be estimated free of all others, as a step or whatever its course."""

    def reached(plant: DescriptorSystem) -> bool:
        asked = Question(plant, tuple(j for j in range(plant.nf) if j != fault), fault, False)
        rest = 1.0 if plant.dt > 0.0 else 0.0
        return asked.visible and (asked.shows_at(rest) if step else not asked.blocking.size)

    return reached


def detectable(fault: int) -> Callable[[DescriptorSystem], bool]:
    """Return the goal that a fault shows free of the unknown inputs."""
    return lambda plant: Question(plant, (), fault, False).visible


def listed(sets: Sequence[Sequence[str]], most: int = 6) -> str:
    """Return sensor sets as a text: ``theta l, or omega l with i``."""
    texts = [" with ".join(names) for names in sets[:most]]
    return ", ".join(texts) + (f", or {len(sets) - most} others" if len(sets) > most else "")
