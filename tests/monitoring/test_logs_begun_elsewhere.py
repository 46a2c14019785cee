"""Logs that begin away from where a design starts: what of it is drawn, and what is said of alarms."""

from __future__ import annotations

import dataclasses
import re

import matplotlib.pyplot as plt
import numpy as np
import pandas as pd
import pytest

import obsynth


@pytest.fixture(scope="module")
def design() -> obsynth.ObserverDesign:
    plant = obsynth.DescriptorSystem(
        A=[[0.98, 0.0], [0.1, 0.9]], C=np.eye(2), Bf=[[0.0], [1.0]], Dw=0.1 * np.eye(2), dt=1.0
    )
    return obsynth.fault_estimation_filter(plant)


@pytest.fixture
def log(design: obsynth.ObserverDesign) -> pd.DataFrame:
    """From a state of 50, which decays, with a fault of 3 from row 300 on."""
    rng, x, rows = np.random.default_rng(8), np.array([50.0, 50.0]), []
    for k in range(400):
        rows.append([k, *(x + 0.1 * rng.standard_normal(2))])
        x = design.plant.A @ x + design.plant.Bf[:, 0] * 3.0 * (k >= 300)
    return pd.DataFrame(rows, columns=["time", "y1", "y2"])


def test_the_start_does_not_hide_what_comes_after_it(design: obsynth.ObserverDesign, log: pd.DataFrame) -> None:
    run = obsynth.run_on_data(design, log, thresholds={"fhat[f1]": 1.5}, warm_up=100.0)
    largest = float(np.abs(run.table["fhat[f1]"]).max())
    assert largest > 40.0
    faults, residuals = obsynth.plotting.plot_data(run, design=design, show=["faults", "residuals"])
    low, high = faults.get_ylim()
    assert -10.0 < low < -1.5
    assert 3.0 < high < 10.0
    assert any("warm-up and gaps: up to" in text.get_text() for text in faults.texts)
    assert residuals.get_ylim()[1] < 0.5 * largest
    plt.close(faults.figure)


def test_nothing_leaves_a_picture_in_which_nothing_is_hidden(design: obsynth.ObserverDesign, log: pd.DataFrame) -> None:
    run = obsynth.run_on_data(design, log.iloc[250:], thresholds={"fhat[f1]": 1.5})
    (faults,) = obsynth.plotting.plot_data(run, design=design, show=["faults"])
    values = run.table["fhat[f1]"]
    assert faults.get_ylim()[0] <= values.min()
    assert faults.get_ylim()[1] >= values.max()
    assert not faults.texts
    plt.close(faults.figure)


def test_logs_that_end_before_the_observer_has_settled_are_refused_with_the_reason(log: pd.DataFrame) -> None:
    """No output shows the state that decays by a five-hundredth a second.  A shorter warm-up, as is said, helps."""
    plant = obsynth.DescriptorSystem(
        A=np.diag([0.998, 0.9]), C=[[0.0, 1.0]], Bf=[[0.0], [1.0]], output_names=["y2"], dt=1.0
    )
    slow = obsynth.fault_estimation_filter(plant)
    with pytest.raises(obsynth.SpecError, match=r"400 of the 400 rows are warm-up: this lasts 1960 s"):
        obsynth.learn_thresholds(slow, log)
    assert obsynth.learn_thresholds(slow, log, warm_up=100.0).rows == 300
    run = obsynth.run_on_data(slow, log, thresholds={"fhat[f1]": 1.5})
    assert 1900.0 < run.warm_up < 2000.0
    assert "the observer was still settling, for 1960 s (32.6 min)" in repr(run)


@pytest.mark.parametrize("share", [1.0, 0.25])
def test_what_is_left_of_the_start_is_told_for_the_warm_up_that_is_given(
    design: obsynth.ObserverDesign, log: pd.DataFrame, share: float
) -> None:
    usual = float((obsynth.run_on_data(design, log).table["status"] == "warm-up").sum())
    run = obsynth.run_on_data(design, log, thresholds={"fhat[f1]": 0.01}, warm_up=share * usual)
    text = next(text for text in run.warnings if "initial-condition response" in text)
    left = 100.0 * 0.02**share
    assert f"when the warm-up ends {left:.2g} % of that response are left" in text
    assert "e+0" not in text


