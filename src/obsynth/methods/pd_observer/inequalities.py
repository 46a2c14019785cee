r"""The matrix inequalities of the PD observer, in coordinates of our choice.

With Y = P3' J, Z = P3' L and ``T = P3' D = P3' + Z C``, every requirement is one inequality of the form

.. math::
    \begin{bmatrix} M + M^T & \cdot \\ \delta M - T^T & -\delta (T + T^T) \end{bmatrix}
    + \begin{bmatrix} a P & b P \\ b P & c P \end{bmatrix} < 0, \qquad P > 0

for the pencil ``Ae - s D``: M = P3' Ae and (a, b, c) = (0, 1, 0) for stability, M = P3' (Ae + alpha D) for a decay
rate, and (c^2 - r^2, c, 1) for a disk of centre -c and radius r.  P3, Y and Z are common, P belongs to each.  Theorem 2
asks for a symmetric positive definite P3.  What is minimised keeps P3 away from singular: the paper's own inequalities
do not (plain feasibility gave gains of 1e9, a maximal margin 3e13).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from obsynth.errors import SolverError
from obsynth.methods.conic import lmi
from obsynth.numerics.arrays import FloatArray

#: How far inside the cone the inequalities must hold, with ``P3 + P3' >= 2 I`` as the scale.
MARGIN = 1e-3


@dataclass(frozen=True, eq=False)
class PdTask:
    """What is asked of the gains, in the coordinates in which it is solved.

    Fields: plants: Augmented ``A (n, n)`` and ``C (ny, n)``; more than one for a range of adaptation gains; theorem:
    Which theorem; delta, decay: delta and alpha; disk: c and r: every eigenvalue within r of -c; gain_bound: Bound on
    the norm of ``[gain_unit J, L]``; gain_unit: Factor from J here to the J that is bounded; rate_gain: Bound on the l2
    gain from the rate of the fault to the fault error; noise_gain: Bound on the l2 gain from noise and its derivative,
    as separate inputs, to the fault error; rate: ``(n, nf)``, where the rate enters; shown: ``(nf, n)``, from the error
    to the fault error; process, sensor, sensor_rate: ``(n, nw)``, ``(ny, nw)``, ``(ny, nw)``: where the noise enters
    the states and the outputs, and its derivative the outputs; has_derivative: False for L = 0.
    """

    plants: tuple[tuple[FloatArray, FloatArray], ...]
    theorem: int
    delta: float
    decay: float
    disk: tuple[float, float] | None
    gain_bound: float | None
    gain_unit: float
    rate_gain: float | None
    noise_gain: float | None
    rate: FloatArray
    shown: FloatArray
    process: FloatArray
    sensor: FloatArray
    sensor_rate: FloatArray
    has_derivative: bool = True


@dataclass(frozen=True, eq=False)
class PdSolution:
    """Gains and certificate in the coordinates of the task.

    Fields: J, L: ``(n, ny)``; P1: One per plant, ``(n, n)``; P3: ``(n, n)``; record: Of the solver run.
    """

    J: FloatArray
    L: FloatArray
    P1: tuple[FloatArray, ...]
    P3: FloatArray
    record: Mapping[str, Any]


@dataclass(frozen=True, eq=False)
class _Variables:
    P3: Any
    Y: Any  # for the shifted plant: P3' (J - alpha L)
    Z: Any


def solve(task: PdTask, *, solver: str) -> PdSolution:
    """Return the gains of least size that meet the task."""
    n, ny = task.plants[0][1].shape[1], task.plants[0][1].shape[0]
    p3 = lmi.symmetric_variable(n) if task.theorem == 2 else lmi.matrix_variable(n, n)
    z = lmi.matrix_variable(n, ny) if task.has_derivative else np.zeros((n, ny))
    found = _Variables(p3, lmi.matrix_variable(n, ny), z)
    own = [lmi.symmetric_variable(n) for _ in task.plants]
    constraints = [lmi.at_least(p3 + p3.T, 2.0)]
    for (a, c), p in zip(task.plants, own, strict=True):
        constraints += [lmi.at_least(p, MARGIN), lmi.at_most(_stability(task, found, a, c, p), -MARGIN)]
    constraints += _further(task, found)
    size = lmi.frobenius_norm(found.Y, found.Z) + lmi.frobenius_norm(p3)
    record = lmi.minimise(size, constraints, what=f"a PD observer by Theorem {task.theorem}", solver=solver)
    p3_value = lmi.value_of(p3)
    try:
        gain_j, gain_l = (np.asarray(np.linalg.solve(p3_value.T, lmi.value_of(part))) for part in (found.Y, found.Z))
    except np.linalg.LinAlgError as error:
        raise SolverError("The solver returned a singular P3: nothing is known.", record=record) from error
    p1 = tuple(symmetric(lmi.value_of(p)) for p in own)
    return PdSolution(
        gain_j + task.decay * gain_l, gain_l, p1, symmetric(p3_value) if task.theorem == 2 else p3_value, record
    )


def symmetric(matrix: FloatArray) -> FloatArray:
    """Return the symmetric part of a matrix."""
    return 0.5 * (matrix + matrix.T)


def _stability(task: PdTask, found: _Variables, a: FloatArray, c: FloatArray, p: Any) -> Any:
    shifted = a + task.decay * np.eye(len(a))
    return lmi.symmetric_blocks(_blocks(task, found, found.P3.T @ shifted - found.Y @ c, c, p, (0.0, 1.0, 0.0)))


def _blocks(task: PdTask, found: _Variables, moving: Any, c: FloatArray, p: Any, weights: tuple[float, ...]) -> Any:
    """Return the lower triangle of blocks; ``moving`` is M and ``weights`` are (a, b, c) of the module's text."""
    still = found.P3.T + found.Z @ c
    return [
        [moving + moving.T + weights[0] * p],
        [task.delta * moving - still.T + weights[1] * p, -task.delta * (still + still.T) + weights[2] * p],
    ]


