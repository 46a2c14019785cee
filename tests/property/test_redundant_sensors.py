"""One sensor more: a copy, a scaled copy, a dead sensor, one of a known input. Claims and noise are no worse."""

from __future__ import annotations

import numpy as np
import pytest
import scipy.linalg

import obsynth
from obsynth.plants.transformations.redundant_outputs import merged_outputs

#: Row of C (as a share of the first, and of a direction of its own), D and noise of the sensor that is added.
MORE = {
    "copy": (1.0, 0.0, 0.0, 0.1),
    "scaled": (10.0, 0.0, 0.0, 1.0),
    "nearly equal": (1.0, 1e-3, 0.0, 0.1),
    "dead": (0.0, 0.0, 0.0, 0.1),
    "of a known input": (0.0, 0.0, 2.0, 0.1),
}


def plants(seed, kind, dt=0.0):
    rng = np.random.default_rng(seed)
    n = int(rng.integers(2, 4))
    a = rng.standard_normal((n, n)) - 1.5 * np.eye(n)
    a = scipy.linalg.expm(0.1 * a).round(3) if dt else a.round(3)
    c, b, bf = (rng.standard_normal(shape).round(3) for shape in ((1, n), (n, 1), (n, 1)))
    share, apart, direct, noise = MORE[kind]
    own = rng.standard_normal((1, n)).round(3)
    one = obsynth.DescriptorSystem(A=a, B=b, C=c, Bf=bf, Dw=[[0.1]], dt=dt)
    both = obsynth.DescriptorSystem(
        A=a, B=b, C=np.vstack([c, share * c + apart * own]), D=[[0.0], [direct]], Bf=bf, Dw=np.diag([0.1, noise]), dt=dt
    )
    return one, both


def noise_of(design):
    """The deviation of the fault estimate under the stated noise of the sensors."""
    observer, noise = design.observer, design.plant.Dw
    row = observer.Cz[observer.fault_rows]
    into = observer.By @ noise
    if design.plant.dt:
        p = scipy.linalg.solve_discrete_lyapunov(observer.Az, into @ into.T)
        direct = observer.Dy[observer.fault_rows] @ noise
        return float(np.sqrt((row @ p @ row.T + direct @ direct.T)[0, 0]))
    return float(np.sqrt((row @ scipy.linalg.solve_continuous_lyapunov(observer.Az, -into @ into.T) @ row.T)[0, 0]))


@pytest.mark.one_in(4)
@pytest.mark.parametrize("kind", MORE)
@pytest.mark.parametrize("seed", range(3))
def test_placed_poles_have_no_more_noise_with_a_sensor_more(seed, kind):
    one, both = plants(seed, kind)
    poles = list(-np.linspace(3, 4, one.nx + 1))
    alone, more = (obsynth.ui_pi_observer(plant, poles=poles) for plant in (one, both))
    assert noise_of(more) <= 1.001 * noise_of(alone)
    expected = noise_of(alone) / (np.sqrt(2.0) if kind in ("copy", "scaled", "nearly equal") else 1.0)
    assert np.isclose(noise_of(more), expected, rtol=1e-2 if kind == "nearly equal" else 1e-3)


@pytest.mark.one_in(2)
@pytest.mark.parametrize("kind", MORE)
@pytest.mark.parametrize("method", ["ui-pi-observer", "pd-observer", "functional-filter"])
def test_no_method_is_slower_or_noisier_for_a_sensor_more(method, kind):
    one, both = plants(5, kind)
    options = {} if method == "ui-pi-observer" else {"decay": 0.3}
    alone, more = (obsynth.design(plant, method, **options) for plant in (one, both))
    assert more.report.passed
    assert noise_of(more) <= 1.001 * noise_of(alone)
    assert more.certificate.claims["decay"] >= alone.certificate.claims["decay"] / 1.001


@pytest.mark.one_in(6)
@pytest.mark.parametrize("kind", MORE)
@pytest.mark.parametrize("seed", range(1, 4))
def test_a_fault_filter_exists_with_a_sensor_more_and_has_no_more_noise(seed, kind):
    one, both = plants(seed, kind, dt=0.1)
    alone, more = (obsynth.fault_estimation_filter(plant) for plant in (one, both))
    assert more.report.passed
    assert noise_of(more) <= 1.001 * noise_of(alone)


def test_the_means_of_sensors_have_the_least_variance():
    plant = obsynth.DescriptorSystem(
        A=[[-1.0]], C=[[1.0], [2.0], [0.0]], B=[[1.0]], D=[[0.0], [0.0], [3.0]], Dw=np.diag([0.1, 0.4, 0.1])
    )
    merged = merged_outputs(plant)
    # Variances of y1 and y2 / 2: 0.01 and 0.04.
    assert np.allclose(merged.weights, [[0.8, 0.1, 0.0]], rtol=1e-9)
    assert np.isclose(np.linalg.norm(merged.plant.Dw), np.sqrt(1.0 / (1 / 0.01 + 1 / 0.04)))
    assert merged_outputs(merged.plant) is None
    assert merged_outputs(plant.replace(Bf=np.zeros((1, 1)), Df=[[0.0], [1.0], [0.0]])).plant.ny == 2