ROOM = obsynth.DescriptorSystem(
    E=np.diag([2e5, 4e6]), A=[[-100.0, 60.0], [60.0, -80.0]], B=[[4000.0, 40.0], [0.0, 20.0]], C=[[1.0, 0.0]],
    Bf=[[4000.0], [0.0]], Dw=[[0.05]], state_names=["air", "wall"], output_names=["T"], input_names=["heat", "out"],
    fault_names=["worn"],
)  # fmt: skip


def room_log(rows: int) -> pd.DataFrame:
    """A heated room at rest, with a wall whose mode lasts for days; its heater fails by 0.2 in the last third."""
    rng, every = np.random.default_rng(4), 60.0
    A, B, sampled = np.linalg.solve(ROOM.E, ROOM.A), np.linalg.solve(ROOM.E, np.hstack([ROOM.B, ROOM.Bf])), []
    v = np.array([0.5, 5.0, 0.0])
    x = -np.linalg.solve(A, B @ v)
    for k in range(rows):
        sampled.append([k * every, *v[:2], x[0] + 0.05 * rng.standard_normal()])
        v[2] = -0.2 * (k > 2 * rows / 3)
        for _ in range(20):
            x = x + every / 20 * (A @ x + B @ v)
    return pd.DataFrame(sampled, columns=["time", "heat", "out", "T"])


@pytest.mark.usefixtures("taken_as_verified")
def test_a_log_without_decisions_names_the_settling_time_and_a_decay_with_which_it_has_some() -> None:
    """The mode of the wall is in the fault estimates for days: no shorter warm-up would be named truthfully."""
    design, log = obsynth.functional_filter(ROOM), room_log(900)
    silent = obsynth.run_on_data(design, log, thresholds={"fhat[worn]": 0.1})
    assert not silent.alarms
    (text,) = [text for text in silent.warnings if "900 of 900 rows have no decision" in text]
    assert "the time in which the slowest mode of the observer decays to 2 %" in text
    assert not re.search(r"--warm-up \d", text)
    decay = float(re.search(r"option decay: (\S+) \(functional-filter", text)[1])
    faster = obsynth.functional_filter(ROOM, decay=decay)
    run = obsynth.run_on_data(faster, log, thresholds={"fhat[worn]": 0.1})
    assert any(event.first_row > 600 for event in run.events)
    assert run.silent["warm-up"] <= 0.26 * len(log)
    assert not any("have no decision" in text for text in run.warnings)

    assert "inputs and outputs of this row as the operating point" in text
    point = log[["heat", "out", "T"]].iloc[0].to_dict()
    from_rest = obsynth.functional_filter(dataclasses.replace(ROOM, operating_point=point))
    run = obsynth.run_on_data(from_rest, log, thresholds={"fhat[worn]": 0.1}, warm_up=60.0)
    assert [event.first_row > 600 for event in run.events] == [True]


def test_a_log_without_decisions_names_a_warm_up_with_which_it_has_some(log: pd.DataFrame) -> None:
    plant = obsynth.DescriptorSystem(
        A=np.diag([0.998, 0.9]), C=[[0.0, 1.0]], Bf=[[0.0], [1.0]], output_names=["y2"], dt=1.0
    )
    slow = obsynth.fault_estimation_filter(plant)
    silent = obsynth.run_on_data(slow, log, thresholds={"fhat[f1]": 1.5})
    (text,) = [text for text in silent.warnings if "400 of 400 rows have no decision" in text]
    tried, share = map(float, re.search(r"--warm-up (\S+), (\S+) % of the time", text).groups())
    run = obsynth.run_on_data(slow, log, thresholds={"fhat[f1]": 1.5}, warm_up=tried)
    assert share == pytest.approx(100.0 * (1.0 - run.silent["warm-up"] / 400), abs=1.0)
    assert "fhat[f1]" in run.alarms


def test_learning_from_logs_that_are_warm_up_names_a_warm_up_that_was_tried(log: pd.DataFrame) -> None:
    plant = obsynth.DescriptorSystem(
        A=np.diag([0.998, 0.9]), C=[[0.0, 1.0]], Bf=[[0.0], [1.0]], output_names=["y2"], dt=1.0
    )
    slow = obsynth.fault_estimation_filter(plant)
    with pytest.raises(obsynth.SpecError, match=r"the slowest mode of the observer decays to 2 %") as refused:
        obsynth.learn_thresholds(slow, log)
    tried = float(re.search(r"--warm-up (\S+), \S+ % of the time", str(refused.value))[1])
    assert 0.0 < tried < 100.0
    assert obsynth.learn_thresholds(slow, log, warm_up=tried).rows == 400 - round(tried)
