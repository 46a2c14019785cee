"""Decisions on parameters of nonlinear designs: from records, row by row, and over many runs of a scenario."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import pytest

sys.path.insert(0, str(Path(__file__).parents[2]))

from benchmarks.campaigns._walking_parameters import cases

import obsynth
from obsynth import SpecError, dae_adaptive_observer, decide, simulate_dae

TANK = cases()["leak and bias of a tank"]
OPTIONS = {"dt": TANK.dt, "Q": TANK.Q, "R": TANK.R, "initial_parameter_covariance": TANK.start,
           "initial_covariance": 1e-4, "integration": "backward-euler", "forgetting": 0.98}  # fmt: skip
CHANGE = [0.2, 0.2]


@pytest.fixture(scope="module")
def design():
    return dae_adaptive_observer(TANK.model, **OPTIONS)


def record(seed: int, leak: float = 0.0, bias: float = 0.0, samples: int = 120):
    u = np.sign(np.sin(0.15 * np.arange(samples)))[:, None]
    path = np.zeros((samples, 2))
    path[60:] = leak, bias
    true = simulate_dae(TANK.model, u, dt=TANK.dt, parameters=path, Q=np.diag([1e-4, 0.0]), R=1e-3 * np.eye(2),
                        integration="backward-euler", seed=seed)  # fmt: skip
    return np.array(true.outputs), u


@pytest.mark.one_in(3)
@pytest.mark.parametrize("statistic", ["chi-square", "cusum", "nis"])
def test_a_jump_is_found_and_named_and_nothing_else(design, statistic):
    observer = design.observer
    y, u = record(1, bias=0.25)
    found = decide(observer, observer.run(y, u, progress=False), statistic=statistic, change=CHANGE)
    assert found.alarm is not None
    assert 60 <= found.alarm.k <= 75
    assert statistic == "nis" or found.alarm.parameter == "bias"
    quiet = [record(seed)[0] for seed in range(20)]
    alarms = [decide(observer, observer.run(y, u, progress=False), statistic=statistic, change=CHANGE).alarm
              for y in quiet]  # fmt: skip
    assert sum(alarm is not None for alarm in alarms) <= 1


def test_cusum_finds_a_small_change_whose_sign_it_knows(design):
    observer = design.observer
    y, u = record(3, leak=-0.15)
    found = decide(observer, observer.run(y, u, progress=False), statistic="cusum", change=[0.15, 0.15])
    assert found.alarm is not None
    assert found.alarm.parameter == "leak"
    assert 55 <= found.alarm.onset <= 75


def test_row_by_row_the_sums_are_those_of_the_record(design):
    y, u = record(4, bias=0.25)
    table = {"time": TANK.dt * np.arange(len(y)), "u": u[:, 0], "y": y[:, 0], "z": y[:, 1]}
    import pandas as pd

    watched = obsynth.online_monitor(design, "cusum", change=0.2)
    run = obsynth.run_on_data(design, pd.DataFrame(table), monitor=watched, warm_up=0, outliers="none")
    whole = decide(design.observer, design.observer.run(y, u, progress=False), statistic="cusum", change=CHANGE)
    column = next(name for name in run.table.columns if name.startswith("cusum") or name == "statistic")
    assert np.allclose(run.table[column].to_numpy()[1:], whole.values[1:], rtol=1e-6, atol=1e-9)
    assert run.alarms


def test_many_runs_count_alarms_of_a_nonlinear_design(design):
    scenario = obsynth.Scenario(horizon=60.0, faults={"bias": obsynth.Step(size=0.25, start=30.0)}, noise=1.0)
    found = obsynth.evaluate(design, scenario, runs=8, monitor=obsynth.ParameterMonitor("cusum", change=0.2))
    assert found.missed_detection_rate.value == 0.0
    assert found.false_alarm_rate.value < 0.2
    assert found.isolation_error_rate.value == 0.0
    assert found.detection_delay.value < 10.0


def test_what_cannot_be_decided_is_refused(design):
    observer = design.observer
    y, u = record(1)
    estimates = observer.run(y, u, progress=False)
    with pytest.raises(SpecError, match="glr"):
        decide(observer, estimates, statistic="glr")
    with pytest.raises(SpecError, match="initial_parameters"):
        decide(observer, estimates, nominal=[0.1, 0.0])
    walking = dae_adaptive_observer(TANK.model, **OPTIONS, random_walk=TANK.walk)
    with pytest.raises(SpecError, match="random-walk"):
        decide(walking.observer, walking.observer.run(y, u, progress=False), statistic="cusum")
    with pytest.raises(SpecError, match="cusum"):
        obsynth.online_monitor(walking, "cusum")
