"""Slow drifts of sensors that thresholds allow for: their effects, in any unit, stored, and what they cost."""

from __future__ import annotations

import dataclasses
import functools
import json
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest

import obsynth
from obsynth.cli.main import main
from obsynth.monitoring.thresholds.learned_statistics import Statistics
from obsynth.monitoring.thresholds.learning import learn_thresholds
from obsynth.monitoring.thresholds.sensor_drifts import (
    SensorDrifts,
    drift_limits,
    drifts_by_runs,
    linear_drifts,
    sensor_deviations,
)
from obsynth.numerics.autoregression import Autoregression

pytestmark = pytest.mark.usefixtures("taken_as_verified")

#: Deviations of the noise of both sensors.
NOISE = (0.1, 0.2)


@functools.cache
def linear_design() -> obsynth.ObserverDesign:
    """Return a filter for a fault that drives one of two states, with noise stated."""
    plant = obsynth.DescriptorSystem(
        A=[[0.9, 0.1], [0.0, 0.8]], C=np.eye(2), Bf=[[1], [0]], dt=1.0, sensor_noise={"y1": NOISE[0], "y2": NOISE[1]},
    )  # fmt: skip
    return obsynth.fault_estimation_filter(plant)


@functools.cache
def filter_without_noise() -> obsynth.ObserverDesign:
    """Return a filter of a plant whose noise nobody states."""
    plant = obsynth.DescriptorSystem(A=[[0.9, 0.1], [0.0, 0.8]], C=np.eye(2), Bf=[[1], [0]], dt=1.0)
    return obsynth.fault_estimation_filter(plant)


def linear_log(seed: int, *, drift: float = 0.0, fault: float = 0.0, rows: int = 1_000) -> pd.DataFrame:
    """Return a log whose first sensor is off by so many deviations at its end, with a fault from the middle on."""
    rng, x = np.random.default_rng(seed), np.zeros(2)
    A, found = np.array([[0.9, 0.1], [0.0, 0.8]]), []
    for k in range(rows):
        y = x + np.array(NOISE) * rng.standard_normal(2) + np.array([drift * NOISE[0] * k / rows, 0.0])
        found.append([float(k), *y])
        x = A @ x + np.array([fault if 2 * k > rows else 0.0, 0.0])
    return pd.DataFrame(found, columns=["time", "y1", "y2"])


def in_alarm(design: obsynth.ObserverDesign, learned: obsynth.types.LearnedThresholds, data: pd.DataFrame) -> Any:
    """Return which rows of a log are in alarm."""
    monitor = obsynth.online_monitor(design, "learned", normal=learned)
    run = obsynth.run_on_data(design, data, monitor=monitor)
    return np.nan_to_num(run.table["statistic"].to_numpy(dtype=float)) > 1.0


@pytest.mark.long
def test_a_drift_that_is_allowed_for_is_no_alarm_and_larger_faults_are() -> None:
    design = linear_design()
    without = learn_thresholds(design, linear_log(0), false_alarms="1 per 500 rows")
    allowed = learn_thresholds(design, linear_log(0), false_alarms="1 per 500 rows", sensor_drift=3.0)
    drifting = linear_log(1, drift=3.0)
    assert in_alarm(design, without, drifting).mean() > 0.1
    assert in_alarm(design, allowed, drifting).mean() < 0.02
    # The fault is what three times the steady effect of the drift would be.
    faulty = linear_log(2, fault=1.0)
    assert in_alarm(design, allowed, faulty)[510:].mean() > 0.9
    assert "drift of each sensor by 3 deviations" in allowed.statement
    assert "drift of each sensor" not in without.statement
    # What is not allowed for may alarm from the limit that the sentence states, and does not at half of it: until it is
    # followed, as thresholds of one log are.
    limit = without.drift_limits["y1"]
    assert (
        f"an offset from the first row on of y1 by {limit:.2g} deviations of its noise may alarm" in without.statement
    )
    assert not allowed.drift_limits
    twice, half = (drifting.assign(y1=linear_log(1)["y1"] + share * limit * NOISE[0]) for share in (2.0, 0.5))
    assert in_alarm(design, without, twice)[100:200].mean() > 0.3
    assert not in_alarm(design, without, twice)[400:].any()
    assert not in_alarm(design, without, half).any()


