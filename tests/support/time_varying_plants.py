"""Time-varying plants for tests, and an independent maximum-likelihood solution of whole records."""

from __future__ import annotations

import numpy as np

from obsynth import TimeVaryingDescriptorSystem
from obsynth.observers.recursive.observer import RecursiveObserver
from obsynth.observers.recursive.settings import Adaptation
from obsynth.plants.sequences import MatrixSequence


def varying(**changes) -> TimeVaryingDescriptorSystem:
    """Three states, one algebraic equation, two outputs (one residual direction), two parameters; all vary with k."""
    return TimeVaryingDescriptorSystem(
        **{
            "E": [[1, 0, "0.1 * sin(0.3 * k)"], [0, 1, 0], [0, 0, 0]],
            "A": [["0.8 + 0.1 * cos(0.2 * k)", 0.1, 0.3], [0, 0.7, "0.2 * sin(k)"], [1, "0.4 + 0.1 * sin(k)", -1]],
            "B": [[1], [0.5], [0.2]],
            "C": [[1, 0, "0.3 + 0.1 * cos(k)"], [0, 1, 1]],
            "Phi": [["sin(0.7 * k)", 0.3], [1, "cos(1.1 * k)"], [0.2, 0]],
            "Psi": [[0, 0.1], ["0.2 * cos(k)", 0]],
            "dt": 1.0,
            **changes,
        }
    )


def textbook(**changes) -> TimeVaryingDescriptorSystem:
    """E = I, so that every textbook filter applies; one parameter."""
    return TimeVaryingDescriptorSystem(
        **{
            "E": None, "A": [[0.9, 0.2], ["-0.1 * sin(k)", 0.7]], "B": [[1], [0]], "C": [[1, 0.5]],
            "Phi": [[1], ["cos(0.5 * k)"]], "dt": 1.0, **changes,
        }
    )  # fmt: skip


def printed(**changes) -> TimeVaryingDescriptorSystem:
    """The example of Moussa Ali and Zhang (2013), section 4: no residual direction."""
    return TimeVaryingDescriptorSystem(
        **{
            "E": [[0, 0], [-1, "(k - 1) / k"]],
            "A": [[1, "-(k + 1) / (k + 0.5)"], [0, "1 / (k + 1)"]],
            "B": np.eye(2),
            "C": [[0, 1]],
            "Phi": [["1 - exp(-k / 30) * sin(0.1 * k)"], ["1 - exp(-k / 15) * sin(0.5 * k)"]],
            "dt": 1.0,
            **changes,
        }
    )


def adaptation(nq: int, **changes) -> Adaptation:
    return Adaptation(
        **{
            "form": "innovation", "forgetting": 0.95, "guard": "none", "initial_parameters": np.zeros(nq),
            "initial_covariance": np.eye(nq), "walk": np.zeros((nq, nq)), "window": 10, **changes,
        }
    )  # fmt: skip


def observer_for(plant: TimeVaryingDescriptorSystem, *, adapt: dict | None = None, **changes) -> RecursiveObserver:
    """An observer with plain noise; ``adapt`` asks for parameters."""
    options = {
        "Q": np.diag(np.linspace(0.1, 0.3, plant.ne)),
        "R": np.diag(np.linspace(0.2, 0.4, plant.ny)),
        "initial_state": np.zeros(plant.nx),
        "initial_covariance": np.eye(plant.nx),
        **changes,
    }
    return RecursiveObserver(
        plant, MatrixSequence.of(options.pop("Q"), "Q"), MatrixSequence.of(options.pop("R"), "R"),
        adaptation=None if adapt is None else adaptation(plant.nq, **adapt), **options,
    )  # fmt: skip


def record(plant: TimeVaryingDescriptorSystem, samples: int, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """Any outputs and inputs: an estimator is a map of data, whatever they are."""
    rng = np.random.default_rng(seed)
    return rng.standard_normal((samples, plant.ny)), rng.standard_normal((samples, plant.nu))


def maximum_likelihood(
    observer: RecursiveObserver, y: np.ndarray, u: np.ndarray, *, parameters: bool = False, constraint: bool = False
) -> tuple[np.ndarray, np.ndarray]:
    """Return estimate and covariance of ``[x(N); theta]`` from one dense weighted least-squares problem.

    ``parameters`` makes theta an unknown with prior, ``constraint`` adds the algebraic row of step N.
    """
    plant, steps = observer.plant, len(y) - 1
    nx, nq = plant.nx, plant.nq if parameters else 0
    size = nx * (steps + 1) + nq
    rows, values, weights = [], [], []

    def add(blocks: dict[int, np.ndarray], value: np.ndarray, covariance: np.ndarray) -> None:
        row = np.zeros((len(value), size))
        for column, block in blocks.items():
            row[:, column : column + block.shape[1]] = block
        kept = np.isfinite(value)
        rows.append(row[kept])
        values.append(value[kept])
        weights.append(np.linalg.inv(covariance[np.ix_(kept, kept)]))

    add({0: np.eye(nx)}, observer.initial_state, observer.initial_covariance)
    if nq:
        prior = observer.adaptation
        add({size - nq: np.eye(nq)}, prior.initial_parameters, prior.initial_covariance)
    for k in range(steps):
        now, after = k * nx, (k + 1) * nx
        blocks = {after: plant.E.at(k + 1), now: -plant.A.at(k)}
        outputs = {after: plant.C.at(k + 1)}
        if nq:
            blocks[size - nq], outputs[size - nq] = -plant.Phi.at(k), plant.Psi.at(k)
        add(blocks, plant.B.at(k) @ u[k], observer.Q.at(k))
        add(outputs, y[k + 1], observer.R.at(k))
    if constraint:
        late = ~plant.E.at(1).any(axis=1)
        add({steps * nx: plant.A.at(steps)[late]}, -(plant.B.at(steps) @ u[steps])[late],
            observer.Q.at(steps)[np.ix_(late, late)])  # fmt: skip
    matrix, value = np.vstack(rows), np.concatenate(values)
    weight = np.zeros((len(value), len(value)))
    position = 0
    for block in weights:
        weight[position : position + len(block), position : position + len(block)] = block
        position += len(block)
    covariance = np.linalg.inv(matrix.T @ weight @ matrix)
    solution = covariance @ matrix.T @ weight @ value
    return solution[steps * nx :], covariance[steps * nx :, steps * nx :]
