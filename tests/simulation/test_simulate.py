"""Scenarios and simulations, against closed forms, another integrator and the older functions."""

from __future__ import annotations

import csv
import pickle
import re
from pathlib import Path

import control
import numpy as np
import pytest
from scipy.integrate import solve_ivp

import obsynth
from obsynth.errors import PreconditionError, SpecError
from obsynth.simulation.linear import make_stepper, simulate_plant
from obsynth.simulation.signals import resolve
from obsynth.specs.loader import load_spec

pytestmark = pytest.mark.usefixtures("taken_as_verified")

DESIGNS = Path(__file__).parents[2] / "designs"


def designed(name: str) -> tuple[obsynth.ObserverDesign, obsynth.Scenario]:
    spec = load_spec(DESIGNS / name / "spec.yaml")
    assert spec.scenario is not None
    return obsynth.design(spec.plant, spec.method, name=spec.name, **dict(spec.options)), spec.scenario


@pytest.fixture(scope="module")
def wang() -> tuple[obsynth.ObserverDesign, obsynth.Scenario]:
    return designed("wang2015")


@pytest.fixture(scope="module")
def sharepasand() -> tuple[obsynth.ObserverDesign, obsynth.Scenario]:
    return designed("sharepasand")


def moved(plant: obsynth.DescriptorSystem, scenario: obsynth.Scenario):
    """Return states, outputs and [u, f, d] of one run of a plant alone."""
    drive = resolve(plant, scenario)
    start = np.array([scenario.initial_state.get(name, 0.0) for name in plant.state_names])
    stepper = make_stepper(plant, drive, initial_state=start, stabilise=scenario.stabilise)
    drawn, noise, _ = drive.drawn([scenario.seed], stepper.noisy.shape[1])
    left = drive.at_begin[:, None] + drawn
    states, outputs, _ = stepper.run(left, (drive.at_end - drive.at_begin)[:, None] + 0.0 * left, noise)
    return states[:, 0], outputs[:, 0], left[:, 0]


# Profiles

T = 0.5 * np.arange(9)


@pytest.mark.parametrize(
    ("profile", "values", "ends"),
    [
        (obsynth.Step(size=2, start=1, end=2), [0, 0, 2, 2, 0, 0, 0, 0], [0, 0, 2, 2, 0, 0, 0, 0]),
        (obsynth.Ramp(rate=2, start=1, end=2), [0, 0, 0, 1, 0, 0, 0, 0], [0, 0, 1, 2, 0, 0, 0, 0]),
        (obsynth.Step(size=1, start=0.6), [0, 0, 1, 1, 1, 1, 1, 1], [0, 0, 1, 1, 1, 1, 1, 1]),
        (obsynth.Intermittent(size=3, period=1), [3, 0, 3, 0, 3, 0, 3, 0], [3, 0, 3, 0, 3, 0, 3, 0]),
        (obsynth.Sine(amplitude=2, frequency=3, phase=1), 2 * np.sin(3 * T[:-1] + 1), 2 * np.sin(3 * T[1:] + 1)),
        (obsynth.Drift(size=2, time_constant=3), 2 - 2 * np.exp(-T[:-1] / 3), 2 - 2 * np.exp(-T[1:] / 3)),
    ],
    ids=lambda value: type(value).__name__ if isinstance(value, obsynth.Step) else "",
)
def test_profiles_have_their_formulas(profile, values, ends) -> None:
    left, right = profile.sampled(8, 0.5)
    np.testing.assert_allclose(left, values, rtol=0, atol=1e-15)
    np.testing.assert_allclose(right, ends, rtol=0, atol=1e-15)


