"""The steady state of the descriptor Kalman filter: what its recursion converges to, and where it does not."""

from __future__ import annotations

import numpy as np
import pytest
from time_varying_plants import observer_for, varying

import obsynth
from obsynth import DescriptorSystem, PreconditionError, SpecError, TimeVaryingDescriptorSystem
from obsynth.observers.recursive.gain_schedule import gain_steps
from obsynth.observers.recursive.steady_filter import steady_state_filter


class TestSteadyState:
    PLANT = TimeVaryingDescriptorSystem(
        np.diag([1.0, 1, 0]), [[0.9, 0.1, 0.3], [0.0, 0.7, 0.2], [1.0, 0.4, -1.0]], C=[[1, 0, 0.3], [0, 1, 1]], dt=1.0
    )
    Q, R = np.diag([0.1, 0.2, 0.3]), np.array([[20.0, 5.0], [5.0, 40.0]])

    def covariances(self, steps: int) -> list[np.ndarray]:
        running = observer_for(self.PLANT, Q=self.Q, R=self.R).start()
        rows = [running.raw_step(np.zeros(2), np.zeros(0)) for _ in range(steps)]
        return [row.factor @ row.factor.T for row in rows]

    def test_the_recursion_converges_to_it_at_its_rate(self) -> None:
        steady = steady_state_filter(self.PLANT, Q=self.Q, R=self.R)
        found = self.covariances(200)
        # Each step rounds 3 x 3 products of size |P|, and errors of earlier steps sum to 1 / (1 - rate) of that.
        rounding = 30 * np.finfo(float).eps * np.linalg.norm(steady.P) / (1.0 - steady.rate)
        assert rounding < 2e-12
        np.testing.assert_allclose(found[-1], steady.P, rtol=0, atol=rounding)
        np.testing.assert_allclose(steady.L @ self.PLANT.E.at(1) + steady.K @ self.PLANT.C.at(1), np.eye(3), atol=1e-12)
        A = self.PLANT.A.at(0)
        # Two products of 3 x 3 matrices, 3 roundings an entry each.
        terms = np.abs(A) @ np.abs(steady.P) @ np.abs(A.T) + self.Q
        np.testing.assert_allclose(
            steady.P_predicted, A @ steady.P @ A.T + self.Q, rtol=0, atol=8 * np.finfo(float).eps * np.max(terms)
        )
        gaps = [np.linalg.norm(P - steady.P) for P in found]
        assert (gaps[30] / gaps[20]) ** (1 / 10) == pytest.approx(steady.rate, rel=0.01)
        assert 0.05 < steady.rate < 0.9

    def test_the_printed_equation_has_it_for_a_solution(self) -> None:
        """(16), with E and A as printed."""
        steady = steady_state_filter(self.PLANT, Q=self.Q, R=self.R)
        E, A, C, P = self.PLANT.E.at(1), self.PLANT.A.at(0), self.PLANT.C.at(1), steady.P_predicted
        inner = E.T @ np.linalg.inv(P) @ E + C.T @ np.linalg.inv(self.R) @ C
        np.testing.assert_allclose(A @ np.linalg.inv(inner) @ A.T + self.Q, P, atol=1e-12)

    def test_refusals(self) -> None:
        with pytest.raises(SpecError, match="changes with k"):
            steady_state_filter(varying(), Q=np.eye(3), R=np.eye(2))
        with pytest.raises(SpecError, match="R is no covariance"):
            steady_state_filter(self.PLANT, Q=self.Q, R=-self.R)
        with pytest.raises(SpecError, match="R is 1 by 1"):
            steady_state_filter(self.PLANT, Q=self.Q, R=[[1.0]])
        with pytest.raises(PreconditionError, match="rank"):
            steady_state_filter(self.PLANT.replace(C=[[1, 0, 0], [0, 1, 0]]), Q=self.Q, R=self.R)
        discrete = DescriptorSystem(np.eye(2), 0.5 * np.eye(2), C=np.eye(2), dt=1.0)
        assert steady_state_filter(discrete, Q=np.eye(2), R=np.eye(2)).rate < 0.25


def sampled(A, C, E=None) -> TimeVaryingDescriptorSystem:
    return TimeVaryingDescriptorSystem(E, A, C=C, dt=1.0)


ALGEBRAIC = sampled([[0.9, 0.1, 0.3], [0, 0.7, 0.2], [1, 0.4, -1]], [[1, 0, 0.3], [0, 1, 1]], np.diag([1.0, 1, 0]))
WIDE = sampled(0.5 * np.ones((2, 3)), np.eye(3), [[1, 0, 0], [0, 1, 0]])
#: Plant, Q and R: what (16) cannot have, as it inverts Q and R.
SINGULAR = {
    "an exact algebraic equation": (ALGEBRAIC, np.diag([0.1, 0.2, 0]), np.diag([20.0, 40])),
    "an exact equation and an exact output": (ALGEBRAIC, np.diag([0.1, 0.2, 0]), np.diag([0.0, 40])),
    "no process noise": (ALGEBRAIC, np.zeros((3, 3)), np.diag([1.0, 40])),
    "no noise": (ALGEBRAIC, np.zeros((3, 3)), np.zeros((2, 2))),
    "fewer equations than states": (WIDE, np.diag([1.0, 0]), np.eye(3)),
    "an unstable mode without noise": (sampled(np.diag([1.3, 0.5]), np.eye(2)), np.diag([0, 1.0]), np.eye(2)),
    "an exact output": (sampled([[0.9, 0.1], [-0.2, 0.7]], [[1.0, 0]]), np.eye(2), np.zeros((1, 1))),
    "noise that is nearly singular": (sampled(np.diag([0.9, 0.5]), np.eye(2)), np.diag([1e-18, 1.0]), np.eye(2)),
}


