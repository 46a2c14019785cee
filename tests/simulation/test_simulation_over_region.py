"""Scenarios over a region: plants along courses of their parameters, and designs over regions beside them."""

from __future__ import annotations

import numpy as np
import pandas as pd
import pytest
from scipy.integrate import solve_ivp
from tests.support.polytopic_plants import record, wang, wang_filter

import obsynth
from obsynth import PolytopicSystem, PreconditionError, Scenario, SpecError


def test_a_discrete_plant_follows_its_own_equations() -> None:
    plant, rng = wang(effectiveness=True), np.random.default_rng(4)
    course, u, f, d = (rng.uniform(-1, 1, (60, size)) for size in (3, 1, 2, 1))
    run = obsynth.simulate(plant, scheduling=course, u=u, f=f, d=d)
    assert run.outputs == pytest.approx(record(plant, course, u, f, d), abs=1e-10)
    for k in range(59):
        now = plant.at(course[k])
        after = now.A @ run.states[k] + now.B @ u[k] + now.Bf @ f[k] + now.Bd @ d[k]
        assert plant.E @ run.states[k + 1] == pytest.approx(after, abs=1e-10)


def test_noise_in_an_algebraic_equation_counts() -> None:
    plant = PolytopicSystem(
        plant={
            "E": np.diag([1.0, 0.0]), "A": [["0.5 * v", 1], [1, -2]], "C": [[0, 1]], "Bw": [[0.5], [1]], "Dw": [[0.3]],
            "dt": 1.0,
        },
        scheduling={"v": [-1.0, 1.0]},
    )  # fmt: skip
    rng = np.random.default_rng(8)
    course, w = rng.uniform(-1, 1, (30, 1)), rng.standard_normal((30, 1))
    run = obsynth.simulate(plant, scheduling=course, w=w, initial_state=[1.0, 0.5])
    assert run.states[0] == pytest.approx([1.0, 0.5 * (1.0 + w[0, 0])])
    for k in range(29):
        now = plant.at(course[k])
        after = now.A @ run.states[k] + now.Bw @ w[k]
        assert after == pytest.approx([run.states[k + 1, 0], 0.0], abs=1e-12)
        assert run.outputs[k] == pytest.approx(now.C @ run.states[k] + now.Dw @ w[k])


def test_a_continuous_plant_agrees_with_an_integrator() -> None:
    plant = PolytopicSystem(
        plant={
            "E": np.diag([1.0, 2.0, 0.0]), "A": [[0, 1, 0], ["-k", -1, 1], [0, "k", -1]],
            "C": [[1, 0, 0]], "Bf": [[0], [1], [0]],
        },
        scheduling={"k": [0.1, 0.7]},
    )  # fmt: skip
    scenario = Scenario(
        horizon=3.75,
        sample_time=0.25,
        faults={"f1": obsynth.Step(size=1.0, start=1.0)},
        scheduling={"k": obsynth.Ramp(rate=0.1, start=1.0)},
        initial_state={"x1": 1.0},
    )
    from obsynth.simulation.over_region import region_runs, scheduled_parameters
    from obsynth.simulation.signals import resolve

    drive = resolve(plant, scenario)
    parameters = scheduled_parameters(plant, scenario, drive.steps, drive.dt)
    states, _ = region_runs(
        plant, parameters, drive.at_begin[:, None], drive.at_end[:, None], np.zeros((drive.steps, 1, 0)),
        np.array([1.0, 0, 0]), drive.dt,
    )  # fmt: skip

    def rate(t: float, x: np.ndarray) -> list[float]:
        k, f = 0.4 + 0.1 * max(t - 1.0, 0.0), float(t >= 1.0)
        return [x[1], 0.5 * (-k * x[0] - x[1] + k * x[1] + f)]

    first = solve_ivp(rate, (0, 1.0 - 1e-9), [1.0, 0.0], rtol=1e-11, atol=1e-12)
    times = np.arange(1.0, 3.8, 0.25)
    later = solve_ivp(rate, (1.0, 3.9), first.y[:, -1], t_eval=times, rtol=1e-11, atol=1e-12)
    assert states[4 : 4 + len(times), 0, :2] == pytest.approx(later.y.T, abs=1e-5)


@pytest.mark.long
def test_a_scheduled_design_finds_the_fault_while_its_parameters_move() -> None:
    design = wang_filter()
    scenario = Scenario(
        horizon=150,
        faults={"f2": obsynth.Step(size=2.0, start=80)},
        scheduling={"a": obsynth.Sine(amplitude=1.0, frequency=0.2), "b": obsynth.Step(size=-1.0, start=50)},
    )
    run = obsynth.simulate(design, scenario)
    assert run.input_names == ("u1", "a", "b")
    assert run.inputs[60, 2] == -1.0
    assert run.fault_warm_up == design.scheduled[1].forgetting
    assert np.nanmax(np.abs(run.fault_errors[run.fault_warm_up :])) < 1e-6
    assert run.notes == ()
    # The table is a log of the same design.
    log = pd.DataFrame(run.columns())
    found = obsynth.run_on_data(design, log)
    assert found is not None


