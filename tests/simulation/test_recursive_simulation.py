"""Recursive designs on scenarios: simulated, evaluated over many runs, and what their decisions are worth."""

from __future__ import annotations

import csv
import pickle
from pathlib import Path

import numpy as np
import pytest

import obsynth
from obsynth.cli.main import main
from obsynth.errors import SpecError
from obsynth.simulation.benches import bench_of
from obsynth.simulation.simulate import Simulation
from obsynth.specs.loader import load_spec

pytestmark = pytest.mark.usefixtures("taken_as_verified")

DESIGNS = Path(__file__).parents[2] / "designs"


def designed(path: str) -> tuple[obsynth.ObserverDesign, obsynth.Scenario]:
    spec = load_spec(DESIGNS / path)
    assert spec.scenario is not None
    return obsynth.design(spec.plant, spec.method, name=spec.name, **dict(spec.options)), spec.scenario


@pytest.fixture(scope="module")
def varying() -> tuple[obsynth.ObserverDesign, obsynth.Scenario]:
    return designed("moussaali2013_ltv/two_outputs.yaml")


@pytest.fixture(scope="module")
def nonlinear() -> tuple[obsynth.ObserverDesign, obsynth.Scenario]:
    return designed("diode_circuit/spec.yaml")


@pytest.fixture(scope="module")
def shifted() -> obsynth.ObserverDesign:
    """Two parameters and one output too many: decisions can blame the right one."""
    plant = obsynth.TimeVaryingDescriptorSystem(
        E=[[1, 0], [0, 1]], A=[["0.8 + 0.1 * cos(0.2 * k)", 0.1], [0, 0.6]], B=[[1], [0]], C=np.eye(2),
        Phi=[["1 + 0.3 * sin(k)", 0], [0, 1]], dt=0.5, horizon=400, parameter_names=["leak", "clog"],
        state_names=["level", "flow"], units={"leak": "kg/s"},
    )  # fmt: skip
    return obsynth.adaptive_observer(plant, Q=1e-4, R=1e-2, forgetting=0.97, initial_parameters=[1.0, -2.0])


# Simulation


def test_a_time_varying_plant_obeys_its_equations(shifted) -> None:
    scenario = obsynth.Scenario(
        horizon=50, inputs={"u1": obsynth.Sine(amplitude=2, frequency=1)},
        faults={"clog": obsynth.Ramp(rate=0.1, start=20)}, initial_state={"level": 3.0},
        sensors={"y2": obsynth.Step(size=5, start=40)},
    )  # fmt: skip
    found = obsynth.simulate(shifted, scenario)
    assert isinstance(found, Simulation)
    assert len(found.time) == 101
    np.testing.assert_array_equal(found.time[:3], [0.0, 0.5, 1.0])
    # Parameters are the observer's first ones and what the scenario adds.
    wanted = np.column_stack([np.full(101, 1.0), -2.0 + 0.1 * np.maximum(found.time - 20.0, 0.0)])
    np.testing.assert_allclose(found.parameters, wanted, atol=1e-12)
    np.testing.assert_allclose(found.inputs[:, 0], 2 * np.sin(found.time), atol=1e-12)
    x = np.array([3.0, 0.0])
    for k in range(100):
        np.testing.assert_allclose(found.states[k], x, rtol=0, atol=1e-11)
        a = np.array([[0.8 + 0.1 * np.cos(0.2 * k), 0.1], [0, 0.6]])
        phi = np.diag([1 + 0.3 * np.sin(k), 1.0])
        x = a @ x + np.array([found.inputs[k, 0], 0]) + phi @ found.parameters[k]
    assert np.isnan(found.outputs[0]).all()
    bias = np.where(found.time >= 40.0, 5.0, 0.0)
    np.testing.assert_allclose(found.outputs[1:, 1], (found.states[:, 1] + bias)[1:], atol=1e-12)


