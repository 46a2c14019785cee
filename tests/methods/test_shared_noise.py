"""Noise that drives equations and outputs at once: the filter is that of the Riccati equation with a cross term."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.linalg import solve_discrete_are

import obsynth
from obsynth.errors import SpecError
from obsynth.numerics.arrays import FloatArray


def drawn(seed: int, *, noises: int, **more: FloatArray) -> obsynth.DescriptorSystem:
    rng = np.random.default_rng([2911, seed])
    nx, ny = int(rng.integers(1, 5)), int(rng.integers(1, 3))
    A = rng.standard_normal((nx, nx))
    A *= 0.9 / max(np.abs(np.linalg.eigvals(A)))
    C = rng.standard_normal((ny, nx))
    noise = {"Bw": rng.standard_normal((nx, noises)), "Dw": rng.standard_normal((ny, noises))}
    return obsynth.DescriptorSystem(A=A, C=C, Bf=np.eye(nx)[:, :1], dt=1.0, **noise, **more)


def filtered_covariance(plant: obsynth.DescriptorSystem) -> FloatArray:
    """Return the covariance of the state given the outputs up to now, by scipy's Riccati equation."""
    R = plant.Dw @ plant.Dw.T
    P = solve_discrete_are(plant.A.T, plant.C.T, plant.Bw @ plant.Bw.T, R, s=plant.Bw @ plant.Dw.T)
    return np.asarray(P - P @ plant.C.T @ np.linalg.solve(plant.C @ P @ plant.C.T + R, plant.C @ P))


def steady_covariance(design: obsynth.ObserverDesign) -> FloatArray:
    observer = design.observer
    P = obsynth.steady_state_filter(observer.plant, Q=observer.Q.at(0), R=observer.R.at(0)).P
    states = [observer.plant.state_names.index(name) for name in observer.plant.state_names if "noise" not in name]
    return np.asarray(P[np.ix_(states, states)])


@pytest.mark.one_in(6)
@pytest.mark.parametrize("noises", [2, 3, 7])
@pytest.mark.parametrize("seed", range(4))
def test_the_steady_covariance_is_that_of_the_riccati_equation_with_a_cross_term(seed: int, noises: int) -> None:
    plant = drawn(seed, noises=noises)
    design = obsynth.descriptor_kalman(plant)
    assert design.report.passed
    # Of more noises than outputs no more become states than there are outputs.
    assert design.plant.nx <= plant.nx + min(plant.ny, noises)
    np.testing.assert_allclose(steady_covariance(design), filtered_covariance(plant), rtol=1e-6, atol=1e-9)


@pytest.mark.one_in(3)
@pytest.mark.parametrize("seed", [4, 26, 35])
def test_outputs_of_fewer_noises_leave_no_rounding_in_the_filter(seed: int) -> None:
    """Three outputs of two noises tell four states exactly after some samples: nothing is left that has a covariance,
    and innovations are whitened by what noise there is."""
    rng = np.random.default_rng([4646, seed])
    A = rng.standard_normal((4, 4))
    A *= 0.9 / np.abs(np.linalg.eigvals(A)).max()
    C, Bw, Dw = (rng.standard_normal(shape) for shape in ((3, 4), (4, 2), (3, 2)))
    design = obsynth.descriptor_kalman(obsynth.DescriptorSystem(A=A, C=C, Bw=Bw, Dw=Dw, dt=1.0))
    assert design.report.passed
    x, outputs = rng.standard_normal(4), []
    for w in rng.standard_normal((20, 2)):
        outputs.append(C @ x + Dw @ w)
        last, x = x, A @ x + Bw @ w
    run = design.observer.run(np.array(outputs))
    assert not np.any(run.state_covariances[-1])
    np.testing.assert_allclose(run.states[-1, :4], last, rtol=1e-7, atol=1e-7)


def test_more_noises_than_outputs_leave_no_rounding_in_the_plant() -> None:
    plant = obsynth.DescriptorSystem(
        A=[[0.99]], C=[[-1.4], [-0.2], [-1.0]], Bw=[[0.3, -1.7, -0.3, 0.3]],
        Dw=[[0.1, -1.4, 1.2, 0.6], [-0.4, -2.2, -0.4, -0.8], [-0.1, -1.1, 0.7, 0.5]], dt=1.0,
    )  # fmt: skip
    design = obsynth.descriptor_kalman(plant)
    assert design.report.passed
    for matrix in (design.plant.A.at(0), design.plant.C.at(1)):
        entries = np.abs(matrix[matrix != 0.0])
        assert np.all(entries > 1e-9)


def test_outputs_that_act_on_the_plant_change_nothing() -> None:
    # With x+ = A x + w + G y, and y measured, the errors of the filter are those of G = 0.
    for seed in range(3):
        plant = drawn(seed, noises=0)
        nx, ny = plant.nx, plant.ny
        apart = plant.replace(
            Bw=np.hstack([0.3 * np.eye(nx), np.zeros((nx, ny))]), Dw=np.hstack([np.zeros((ny, nx)), 0.2 * np.eye(ny)])
        )
        G = 0.1 * np.ones((nx, ny))
        joined = apart.replace(A=apart.A + G @ apart.C, Bw=apart.Bw + G @ apart.Dw)
        first, second = (steady_covariance(obsynth.descriptor_kalman(each)) for each in (apart, joined))
        np.testing.assert_allclose(first, second, rtol=1e-6, atol=1e-9)