def test_a_parameter_that_is_an_output_moves_apart_from_it_and_that_is_said() -> None:
    plant = obsynth.PolytopicSystem(
        plant={"A": [["0.5 + 0.1 * level"]], "C": [[1]], "Bf": [[1]], "output_names": ["gauge"], "dt": 1.0},
        scheduling={"level": {"range": [0, 1], "column": "gauge"}},
    )
    design = obsynth.fault_estimation_filter(plant)
    (note,) = obsynth.simulate(design, Scenario(horizon=20)).notes
    assert note.startswith("In a log the parameter 'level' is the output 'gauge'; here it follows its profile")


@pytest.mark.long
def test_samples_faster_than_the_stated_rate_are_counted() -> None:
    design = obsynth.fault_estimation_filter(wang(rate=0.05))
    scenario = Scenario(horizon=200, scheduling={"a": obsynth.Step(size=1.0, start=80)})
    notes = obsynth.simulate(design, scenario).notes
    forgetting = int(design.scheduled[1].forgetting)
    assert any(f"In {forgetting} of 201 samples nothing is claimed" in note for note in notes)


@pytest.mark.long
def test_the_observer_of_a_nonlinear_plant_runs_on_a_scenario() -> None:
    tank = obsynth.DAEModel(
        {"balance": "2.0 * der(level) = inflow - 0.5 * sqrt(level) - leak"}, {"gauge": "level"},
        states={"level": 1.0}, inputs={"inflow": 0.5}, parameters={"leak": 0.0},
    )  # fmt: skip
    design = obsynth.region_observer(
        tank, region={"level": [0.2, 2.0]}, sample_time=1.0, noise={"gauge": 1e-3, "leak": 1e-4}
    )
    scenario = Scenario(horizon=400, noise=1.0, faults={"leak": obsynth.Step(size=0.02, start=100)}, seed=3)
    run = obsynth.simulate(design, scenario)
    settled = slice(200, None)
    size = float(np.sqrt(np.mean(run.fault_errors[settled] ** 2)))
    assert size < design.certificate.claims["region_deviation"]
    assert run.fault_warm_up == design.over_region[1].forgetting
    assert obsynth.evaluate(design, scenario, runs=3).fault_rmse["leak"].value < 3e-3


@pytest.mark.one_in(4)
@pytest.mark.parametrize(
    ("changes", "told"),
    [
        ({"scheduling": {"a": obsynth.Step(size=1.5, start=5)}}, "a is 1.5 at 5 s"),
        ({"scheduling": {"speed": obsynth.Step(size=1, start=5)}}, "speed"),
        ({"stabilise": True}, "No feedback is designed over a region"),
        ({"observer_state": [0.0]}, "leave observer_state out"),
        ({"faults": {"f1": obsynth.Stuck(start=1)}}, "where one input does"),
    ],
)
def test_what_a_scenario_over_a_region_does_not_have(changes: dict[str, object], told: str) -> None:
    design = wang_filter()
    with pytest.raises(SpecError, match=told):
        obsynth.simulate(design, Scenario(horizon=20, **changes))


def test_other_plants_have_no_scheduling_and_points_of_higher_index_are_named() -> None:
    plain = obsynth.fault_estimation_filter(wang().at([0.0, 0.0]))
    with pytest.raises(SpecError, match="no scheduling parameters"):
        obsynth.simulate(plain, Scenario(horizon=5, scheduling={"a": obsynth.Step(size=1, start=0)}))
    plant = PolytopicSystem(
        plant={"E": np.diag([1.0, 0.0]), "A": [[0.5, 1], [1, "v"]], "C": [[1, 0]], "dt": 1.0},
        scheduling={"v": [-1.0, 1.0]},
    )
    with pytest.raises(PreconditionError, match="At v = 0 the equations"):
        obsynth.simulate(plant, scheduling=np.zeros((3, 1)))
    with pytest.raises(SpecError, match="v is 2 at 1 s"):
        obsynth.simulate(plant, scheduling=[[1.0], [2.0]])


@pytest.mark.long
def test_learned_thresholds_of_a_nonlinear_region_and_what_has_none() -> None:
    tank = obsynth.DAEModel(
        {"balance": "2.0 * der(level) = inflow - 0.5 * sqrt(level) - leak"}, {"gauge": "level"},
        states={"level": 1.0}, inputs={"inflow": 0.5}, parameters={"leak": 0.0},
    )  # fmt: skip
    design = obsynth.region_observer(
        tank, region={"level": [0.2, 2.0]}, sample_time=1.0, noise={"gauge": 1e-3, "leak": 1e-4}
    )
    log = pd.DataFrame(obsynth.simulate(design, Scenario(horizon=400, sensor_noise={"gauge": 1e-3})).columns())
    learned = obsynth.learn_thresholds(design, log, false_alarms="1 per 200 rows")
    assert "gauge" in " ".join(learned.columns)
    for kind in ("pointwise", "cusum", "window"):
        with pytest.raises(SpecError, match="learn thresholds from rows without faults"):
            obsynth.online_monitor(design, kind=kind)
    with pytest.raises(SpecError, match="states no covariance of its residual"):
        obsynth.validate(design, log)
