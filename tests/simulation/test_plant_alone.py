"""A plant alone over a scenario shows what it shows beside an observer."""

from __future__ import annotations

import numpy as np
import pytest

import obsynth

CONTINUOUS = obsynth.DescriptorSystem(
    E=np.diag([1.0, 1.0, 0.0]), A=[[-1.0, 0.5, 0.0], [0.2, -2.0, 1.0], [1.0, 0.0, -1.0]], B=[[1.0], [0.0], [0.0]],
    C=[[1.0, 0.0, 0.0], [0.0, 1.0, 0.0]], Bf=[[1.0], [0.3], [0.0]], Bd=[[0.0], [1.0], [0.0]],
    sensor_noise={"y1": 0.1, "y2": 0.2},
)  # fmt: skip

SCENARIO = obsynth.Scenario(
    horizon=4.0,
    sample_time=0.1,
    inputs={"u1": obsynth.Sine(amplitude=1.0, frequency=2.0)},
    faults={"f1": obsynth.Step(size=1.0, start=1.0)},
    disturbances={"d1": obsynth.Gaussian(deviation=0.3)},
    sensors={"y2": obsynth.Stuck(start=3.0)},
    noise=1.0,
    sensor_noise={"y1": 0.05},
    seed=11,
    initial_state={"x1": 1.0},
)


def nonlinear() -> obsynth.DAEModel:
    return obsynth.DAEModel(
        {"balance": "der(level) = inflow - leak * sqrt(level)"}, {"gauge": "level"},
        states={"level": 1.0}, inputs={"inflow": 1.0}, parameters={"leak": 1.0},
    )  # fmt: skip


@pytest.mark.parametrize("dt", [0.0, 0.1])
def test_a_linear_plant_shows_what_it_shows_beside_an_observer(dt: float) -> None:
    plant = obsynth.discretise(CONTINUOUS, dt).plant if dt else obsynth.eliminate_algebraic_states(CONTINUOUS).plant
    design = obsynth.ui_pi_observer(plant)
    alone, beside = obsynth.simulate(plant, SCENARIO), obsynth.simulate(design, SCENARIO)
    for name in ("states", "outputs", "inputs", "faults", "disturbances", "time"):
        np.testing.assert_array_equal(getattr(alone, name), getattr(beside, name), err_msg=name)
    assert alone.outputs.std() > 0.1


def test_an_algebraic_state_of_the_plant_as_written_is_part_of_what_it_does() -> None:
    run = obsynth.simulate(CONTINUOUS, SCENARIO)
    np.testing.assert_allclose(run.states[:, 2], run.states[:, 0], atol=1e-12)


def test_outputs_with_dead_time_come_later() -> None:
    plant = obsynth.discretise(CONTINUOUS, 0.1).plant
    late = plant.replace(delays={"y1": 0.3})
    quiet = SCENARIO.replace(noise=0.0, sensor_noise={}, sensors={}, initial_state={})
    at_once, later = obsynth.simulate(plant, quiet), obsynth.simulate(late, quiet)
    np.testing.assert_allclose(later.outputs[3:, 0], at_once.outputs[:-3, 0], atol=1e-12)
    np.testing.assert_allclose(later.outputs[:, 1], at_once.outputs[:, 1], atol=1e-12)


def test_a_nonlinear_plant_needs_a_sample_time_and_begins_at_its_nominal_values() -> None:
    scenario = obsynth.Scenario(
        horizon=5.0, sample_time=0.1, faults={"leak": obsynth.Step(size=0.2, start=2.0)}, sensor_noise={"gauge": 0.01}
    )
    run = obsynth.simulate(nonlinear(), scenario)
    settled = 1.0 / 1.2**2  # inflow 1 = 1.2 sqrt(level)
    assert run.states[19, 0] == pytest.approx(1.0, abs=1e-9)
    long = obsynth.simulate(nonlinear(), scenario.replace(horizon=60.0))
    assert long.states[-1, 0] == pytest.approx(settled, abs=1e-6)
    assert (run.outputs - run.states).std() == pytest.approx(0.01, rel=0.4)
    np.testing.assert_array_equal(run.faults[:, 0], np.where(run.time >= 2.0 - 1e-9, 1.2, 1.0))
    with pytest.raises(obsynth.SpecError, match="give the scenario a sample_time"):
        obsynth.simulate(nonlinear(), scenario.replace(sample_time=None))
    with pytest.raises(obsynth.SpecError, match="give sensor_noise"):
        obsynth.simulate(nonlinear(), scenario.replace(noise=1.0))


def test_a_time_varying_plant_and_one_over_a_region() -> None:
    varying = obsynth.TimeVaryingDescriptorSystem(
        E=[[1.0]], A=[[0.5]], B=[[1.0]], C=[[1.0]], Phi=[[1.0]], dt=1.0, input_names=["u1"], parameter_names=["f1"]
    )
    scenario = obsynth.Scenario(horizon=40.0, faults={"f1": obsynth.Step(size=1.0, start=10.0)})
    run = obsynth.simulate(varying, scenario)
    assert run.states[-1, 0] == pytest.approx(2.0)  # x = x / 2 + 1
    assert np.isnan(run.outputs[0, 0])
    region = obsynth.PolytopicSystem(
        plant={"A": [["a"]], "B": [[1.0]], "C": [[1.0]], "Bf": [[1.0]], "dt": 1.0},
        scheduling={"a": {"range": [0.2, 0.5]}},
    )
    run = obsynth.simulate(region, scenario.replace(scheduling={"a": obsynth.Step(size=0.15)}))
    assert run.states[-1, 0] == pytest.approx(2.0)


def test_signals_beside_a_scenario_are_refused() -> None:
    with pytest.raises(obsynth.SpecError, match="steps: give a scenario, or the signals"):
        obsynth.simulate(CONTINUOUS, SCENARIO, steps=3)