def test_a_matrix_that_is_given_for_independent_outputs_is_named():
    plant = obsynth.DescriptorSystem(A=[[0.9, 0.1], [0.0, 0.8]], C=[[1.0, 0.0], [1.0, 0.0]], Bf=[[1.0], [0.5]], dt=0.1)
    with pytest.raises(obsynth.PreconditionError, match="Leave S out") as caught:
        obsynth.fault_estimation_filter(plant, S=np.zeros((2, 4)))
    assert caught.value.condition == "rank [C Dd]"
    assert obsynth.fault_estimation_filter(plant).report.passed


@pytest.mark.one_in(6)
@pytest.mark.parametrize("nd", [0, 1])
@pytest.mark.parametrize("seed", range(3))
def test_outputs_that_depend_on_others_get_another_left_inverse_than_the_paper_s(seed, nd):
    rng = np.random.default_rng([77, seed])
    independent = rng.normal(size=(3, 4))
    c = np.vstack([independent, rng.normal(size=(1, 3)) @ independent])
    plant = obsynth.DescriptorSystem(
        A=0.2 * rng.normal(size=(4, 4)), C=c, Bf=rng.normal(size=(4, 1)), Bd=rng.normal(size=(4, nd)), dt=0.1
    )
    design = obsynth.fault_estimation_filter(plant)
    assert design.report.passed
    assert design.options["weight"] == "free"
    with pytest.raises(obsynth.PreconditionError, match="The paper's W is for independent outputs"):
        obsynth.fault_estimation_filter(plant, weight="paper")


def test_a_copy_in_another_unit_changes_no_choice_of_outputs():
    # 10 times 1.076 in doubles is not ten times the number as written: the rows depend within rounding alone.
    c = np.array([[1.076, -0.806, 0.767]])
    for factor in (0.1, 10.0, 1000.0):
        both = obsynth.DescriptorSystem(
            A=-np.diag([1.0, 2.0, 3.0]), C=np.vstack([c, factor * c]), Dw=np.diag([0.1, 0.1 * factor])
        )
        assert np.allclose(merged_outputs(both).plant.C, c, rtol=1e-12)


def test_nearly_equal_sensors_are_merged_where_the_stated_decay_is_reached():
    a, bf = [[-1.866, -0.394], [-0.162, -1.27]], [[-1.225], [-0.032]]
    rows = [[-0.15, -0.706], [-0.149026, -0.704717]]
    one = obsynth.DescriptorSystem(A=a, C=rows[:1], Bf=bf, Dw=[[0.1]])
    both = obsynth.DescriptorSystem(A=a, C=rows, Bf=bf, Dw=np.diag([0.1, 0.1]))
    alone, more = (obsynth.pd_observer(plant, decay=0.3) for plant in (one, both))
    assert noise_of(more) <= 0.75 * noise_of(alone)


def test_a_scaled_copy_that_differs_in_the_last_digit_takes_the_place_of_no_other_sensor():
    first = np.array([1.4528265468366863, -0.47477474169790523])
    other = [0.4472415238205908, -0.9719207939310532]
    c = np.vstack([first, -2.0 * first, other])
    c[1, 1] = 0.9495494833958105
    c[1, 0] = np.nextafter(c[1, 0], 0.0)
    plant = obsynth.DescriptorSystem(
        A=[[0.1, -0.4], [0.2, 0.1]], C=c, Bf=[[-2.0], [-0.9]], Bd=[[-0.9], [0.35]], Dw=0.1 * np.eye(3), dt=1.0
    )
    assert np.allclose(merged_outputs(plant).plant.C, c[[0, 2]], rtol=1e-12)
    assert obsynth.ui_pi_observer(plant).report.passed


@pytest.mark.parametrize("method", ["optimal-filter", "pd-observer"])
def test_a_fast_state_that_nothing_shows_does_not_hurry_a_default(method):
    alone = obsynth.DescriptorSystem(A=[[-1.0]], C=[[1.0]], Bf=[[1.0]], Dw=[[0.1]])
    beside = obsynth.DescriptorSystem(
        A=np.diag([-1.0, -50.0]), C=[[1.0, 0.0]], Bf=[[1.0], [0.0]], Dw=[[0.1]], noise_names=alone.noise_names
    )
    own, more = (obsynth.design(plant, method) for plant in (alone, beside))
    if method == "optimal-filter":
        assert more.certificate.claims["gain"] == pytest.approx(own.certificate.claims["gain"], rel=1e-3)
    assert noise_of(more) <= 4.0 * noise_of(own)


def test_a_sensor_that_shows_a_fault_at_once_by_a_small_difference_makes_no_filter_noisier():
    a = [[0.2, 0.6, 0.2, 0.2], [-1.2, 0.2, -0.4, 0.0], [0.0, 0.0, -0.2, -0.2], [0.8, 0.2, 0.4, 0.6]]
    rows = [[0.0, 0.0, 0.0, 1.0], [-0.000452, -0.001303, -0.002231, 0.999008]]
    noise = []
    for count in (1, 2):
        plant = obsynth.DescriptorSystem(
            A=a, C=rows[:count], Bf=[[1.0], [0.0], [0.5], [0.0]], Dw=0.1 * np.eye(count), dt=1.0
        )
        noise.append(noise_of(obsynth.fault_estimation_filter(plant)))
    assert noise[1] <= 1.001 * noise[0]