@pytest.mark.parametrize(
    ("make", "path"),
    [
        (lambda: obsynth.Step(size=float("nan")), "size"),
        (lambda: obsynth.Step(size=True), "size"),
        (lambda: obsynth.Step(size=1, start=2, end=2), "end"),
        (lambda: obsynth.Drift(size=1, time_constant=0), "time_constant"),
        (lambda: obsynth.Intermittent(size=1, period=-1), "period"),
        (lambda: obsynth.Intermittent(size=1, period=1, duty=1.0), "duty"),
        (lambda: obsynth.LostEffectiveness(share=1.5), "share"),
        (lambda: obsynth.Uniform(low=1, high=1), "high"),
        (lambda: obsynth.Gaussian(deviation=0), "deviation"),
        (lambda: obsynth.Scenario(horizon=-1), "horizon"),
        (lambda: obsynth.Scenario(horizon=1, noise=-1), "noise"),
        (lambda: obsynth.Scenario(horizon=1, seed=1.5), "seed"),
        (lambda: obsynth.Scenario(horizon=1, inputs={"u1": obsynth.Uniform(low=0, high=1)}), "inputs.u1"),
        (lambda: obsynth.Scenario(horizon=1, disturbances={"d": obsynth.Stuck()}), "disturbances.d"),
        (lambda: obsynth.Scenario(horizon=1, faults={"f": []}), "faults.f"),
        (lambda: obsynth.Scenario(horizon=1, faults={"f": [obsynth.Stuck(), obsynth.Step(size=1)]}), "faults.f"),
        (lambda: obsynth.Scenario(horizon=1, initial_state={"x1": float("inf")}), "initial_state.x1"),
        (lambda: obsynth.Scenario(horizon=1, sensor_noise={"y1": -1.0}), "sensor_noise"),
        (lambda: obsynth.Scenario(horizon=1, observer_state=[float("nan")]), "observer_state"),
    ],
)
def test_bad_profiles_and_scenarios_say_where(make, path: str) -> None:
    with pytest.raises(SpecError) as caught:
        make()
    assert caught.value.path == path


@pytest.mark.parametrize(
    ("make", "text"),
    [
        (lambda: obsynth.Intermittent(size=1, period=1, duty=1.0), "duty is 1.0: give a number above 0 and below 1."),
        (lambda: obsynth.LostEffectiveness(share=1.5), "share is 1.5: give a number above 0 and at most 1."),
        (lambda: obsynth.Drift(size=1, time_constant=-2.0), "time_constant is -2.0: give a number above 0."),
    ],
)
def test_a_profile_out_of_range_tells_value_and_range(make, text: str) -> None:
    with pytest.raises(SpecError, match=re.escape(text)):
        make()
    # The upper end of a share is all of the signal.
    assert obsynth.LostEffectiveness(share=1.0).share == 1.0


def test_a_scenario_cannot_be_changed_and_travels(wang) -> None:
    scenario = wang[1]
    with pytest.raises(TypeError):
        scenario.faults["actuator 1"] = ()
    assert pickle.loads(pickle.dumps(scenario)) == scenario
    assert scenario.replace(seed=7).replace(seed=2015) == scenario
    assert scenario.replace(seed=7) != scenario


# Discrete plants


def test_discrete_simulation_agrees_with_the_older_functions(wang) -> None:
    design, scenario = wang
    found = obsynth.simulate(design, scenario)
    k = np.arange(301)
    inputs = np.column_stack([2 * np.sin(k), 2 * np.sin(k)])
    faults = np.column_stack([np.where(k >= 80, 1.0, 0.0), np.where(k >= 100, 1.2 * np.sin(0.1 * k), 0.0)])
    noise = np.random.default_rng(2015).uniform(0.0, 0.1, 301)
    run = simulate_plant(design.plant, steps=301, u=inputs, f=faults, d=noise, initial_state=[0.5, 1, 0, -0.5])
    start = np.array([0, 1, 0, -0.5]) - design.gains["N"] @ run.outputs[0]
    estimates = design.observer.run(run.outputs, inputs, initial_state=start)
    np.testing.assert_allclose(found.outputs, run.outputs, rtol=0, atol=1e-12)
    np.testing.assert_allclose(found.states, run.states, rtol=0, atol=1e-12)
    np.testing.assert_allclose(found.estimates.faults, estimates.faults, rtol=0, atol=1e-11)
    np.testing.assert_allclose(found.fault_errors[1:], estimates.faults[1:] - faults[:-1], rtol=0, atol=1e-11)
    assert np.isnan(found.fault_errors[0]).all()
    assert found.inconsistency == 0.0
    end = int(found.summary()["fault_warm_up"])
    rmse = np.sqrt(np.mean((estimates.faults[end:] - faults[end - 1 : -1]) ** 2, axis=0))
    assert found.summary()["faults"]["actuator 2"]["rmse"] == pytest.approx(rmse[1], rel=1e-9)


