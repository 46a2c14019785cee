"""Motions that hide a fault: amplitudes of states and unknown inputs that cancel it at every sensor, in words."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from obsynth.analysis.diagnosis.decoupled import unknowns_pencil
from obsynth.analysis.diagnosis.fault_columns import dc_point
from obsynth.analysis.diagnosis.without_unknown_inputs import PencilUnits
from obsynth.numerics.arrays import ComplexArray
from obsynth.numerics.ranks import RANK_TOLERANCE
from obsynth.plants.descriptor import DescriptorSystem

#: A motion hides a fault if the remainder at the sensors is at most this, relative to the fault's own column.
EXACTNESS = 1e-8

#: Signals of a motion that a sentence names; further ones are only counted.
MOST_NAMED_SIGNALS = 6

#: Motions with more unknowns keep all nonzero amplitudes: leaving out one by one solves as many least-squares problems.
MOST_PRUNED_UNKNOWNS = 40


def hidden_motion(plant: DescriptorSystem, fault: int, point: complex, removed: Sequence[int]) -> str | None:
    """Return a motion that hides a fault, in words: with it a fault of amplitude 1 leaves every output at zero.

    The motion has amplitudes of states, unknown inputs and the ``removed`` faults, all proportional to
    ``exp(point t)``, or to ``point^k`` in discrete time.  ``None`` where no motion hides the fault.
    """
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
    """Return the amplitudes of a motion that hides a fault of amplitude 1, by signal name, inputs first.

    Among such motions it is nearly the sparsest one.  ``None`` where no motion hides the fault.
    """
    e, a = unknowns_pencil(plant, removed)
    amplitudes = _sparse_solution(a - point * e, -np.concatenate([plant.Bf[:, fault], plant.Df[:, fault]]))
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


def _sparse_solution(matrix: ComplexArray, right: ComplexArray) -> ComplexArray | None:
    """Return a solution with few entries: a least-squares solution, then unneeded entries are removed one by one."""
    units = PencilUnits.of(np.zeros(matrix.shape), np.abs(matrix))
    work, goal = units.rows[:, None] * matrix * units.columns, units.rows * right
    size = float(np.linalg.norm(goal))
    if size == 0.0:
        return None

    def solve(chosen: list[int]) -> tuple[ComplexArray, float]:
        part, *_ = np.linalg.lstsq(work[:, chosen], goal, rcond=RANK_TOLERANCE)
        return np.asarray(part, dtype=np.complex128), float(np.linalg.norm(work[:, chosen] @ part - goal)) / size

    columns = list(range(matrix.shape[1]))
    part, miss = solve(columns)
    if miss > EXACTNESS:
        return None
    smallest_first = sorted(columns, key=lambda j: abs(part[j])) if len(columns) <= MOST_PRUNED_UNKNOWNS else []
    for index in smallest_first:
        fewer = [j for j in columns if j != index]
        if solve(fewer)[1] <= EXACTNESS:
            columns = fewer
    part, _ = solve(columns)
    amplitudes = np.zeros(matrix.shape[1], dtype=np.complex128)
    amplitudes[columns] = part
    # Amplitudes that are rounding in balanced units are set to zero before they are scaled to the data's units.
    amplitudes[np.abs(amplitudes) <= RANK_TOLERANCE * float(np.max(np.abs(amplitudes), initial=0.0))] = 0.0
    return np.asarray(units.columns * amplitudes)


def _named(names: Sequence[str], values: ComplexArray) -> dict[str, complex]:
    return {name: complex(value) for name, value in zip(names, values, strict=True) if value != 0.0}


def _amplitude(value: complex) -> str:
    if abs(value.imag) <= EXACTNESS * abs(value):
        return f"{value.real:.3g}"
    return f"{value.real:.3g}{value.imag:+.3g}j"