@pytest.mark.long
def test_the_observer_beside_it_is_that_of_run(varying) -> None:
    design, scenario = varying
    found = obsynth.simulate(design, scenario.replace(horizon=60))
    again = design.observer.run(found.outputs, found.inputs)
    np.testing.assert_array_equal(found.estimates.states, again.states)
    np.testing.assert_array_equal(found.parameter_errors, again.parameters - found.parameters)


@pytest.mark.long
def test_runs_at_once_are_runs_one_by_one(varying, shifted) -> None:
    cases = ((varying[0], varying[1].replace(horizon=80)), (shifted, obsynth.Scenario(horizon=40, noise=1)))
    for design, scenario in cases:
        bench = bench_of(design, scenario)
        together = bench.run(range(5))
        for seed, found in enumerate(together.estimates):
            alone = bench.run([seed])
            np.testing.assert_allclose(together.outputs[:, seed], alone.outputs[:, 0], rtol=1e-12, atol=1e-13)
            for name in ("states", "parameters", "innovations", "nis"):
                np.testing.assert_allclose(
                    getattr(found, name), getattr(alone.estimates[0], name), rtol=1e-7, atol=1e-8, err_msg=name
                )


def test_noise_is_as_large_as_the_design_states(shifted) -> None:
    """Sensors of 0.1, equations of 0.01: from what the plant does with it."""
    bench = bench_of(shifted, obsynth.Scenario(horizon=100, noise=2.0))
    noisy = bench.run(range(40))
    sensed = (noisy.outputs - noisy.states)[1:]
    assert np.std(sensed) == pytest.approx(2.0 * 0.1, rel=0.03)
    steps = noisy.states[1:, :, 1] - 0.6 * noisy.states[:-1, :, 1] - noisy.faults[:-1, :, 1]
    assert np.std(steps) == pytest.approx(2.0 * 0.01, rel=0.03)
    quiet = bench_of(shifted, obsynth.Scenario(horizon=10, sensor_noise={"y1": 0.5})).run(range(200))
    assert np.std((quiet.outputs - quiet.states)[1:, :, 0]) == pytest.approx(0.5, rel=0.05)
    assert not (quiet.outputs - quiet.states)[1:, :, 1].any()


def test_a_resetting_observer_is_run_on_each_record() -> None:
    plant = obsynth.TimeVaryingDescriptorSystem(
        E=None, A=[["0.9 + 0.05 * sin(k)"]], C=[[1]], Phi=[[1]], dt=1.0, horizon=100, parameter_names=["leak"]
    )
    design = obsynth.adaptive_observer(plant, Q=1e-4, R=1e-2, forgetting=0.98, reset=1e-4)
    scenario = obsynth.Scenario(horizon=80, noise=1, faults={"leak": obsynth.Step(size=2, start=40)})
    bench = bench_of(design, scenario)
    both = bench.run([3, 4]).estimates
    np.testing.assert_array_equal(both[1].parameters, bench.run([4]).estimates[0].parameters)
    assert obsynth.evaluate(design, scenario, runs=3).runs == 3


@pytest.mark.long
def test_a_dae_is_integrated_on_its_own_equations(nonlinear) -> None:
    design, scenario = nonlinear
    quiet = scenario.replace(noise=0.0, horizon=2.5)
    found = obsynth.simulate(design, quiet)
    alone = obsynth.simulate_dae(design.plant, found.inputs, dt=0.001, parameters=found.parameters)
    np.testing.assert_array_equal(found.states, alone.states)
    np.testing.assert_array_equal(found.outputs, alone.outputs)
    np.testing.assert_allclose(found.parameters[[0, -1], 0], [1.0e-3, 1.5e-3])
    # The true load is followed.
    assert abs(found.parameter_errors[-1, 0]) < 2e-5
    assert "Radau" in " ".join(found.notes)