def test_the_steady_state_of_a_linear_observer_is_what_runs_settle_at() -> None:
    design, offsets = linear_design(), np.array([0.3, 0.7])
    found = linear_drifts(design.observer, offsets)
    data, columns = linear_log(3, rows=200), ["y1", "y2"]
    rows = {}
    for i in range(3):
        moved = data.copy()
        if i:
            moved[columns[i - 1]] += offsets[i - 1]
        rows[i] = obsynth.run_on_data(design, moved).table["fhat[f1]"].to_numpy(dtype=float)[-1]
    np.testing.assert_allclose(found.watched[:, -1, 0], [rows[1] - rows[0], rows[2] - rows[0]], atol=1e-9)


def test_noise_that_nobody_states_is_that_of_the_log() -> None:
    data = linear_log(4, rows=2_000)[["y1", "y2"]].to_numpy(copy=True)
    stated = sensor_deviations(linear_design(), data)
    np.testing.assert_allclose(stated, NOISE)
    data[::7, 0] = np.nan
    data[::50] += 40.0
    np.testing.assert_allclose(sensor_deviations(filter_without_noise(), data), NOISE, rtol=0.2)


@pytest.mark.long
def test_levels_with_a_drift_are_the_same_in_all_units_of_a_log() -> None:
    design, data = linear_design(), linear_log(5)
    scaled = data.copy()
    scaled["y1"] *= 1_000.0
    expected = learn_thresholds(design, data, false_alarms="1 per 500 rows", sensor_drift=1.0)
    again = learn_thresholds(design, scaled, false_alarms="1 per 500 rows", sensor_drift=1.0, scales={"y1": 1e-3})
    np.testing.assert_allclose(again.levels, expected.levels, rtol=1e-6)
    np.testing.assert_allclose(again.statistics.bands, expected.statistics.bands, rtol=1e-9)


def with_held(data: pd.DataFrame, *names: str) -> pd.DataFrame:
    """Return a log in which sensors hold each value for ten rows: most of their third differences vanish."""
    return data.assign(**{name: data[name].iloc[::10].repeat(10).to_numpy() for name in names})


def test_sensors_whose_noise_nobody_knows_get_no_room() -> None:
    data = with_held(linear_log(8, rows=300), "y2")[["y1", "y2"]].to_numpy()
    design = filter_without_noise()
    drifts = linear_drifts(design.observer, sensor_deviations(design, data))
    assert drifts.sensors_without().tolist() == [False, True]
    # So does one whose offset leaves no row known.
    watched = drifts.watched.copy()
    watched[0] = np.nan
    assert drifts._replace(watched=watched).sensors_without().tolist() == [True, True]


def test_a_drift_is_refused_where_no_sensor_has_noise() -> None:
    design, data = filter_without_noise(), with_held(linear_log(8, rows=300), "y1", "y2")
    with pytest.raises(obsynth.SpecError, match="No noise of any sensor") as refused:
        learn_thresholds(design, data, false_alarms="1 per 50 rows", sensor_drift=1.0)
    assert refused.value.path == "sensor_drift"


@pytest.mark.long
def test_the_statement_names_sensors_without_room(tmp_path: Path) -> None:
    design, data = filter_without_noise(), with_held(linear_log(8, rows=300), "y2")
    found = learn_thresholds(design, data, false_alarms="1 per 50 rows", sensor_drift=1.0)
    assert found.without_drift == ("y2",)
    assert "drift of each sensor but y2 by one deviation" in found.statement
    assert obsynth.load_thresholds(found.save(tmp_path / "t.json")).without_drift == ("y2",)


def test_a_drift_at_its_limit_passes_a_level_and_one_below_none() -> None:
    """Whitened residuals that are a sensor in its deviations: what passes first is the mean with the longest memory, or
    a step of the highest age."""
    model = Autoregression(np.zeros(1), np.zeros((0, 1, 1)), np.eye(1))
    statistics = Statistics(model, np.eye(1), ("r[y]",))
    levels = np.full(len(statistics.names), 40.0)
    nothing = np.zeros((1, 0, 0))
    drifts = SensorDrifts(np.ones((1, 400, 1)), nothing, nothing, nothing, np.ones(1))
    (limit,) = drift_limits(statistics, levels, drifts, [0])
    assert limit == pytest.approx(np.sqrt(40.0 / 200.0), abs=0.01)
    # Offsets that alarm nothing add to it, and levels that no drift of one deviation passes have none.
    banded = dataclasses.replace(statistics, bands=np.array([0.2]))
    assert limit + 0.15 < drift_limits(banded, levels, drifts, [0])[0] < limit + 0.25
    assert drift_limits(statistics, 1e3 * levels, drifts, [0])[0] == np.inf


def test_a_drift_is_refused_where_the_observer_integrates() -> None:
    observer = dataclasses.replace(linear_design().observer, Az=np.eye(linear_design().observer.order))
    with pytest.raises(obsynth.SpecError, match="never settles"):
        linear_drifts(observer, np.array(NOISE))