def test_estimates_are_those_of_the_filter_with_a_cross_term() -> None:
    plant = drawn(1, noises=3)
    rng = np.random.default_rng(5)
    outputs = rng.standard_normal((400, plant.ny))
    design = obsynth.descriptor_kalman(plant)
    states = design.observer.run(outputs).states[:, : plant.nx]
    # The predictor of any textbook, in its steady state.
    S, R = plant.Bw @ plant.Dw.T, plant.Dw @ plant.Dw.T
    P = solve_discrete_are(plant.A.T, plant.C.T, plant.Bw @ plant.Bw.T, R, s=S)
    innovation = plant.C @ P @ plant.C.T + R
    K, L = (plant.A @ P @ plant.C.T + S) @ np.linalg.inv(innovation), P @ plant.C.T @ np.linalg.inv(innovation)
    predicted = np.zeros(plant.nx)
    for y in outputs:
        residual = y - plant.C @ predicted
        filtered, predicted = predicted + L @ residual, plant.A @ predicted + K @ residual
    np.testing.assert_allclose(states[-1], filtered, rtol=1e-7, atol=1e-9)


def test_noise_in_a_constraint_reaches_equations_and_outputs() -> None:
    # 0 = x1 - x2 + w enters y = x2 and, without x2, the equation of x1.
    plant = obsynth.DescriptorSystem(
        E=[[1, 0], [0, 0]], A=[[0.5, 0.4], [1.0, -1.0]], C=[[0.0, 1.0]], Bw=[[0.1, 0.0], [0.0, 0.3]],
        Dw=np.zeros((1, 2)), Bf=[[1.0], [0.0]], dt=1.0,
    )  # fmt: skip
    proper = obsynth.eliminate_algebraic_states(plant).plant
    assert np.any(proper.Bw @ proper.Dw.T)
    design = obsynth.descriptor_kalman(proper)
    assert design.report.passed
    np.testing.assert_allclose(steady_covariance(design), filtered_covariance(proper), rtol=1e-6)


def test_the_adaptive_observer_and_unknown_inputs_take_such_noise() -> None:
    plant = drawn(2, noises=3)
    assert obsynth.adaptive_observer(plant).report.passed
    sensors = np.eye(plant.nx)
    noise = 0.1 * np.random.default_rng(1).standard_normal((plant.nx, 4))
    hidden = plant.replace(
        C=sensors,
        Df=None,
        Dd=None,
        D=None,
        output_names=None,
        noise_names=None,
        Dw=noise,
        Bw=0.3 * noise,
        Bd=np.eye(plant.nx)[:, :1],
    )
    design = obsynth.descriptor_kalman(hidden)
    assert design.report.passed
    assert "estimated with the states, as 'shared noise 1'" in " ".join(design.notes)
    assert obsynth.check(hidden)["descriptor-kalman"].passed


@pytest.mark.parametrize("stated", ["initial_state", "initial_covariance"])
def test_what_is_stated_of_the_first_state_has_the_size_of_the_plant_as_written(stated: str) -> None:
    plant = drawn(1, noises=3)
    right = np.ones(plant.nx) if stated == "initial_state" else 4.0 * np.eye(plant.nx)
    observer = obsynth.descriptor_kalman(plant, **{stated: right}).observer
    assert np.array_equal(np.asarray(getattr(observer, stated))[: plant.nx, ...][..., : plant.nx], right)
    wrong = np.ones(plant.nx + 1) if stated == "initial_state" else np.eye(plant.nx + 1)
    with pytest.raises(SpecError, match=stated):
        obsynth.descriptor_kalman(plant, **{stated: wrong})


def test_units_of_states_and_outputs_change_nothing() -> None:
    plant = drawn(3, noises=3)
    state, output = 10.0 ** np.arange(-4, plant.nx - 4), 10.0 ** np.arange(3, plant.ny + 3)
    scaled = plant.replace(
        A=state[:, None] * plant.A / state, C=output[:, None] * plant.C / state, Bf=state[:, None] * plant.Bf,
        Bw=state[:, None] * plant.Bw, Dw=output[:, None] * plant.Dw,
    )  # fmt: skip
    first, second = (steady_covariance(obsynth.descriptor_kalman(each)) for each in (plant, scaled))
    np.testing.assert_allclose(second / np.outer(state, state), first, rtol=1e-6)


@pytest.mark.long
def test_the_inequality_of_the_paper_has_such_noise_too() -> None:
    noise = {"Bw": [[0.3, 0.1], [0.0, 0.2]], "Dw": [[0.2, 0.1]]}
    plant = obsynth.DescriptorSystem(A=[[0.9, 0.1], [0.0, 0.8]], C=[[1.0, 0.0]], dt=1.0, **noise)
    paper = obsynth.conditions.kalman(plant)
    paper.problem.solve()
    covariance = paper.gains()["covariance"][: plant.nx, : plant.nx]
    np.testing.assert_allclose(covariance, filtered_covariance(plant), rtol=1e-3)