def test_summary_and_file_hold_every_signal(shifted, tmp_path: Path) -> None:
    found = obsynth.simulate(shifted, obsynth.Scenario(horizon=100, noise=1))
    row = found.summary()["faults"]["leak"]
    errors = found.estimates.parameters[:, 0] - found.parameters[:, 0]
    assert row["rmse"] == pytest.approx(np.sqrt(np.mean(errors**2)))
    inside = np.abs(errors) <= 1.96 * found.estimates.parameter_deviations[:, 0]
    assert row["within_band"] == pytest.approx(np.mean(inside))
    assert row["within_band"] > 0.7
    path = found.write_csv(tmp_path / "run.csv")
    with path.open(encoding="utf-8", newline="") as stream:
        rows = list(csv.DictReader(stream))
    assert list(rows[0]) == [
        "time", "u1", "y1", "y2", "x[level]", "x[flow]", "f[leak]", "f[clog]", "xhat[level]", "xhat[flow]",
        "sd xhat[level]", "sd xhat[flow]", "fhat[leak]", "fhat[clog]", "sd fhat[leak]", "sd fhat[clog]",
    ]  # fmt: skip
    assert rows[0]["y1"] == ""
    assert float(rows[7]["fhat[clog]"]) == found.estimates.parameters[7, 1]


@pytest.mark.parametrize(
    ("changes", "path"),
    [
        ({"faults": {"lek": obsynth.Step(size=1)}}, "faults.lek"),
        ({"faults": {"leak": obsynth.LostEffectiveness(share=0.5)}}, "faults.leak"),
        ({"disturbances": {"d": obsynth.Step(size=1)}}, "disturbances"),
        ({"observer_state": [0.0, 0.0]}, "observer_state"),
        ({"stabilise": True}, "stabilise"),
        ({"sample_time": 0.1}, "sample_time"),
        ({"horizon": 1000.0}, "horizon"),
        ({"initial_state": {"depth": 1.0}}, "initial_state.depth"),
    ],
)
def test_what_such_a_plant_does_not_have_is_refused(shifted, changes, path: str) -> None:
    with pytest.raises(SpecError) as caught:
        obsynth.simulate(shifted, obsynth.Scenario(**{"horizon": 10.0, **changes}))
    assert caught.value.path == path


