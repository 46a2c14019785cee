r"""The matrix inequalities of PD observers of several plants, with bounds on gains, in coordinates of our choice.

.. math::
    \begin{bmatrix} M + M^T & \cdot \\ \delta M - T^T & -\delta (T + T^T) \end{bmatrix}
    + \begin{bmatrix} a P & b P \\ b P & c P \end{bmatrix} < 0, \qquad P > 0

with Y = P3' J, Z = P3' L, ``T = P3' + Z C``: M = P3' Ae and (a, b, c) = (0, 1, 0) for stability, M = P3' (Ae + alpha D)
for a decay rate, (c^2 - r^2, c, 1) for a disk of centre -c and radius r.  P3, Y, Z are common, P belongs to each.
What is minimised keeps P3 from singular: plain feasibility gave gains of 1e9, a maximal margin 3e13.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from threading import Lock
from typing import Any

import numpy as np

from obsynth.conditions import lazy_cvxpy as cp
from obsynth.conditions import lmi
from obsynth.conditions.filasova import PD_MARGIN
from obsynth.errors import SolverError
from obsynth.numerics.arrays import FloatArray
from obsynth.numerics.doubling import symmetric

#: Up to so many states plants of one size share a canonical form, of as many sizes at a time: cvxpy takes several times
#: as long to make one as Clarabel to solve it, and a design solves a hundred.
STATES_OF_COMMON_FORMS, COMMON_FORMS = 12, 16

#: The theorem with a symmetric P3.
SYMMETRIC_THEOREM = 2


@dataclass(frozen=True, eq=False)
class PdTask:
    """What is asked of the gains, in the coordinates in which it is solved."""

    plants: tuple[tuple[FloatArray, FloatArray], ...]  # augmented A (n, n), C (ny, n); several for a range
    theorem: int
    delta: float
    decay: float
    disk: tuple[float, float] | None  # c and r: every eigenvalue within r of -c
    gain_bound: float | None  # on the norm of [gain_unit J, L]
    gain_unit: float  # from J here to the J that is bounded
    rate_gain: float | None  # l2 gain from the fault's rate to the fault error
    noise_gain: float | None  # from noise and its derivative, separate inputs
    rate: FloatArray  # (n, nf), where the rate enters
    fault_error: FloatArray  # (nf, n): from the error
    process: FloatArray  # (n, nw)
    sensor: FloatArray  # (ny, nw)
    sensor_rate: FloatArray  # (ny, nw), of the noise's derivative

    @property
    def is_plain(self) -> bool:
        """Whether stability and a decay rate are all that is asked."""
        return all(one is None for one in (self.disk, self.gain_bound, self.rate_gain, self.noise_gain))


@dataclass(frozen=True, eq=False)
class PdSolution:
    """Gains and certificate in the coordinates of the task."""

    J: FloatArray  # (n, ny), as L
    L: FloatArray
    P1: tuple[FloatArray, ...]  # one per plant, (n, n), as P3
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
    has_default = str(solver) == "CLARABEL" and not getattr(solver, "options", None)
    if task.is_plain and has_default and ny and n <= STATES_OF_COMMON_FORMS:
        form = _common_form(n, ny, len(task.plants), task.theorem)
        with form.lock:
            form.take(task)
            what = f"a PD observer by Theorem {task.theorem}"
            record = lmi.solved(form.problem, what, solver, run=lmi.solve_again)
            return _solution(task, form.variables, form.own, record)
    variables, own = _variables(n, ny, len(task.plants), task.theorem)
    constraints = [lmi.at_least(2.0 * variables.P3, 2.0)]
    for (a, c), p in zip(task.plants, own, strict=True):
        constraints += [lmi.at_least(p, PD_MARGIN), lmi.at_most(_stability(task, variables, a, c, p), -PD_MARGIN)]
    constraints += _further(task, variables)
    record = lmi.minimise(_size(variables), constraints, what=f"a PD observer by Theorem {task.theorem}", solver=solver)
    return _solution(task, variables, own, record)


def _variables(n: int, ny: int, plants: int, theorem: int) -> tuple[_Variables, list[Any]]:
    """Return the common variables, and P of each plant."""
    p3 = lmi.symmetric_variable(n) if theorem == SYMMETRIC_THEOREM else lmi.matrix_variable(n, n)
    z = lmi.matrix_variable(n, ny)
    return _Variables(p3, lmi.matrix_variable(n, ny), z), [lmi.symmetric_variable(n) for _ in range(plants)]


def _size(variables: _Variables) -> Any:
    return cp.norm(cp.hstack([variables.Y, variables.Z]), "fro") + cp.norm(cp.hstack([variables.P3]), "fro")


def _solution(task: PdTask, variables: _Variables, own: Sequence[Any], record: Mapping[str, Any]) -> PdSolution:
    p3_value = lmi.value_of(variables.P3)
    try:
        gain_j, gain_l = (
            np.asarray(np.linalg.solve(p3_value.T, lmi.value_of(part))) for part in (variables.Y, variables.Z)
        )
    except np.linalg.LinAlgError as error:
        raise SolverError("The solver returned a singular P3: the result is inconclusive.", record=record) from error
    p1, p3 = tuple(symmetric(lmi.value_of(p)) for p in own), p3_value
    is_symmetric = task.theorem == SYMMETRIC_THEOREM
    return PdSolution(gain_j + task.decay * gain_l, gain_l, p1, symmetric(p3) if is_symmetric else p3, record)


@dataclass(frozen=True, eq=False)
class _CommonForm:
    """The inequalities of stability with the plants' numbers as parameters, for one task at a time."""

    problem: Any
    variables: _Variables
    own: Sequence[Any]
    double_delta: Any
    plants: Sequence[Mapping[str, Any]]
    lock: Lock

    def take(self, task: PdTask) -> None:
        """Put the numbers of a task in place; products of numbers are parameters of their own."""
        self.double_delta.value = 2.0 * task.delta
        for parameters, (a, c) in zip(self.plants, task.plants, strict=True):
            shifted = a + task.decay * np.eye(len(a))
            values = {
                "A": shifted, "C": c, "delta A": task.delta * shifted, "delta C": task.delta * c,
                "2 delta C": 2.0 * task.delta * c,
            }  # fmt: skip
            for name, value in values.items():
                parameters[name].value = value