def test_an_inconsistent_start_is_projected_and_the_distance_is_told(wang) -> None:
    design, scenario = wang
    found = obsynth.simulate(design, scenario.replace(initial_state={"x1": 0.5, "x2": 1.0, "x4": 2.0}))
    assert found.inconsistency == pytest.approx(2.5)
    np.testing.assert_allclose(found.states[0], [0.5, 1.0, 0.0, -0.5], atol=1e-14)
    assert any("projected, a change of 2.5" in note for note in found.notes)


def test_a_failing_actuator_is_the_plant_with_another_input(wang) -> None:
    plant, (_, scenario) = wang[0].plant, wang
    quiet = scenario.replace(faults={}, disturbances={})
    commanded = 2 * np.sin(np.arange(301))
    for profile, given in (
        (obsynth.Stuck(start=50), np.where(np.arange(301) >= 50, commanded[50], commanded)),
        (obsynth.Stuck(start=50, value=0.3), np.where(np.arange(301) >= 50, 0.3, commanded)),
        (obsynth.LostEffectiveness(share=0.4, start=50), np.where(np.arange(301) >= 50, 0.6, 1.0) * commanded),
    ):
        states = moved(plant, quiet.replace(faults={"actuator 1": profile}))[0]
        other = simulate_plant(plant, steps=301, u=np.column_stack([given, commanded]), initial_state=[0.5, 1, 0, -0.5])
        np.testing.assert_allclose(states, other.states, rtol=0, atol=1e-11)


def test_a_failing_actuator_must_be_one(wang) -> None:
    plant = wang[0].plant.replace(Bf=2.0 * wang[0].plant.Bf)
    with pytest.raises(SpecError, match="exactly where one input does"):
        resolve(plant, obsynth.Scenario(horizon=5, faults={"actuator 1": obsynth.Stuck()}))


def test_sensor_faults_change_what_is_measured_and_nothing_else(wang) -> None:
    design, scenario = wang
    good = obsynth.simulate(design, scenario)
    sensors = {
        "x2": obsynth.Step(size=0.5, start=10), "x3": obsynth.Stuck(start=20),
        "x4": obsynth.LostEffectiveness(share=0.25, end=30),
    }  # fmt: skip
    bad = obsynth.simulate(design, scenario.replace(sensors=sensors))
    late = np.arange(301)
    np.testing.assert_array_equal(bad.states, good.states)
    np.testing.assert_allclose(bad.outputs[:, 0], good.outputs[:, 0] + 0.5 * (late >= 10), atol=1e-14)
    np.testing.assert_array_equal(bad.outputs[20:, 1], good.outputs[20, 1])
    np.testing.assert_allclose(bad.outputs[:, 2], good.outputs[:, 2] * np.where(late < 30, 0.75, 1.0), atol=1e-14)


@pytest.mark.long
def test_noise_has_the_sizes_that_are_stated_and_follows_the_seed() -> None:
    plant = load_spec(DESIGNS / "smib" / "spec.yaml").plant
    design = obsynth.fault_estimation_filter(plant, gamma=0.3)
    scenario = obsynth.Scenario(horizon=100, noise=1, seed=4, sensor_noise={"a Bus 1": 2e-3})
    first, again = obsynth.simulate(design, scenario), obsynth.simulate(design, scenario)
    np.testing.assert_array_equal(first.outputs, again.outputs)
    assert not np.array_equal(first.outputs, obsynth.simulate(design, scenario.replace(seed=5)).outputs)
    wanted = np.array([1e-4, np.hypot(1e-3, 2e-3), 1e-3])
    # 5001 samples: the standard deviation of a standard deviation is 1 %.
    np.testing.assert_allclose(np.std(first.outputs, axis=0), wanted, rtol=0.05)


# Continuous plants