@pytest.mark.long
def test_the_command_simulates_a_varying_plant(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    spec = DESIGNS / "moussaali2013_ltv" / "two_outputs.yaml"
    assert main(["simulate", "--system", str(spec), "--quiet", "--out", str(tmp_path / "run.csv")]) == 0
    shown = capsys.readouterr().out
    assert "Parameter estimates" in shown
    assert "in its 95 % band" in shown
    assert (tmp_path / "run.csv").is_file()


# Many runs


@pytest.mark.long
def test_decisions_over_many_runs(shifted) -> None:
    scenario = obsynth.Scenario(horizon=150, noise=1, faults={"clog": obsynth.Step(size=0.3, start=75)})
    monitor = obsynth.ParameterMonitor(statistic="chi-square", false_alarms=0.05)
    found = obsynth.evaluate(shifted, scenario, runs=60, monitor=monitor)
    assert (found.missed_detection_rate.value, found.isolation_error_rate.value) == (0.0, 0.0)
    assert found.false_alarm_rate.low <= 0.05
    # One run by hand.
    one = obsynth.simulate(shifted, scenario.replace(seed=7))
    decision = obsynth.decide(shifted.observer, one.estimates, false_alarms=0.05)
    alone = obsynth.evaluate(shifted, scenario.replace(seed=7), runs=1, monitor=monitor)
    assert decision.alarm is not None
    assert decision.alarm.k >= 150
    assert alone.detection_delay.value == pytest.approx((decision.alarm.k - 150) * 0.5)
    errors = one.parameter_errors[1:, 0]
    assert alone.fault_rmse["leak"].value == pytest.approx(np.sqrt(np.mean(errors**2)))
    assert alone.state_rmse["flow"].value == pytest.approx(np.sqrt(np.mean(one.state_errors[1:, 1] ** 2)))


@pytest.mark.long
@pytest.mark.parametrize("statistic", ["chi-square", "nis", "cusum"])
def test_false_alarms_without_a_change_are_as_rare_as_asked(shifted, statistic: str) -> None:
    monitor = obsynth.ParameterMonitor(statistic=statistic, false_alarms=0.1)
    quiet = obsynth.Scenario(horizon=100, noise=1)
    found = obsynth.evaluate(shifted, quiet, runs=150, monitor=monitor)
    assert found.false_alarm_rate.count == 150
    assert found.false_alarm_rate.low <= 0.1
    assert found.missed_detection_rate.count == 0
    wrong = obsynth.ParameterMonitor(statistic=statistic, nominal=(1.5, -2.0))
    assert obsynth.evaluate(shifted, quiet, runs=5, monitor=wrong).false_alarm_rate.value == 1.0


def test_a_small_change_is_missed_and_another_fault_is_blamed(shifted) -> None:
    scenario = obsynth.Scenario(horizon=100, noise=1, faults={"leak": obsynth.Step(size=1e-6, start=50)})
    monitor = obsynth.ParameterMonitor()
    assert obsynth.evaluate(shifted, scenario, runs=20, monitor=monitor).missed_detection_rate.value == 1.0
    # A biased sensor of the second state looks like a change of "clog", which has not changed.
    biased = scenario.replace(sensors={"y2": obsynth.Step(size=1, start=50)})
    found = obsynth.evaluate(shifted, biased, runs=20, monitor=monitor)
    assert (found.missed_detection_rate.value, found.isolation_error_rate.value) == (0.0, 1.0)


@pytest.mark.long
def test_a_kalman_filter_has_errors_only_and_a_dae_decisions_too(shifted, nonlinear) -> None:
    kalman = obsynth.descriptor_kalman(shifted.plant, Q=1e-4, R=1e-2)
    found = obsynth.evaluate(kalman, obsynth.Scenario(horizon=20, noise=1), runs=10)
    assert found.fault_rmse == {}
    assert 0.0 < found.state_rmse["flow"].value < 0.1
    design, scenario = nonlinear
    found = obsynth.evaluate(design, scenario.replace(horizon=0.1, faults={}), runs=3)
    assert 0.0 < found.fault_rmse["load"].value < 2e-4
    quiet = scenario.replace(horizon=0.1, faults={})
    decided = obsynth.evaluate(design, quiet, runs=3, monitor=obsynth.ParameterMonitor())
    assert decided.false_alarm_rate.value == 0.0


@pytest.mark.long
def test_monitors_go_with_their_designs(shifted, varying) -> None:
    spec = load_spec(DESIGNS / "wang2015" / "spec.yaml")
    linear = obsynth.fault_estimation_filter(spec.plant)
    with pytest.raises(SpecError, match="linear"):
        obsynth.evaluate(linear, spec.scenario, runs=1, monitor=obsynth.ParameterMonitor())
    with pytest.raises(SpecError, match="recursive"):
        obsynth.evaluate(shifted, obsynth.Scenario(horizon=5), runs=1, monitor=obsynth.monitor(linear, spec.scenario))
    with pytest.raises(SpecError, match="statistic"):
        obsynth.ParameterMonitor(statistic="nonsense")
    with pytest.raises(obsynth.SpecError, match="change is for cusum, not for nis"):
        obsynth.ParameterMonitor("nis", change=0.1)


def test_benches_travel_to_other_processes(varying, nonlinear) -> None:
    for design, scenario in (varying, nonlinear):
        bench = bench_of(design, scenario.replace(horizon=20 * design.observer.dt, faults={}))
        there = pickle.loads(pickle.dumps(bench))
        np.testing.assert_array_equal(there.run([5]).outputs, bench.run([5]).outputs)
