"""Polytopic plants of known truth."""

from __future__ import annotations

from functools import cache

import numpy as np

import obsynth
from obsynth import ObserverDesign, PolytopicSystem
from obsynth.numerics.arrays import FloatArray

#: Wang et al. 2015, example: E, A, C, Bf, Bd.
WANG_E = np.diag([1.0, 1.0, 1.0, 0.0])
WANG_A = np.array([[0.9, 0.005, -0.095, 0], [0.005, 0.995, 0.0997, 0], [0.095, -0.0997, 0.99, 0], [1.0, 0.0, 1.0, 1.0]])
WANG_C = np.eye(4)[1:]
WANG_BF = np.array([[0.1, 0], [1, 1], [-0.1, 1], [-1, 0]])
WANG_BD = np.array([[1.0], [1], [1], [0]])
#: The least gain of the paper's example.
WANG_LEAST = 1.464718345733


def wang(spread: float = 0.05, *, effectiveness: bool = False, rate: float | None = None) -> PolytopicSystem:
    """Return the example with a11 (and a23) off by a share that is measured; with faults of changing effect."""
    A, Bf = WANG_A.tolist(), WANG_BF.tolist()
    A[0][0] = f"0.9 * (1 + {spread} * a)"
    scheduling: dict[str, object] = {"a": {"range": [-1.0, 1.0], **({"rate": rate} if rate else {})}}
    if rate is None:
        A[1][2] = f"0.0997 + {spread} * b"
        scheduling["b"] = [-1.0, 1.0]
    if effectiveness:
        Bf = [[f"{one} * (1 + 0.5 * c)", other] for one, other in Bf]
        scheduling["c"] = [-1.0, 1.0]
    plant = {"E": WANG_E, "A": A, "B": [[1], [0], [0], [0]], "C": WANG_C, "Bf": Bf, "Bd": WANG_BD, "dt": 1.0}
    return PolytopicSystem(plant=plant, scheduling=scheduling)


@cache
def wang_filter(*, effectiveness: bool = False) -> ObserverDesign:
    """Return the fault estimation filter of the example, which many tests look at."""
    return obsynth.fault_estimation_filter(wang(effectiveness=effectiveness))


def record(
    plant: PolytopicSystem, parameters: FloatArray, u: FloatArray, f: FloatArray, d: FloatArray | None = None
) -> FloatArray:
    """Return outputs ``(samples, ny)`` of a plant ``E = diag(I, 0)`` of index 1 along courses of its parameters."""
    n = int(np.linalg.matrix_rank(plant.E))
    x, outputs = np.zeros(n), []
    d = np.zeros((len(u), plant.nd)) if d is None else d
    for k in range(len(u)):
        now = plant.at(parameters[k])
        driven = now.B @ u[k] + now.Bf @ f[k] + now.Bd @ d[k]
        whole = np.r_[x, np.linalg.solve(now.A[n:, n:], -(now.A[n:, :n] @ x + driven[n:]))]
        outputs.append(now.C @ whole + now.D @ u[k] + now.Df @ f[k] + now.Dd @ d[k])
        x = (now.A @ whole + driven)[:n]
    return np.array(outputs)
