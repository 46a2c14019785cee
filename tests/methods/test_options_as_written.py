"""Noise and states as written of a plant whose index is reduced: what Kalman filters make of them."""

from __future__ import annotations

import numpy as np
import pytest

import obsynth

#: Two masses on springs that a rod holds at the same place, sampled: index 3.
STEP = 0.05


def masses() -> obsynth.DescriptorSystem:
    rod, springs = np.array([[1.0, -1.0]]), np.array([[2.0, -1.0], [-1.0, 3.0]])
    e, a = np.diag([1.0, 1.0, 1.0, 1.0, 0.0]), np.zeros((5, 5))
    a[:4, :4] = np.eye(4)
    a[:2, 2:4] = STEP * np.eye(2)
    a[2:4, :2], a[2:4, 4:] = -STEP * springs, -STEP * rod.T
    a[2:4, 2:4] -= 0.3 * STEP * np.eye(2)
    a[4, :2] = rod[0]
    return obsynth.DescriptorSystem(
        e, a, C=np.eye(5)[[0]], dt=STEP, sensor_noise={"y1": 0.01}, state_names=["q1", "q2", "v1", "v2", "lambda"]
    )


def test_noise_in_the_equations_of_motion_is_carried_to_the_free_states() -> None:
    plant, q = masses(), np.diag([0.0, 0.0, 1e-4, 3e-4, 0.0])
    design = obsynth.descriptor_kalman(plant, Q=q, initial_state=[1.0, 1.0, 2.0, 2.0, 0.0])
    reduced = design.plant
    assert reduced.state_names == ("q1", "v1")
    assert any("Q, of the equations as written" in note for note in design.notes)
    np.testing.assert_allclose(design.observer.initial_state, [1.0, 2.0])
    for z in (1.2 + 0.3j, 0.9 - 0.8j):
        full = np.linalg.solve(z * plant.E - plant.A, np.sqrt(q))[[0, 2]]
        free = np.linalg.inv(z * np.eye(2) - reduced.A.at(0))
        own = free @ design.observer.Q.at(0) @ free.conj().T
        np.testing.assert_allclose(own, full @ full.conj().T, rtol=1e-9, atol=1e-12 * np.abs(own).max())


@pytest.mark.one_in(2)
@pytest.mark.parametrize("method", ["descriptor-kalman", "adaptive-observer"])
def test_noise_that_a_constraint_differentiates_is_refused_with_what_is_taken(method: str) -> None:
    plant = masses()
    if method == "adaptive-observer":
        plant = plant.replace(Bf=[[0.0], [0.0], [0.0], [STEP], [0.0]], Df=[[0.0]], fault_names=["force"])
    with pytest.raises(obsynth.SpecError, match=r"of the equations as written.* equations 3, 4 alone it is taken"):
        obsynth.design(plant, method, Q=1e-4 * np.eye(5))
    assert obsynth.design(plant, method, Q=np.diag([0.0, 0.0, 1e-4, 1e-4, 0.0])).report.passed