def test_runs_give_what_offsets_do_and_their_own_centre() -> None:
    """Rows that are linear in the offsets: the difference is what the offset makes of them."""

    class Output:
        scores = None

        def __init__(self, added: np.ndarray) -> None:
            self.watched = np.arange(800.0).reshape(400, 2) + added @ np.array([[1.0, 2.0], [3.0, 4.0]])

    found = drifts_by_runs(Output, np.array([0.5, 2.0]))
    assert found.watched.shape == (2, 200, 2)
    np.testing.assert_allclose(found.watched[:, 0], [[0.5, 1.0], [6.0, 8.0]])
    assert not found.away.shape[2]


@pytest.mark.long
def test_a_drift_is_stored_and_one_below_zero_is_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    design = linear_design()
    gains, data = design.save(tmp_path / "g.json"), tmp_path / "n.csv"
    linear_log(6, rows=600).to_csv(data, index=False)
    command = ["thresholds", "--gains", str(gains), "--data", str(data), "--false-alarms", "1 per 200 rows"]
    assert main([*command, "--sensor-drift", "1", "--json", "--quiet", "--out", str(tmp_path / "t.json")]) == 0
    printed = json.loads(capsys.readouterr().out)
    assert printed["sensor_drift"] == 1.0
    stored = obsynth.load_thresholds(tmp_path / "t.json")
    assert stored.sensor_drift == 1.0
    assert printed["levels"] == dict(zip(stored.statistics.names, stored.levels.tolist(), strict=True))
    assert "one deviation" in stored.statement
    assert main([*command, "--sensor-drift", "-1", "--quiet"]) == 2
    assert "sensor_drift" in capsys.readouterr().err


@functools.cache
def walking_design() -> obsynth.ObserverDesign:
    """Return a lag with a loss of its input that walks."""
    model = obsynth.DAEModel(
        {"a": "der(x) = 0.1 * (u * (1 - loss) - x)"}, {"y": "x"}, states={"x": 1.0}, inputs={"u": 1.0},
        parameters={"loss": 0.0},
    )  # fmt: skip
    return obsynth.dae_adaptive_observer(
        model, dt=1.0, Q={"a": 1e-6}, R={"y": 0.0025}, form="augmented-kalman", random_walk={"loss": 1e-5},
        initial_parameter_covariance={"loss": 1e-3}, initial_covariance={"x": 0.01},
    )  # fmt: skip


def walking_log(seed: int, *, drift: float = 0.0, rows: int = 500) -> pd.DataFrame:
    """Return a log of the lag whose sensor is off by so many deviations from its first row on."""
    rng, x, found = np.random.default_rng(seed), 1.0, []
    for k in range(rows):
        u = 1.0 + 0.2 * np.sign(np.sin(0.05 * k))
        x = (x + 0.1 * u) / 1.1
        found.append([float(k), u, x + 0.05 * (rng.standard_normal() + drift)])
    return pd.DataFrame(found, columns=["time", "u", "y"])


@pytest.mark.long
def test_faults_that_walk_have_bands_of_what_a_drift_makes_of_them() -> None:
    design = walking_design()
    without = learn_thresholds(design, walking_log(0), false_alarms="1 per 200 rows")
    allowed = learn_thresholds(design, walking_log(0), false_alarms="1 per 200 rows", sensor_drift=2.0)
    # An offset of the sensor by two deviations is a loss of a tenth of the input.
    assert allowed.statistics.fault_bands[0] == pytest.approx(0.1, rel=0.3)
    drifting = walking_log(1, drift=2.0)
    # With one normal log an alarm that stands from the start on ends after 100 decided rows.
    assert in_alarm(design, without, drifting)[100:200].mean() > 0.3
    limit = without.drift_limits["y"]
    assert in_alarm(design, without, walking_log(1, drift=1.3 * limit))[100:200].mean() > 0.3
    assert in_alarm(design, without, walking_log(1, drift=0.5 * limit))[100:].mean() < 0.1
    assert in_alarm(design, allowed, drifting)[200:].mean() < 0.02
    # In another unit of the log everything is the same.
    scaled = walking_log(0)
    scaled["y"] *= 1_000.0
    again = learn_thresholds(
        design, scaled, false_alarms="1 per 200 rows", sensor_drift=2.0, scales={"y": 1e-3}
    )  # fmt: skip
    np.testing.assert_allclose(again.levels, allowed.levels, rtol=1e-6)
    np.testing.assert_allclose(again.statistics.fault_bands, allowed.statistics.fault_bands, rtol=1e-6)