def test_first_order_plant_has_its_closed_form() -> None:
    plant = obsynth.DescriptorSystem(None, [[-2.0]], [[1.0]], [[1.0]], Bf=[[3.0]])
    scenario = obsynth.Scenario(
        horizon=2, sample_time=0.25, inputs={"u1": obsynth.Ramp(rate=4)}, initial_state={"x1": 1.0},
        faults={"f1": obsynth.Step(size=2, start=1)},
    )  # fmt: skip
    states, _, _ = moved(plant, scenario)
    t = 0.25 * np.arange(9)
    exact = np.exp(-2 * t) + (2 * t - 1 + np.exp(-2 * t)) + np.where(t >= 1, 3 * (1 - np.exp(-2 * (t - 1))), 0.0)
    np.testing.assert_allclose(states[:, 0], exact, rtol=0, atol=1e-14)


@pytest.mark.parametrize("seed", range(3))
def test_another_integrator_agrees_on_an_index_one_plant(seed: int) -> None:
    rng = np.random.default_rng(seed)
    a = rng.standard_normal((4, 4)) - 3.0 * np.eye(4)
    b, bf = rng.standard_normal((4, 1)), rng.standard_normal((4, 1))
    mix = rng.standard_normal((4, 4))
    plant = obsynth.DescriptorSystem(mix @ np.diag([1.0, 1, 0, 0]), mix @ a, mix @ b, np.eye(4), Bf=mix @ bf)
    scenario = obsynth.Scenario(
        horizon=3, sample_time=0.1, inputs={"u1": obsynth.Ramp(rate=1)}, faults={"f1": obsynth.Step(size=1, start=1)},
        initial_state={"x1": 1.0, "x2": -1.0},
    )  # fmt: skip
    states, _, _ = moved(plant, scenario)

    def algebraic(x, s):
        return -np.linalg.solve(a[2:, 2:], a[2:, :2] @ x + s[2:])

    def slope(t, x, fault):
        s = b[:, 0] * t + bf[:, 0] * fault
        return a[:2, :2] @ x + a[:2, 2:] @ algebraic(x, s) + s[:2]

    options = {"rtol": 1e-12, "atol": 1e-13, "method": "DOP853"}
    early = solve_ivp(slope, (0, 1), [1.0, -1.0], args=(0.0,), **options).y[:, -1]
    late = solve_ivp(slope, (1, 3), early, args=(1.0,), **options).y[:, -1]
    whole = np.concatenate([late, algebraic(late, b[:, 0] * 3 + bf[:, 0])])
    np.testing.assert_allclose(states[-1], whole, rtol=1e-9, atol=1e-10)


def test_sines_are_linear_between_samples() -> None:
    plant = obsynth.DescriptorSystem(None, [[-1.0]], [[1.0]], [[1.0]])
    errors = []
    for step in (0.2, 0.1, 0.05):
        sine = obsynth.Sine(amplitude=1, frequency=2)
        states, _, _ = moved(plant, obsynth.Scenario(horizon=4, sample_time=step, inputs={"u1": sine}))
        exact = (np.sin(8.0) - 2 * np.cos(8.0) + 2 * np.exp(-4.0)) / 5
        errors.append(abs(states[-1, 0] - exact))
    assert errors[0] / errors[1] == pytest.approx(4.0, rel=0.05)
    assert errors[1] / errors[2] == pytest.approx(4.0, rel=0.05)


@pytest.mark.long
def test_the_audit_of_the_unknown_input_observer(sharepasand) -> None:
    design, scenario = sharepasand
    found = obsynth.simulate(design, scenario)
    errors = found.fault_errors[:, 0]
    # The audit ran observer and plant as one system; ours sees samples, 5 ms apart.
    for begin, rmse, slack in ((5, 1.332, 2e-3), (7, 0.360, 2e-3), (10, 1.55e-3, 1e-4)):
        assert np.sqrt(np.mean(errors[round(begin / 0.005) :] ** 2)) == pytest.approx(rmse, abs=slack)


def test_an_observer_without_initial_error_starts_without_one() -> None:
    """z(0) is that of the continuous observer, whatever a first-order hold keeps."""
    plant = obsynth.DescriptorSystem(None, [[-1.0, 1.0], [0.0, -2.0]], [[0.0], [1.0]], [[1.0, 0.0]], Bf=[[0.0], [1.0]])
    design = obsynth.pd_observer(plant)
    scenario = obsynth.Scenario(horizon=2, sample_time=0.001, initial_state={"x1": 1.0, "x2": 0.5})
    rest = obsynth.simulate(design, scenario)
    # Output of the continuous observer at rest: only what y(0) adds directly.
    np.testing.assert_allclose(rest.estimates.faults[0], design.observer.Dy[2:3] @ [1.0], rtol=0, atol=1e-12)


