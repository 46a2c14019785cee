"""Simulation of discrete linear descriptor systems of index 0 or 1.

The algebraic equations are solved once, by `obsynth.eliminate_algebraic_states`; what is left is an ordinary
recursion, and all states come back through the recovery of that elimination.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from obsynth.analysis.transformations import StateRecovery, eliminate_algebraic_states
from obsynth.errors import SpecError
from obsynth.numerics.arrays import FloatArray, as_matrix
from obsynth.plants.descriptor import DescriptorSystem
from obsynth.simulation.trajectory import Trajectory


def simulate_plant(
    plant: DescriptorSystem,
    *,
    steps: int,
    u: ArrayLike | None = None,
    f: ArrayLike | None = None,
    d: ArrayLike | None = None,
    w: ArrayLike | None = None,
    initial_state: ArrayLike | None = None,
) -> Trajectory:
    """Simulate a discrete plant; every row satisfies its equations up to rounding.

    Shapes: ``initial_state (nx,)``.
    """
    if not plant.is_discrete:
        raise SpecError(
            "The plant is continuous: sample it first, with obsynth.discretise or transform: {sample_time: ...}.",
            path="dt",
        )
    if isinstance(steps, bool) or not isinstance(steps, (int, np.integer)) or steps < 1:
        raise SpecError(f"steps is {steps!r}: give a whole number of samples, 1 or more.", path="steps")
    sizes = {"u": plant.nu, "f": plant.nf, "d": plant.nd, "w": plant.nw}
    given = {"u": u, "f": f, "d": d, "w": w}
    signals = {name: _signal(given[name], name, (int(steps), size)) for name, size in sizes.items()}
    start = np.zeros(plant.nx) if initial_state is None else _initial_state(initial_state, plant.nx)
    elimination = eliminate_algebraic_states(plant)
    reduced, recovery = elimination.plant, elimination.recovery
    drive = _sum_of(signals, {"u": reduced.B, "f": reduced.Bf, "d": reduced.Bd, "w": reduced.Bw})
    dynamic = _recursion(reduced.A, dynamic_part(plant, recovery, start), drive)
    states = dynamic @ recovery.from_state.T + _sum_of(
        signals,
        {
            "u": recovery.from_input, "f": recovery.from_fault, "d": recovery.from_disturbance,
            "w": recovery.from_noise,
        },
    )  # fmt: skip
    outputs = states @ plant.C.T + _sum_of(signals, {"u": plant.D, "f": plant.Df, "d": plant.Dd, "w": plant.Dw})
    inconsistency = 0.0 if initial_state is None else float(np.linalg.norm(states[0] - start))
    return Trajectory(
        states, outputs, signals["u"], signals["f"], signals["d"], signals["w"],
        time=plant.dt * np.arange(steps, dtype=np.float64), inconsistency=inconsistency,
    )  # fmt: skip


def _signal(value: Any, name: str, shape: tuple[int, int]) -> FloatArray:
    if value is None:
        return np.zeros(shape)
    array = np.asarray(value)
    matrix = as_matrix(array.reshape(-1, 1) if array.ndim == 1 and shape[1] == 1 else array, name)
    if matrix.shape != shape:
        raise SpecError(
            f"{name} is {matrix.shape[0]} by {matrix.shape[1]}, but {shape[0]} by {shape[1]} is needed "
            "(samples by signals).",
            path=name,
        )
    return matrix


def _initial_state(value: Any, nx: int) -> FloatArray:
    array = np.asarray(value)
    state = as_matrix(array.reshape(1, -1) if array.ndim == 1 else array, "initial_state")
    if state.shape != (1, nx):
        raise SpecError(f"initial_state needs {nx} numbers, one for each state.", path="initial_state")
    row: FloatArray = state[0]
    return row


def _sum_of(signals: dict[str, FloatArray], matrices: dict[str, FloatArray]) -> FloatArray:
    """Return the sum of ``signal @ matrix.T`` over all signals."""
    first, *others = (np.asarray(signals[name] @ matrix.T) for name, matrix in matrices.items())
    return sum(others, start=first)


def dynamic_part(plant: DescriptorSystem, recovery: StateRecovery, state: FloatArray) -> FloatArray:
    """Return the coordinates of the dynamic states with the same ``E x``; the rest of x adds nothing to it."""
    moving = plant.E @ recovery.from_state
    sizes = np.max(np.abs(moving), axis=1)
    sizes[sizes == 0.0] = 1.0
    # The equations are consistent, so weighting rows changes nothing but accuracy.
    q, r = np.linalg.qr(moving / sizes[:, None])
    return np.asarray(np.linalg.solve(r, q.T @ (plant.E @ state / sizes)))


def _recursion(a: FloatArray, start: FloatArray, drive: FloatArray) -> FloatArray:
    """Return x(0), x(1), ... of ``x+ = a x + drive``."""
    states = np.empty_like(drive)
    states[0] = start
    with np.errstate(over="ignore", invalid="ignore"):
        for k in range(len(drive) - 1):
            states[k + 1] = a @ states[k] + drive[k]
    finite = np.all(np.isfinite(states), axis=1)
    if not np.all(finite):
        raise SpecError(
            f"The states outgrow double precision at sample {int(np.argmin(finite))}: the plant is unstable; "
            "simulate fewer steps.",
            path="steps",
        )
    return states