def _further(task: PdTask, found: _Variables) -> list[Any]:
    """Return the constraints of what is asked besides a decay rate, for the plant itself (not shifted)."""
    a, c = task.plants[0]
    proportional = found.Y + task.decay * found.Z  # P3' J
    moving = found.P3.T @ a - proportional @ c
    constraints: list[Any] = []
    if task.disk is not None:
        centre, radius = task.disk
        p = lmi.symmetric_variable(len(a))
        blocks = _blocks(task, found, moving, c, p, (centre**2 - radius**2, centre, 1.0))
        constraints += [lmi.at_least(p, MARGIN), lmi.at_most(lmi.symmetric_blocks(blocks), -MARGIN)]
    if task.gain_bound is not None:
        # P3' P3 >= P3 + P3' - I, so that [Y Z][Y Z]' <= r^2 (P3 + P3' - I) bounds the norm of [J L] by r.
        constraints.append(_bounded(task, found, proportional, task.gain_bound))
    if task.rate_gain is not None:
        row = found.P3.T @ task.rate
        constraints += _gain(task, found, moving, c, row.T, task.rate_gain)
    if task.noise_gain is not None:
        direct = found.P3.T @ task.process - proportional @ task.sensor
        row = lmi.stacked(direct.T, -(found.Z @ task.sensor_rate).T)
        constraints += _gain(task, found, moving, c, row, task.noise_gain)
    return constraints


def _bounded(task: PdTask, found: _Variables, proportional: Any, bound: float) -> Any:
    n, ny = task.shown.shape[1], task.sensor.shape[0]
    return lmi.at_least(
        lmi.symmetric_blocks([
            [found.P3 + found.P3.T - np.eye(n)],
            [task.gain_unit * proportional.T / bound, np.eye(ny)],
            [found.Z.T / bound, np.zeros((ny, ny)), np.eye(ny)],
        ])
    )  # fmt: skip


def _gain(task: PdTask, found: _Variables, moving: Any, c: FloatArray, row: Any, level: float) -> list[Any]:
    """Return the bounded real inequality of the pencil; the scale theta of the fault error is free."""
    p, theta = lmi.symmetric_variable(task.shown.shape[1]), lmi.scalar_variable()
    stability = _blocks(task, found, moving, c, p, (0.0, 1.0, 0.0))
    stability[0][0] = stability[0][0] + theta * (task.shown.T @ task.shown)
    inputs = row.shape[0]
    blocks = [*stability, [row, task.delta * row, -(level**2) * theta * np.eye(inputs)]]
    return [lmi.at_least(p, MARGIN), lmi.at_most(lmi.symmetric_blocks(blocks), -MARGIN)]
