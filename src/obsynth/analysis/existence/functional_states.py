"""States and functionals of the state that the outputs determine, whatever unknown inputs and faults are."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from obsynth.analysis.diagnosis.decoupled import DecoupledPlant, decoupled
from obsynth.analysis.existence.augmented_pencils import numbers
from obsynth.analysis.existence.condition import OPTIONS_PATH, Condition
from obsynth.errors import SpecError
from obsynth.numerics.arrays import SMALLEST, FloatArray
from obsynth.numerics.ranks import numerical_rank
from obsynth.numerics.suggestions import there_are
from obsynth.plants.descriptor import DescriptorSystem
from obsynth.plants.plant_units import PlantUnits

#: A functional is missed where combinations leave more than this share of it, in the plant's own units.
MISSED_SHARE = 1e-9

#: A zero is real, or on the boundary of stability, within this share of its size: no double zero comes out closer.
AS_REAL = 1e-9

#: Weights and directions below this share of the largest are rounding of a few hundred sums.
ROUNDING_SHARE = 1e-13

_SOURCE = "[A - sE, Bd, Bf; C, Dd, Df], after Darouach 2000"


@dataclass(frozen=True, eq=False)
class StateGoals:
    """``x_i = moving xi + known [u; y] + (T0 times the plant's equations)`` for some states i.

    ``moving (count, order)``, ``known (count, nu + ny)``, ``T0 (count, nx)`` with ``T0 E = 0``; ``missed (count,)``:
    share of each state that no such combination is.
    """

    moving: FloatArray
    known: FloatArray
    T0: FloatArray
    missed: FloatArray


def chosen_states(states: Any, plant: DescriptorSystem) -> list[int]:
    """Return the numbers of states by name."""
    listed = [states] if isinstance(states, str) else list(states or ())
    path = f"{OPTIONS_PATH}.states"
    unknown = [name for name in listed if name not in plant.state_names]
    if unknown:
        raise SpecError(
            f"{', '.join(map(repr, unknown))}: no such state; {there_are(unknown[0], plant.state_names)} For a "
            "combination of states, such as x1 - x2, give the plant functionals: {NAME: {x1: 1, x2: -1}}.",
            path=path,
        )
    if len(set(listed)) < len(listed):
        raise SpecError("a state is named twice.", path=path)
    return sorted(plant.state_names.index(name) for name in listed)


def without_faults(plant: DescriptorSystem) -> DecoupledPlant:
    """Return the plant free of unknown inputs and of all faults, whatever their time course."""
    return decoupled(plant, list(range(plant.nf)), ())


def state_goals(plant: DescriptorSystem, places: Sequence[int], t: FloatArray) -> StateGoals:
    """Return states as combinations of ``xi = T E x (order, nx)``, the outputs and the plant's equations.

    ``Cz T E + Dy C = T0 A + goal`` with ``T0 E = 0`` and nothing of unknown inputs and faults: outputs are taken only
    where the filter's states do not have it, as their noise would pass right through.
    """
    units = PlantUnits.of(plant)
    nx, ny, order = plant.nx, plant.ny, len(t)
    goal = np.zeros((len(places), nx))
    goal[range(len(places)), list(places)] = 1.0
    unknown_a, unknown_c = np.hstack([plant.Bd, plant.Bf]), np.hstack([plant.Dd, plant.Df])
    te = t @ plant.E
    count = unknown_a.shape[1]
    rows = np.vstack([
        np.hstack([te, np.zeros((order, count + nx))]),
        np.hstack([-plant.A, -unknown_a, plant.E]),
        np.hstack([plant.C, unknown_c, np.zeros((ny, nx))]),
    ])  # fmt: skip
    # States in their own units; conditions on E are about the same equations.
    columns = np.concatenate([units.states, np.ones(count), units.states])
    scaled = rows * columns
    sizes = np.linalg.norm(scaled, axis=1)
    scaled = scaled / np.where(sizes > 0.0, sizes, 1.0)[:, None]
    targets = np.hstack([goal * units.states, np.zeros((len(places), count + nx))])
    lengths = np.linalg.norm(targets, axis=1)
    weights = np.zeros((len(places), len(rows)))
    missed = np.ones(len(places))
    for width in (order + nx, len(rows)):
        todo = missed > MISSED_SHARE
        if not todo.any() or not width:
            continue
        solution = np.linalg.lstsq(scaled[:width].T, targets[todo].T, rcond=ROUNDING_SHARE)[0].T
        shares = np.linalg.norm(solution @ scaled[:width] - targets[todo], axis=1) / lengths[todo]
        weights[todo] = 0.0
        weights[todo, :width] = solution / np.where(sizes[:width] > 0.0, sizes[:width], 1.0)
        missed[todo] = shares
    largest = np.max(np.abs(weights) * np.where(sizes > 0.0, sizes, 1.0), axis=1, initial=0.0, keepdims=True)
    weights = np.where(np.abs(weights) * sizes > ROUNDING_SHARE * largest, weights, 0.0)
    moving, t0, direct = np.split(weights, [order, order + nx], axis=1)
    # moving T E - t0 A + direct C = goal
    known = np.hstack([t0 @ plant.B - direct @ plant.D, direct])
    return StateGoals(moving, known, t0, missed)


@dataclass(frozen=True, eq=False)
class FixedModes:
    """``xi = T E x`` with ``xi+ = A xi + B [u; y]``, whatever unknown inputs and faults are: motions at zeros of the
    plant, which no gain changes, and which decay."""

    A: FloatArray  # (m, m)
    B: FloatArray  # (m, nu + ny)
    T: FloatArray  # (m, nx)


def fixed_modes(plant: DescriptorSystem, decoupled_plant: DecoupledPlant, t: FloatArray, rate: float) -> FixedModes:
    """Return the motions at zeros that decay faster than at ``rate`` (1/s), beside the rows ``t`` of the filter.

    At such a zero a row ``[t b]`` is orthogonal to all columns of the plant's pencil: ``t A + b C = zero t E``,
    ``t Bd + b Dd = 0``.  Of a multiple zero the rows at it are taken, not those of longer chains.
    """
    columns = np.vstack([np.hstack([plant.Bd, plant.Bf]), np.hstack([plant.Dd, plant.Df])])
    nx, ny, rows = plant.nx, plant.ny, t
    blocks, moved, own = list[FloatArray](), list[FloatArray](), list[FloatArray]()
    units = PlantUnits.of(plant)
    scale = np.concatenate([units.equations, units.outputs])
    for zero in _decaying(decoupled_plant.removed, plant.dt, rate):
        pencil = np.hstack([np.vstack([plant.A - zero * plant.E, plant.C]), columns])
        pencil = scale[:, None] * pencil
        sizes = np.linalg.norm(pencil, axis=0)
        left_vectors, values, _ = np.linalg.svd(pencil / np.where(sizes > 0.0, sizes, 1.0))
        rank = numerical_rank(values, tolerance=MISSED_SHARE)
        for vector in left_vectors[:, rank:].conj().T * scale:
            parts = [vector] if zero.imag == 0.0 else [vector.real, vector.imag]
            new = np.array([part[:nx].real for part in parts])
            if not _adds(rows, new, plant.E * units.states):
                continue
            rows = np.vstack([rows, new])
            b = np.array([part[nx:].real for part in parts])
            block = np.array([[zero.real]]) if zero.imag == 0.0 else np.array(
                [[zero.real, -zero.imag], [zero.imag, zero.real]]
            )  # fmt: skip
            blocks.append(block)
            moved.append(np.hstack([new @ plant.B + b @ plant.D, -b]))
            own.append(new)
    from scipy.linalg import block_diag

    return FixedModes(
        block_diag(*blocks) if blocks else np.zeros((0, 0)),
        np.vstack([np.zeros((0, plant.nu + ny)), *moved]),
        np.vstack([np.zeros((0, nx)), *own]),
    )


def _decaying(zeros: Any, dt: float, rate: float) -> list[complex]:
    """Return the zeros that decay faster than at a rate, one of each complex pair; real ones exactly real."""
    decaying = list[complex]()
    for value in zeros:
        zero = complex(value)
        if abs(zero.imag) <= AS_REAL * max(abs(zero), SMALLEST):
            zero = complex(zero.real, 0.0)
        slowest = np.exp(-rate * dt) * (1.0 - AS_REAL) if dt > 0.0 else max(rate, AS_REAL * abs(zero))
        fast = abs(zero) <= slowest if dt > 0.0 else -zero.real > slowest
        if zero.imag >= 0.0 and fast:
            decaying.append(zero)
    return decaying


def _adds(rows: FloatArray, new: FloatArray, e: FloatArray) -> bool:
    """Whether all of ``new E`` is independent of ``rows E``."""
    joined = np.vstack([rows, new]) @ e
    sizes = np.linalg.norm(joined, axis=1, keepdims=True)
    if not np.all(sizes > 0.0):
        return False
    values = np.linalg.svd(joined / sizes, compute_uv=False)
    return len(joined) <= joined.shape[1] and numerical_rank(values, tolerance=MISSED_SHARE, scale=1.0) == len(joined)


def filter_rows(plant: DescriptorSystem, decoupled_plant: DecoupledPlant) -> FloatArray:
    """Return T ``(order, nx)`` of the decoupled plant's states ``T E x``."""
    if not decoupled_plant.order:
        return np.zeros((0, plant.nx))
    return np.asarray(np.linalg.solve(decoupled_plant.E, decoupled_plant.rows[: decoupled_plant.order, : plant.nx]))


def state_conditions(plant: DescriptorSystem, places: Sequence[int], decay: float | None) -> tuple[Condition, ...]:
    """Return, for each state asked for, whether an observer with errors that decay (at least at a rate, 1/s) exists."""
    if not places:
        return ()
    decoupled_plant = without_faults(plant)
    t = filter_rows(plant, decoupled_plant)
    fixed = fixed_modes(plant, decoupled_plant, t, decay or 0.0)
    goals = state_goals(plant, places, np.vstack([t, fixed.T]))
    unknowns = ", ".join((*plant.disturbance_names, *plant.fault_names)) or "the initial state"
    conditions, at = [], f" at {decay:.4g} 1/s" if decay else ""
    for place, missed in zip(places, goals.missed, strict=True):
        name = plant.state_names[place]
        holds = bool(missed <= MISSED_SHARE)
        detail = f"share that is missed: {missed:.1e}" if not holds else ""
        if not holds and len(decoupled_plant.removed):
            modes = ", ".join(numbers(decoupled_plant.removed[:3]))
            detail += f"; what is missed may move with zeros of the plant ({modes}), which no gain changes"
        conditions.append(
            Condition(
                f"{name} determined",
                f"the outputs determine {name}, but for errors that decay{at}, whatever {unknowns} may be",
                holds,
                float(holds),
                1.0,
                _SOURCE,
                f"{detail}." if detail else "",
                signals=() if holds else (name,),
            )
        )
    return tuple(conditions)