def test_feedback_makes_an_unstable_plant_last() -> None:
    design, scenario = designed("filasova")
    found = obsynth.simulate(design, scenario)
    assert np.max(np.abs(found.states)) < 10.0
    gain = np.asarray(control.lqr(design.plant.A, design.plant.B, np.eye(4), np.eye(2))[0])
    np.testing.assert_allclose(found.inputs, -found.states @ gain.T, rtol=0, atol=1e-9)
    assert any("stabilising state feedback" in note for note in found.notes)
    with pytest.raises(SpecError, match="set stabilise"):
        obsynth.simulate(design, scenario.replace(stabilise=False, horizon=1000, sample_time=0.1))


def test_feedback_of_a_discrete_plant_is_the_linear_quadratic_one() -> None:
    a, b = np.array([[1.2, 0.3], [0.0, 0.7]]), np.array([[0.0], [1.0]])
    plant = obsynth.DescriptorSystem(None, a, b, np.eye(2), dt=0.5)
    scenario = obsynth.Scenario(horizon=10, initial_state={"x1": 1.0}, stabilise=True)
    states, _, _ = moved(plant, scenario)
    gain = np.asarray(control.dlqr(a, b, np.eye(2), np.eye(1))[0])
    np.testing.assert_allclose(states[1:], states[:-1] @ (a - b @ gain).T, rtol=0, atol=1e-12)


def test_process_noise_of_a_continuous_plant_has_its_stationary_variance() -> None:
    """x' = -a x + s w has variance s^2 / (2 a), whatever the sampling."""
    plant = obsynth.DescriptorSystem(None, [[-2.0]], None, [[1.0]], Bw=[[3.0]])
    states, _, _ = moved(plant, obsynth.Scenario(horizon=5000, sample_time=0.5, noise=1))
    # Samples a time constant apart: the standard deviation of the variance's estimate is about 2 %.
    assert np.var(states[20:]) == pytest.approx(9.0 / 4.0, rel=0.08)


def test_the_horizon_is_not_passed_and_has_a_limit() -> None:
    plant = obsynth.DescriptorSystem(None, [[0.5]], None, [[1.0]], dt=0.1)
    assert resolve(plant, obsynth.Scenario(horizon=0.3)).steps == 4
    assert resolve(plant, obsynth.Scenario(horizon=0.39)).steps == 4
    assert resolve(plant, obsynth.Scenario(horizon=0.05)).steps == 1
    with pytest.raises(SpecError, match="shorten the horizon"):
        resolve(plant, obsynth.Scenario(horizon=1e9))


def test_what_no_feedback_can_stabilise_is_refused() -> None:
    plant = obsynth.DescriptorSystem(None, [[1.0, 0], [0, -1]], [[0.0], [1.0]], np.eye(2))
    with pytest.raises(PreconditionError) as caught:
        moved(plant, obsynth.Scenario(horizon=1, sample_time=0.1, stabilise=True))
    assert caught.value.condition == "stabilisability"


def test_index_two_is_refused_with_the_reason() -> None:
    plant = obsynth.DescriptorSystem([[0.0, 1], [0, 0]], np.eye(2), [[0.0], [1]], np.eye(2))
    with pytest.raises(PreconditionError, match="index 2") as caught:
        moved(plant, obsynth.Scenario(horizon=1, sample_time=0.1))
    assert caught.value.condition == "index"


@pytest.mark.long
def test_a_continuous_plant_needs_a_sample_time(sharepasand) -> None:
    with pytest.raises(SpecError, match="needs a sample_time"):
        obsynth.simulate(sharepasand[0], obsynth.Scenario(horizon=1))