@lru_cache(COMMON_FORMS)
def _common_form(n: int, ny: int, plants: int, theorem: int) -> _CommonForm:
    (variables, own), double_delta = _variables(n, ny, plants, theorem), cp.Parameter()
    p3, y, z = variables.P3, variables.Y, variables.Z
    constraints, shapes = [lmi.at_least(2.0 * p3, 2.0)], {"A": (n, n), "delta A": (n, n)}
    shapes |= dict.fromkeys(("C", "delta C", "2 delta C"), (ny, n))
    parameters = [{name: cp.Parameter(shape) for name, shape in shapes.items()} for _ in own]
    for p, of in zip(own, parameters, strict=True):
        blocks = [
            [2.0 * (p3.T @ of["A"] - y @ of["C"])],
            [
                p3.T @ of["delta A"] - y @ of["delta C"] - (p3.T + z @ of["C"]).T + p,
                -(double_delta * p3.T + z @ of["2 delta C"]),
            ],
        ]
        constraints += [lmi.at_least(p, PD_MARGIN), lmi.at_most(lmi.symmetric_blocks(blocks), -PD_MARGIN)]
    problem = cp.Problem(cp.Minimize(_size(variables)), constraints)
    return _CommonForm(problem, variables, own, double_delta, parameters, Lock())


def _stability(task: PdTask, variables: _Variables, a: FloatArray, c: FloatArray, p: Any) -> Any:
    shifted = a + task.decay * np.eye(len(a))
    return lmi.symmetric_blocks(
        _blocks(task, variables, variables.P3.T @ shifted - variables.Y @ c, c, p, (0.0, 1.0, 0.0))
    )


def _blocks(task: PdTask, variables: _Variables, moving: Any, c: FloatArray, p: Any, weights: tuple[float, ...]) -> Any:
    """Return the lower triangle of blocks; ``moving`` is M and ``weights`` are (a, b, c) of the module's text.

    On the diagonal stands what has the symmetric part that is meant.
    """
    still = variables.P3.T + variables.Z @ c
    first, second, third = (weight * p if weight else np.zeros(p.shape) for weight in weights)
    return [[2.0 * moving + first], [task.delta * moving - still.T + second, -2.0 * task.delta * still + third]]


def _further(task: PdTask, variables: _Variables) -> list[Any]:
    """Return the constraints of what is asked besides a decay rate, for the plant itself (not shifted)."""
    a, c = task.plants[0]
    proportional = variables.Y + task.decay * variables.Z  # P3' J
    moving = variables.P3.T @ a - proportional @ c
    constraints: list[Any] = []
    if task.disk is not None:
        centre, radius = task.disk
        p = lmi.symmetric_variable(len(a))
        blocks = _blocks(task, variables, moving, c, p, (centre**2 - radius**2, centre, 1.0))
        constraints += [lmi.at_least(p, PD_MARGIN), lmi.at_most(lmi.symmetric_blocks(blocks), -PD_MARGIN)]
    if task.gain_bound is not None:
        # P3' P3 >= P3 + P3' - I, so that [Y Z][Y Z]' <= r^2 (P3 + P3' - I) bounds the norm of [J L] by r.
        constraints.append(_bounded(task, variables, proportional, task.gain_bound))
    if task.rate_gain is not None:
        row = variables.P3.T @ task.rate
        constraints += _gain(task, variables, moving, c, row.T, task.rate_gain)
    if task.noise_gain is not None:
        direct = variables.P3.T @ task.process - proportional @ task.sensor
        row = cp.vstack([direct.T, -(variables.Z @ task.sensor_rate).T])
        constraints += _gain(task, variables, moving, c, row, task.noise_gain)
    return constraints


def _bounded(task: PdTask, variables: _Variables, proportional: Any, bound: float) -> Any:
    n, ny = task.fault_error.shape[1], task.sensor.shape[0]
    return lmi.at_least(
        lmi.symmetric_blocks(
            [
                [2.0 * variables.P3 - np.eye(n)],
                [task.gain_unit * proportional.T / bound, np.eye(ny)],
                [variables.Z.T / bound, np.zeros((ny, ny)), np.eye(ny)],
            ]
        )
    )


def _gain(task: PdTask, variables: _Variables, moving: Any, c: FloatArray, row: Any, level: float) -> list[Any]:
    """Return the bounded real inequality of the pencil; the scale theta of the fault error is free."""
    p, theta = lmi.symmetric_variable(task.fault_error.shape[1]), cp.Variable(nonneg=True)
    stability = _blocks(task, variables, moving, c, p, (0.0, 1.0, 0.0))
    stability[0][0] = stability[0][0] + theta * (task.fault_error.T @ task.fault_error)
    inputs = row.shape[0]
    blocks = [*stability, [row, task.delta * row, -(level**2) * theta * np.eye(inputs)]]
    return [lmi.at_least(p, PD_MARGIN), lmi.at_most(lmi.symmetric_blocks(blocks), -PD_MARGIN)]
