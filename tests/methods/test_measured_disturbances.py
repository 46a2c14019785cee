"""A sensor that shows an unknown input, and no state, is used: the paper's rank C = ny refused such plants."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest

import obsynth

#: An unknown input that both states and the sensor feel: with this sensor alone it cannot be told from a fault.
A, BD = np.array([[0.8, 0.3], [-0.2, 0.5]]), np.array([[1.0], [0.7]])
C, DD = np.array([[1.0, 0.4]]), np.array([[0.5]])
SENSORS = {"one unit": 1.0, "small units": 1e-4, "large units": 1e5}
#: Mixed rows: which outputs are combined before anybody measures them.
MIXED = np.array([[1.0, 2.0], [0.5, -1.0]])


@cache
def plant_with(size: float | None, *, mixed: bool = False) -> obsynth.DescriptorSystem:
    rows = (C, DD) if size is None else (np.vstack([C, np.zeros((1, 2))]), np.vstack([DD, [[size]]]))
    c, dd = (MIXED @ part for part in rows) if mixed else rows
    return obsynth.DescriptorSystem(A=A, C=c, Bf=[[0.3], [1.0]], Bd=BD, Dd=dd, dt=0.1)


@cache
def filter_of(size: float | None, *, mixed: bool = False) -> obsynth.ObserverDesign:
    return obsynth.fault_estimation_filter(plant_with(size, mixed=mixed))


@pytest.mark.one_in(2)
@pytest.mark.parametrize("mixed", [False, True])
@pytest.mark.parametrize("units", SENSORS)
def test_a_measured_disturbance_costs_nothing_any_more(units: str, mixed: bool) -> None:
    without, design = filter_of(None), filter_of(SENSORS[units], mixed=mixed)
    assert design.report.passed
    assert without.certificate.claims["gamma_min"] > 0.1
    assert design.certificate.claims["gamma"] < 1e-2 * without.certificate.claims["gamma_min"]


@pytest.mark.parametrize("mixed", [False, True])
def test_the_estimate_of_a_simulated_fault_is_that_of_the_claim(mixed: bool) -> None:
    design = filter_of(SENSORS["one unit"], mixed=mixed)
    (plant, observer), rng = design.linear, np.random.default_rng(20261129)
    fault, disturbance = np.repeat(rng.standard_normal(8), 25), rng.standard_normal(200)
    x, z, estimates = np.zeros(2), np.zeros(observer.order), []
    for f, d in zip(fault, disturbance, strict=True):
        y = plant.C @ x + plant.Dd[:, 0] * d
        estimates.append((observer.Cz @ z + observer.Dy @ y)[observer.fault_rows][0])
        z, x = observer.Az @ z + observer.By @ y, A @ x + BD[:, 0] * d + plant.Bf[:, 0] * f
    delay = observer.fault_delays[0]
    missed = np.asarray(estimates)[delay:] - fault[: len(fault) - delay]
    assert np.linalg.norm(missed) <= design.certificate.claims["gamma"] * np.linalg.norm(disturbance)
    assert np.linalg.norm(missed) < 1e-2 * np.linalg.norm(fault)


def test_the_condition_says_what_is_counted() -> None:
    assert "exists: rank [C Dd]" in [row.name for row in filter_of(1.0).report.checks]


def test_a_fault_of_the_sensor_that_measures_a_disturbance_is_estimated() -> None:
    plant = plant_with(1.0).replace(Bf=[[0.3, 0.0], [1.0, 0.0]], Df=[[0.0, 0.0], [0.0, 1.0]], fault_names=None)
    assert obsynth.fault_estimation_filter(plant).report.passed


@pytest.mark.one_in(3)
@pytest.mark.parametrize("size", [1.0, 3.3, -0.7])
def test_a_mean_of_estimates_beside_a_copied_sensor_is_the_one_that_is_claimed(size: float) -> None:
    plant = plant_with(None)
    both = obsynth.DescriptorSystem(
        A=A, C=np.vstack([C, size * C]), Bf=plant.Bf, Bd=BD, Dd=np.vstack([DD, size * DD]), dt=0.1
    )
    assert obsynth.fault_estimation_filter(both, mean=3).report.passed


def test_bisection_names_itself_where_it_asks_for_the_paper_s_weight() -> None:
    both = obsynth.DescriptorSystem(
        A=A, C=[[1.0, 0.4], [0.0, 1.0], [3.3, 1.32]], Bf=[[0.3], [1.0]], Bd=BD, Dd=[[0.5], [0.0], [1.65]], dt=0.1
    )
    with pytest.raises(obsynth.PreconditionError, match="Leave gamma_search out"):
        obsynth.fault_estimation_filter(both, gamma_search="bisection")
    assert obsynth.fault_estimation_filter(both).report.passed


def test_an_observer_whose_sensors_all_decouple_unknown_inputs_has_no_gain_left_to_choose() -> None:
    """Three sensors for two unknown inputs and a fault: none is left that an injection could use."""
    plant = obsynth.DescriptorSystem(
        A=[[-1.0466, -0.0068], [0.3583, -1.0119]],
        C=[[-0.3658, -1.5919], [0.3759, 0.2418], [1.0067, -0.9023]],
        Bf=[[-2.9202], [-0.7629]],
        Bd=[[-0.4415, -0.6837], [0.608, -2.7701]],
        Dd=[[-1.146, 1.3855], [0.3037, 2.3065], [0.3789, -0.4792]],
        Dw=0.1 * np.eye(3),
    )
    assert obsynth.ui_pi_observer(plant).report.passed