def test_the_file_holds_every_signal_to_the_last_bit(wang, tmp_path: Path) -> None:
    design, scenario = wang
    found = obsynth.simulate(design, scenario)
    path = found.write_csv(tmp_path / "run.csv")
    with path.open(encoding="utf-8", newline="") as stream:
        rows = list(csv.DictReader(stream))
    assert len(rows) == 301
    np.testing.assert_array_equal([float(row["x3"]) for row in rows], found.outputs[:, 1])
    np.testing.assert_array_equal([float(row["u2"]) for row in rows], found.inputs[:, 1])
    np.testing.assert_array_equal([float(row["fhat[actuator 1]"]) for row in rows], found.estimates.faults[:, 0])
    assert [item.name for item in tmp_path.iterdir()] == ["run.csv"]


def test_an_output_may_have_the_name_of_an_input() -> None:
    plant = obsynth.DescriptorSystem(
        None, [[0.5]], [[1.0]], [[1.0]], Bf=[[1.0]], dt=1.0, input_names=["level"], output_names=["level"]
    )
    design = obsynth.fault_estimation_filter(plant)
    found = obsynth.simulate(design, obsynth.Scenario(horizon=3, inputs={"level": obsynth.Step(size=2)}))
    table = found.columns()
    assert list(table)[:4] == ["time", "level", "y[level]", "x[x1]"]
    np.testing.assert_array_equal(table["level"], 2.0)
    np.testing.assert_allclose(table["y[level]"], [0.0, 2.0, 3.0, 3.5])


def test_a_plant_of_any_kind_is_simulated_alone(wang) -> None:
    """One `simulate`: the kind of the plant decides; the signals are given, not a scenario."""
    plant = wang[0].linear[0]
    found = obsynth.simulate(plant, steps=4, f=np.ones((4, plant.nf)))
    np.testing.assert_allclose(found.states[1:] @ plant.E.T, found.states[:-1] @ plant.A.T + plant.Bf.sum(1), atol=1e-9)
    varying = obsynth.TimeVaryingDescriptorSystem(None, [["0.5 + 0 * k"]], C=[[1.0]], Phi=[[1.0]], dt=2.0)
    found = obsynth.simulate(varying, samples=3, parameters=[1.0])
    np.testing.assert_allclose(found.states[:, 0], [0.0, 1.0, 1.5])
    np.testing.assert_allclose(found.time, [0.0, 2.0, 4.0])
    tank = obsynth.DAEModel(
        {"tank": "der(level) = -leak * level"}, {"gauge": "level"}, states={"level": 1.0}, inputs={},
        parameters={"leak": 0.5},
    )  # fmt: skip
    found = obsynth.simulate(tank, u=np.zeros((3, 0)), dt=0.1)
    np.testing.assert_allclose(found.outputs[:, 0], np.exp(-0.05 * np.arange(3)), rtol=1e-6)
    with pytest.raises(SpecError, match=r"an obsynth\.Scenario"):
        obsynth.simulate(wang[0])
    with pytest.raises(SpecError, match="steps: the signals of a design are its scenario's"):
        obsynth.simulate(*wang, steps=3)


def test_estimates_without_deviations_have_none() -> None:
    design = obsynth.fault_estimation_filter(
        obsynth.DescriptorSystem(None, [[0.5]], [[1.0]], [[1.0]], Bf=[[1.0]], dt=1.0)
    )
    found = design.observer.run(np.zeros((3, 1)), np.zeros((3, 1)))
    assert not found.has_deviations
    assert np.isnan(found.state_deviations).all()
    assert found.fault_deviations.shape == found.parameters.shape == (3, 1)
    assert found.nis.size == 0


def test_what_begins_after_the_end_of_a_scenario_is_refused_by_name_or_left_out_where_it_is_shortened() -> None:
    late = obsynth.Step(size=1.0, start=20.0)
    with pytest.raises(obsynth.SpecError, match=r"'pump' among the faults begins at 20 s.*ends at 10 s") as refused:
        obsynth.Scenario(horizon=10.0, faults={"pump": late})
    assert refused.value.path == "faults.pump"
    scenario = obsynth.Scenario(horizon=20.0, faults={"pump": late}, inputs={"u": [late, obsynth.Step(size=2.0)]})
    ended = scenario.replace(horizon=15.0)
    assert (ended.horizon, ended.faults, ended.inputs) == (15.0, {}, {"u": (obsynth.Step(size=2.0),)})
