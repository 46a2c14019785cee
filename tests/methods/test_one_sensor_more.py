"""A sensor that reads nothing takes no design away, and a rate that is asked for costs no more noise than it must."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import scipy.linalg

import obsynth

A = [[0.9, 0.2], [0.0, 0.8]]
#: By name: rows of C and D, and the noise of the sensor, of a second sensor that says nothing of the states.
SILENT = {
    "reads nothing": ([0.0, 0.0], 0.0, 0.0),
    "reads an input": ([0.0, 0.0], 3.0, 0.0),
    "reads noise": ([0.0, 0.0], 0.0, 0.2),
}
METHODS: dict[str, dict[str, Any]] = {
    "descriptor-kalman": {},
    "adaptive-observer": {},
    "functional-filter": {},
    "ui-pi-observer": {},
    "optimal-filter": {"delay": 2},
}


def with_second_sensor(name: str) -> obsynth.DescriptorSystem:
    row, direct, noise = SILENT[name]
    return obsynth.DescriptorSystem(
        A=A, B=[[1.0], [0.0]], C=[[1.0, 0.0], row], D=[[0.0], [direct]], Bf=[[0.0], [1.0]],
        Dw=np.diag([0.1, noise]), dt=0.1,
    )  # fmt: skip


@pytest.mark.one_in(2)
@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("name", SILENT)
def test_a_sensor_that_says_nothing_of_the_states_takes_no_design_away(name: str, method: str) -> None:
    assert obsynth.design(with_second_sensor(name), method, **METHODS[method]).report.passed


@pytest.mark.one_in(3)
@pytest.mark.parametrize("name", SILENT)
def test_a_detection_filter_has_the_same_claims_beside_a_sensor_that_says_nothing(name: str) -> None:
    row, direct, noise = SILENT[name]
    alone = obsynth.DescriptorSystem(A=[[-1.0, 0.2], [0.0, -2.0]], C=[[1.0, 0.0]], Bf=[[0.0], [1.0]], Dw=[[0.1]])
    both = alone.replace(
        B=[[1.0], [0.0]], C=[[1.0, 0.0], row], D=[[0.0], [direct]], Df=None, Dd=None, Dw=np.diag([0.1, noise]),
        Bw=None, noise_names=None, output_names=None,
    )  # fmt: skip
    claims = [obsynth.detection_filter(plant, band=(0.0, 10.0)).certificate.claims for plant in (alone, both)]
    assert claims[1]["fault_sensitivity"] == pytest.approx(claims[0]["fault_sensitivity"], rel=1e-6)
    assert claims[1]["disturbance_gain"] == pytest.approx(claims[0]["disturbance_gain"], rel=1e-6)


def test_a_filter_runs_on_a_sensor_that_reads_an_input_to_rounding() -> None:
    design = obsynth.descriptor_kalman(with_second_sensor("reads an input"))
    rng = np.random.default_rng(8)
    u = rng.standard_normal((50, 1))
    y = np.hstack([rng.standard_normal((50, 1)), 3.0 * u * (1.0 + 2.0**-52)])
    alone = obsynth.descriptor_kalman(
        obsynth.DescriptorSystem(
            A=A, B=[[1.0], [0.0]], C=[[1.0, 0.0]], Bf=[[0.0], [1.0]], Dw=[[0.1]], dt=0.1, noise_names=["w1"]
        )
    )
    states = [one.recursive[1].run(y[:, : one.plant.ny], u).states for one in (design, alone)]
    np.testing.assert_allclose(states[0], states[1], rtol=1e-12, atol=1e-12)


@pytest.mark.one_in(4)
@pytest.mark.parametrize("seed", [0, 1, 2, 3])
def test_a_decay_is_reached_with_less_noise_than_by_a_gain_of_that_rate(seed: int) -> None:
    rng = np.random.default_rng(seed)
    n, dt = 3, 0.2 * (seed % 2)
    a = rng.standard_normal((n, n)) - 1.5 * np.eye(n)
    a = scipy.linalg.expm(dt * a) if dt else a
    plant = obsynth.DescriptorSystem(
        A=a.round(3), C=rng.standard_normal((2, n)).round(3), Bf=rng.standard_normal((n, 1)).round(3),
        Dw=0.1 * np.eye(2), dt=dt,
    )  # fmt: skip
    design = obsynth.ui_pi_observer(plant, decay=1.0)
    plain = obsynth.ui_pi_observer(plant, decay=0.0)
    assert 1.0 <= design.certificate.claims["decay"] < 1.3 * max(1.0, plain.certificate.claims["decay"])
    faster = obsynth.ui_pi_observer(plant, decay=2.0)
    assert design.certificate.claims["noise_amplification"] < 0.9 * faster.certificate.claims["noise_amplification"]


@pytest.mark.one_in(6)
@pytest.mark.parametrize("ratio", [1.5, -0.3, 1e4])
@pytest.mark.parametrize("seed", [0, 1, 3, 4])
def test_a_copy_in_another_unit_takes_no_fault_filter_away(seed: int, ratio: float) -> None:
    # The disturbance enters as the fault does: the least is proved for one sensor, not for both with rounded gains.
    rng = np.random.default_rng([46, seed])
    c, fault = rng.standard_normal((1, 2)), rng.standard_normal((2, 1))
    plant = obsynth.DescriptorSystem(
        A=0.3 * rng.standard_normal((2, 2)), C=np.vstack([c, ratio * c]), Bf=fault, Bd=-2.0 * fault,
        Dw=np.diag([0.1, abs(0.1 * ratio)]), dt=0.1,
    )  # fmt: skip
    alone = obsynth.DescriptorSystem(A=plant.A, C=c, Bf=fault, Bd=plant.Bd, Dw=[[0.1]], dt=0.1)
    both, one = obsynth.fault_estimation_filter(plant), obsynth.fault_estimation_filter(alone)
    assert both.certificate.claims["gamma"] <= 1.001 * one.certificate.claims["gamma"]


@pytest.mark.one_in(2)
@pytest.mark.parametrize("difference", [1e-12, 1e-8, 1e-4])
@pytest.mark.parametrize("parallel", [False, True])
def test_a_copy_but_for_its_last_digits_costs_no_noise_and_no_gain(parallel: bool, difference: float) -> None:
    # With an unknown input the difference was used: 1e4 times the noise, or a filter that could not be proved.
    rng = np.random.default_rng([46, 4 - parallel])
    c, fault = rng.standard_normal((1, 2)), rng.standard_normal((2, 1))
    A = 0.3 * rng.standard_normal((2, 2))
    Bd = -2.0 * fault if parallel else rng.standard_normal((2, 1))
    alone = obsynth.DescriptorSystem(A=A, C=c, Bf=fault, Bd=Bd, Dw=[[0.1]], dt=0.1)
    near = np.vstack([c, c + difference * rng.standard_normal((1, 2))])
    both = obsynth.DescriptorSystem(A=A, C=near, Bf=fault, Bd=Bd, Dw=0.1 * np.eye(2), dt=0.1)
    one, more = obsynth.fault_estimation_filter(alone), obsynth.fault_estimation_filter(both)
    assert more.certificate.claims["gamma"] <= 1.001 * one.certificate.claims["gamma"]
    assert deviation_of(more) <= 1.001 * deviation_of(one)


def deviation_of(design: obsynth.ObserverDesign) -> float:
    """Standard deviation of the first fault estimate with white noise of deviation 0.1 on every sensor."""
    run, noise = design.observer, 0.1 * design.observer.By
    steady = scipy.linalg.solve_discrete_lyapunov(run.Az, noise @ noise.T)
    direct, row = 0.1 * run.Dy[run.fault_rows], run.Cz[run.fault_rows]
    return float(np.sqrt((row @ steady @ row.T + direct @ direct.T)[0, 0]))


@pytest.mark.one_in(3)
@pytest.mark.parametrize(("seed", "dt"), [(7, 0.2), (14, 0.0), (46, 0.0)])
def test_a_copy_makes_no_default_slower_beside_process_noise(seed: int, dt: float) -> None:
    """The mean of two copies has less noise beside that of the process: the price of speed is no reason to be slow."""
    rng = np.random.default_rng([77, seed])
    order = int(rng.integers(2, 5))
    a = rng.standard_normal((order, order)) - 1.5 * np.eye(order)
    a = scipy.linalg.expm(dt * a) if dt else a
    c, bf = rng.standard_normal((1, order)), rng.standard_normal((order, 1))
    process = 0.1 * 10.0 ** rng.uniform(-1.0, 1.0) * np.eye(order)
    rates = []
    for copies in (1, 2):
        plant = obsynth.DescriptorSystem(
            A=a, C=np.repeat(c, copies, axis=0), Bf=bf, dt=dt,
            Bw=np.hstack([process, np.zeros((order, copies))]),
            Dw=np.hstack([np.zeros((copies, order)), 0.1 * np.eye(copies)]),
        )  # fmt: skip
        rates.append(obsynth.ui_pi_observer(plant).certificate.claims["decay"])
    assert rates[1] > rates[0] / 1.001


@pytest.mark.parametrize("combination", [[3.7, 0.0], pytest.param([0.3, -1.1], marks=pytest.mark.long)])
def test_the_least_gain_with_a_dependent_sensor_is_proved(combination: list[float]) -> None:
    a = np.array([[0.3, -0.2, 0.1], [0.0, 0.5, 0.4], [-0.3, 0.1, 0.2]])
    c = np.array([[1.0, 0.4, -0.7], [0.2, -1.1, 0.5]])
    bd = np.array([[0.3, 0.0, 0.2], [-0.1, 0.4, 0.0], [0.2, 0.1, -0.3]])
    plant = obsynth.DescriptorSystem(A=a, C=np.vstack([c, combination @ c]), Bf=[[1.0], [0.5], [-0.4]], Bd=bd, dt=1.0)
    design = obsynth.fault_estimation_filter(plant, prove_least=True)
    row = design.report["least gain"]
    assert row.kind == "proved"
    assert row.passed
    # Filters that read less have a larger least gain: a proof of that is none.
    matrices = design.certificate.matrices
    fewer = {**matrices, "least_gain_outputs": matrices["least_gain_outputs"][:1]}
    forged = design.replace(certificate=replace(design.certificate, matrices=fewer))
    assert not obsynth.verify(forged)["least gain"].passed


def test_a_noisy_sensor_more_costs_no_noise_at_a_stated_decay() -> None:
    # The drive that keeps a filter awake is of the size of all sensors' noise: the default was faster than asked.
    rows = [[-0.345, -1.91, 0.567, 0.862], [0.745, 0.155, 0.333, -0.507], [0.695, -0.191, -0.396, 1.415]]
    process, noise = np.array([[-0.053], [0.036], [0.031], [0.121]]), [0.0125, 0.023, 0.55]
    deviations = []
    for count in (2, 3):
        plant = obsynth.DescriptorSystem(
            A=[[-1.266, -0.325, 0.009, -1.223], [0.697, -0.721, 0.946, -1.383],
               [0.646, 0.36, -2.385, 0.018], [-1.335, 0.241, -1.272, -0.795]],
            Bf=[[0.693], [-0.392], [0.395], [-0.493]], C=rows[:count],
            Bw=np.hstack([process, np.zeros((4, count))]),
            Dw=np.hstack([np.zeros((count, 1)), np.diag(noise[:count])]), dt=0.0,
        )  # fmt: skip
        design = obsynth.ui_pi_observer(plant, decay=0.5)
        assert 0.5 <= design.certificate.claims["decay"] < 0.55
        run, n = design.observer, plant.nx
        a = np.block([[plant.A, np.zeros((n, run.order))], [run.By @ plant.C, run.Az]])
        b = np.vstack([plant.Bw, run.By @ plant.Dw])
        c = np.hstack([run.Dy[run.fault_rows] @ plant.C, run.Cz[run.fault_rows]])
        spread = scipy.linalg.solve_continuous_lyapunov(a, -b @ b.T)
        deviations.append(float(np.sqrt((c @ spread @ c.T).item())))
    assert deviations[1] <= 1.001 * deviations[0]


def _with_one_more(seed: int, dt: float) -> list[obsynth.DescriptorSystem]:
    """Return a random plant of one fault with one sensor, and the same with a second one, each with its own noise."""
    rng = np.random.default_rng([4801, seed])
    a = rng.normal(size=(3, 3)) - 1.5 * np.eye(3)
    a = scipy.linalg.expm(dt * a) if dt else a
    c, bf, sensors = rng.normal(size=(2, 3)), rng.normal(size=(3, 1)), 10.0 ** rng.uniform(-2, 0, 2)
    process = 0.1 * rng.normal(size=(3, 1))
    return [
        obsynth.DescriptorSystem(
            A=a, C=c[:count], Bf=bf, Bw=np.hstack([process, np.zeros((3, count))]),
            Dw=np.hstack([np.zeros((count, 1)), np.diag(sensors[:count])]), dt=dt,
        )
        for count in (1, 2)
    ]  # fmt: skip


def _deviation_behind_a_lag(design: obsynth.ObserverDesign, rate: float) -> float:
    """Return that of the error of the fault, by its error system: the observer's own state less the plant's."""
    plant, observer = design.linear
    rows = observer.fault_rows
    driven = np.vstack([plant.Bw, np.zeros((plant.nf, plant.nw))]) - observer.By @ plant.Dw
    read, direct = observer.Cz[rows], observer.Dy[rows] @ plant.Dw
    a = np.block([[observer.Az, np.zeros((observer.order, 1))], [rate * read, -rate * np.eye(1)]])
    b = np.vstack([driven, -rate * direct])
    return float(np.sqrt(scipy.linalg.solve_continuous_lyapunov(a, -b @ b.T)[-1, -1]))


@pytest.mark.one_in(2)
@pytest.mark.parametrize("seed", [1, 7])
def test_one_sensor_more_costs_a_pd_observer_no_noise(seed: int) -> None:
    plants = _with_one_more(seed, 0.0)
    rate = float(np.max(np.abs(np.linalg.eigvals(plants[0].A))))
    designs = [obsynth.pd_observer(plant, decay=0.3) for plant in plants]
    alone, both = (_deviation_behind_a_lag(design, rate) for design in designs)
    assert both <= 1.001 * alone
    assert designs[1].report.passed
    assert min(-np.max(np.linalg.eigvals(design.observer.Az).real) for design in designs) >= 0.3


@pytest.mark.one_in(3)
@pytest.mark.parametrize(("seed", "dt"), [(1, 0.0), (6, 0.2), (7, 0.0)])
def test_one_sensor_more_costs_no_noise_at_given_poles(seed: int, dt: float) -> None:
    poles = [np.exp(-dt * rate) if dt else -rate for rate in (3.0, 3.3, 3.6, 4.0)]
    deviations = []
    for plant in _with_one_more(seed, dt):
        design = obsynth.ui_pi_observer(plant, poles=poles)
        assert design.report.passed
        observer = design.observer
        whole = np.block([[plant.A, np.zeros((plant.nx, observer.order))], [observer.By @ plant.C, observer.Az]])
        driven = np.vstack([plant.Bw, observer.By @ plant.Dw])
        read = np.hstack([observer.Dy[observer.fault_rows] @ plant.C, observer.Cz[observer.fault_rows]])
        direct = observer.Dy[observer.fault_rows] @ plant.Dw
        if dt:
            spread = scipy.linalg.solve_discrete_lyapunov(whole, driven @ driven.T)
        else:
            spread = scipy.linalg.solve_continuous_lyapunov(whole, -driven @ driven.T)
        deviations.append(float((read @ spread @ read.T + (direct @ direct.T if dt else 0.0))[0, 0]) ** 0.5)
    assert deviations[1] <= 1.001 * deviations[0]
