"""Logs against linear designs: the plant's innovations, whatever the gains of the observer are."""

from __future__ import annotations

import numpy as np
import pandas as pd
import pytest

import obsynth
from obsynth import SpecError

ROWS = 300


def plant_with(*, noise: float = 0.1, disturbed: bool = True) -> obsynth.DescriptorSystem:
    """Return two states, three sensors the first with a direct part, and a disturbance that one sensor misses."""
    return obsynth.DescriptorSystem(
        A=[[0.9, 0.1], [0.0, 0.8]], B=[[1.0], [0.5]], C=[[1.0, 0.0], [0.0, 1.0], [1.0, 1.0]], D=[[0.5], [0.0], [0.0]],
        Bf=[[1.0], [0.0]], Bd=[[0.0], [1.0]] if disturbed else None, dt=1.0,
        Bw=[[0.05, 0.0, 0.0, 0.0], [0.0, 0.0, 0.0, 0.0]], Dw=np.hstack([np.zeros((3, 1)), noise * np.eye(3)]),
    )  # fmt: skip


def log_of(plant: obsynth.DescriptorSystem, seed: int = 0, start: float = 5.0) -> pd.DataFrame:
    """Return a log by the plant's equations, from another start than the design's."""
    rng = np.random.default_rng(seed)
    x, rows = np.array([start, -start]), []
    for k in range(ROWS):
        u, w = np.array([np.sign(np.sin(k / 20.0))]), rng.standard_normal(4)
        rows.append([k, *u, *(plant.C @ x + plant.D @ u + plant.Dw @ w)])
        x = plant.A @ x + plant.B @ u + plant.Bw @ w + 3.0 * plant.Bd.sum(axis=1) * rng.standard_normal()
    return pd.DataFrame(rows, columns=["time", "u1", "y1", "y2", "y3"])


PLANT = plant_with()
DESIGN = obsynth.fault_estimation_filter(PLANT)


@pytest.mark.long
def test_a_log_of_the_plant_agrees_from_another_start_and_beside_disturbances() -> None:
    found = [obsynth.validate(DESIGN, log_of(PLANT, seed)) for seed in range(2)]
    assert all(one.passed for one in found)
    assert "What the unknown disturbance 'd1' explains is not counted" in found[0].verdict[0]
    assert found[0].sensors["y1"].nis.samples == ROWS - 1
    assert not found[0].sensors["y2"].nis.samples


@pytest.mark.long
def test_noise_that_is_stated_too_small_is_named() -> None:
    design = obsynth.fault_estimation_filter(plant_with(noise=0.1 / 3.0))
    found = obsynth.validate(design, log_of(PLANT))
    assert not found.passed
    assert found.nis.value > 4.0
    assert any("y1" in text and "too small" in text for text in found.verdict)


@pytest.mark.long
def test_another_unit_is_the_only_reason() -> None:
    log = log_of(PLANT)
    log["y1"] *= 1000.0
    found = obsynth.validate(DESIGN, log)
    assert not found.passed
    assert "--scale y1=0.001" in found.verdict[-1]
    assert not any("white" in text or "offset" in text for text in found.verdict)


@pytest.mark.long
def test_what_is_not_white_is_named_with_its_period() -> None:
    log = log_of(PLANT)
    log["y1"] += 0.3 * np.sin(2.0 * np.pi * np.arange(ROWS) / 30.0)
    found = obsynth.validate(DESIGN, log)
    period, multiple = found.sensors["y1"].power
    assert not found.passed
    assert 24.0 < period < 38.0
    assert multiple > 8.0
    assert any(f"periods of about {period:.2g} s" in text for text in found.verdict)
    assert found.to_dict()["sensors"]["y1"]["largest_power"]["period"] == period


@pytest.mark.long
def test_single_wrong_samples_are_no_disagreement() -> None:
    log = log_of(PLANT)
    log.loc[[100, 200], "y1"] += 30.0
    found = obsynth.validate(DESIGN, log)
    assert found.passed
    assert "row 100" in found.verdict[0]


@pytest.mark.long
def test_an_input_that_acts_later_is_named() -> None:
    plant = plant_with(disturbed=False)
    log = log_of(plant)
    log["u1"] = log["u1"].shift(-1).ffill()
    found = obsynth.validate(obsynth.fault_estimation_filter(plant), log)
    assert not found.passed
    assert "an input u1 that acts later" in found.verdict[-1]


@pytest.mark.long
def test_a_continuous_plant_is_compared_on_the_grid_of_the_log() -> None:
    plant = obsynth.DescriptorSystem(
        A=[[-0.5]], B=[[1.0]], C=[[1.0], [1.0]], Bf=[[1.0]], sensor_noise={"y1": 0.05, "y2": 0.1}
    )
    design = obsynth.functional_filter(plant)
    rng, x, rows = np.random.default_rng(0), 3.0, []
    for k in range(400):
        u = float(np.sign(np.sin(k / 15.0)))
        rows.append([0.2 * k, u, x + 0.05 * rng.standard_normal(), x + 0.1 * rng.standard_normal()])
        x = np.exp(-0.1) * x + (1.0 - np.exp(-0.1)) / 0.5 * u
    log = pd.DataFrame(rows, columns=["time", "u1", "y1", "y2"])
    assert obsynth.validate(design, log).passed
    log["y2"] += 0.5
    assert any("y2 have an offset" in text for text in obsynth.validate(design, log).verdict)


def test_without_stated_noise_nothing_is_judged() -> None:
    plant = obsynth.DescriptorSystem(A=[[0.9]], C=[[1.0], [1.0]], Bf=[[1.0]], dt=1.0)
    log = {"time": np.arange(50.0), "y1": np.zeros(50), "y2": np.zeros(50)}
    with pytest.raises(SpecError, match="sensor_noise"):
        obsynth.validate(obsynth.fault_estimation_filter(plant), log)


def test_innovations_are_computed_once_where_no_sample_is_wrong(monkeypatch: pytest.MonkeyPatch) -> None:
    """The start of the filter is as far off as the states have been, which needs no innovations."""
    from obsynth.monitoring.calibration import validating

    runs, run = [], validating.recorded_innovations
    monkeypatch.setattr(validating, "recorded_innovations", lambda *given: runs.append(given[1]) or run(*given))
    obsynth.validate(DESIGN, log_of(PLANT)[:60])
    assert len(runs) == 1