@pytest.mark.one_in(6)
@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("name", SINGULAR)
def test_singular_noise(name: str) -> None:
    plant, Q, R = SINGULAR[name]
    steady = steady_state_filter(plant, Q=Q, R=R)
    *_, last = gain_steps(observer_for(plant, Q=Q, R=R), 600)
    size = max(float(np.linalg.norm(steady.P)), 1e-12)
    np.testing.assert_allclose(last.factor @ last.factor.T, steady.P, rtol=0, atol=1e-11 * size)
    np.testing.assert_allclose(last.gain, np.hstack([steady.L, steady.K]), rtol=0, atol=1e-10)
    assert steady.rate < 1.0


@pytest.mark.one_in(6)
@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("seed", range(8))
def test_random_plants_with_singular_noise(seed: int) -> None:
    rng = np.random.default_rng(seed)
    n = int(rng.integers(2, 6))
    A, C, root = rng.standard_normal((n, n)), rng.standard_normal((2, n)), rng.standard_normal((n, n - 1))
    for R in (np.eye(2), np.diag([0.0, 1])):
        plant, Q = sampled(A, C), root @ root.T
        steady = steady_state_filter(plant, Q=Q, R=R)
        *_, last = gain_steps(observer_for(plant, Q=Q, R=R), 400)
        np.testing.assert_allclose(last.factor @ last.factor.T, steady.P, rtol=0, atol=1e-10 * np.linalg.norm(steady.P))


@pytest.mark.one_in(2)
@pytest.mark.parametrize(
    ("A", "mode", "text"),
    [(np.diag([1.0, 0.5]), 1.0, "at z = 1 the noise"), ([[0.0, 1], [-1, 0]], 1j, "at z = 0 +- 1j the noise")],
)
def test_a_mode_on_the_unit_circle_that_no_noise_reaches(A, mode: complex, text: str) -> None:
    """The filter exists, and converges like 1 / k: there is no steady state, and the design says so."""
    plant, Q = sampled(A, np.eye(2)), np.diag([0.0, 0.0])
    with pytest.raises(PreconditionError, match="gains tend to zero like 1 / k") as caught:
        steady_state_filter(plant, Q=Q, R=np.eye(2))
    assert caught.value.mode == pytest.approx(mode)
    assert text in str(caught.value)
    design = obsynth.descriptor_kalman(plant, Q=0.0, R=1.0)
    assert any(text in note for note in design.notes)
    deviations = design.observer.run(np.zeros((401, 2))).state_deviations[[100, 400], 0]
    assert deviations[0] / deviations[1] == pytest.approx(2.0, rel=0.01)
    assert not obsynth.descriptor_kalman(plant, Q=1.0, R=1.0).notes


def test_an_exact_output_may_hide_the_noise() -> None:
    """x1(k + 1) = x2(k), x2(k + 1) = w: y = x1 - x2 shows w(k) - w(k + 1), which vanishes at z = 1."""
    plant = sampled([[0.0, 1], [0, 0]], [[1.0, -1]])
    with pytest.raises(PreconditionError, match="at z = 1 the noise does not act"):
        steady_state_filter(plant, Q=np.diag([0.0, 1]), R=[[0.0]])
    assert steady_state_filter(plant, Q=np.diag([0.0, 1]), R=[[1.0]]).rate < 1.0


def test_a_number_is_that_multiple_of_the_identity() -> None:
    plant = DescriptorSystem(E=np.eye(2), A=[[0.9, 0.1], [0.0, 0.5]], C=[[1.0, 0.0]], dt=1.0)
    number = steady_state_filter(plant, Q=0.01, R=0.1)
    matrix = steady_state_filter(plant, Q=0.01 * np.eye(2), R=[[0.1]])
    np.testing.assert_array_equal(number.P, matrix.P)


def test_noise_that_the_plant_states_is_the_default_and_identities_where_it_states_none() -> None:
    plant = DescriptorSystem(
        A=[[0.9, 0.1], [0.0, 0.7]], C=[[1, 0], [1, 1]], Bw=[[0.3, 0, 0], [0, 0, 0]], Dw=[[0, 0.1, 0], [0, 0, 2]], dt=1.0
    )
    stated = steady_state_filter(plant)
    given = steady_state_filter(plant, Q=plant.Bw @ plant.Bw.T, R=np.diag([0.01, 4.0]))
    np.testing.assert_array_equal(stated.K, given.K)
    without = plant.replace(Bw=None, Dw=None)
    np.testing.assert_array_equal(steady_state_filter(without).K, steady_state_filter(without, Q=1.0, R=1.0).K)
    # A part of it may be given.
    np.testing.assert_array_equal(steady_state_filter(plant, R=np.diag([0.01, 4.0])).K, given.K)
