"""Steady filters of plants of which outputs or equations without noise tell states exactly: no covariance is left."""

from __future__ import annotations

import numpy as np
import pytest

import obsynth
from obsynth.errors import PreconditionError


def drawn(seed: int) -> tuple[obsynth.DescriptorSystem, np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    n = int(rng.integers(1, 5))
    ny = int(rng.integers(1, n + 1))
    a = rng.standard_normal((n, n)) * rng.choice([0.3, 0.6, 1.0])
    c = rng.standard_normal((ny, n))
    q, r = (
        rng.standard_normal((n, int(rng.integers(0, n + 1)))),
        rng.standard_normal((ny, int(rng.integers(0, ny + 1)))),
    )
    return obsynth.DescriptorSystem(A=a, C=c, dt=1.0), q @ q.T, r @ r.T


def settled(plant: obsynth.DescriptorSystem, q: np.ndarray, r: np.ndarray) -> np.ndarray:
    """Return the covariance that the textbook's recursion comes to."""
    a, c = plant.A, plant.C
    p, little = np.eye(len(a)), 1e-12 * np.eye(len(c))
    for _ in range(400):
        p = a @ p @ a.T + q
        p = p - p @ c.T @ np.linalg.solve(c @ p @ c.T + r + little, c @ p)
    return p


@pytest.mark.parametrize("seed", [16, 37, 59, 114, 116, 131, 147, 149, 157, 189, 199, 205, 222, 327, 330, 384])
def test_what_is_known_exactly_has_no_covariance(seed: int) -> None:
    plant, q, r = drawn(seed)
    try:
        steady = obsynth.steady_state_filter(plant, Q=q, R=r)
    except PreconditionError:
        return
    assert steady.rate < 1.0
    size = max(float(np.linalg.norm(q) + np.linalg.norm(r)), 1.0)
    np.testing.assert_allclose(steady.P, settled(plant, q, r), atol=1e-7 * size)


def test_perfect_sensors_of_all_states_leave_nothing_unknown() -> None:
    plant = obsynth.DescriptorSystem(A=[[1.2, 1.0], [0.3, 1.1]], C=[[3.0, 1.0], [1.0, 7.0]], dt=1.0)
    steady = obsynth.steady_state_filter(plant, Q=np.eye(2), R=0.0)
    assert not steady.P.any()
    np.testing.assert_allclose(steady.K @ plant.C, np.eye(2), atol=1e-12)


def test_little_noise_is_not_taken_for_none() -> None:
    plant = obsynth.DescriptorSystem(A=[[0.9]], C=[[1.0]], dt=1.0)
    steady = obsynth.steady_state_filter(plant, Q=1e-40, R=1.0)
    assert steady.P[0, 0] == pytest.approx(1e-40 / (1.0 - 0.81), rel=1e-6)
