"""Logs that begin away from where a design starts: what of it is drawn, and what is said of alarms."""

from __future__ import annotations

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
