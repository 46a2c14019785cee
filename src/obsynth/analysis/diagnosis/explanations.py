"""What hides a fault, as a motion in one sentence, and which sensors would let it be detected or estimated."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import combinations

import numpy as np
from numpy.typing import NDArray

from obsynth.analysis.diagnosis.decoupled import unknowns_pencil
from obsynth.analysis.diagnosis.fault_columns import dc_point
from obsynth.analysis.diagnosis.without_unknown_inputs import PencilUnits
from obsynth.numerics.arrays import ComplexArray, FloatArray
from obsynth.numerics.ranks import RANK_TOLERANCE
from obsynth.plants.descriptor import DescriptorSystem
from obsynth.plants.transformations.recovery import StateRecovery

#: Plants with more states are not searched for pairs.
SENSOR_PAIRS_UP_TO = 24

#: Plants with more states are not searched for suggestions at all.
SENSOR_SEARCH_UP_TO = 120

#: Sets of sensors that are listed; the others are counted.
MOST_LISTED_CHOICES = 6

#: A motion is stated where it cancels the fault to this, relative to the fault's own column.
EXACTNESS = 1e-8

#: Signals of a motion that are named; the others are counted.
MOST_NAMED_SIGNALS = 6


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


def recovered_sensors(plant: DescriptorSystem, recovery: StateRecovery, dropped: Sequence[str]) -> tuple[Sensor, ...]:
    """Return a sensor for each state as written that is not an output of the reduced plant already; ``dropped`` ones
    are not known."""
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
    reached: Callable[[DescriptorSystem], bool],
    *,
    most: tuple[int, int] = (SENSOR_SEARCH_UP_TO, SENSOR_PAIRS_UP_TO),
    promising: Callable[[NDArray[np.int64]], NDArray[np.bool_]] | None = None,
) -> tuple[tuple[str, ...], ...]:
    """Return all single sensors that do it, or else all pairs; none for plants of more states than ``most``.

    ``promising`` says of sets ``(N, size)`` of places which ones are to be asked about at all.
    """
    if plant.nx > most[0]:
        return ()
    for size in (1, 2) if plant.nx <= most[1] else (1,):
        sets = np.array(list(combinations(range(len(sensors)), size)), dtype=np.int64).reshape(-1, size)
        candidates = sets if promising is None else sets[promising(sets)]
        sensor_sets = [[sensors[i] for i in chosen] for chosen in candidates.tolist()]
        helping = [chosen for chosen in sensor_sets if reached(with_sensors(plant, chosen))]
        if helping:
            return tuple(tuple(sensor.name for sensor in chosen) for chosen in helping)
    return ()


def listed_sets(sets: Sequence[Sequence[str]]) -> str:
    """Return sensor sets as a text: ``theta l, or omega l with i``."""
    texts = [" with ".join(names) for names in sets[:MOST_LISTED_CHOICES]]
    more = len(sets) - MOST_LISTED_CHOICES
    return ", ".join(texts) + (f", or {more} others" if more > 0 else "")


def hidden_motion(plant: DescriptorSystem, fault: int, point: complex, removed: Sequence[int]) -> str | None:
    """Return in words the amplitudes of states, unknown inputs and other faults with which a fault of 1 leaves every
    output at zero, least in balanced units; all go like ``exp(point t)``, or ``point^k``.  ``None`` where none do."""
    values = hiding_amplitudes(plant, fault, point, removed)
    if values is None:
        return None
    own = plant.fault_names[fault]
    names = (*plant.disturbance_names, *(plant.fault_names[j] for j in removed))
    inputs = [_signal(plant.dt, point, name, value) for name, value in values.items() if name in names]
    states = [f"{name} = {_amplitude(value)}" for name, value in values.items() if name not in names]
    more = len(states) - MOST_NAMED_SIGNALS
    state_texts = [*states[:MOST_NAMED_SIGNALS], *([f"{more} more states"] if more > 0 else [])]
    causes = [*inputs, *([f"states {', '.join(state_texts)}"] if state_texts else [])]
    signal = _signal(plant.dt, point, own, 1.0)
    if not causes:
        return f"{signal} has no effect on any sensor from some initial state"
    return f"{signal} and {' and '.join(causes)} cancel at every sensor"


def hiding_amplitudes(
    plant: DescriptorSystem, fault: int, point: complex, removed: Sequence[int]
) -> dict[str, complex] | None:
    """Return these amplitudes by name, those of inputs first."""
    e, a = unknowns_pencil(plant, removed)
    amplitudes = _solved(a - point * e, -np.concatenate([plant.Bf[:, fault], plant.Df[:, fault]]))
    if amplitudes is None:
        return None
    names = (*plant.disturbance_names, *(plant.fault_names[j] for j in removed))
    return {**_named(names, amplitudes[plant.nx :]), **_named(plant.state_names, amplitudes[: plant.nx])}


def _signal(dt: float, point: complex, name: str, value: complex) -> str:
    size = _amplitude(value)
    if point == dc_point(dt):
        return f"a step of {size} in {name}"
    if dt > 0.0:
        return f"{name} = {size} * ({_amplitude(point)})^k"
    if point.real == 0.0:
        return f"a sinusoid of {size} at {abs(point.imag):.4g} rad/s in {name}"
    return f"{name} = {size} * exp({_amplitude(point)} t)"


def _solved(matrix: ComplexArray, right: ComplexArray) -> ComplexArray | None:
    """Return the solution with few entries: least squares, then those that are not needed left out one by one."""
    units = PencilUnits.of(np.zeros(matrix.shape), np.abs(matrix))
    work, goal = units.rows[:, None] * matrix * units.columns, units.rows * right
    reach = float(np.linalg.norm(goal))
    if reach == 0.0:
        return None

    def solve(chosen: list[int]) -> tuple[ComplexArray, float]:
        part, *_ = np.linalg.lstsq(work[:, chosen], goal, rcond=RANK_TOLERANCE)
        return np.asarray(part, dtype=np.complex128), float(np.linalg.norm(work[:, chosen] @ part - goal)) / reach

    columns = list(range(matrix.shape[1]))
    part, miss = solve(columns)
    if miss > EXACTNESS:
        return None
    for index in sorted(columns, key=lambda j: abs(part[columns.index(j)]))[
        : len(columns) if len(columns) <= 40 else 0
    ]:
        fewer = [j for j in columns if j != index]
        if solve(fewer)[1] <= EXACTNESS:
            columns = fewer
    part, _ = solve(columns)
    amplitudes = np.zeros(matrix.shape[1], dtype=np.complex128)
    amplitudes[columns] = part
    # What is only rounding in balanced units is nothing in those of the data.
    amplitudes[np.abs(amplitudes) <= RANK_TOLERANCE * float(np.max(np.abs(amplitudes), initial=0.0))] = 0.0
    return np.asarray(units.columns * amplitudes)


def _named(names: Sequence[str], values: ComplexArray) -> dict[str, complex]:
    return {name: complex(value) for name, value in zip(names, values, strict=True) if value != 0.0}


def _amplitude(value: complex) -> str:
    if abs(value.imag) <= EXACTNESS * abs(value):
        return f"{value.real:.3g}"
    return f"{value.real:.3g}{value.imag:+.3g}j"
