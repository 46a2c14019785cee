"""Recursive filters of plants whose errors decay slowly from a start that is well known, and of plants without
dynamics."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import scipy.linalg as sl

import obsynth
from obsynth.observers.recursive.steady_filter import settled_contraction


def radius(a: np.ndarray, c: np.ndarray, q: np.ndarray, r: np.ndarray) -> float:
    """Spectral radius of the error of the steady-state filter, by SciPy."""
    p = sl.solve_discrete_are(a.T, c.T, q, r)
    gain = p @ c.T @ np.linalg.inv(c @ p @ c.T + r)
    return float(max(abs(np.linalg.eigvals(a @ (np.eye(len(a)) - gain @ c)))))


@pytest.mark.one_in(4)
@pytest.mark.parametrize("start", [1.0, 1e-6, 1e-12, 1e-30])
@pytest.mark.parametrize("mode", [1.0002, 1.01, 1.5])
def test_a_plant_that_does_not_change_has_no_horizon(mode: float, start: float) -> None:
    a, c, q, r = np.diag([mode, 0.5]), np.ones((1, 2)), 1e-14 * np.eye(2), np.eye(1)
    plant = obsynth.TimeVaryingDescriptorSystem(None, a, C=c, dt=1.0)
    design = obsynth.descriptor_kalman(plant, Q=q, R=r, initial_covariance=start)
    assert design.report.passed
    claimed = design.certificate.claims["contraction"]
    assert claimed < 1.0
    row = design.report["contraction"]
    if "steady state" in row.detail:
        assert claimed == pytest.approx(radius(a, c, q, r), abs=1e-6)


@pytest.mark.parametrize(("known", "settles"), [(0.0, False), (1e-30, True)])
def test_gains_that_never_look_at_a_state_settle_nowhere(known: float, settles: bool) -> None:
    # No noise moves the second state: where it is known exactly, no gain ever looks at it, and an error of it grows.
    plant = obsynth.TimeVaryingDescriptorSystem(None, np.diag([0.5, 1.1]), C=np.ones((1, 2)), dt=1.0)
    options = {"Q": np.diag([1.0, 0.0]), "R": np.eye(1)}
    design = obsynth.descriptor_kalman(plant, initial_covariance=np.eye(2), **options)
    observer = replace(design.observer, initial_covariance=np.diag([1.0, known]))
    assert (settled_contraction(observer) is not None) is settles


@pytest.mark.one_in(4)
@pytest.mark.parametrize("seed", range(6))
def test_parameters_of_plants_without_dynamics_are_estimated(seed: int) -> None:
    rng = np.random.default_rng([46, seed])
    n = int(rng.integers(1, 4))
    a = np.round(rng.normal(size=(n, n)) + 2.0 * np.eye(n), 1)
    bf = np.round(rng.normal(size=(n, 1)) + 1.0, 1)
    plant = obsynth.DescriptorSystem(
        E=np.zeros((n, n)), A=a, C=np.vstack([np.eye(n), np.ones((1, n))]), Bf=bf, dt=1.0,
        sensor_noise={f"y{k + 1}": 0.01 for k in range(n + 1)},
    )  # fmt: skip
    design = obsynth.adaptive_observer(plant, Q=1e-4)
    assert design.report.passed
    y = plant.C @ np.linalg.solve(a, -2.0 * bf[:, 0])
    said = design.observer.run(np.tile(y, (200, 1)), np.zeros((200, 0)))
    assert said.faults[-1, 0] == pytest.approx(2.0, abs=0.05)
