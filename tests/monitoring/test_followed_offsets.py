"""Thresholds of one log: slow offsets of residuals and slow changes of faults are followed, quick ones alarm."""

from __future__ import annotations

import functools
from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from pumped_tank import DT, pumped

import obsynth
from obsynth.monitoring.thresholds import learned_rule

ROWS, NOISE, AT = 1_500, 0.1, 700
pytestmark = pytest.mark.usefixtures("taken_as_verified")


def log(seed: int, *, rows: int = ROWS, offset: str = "", size: float = 0.0, fault: float = 0.0) -> pd.DataFrame:
    """Return a log whose sensor drifts over all rows or jumps, and whose pump loses a share, both from a row on."""
    rng, h, found = np.random.default_rng(seed), 0.0, []
    for k in range(rows):
        u, f = 0.2 * (-1.0) ** (k // 3), fault * (k >= AT)
        h = (h + DT * 10.0 * (1.0 - f) * u) / (1.0 + DT) + 0.01 * rng.standard_normal()
        off = size * (k / rows if offset == "drift" else float(k >= AT and offset == "jump"))
        found.append([k * DT, u, h + off + NOISE * rng.standard_normal()])
    return pd.DataFrame(found, columns=["time", "u", "y"])


@functools.cache
def learned() -> obsynth.types.LearnedThresholds:
    return obsynth.learn_thresholds(pumped(), log(0), false_alarms="1 per 500 rows")


def alarms(data: pd.DataFrame, memory: float) -> np.ndarray:
    """Return which rows are in alarm where offsets are followed over so many rows."""
    monitor = obsynth.online_monitor(pumped(), "learned", normal=replace(learned(), memory=memory))
    return obsynth.run_on_data(pumped(), data, monitor=monitor).table["alarm"].ne("").to_numpy()


@pytest.mark.long
def test_a_slow_drift_alarms_nothing_and_a_jump_stays_an_alarm() -> None:
    """A drift of .8 deviations of the sensor, which no fault explains, was an alarm for most of a healthy log."""
    memory = learned().memory
    assert memory == 300.0
    drift = log(1, offset="drift", size=0.8 * NOISE)
    assert alarms(drift, 0.0).mean() > 0.2
    assert alarms(drift, memory).mean() < 0.02
    jump = log(2, offset="jump", size=4.0 * NOISE)
    for found in (alarms(jump, 0.0), alarms(jump, memory)):
        assert not found[:AT].any()
        assert found[AT:].argmax() < 5
        assert found[AT:].mean() > 0.5


@pytest.mark.long
def test_a_fault_that_comes_at_once_is_found_as_soon() -> None:
    delays = [int(alarms(log(3, fault=0.3), memory)[AT:].argmax()) for memory in (0.0, learned().memory)]
    assert delays[0] > 0
    assert delays[1] <= delays[0] + 5


@pytest.mark.long
def test_one_wrong_sample_moves_what_is_followed_no_more_than_noise_does() -> None:
    data = log(4)
    data.loc[600, "y"] += 1e6
    assert not alarms(data, learned().memory)[900:].any()


@pytest.mark.long
def test_several_logs_show_drifts_themselves_and_nothing_is_followed(tmp_path: Path) -> None:
    several = obsynth.learn_thresholds(pumped(), [log(k, rows=600) for k in range(3)], false_alarms="1 per 500 rows")
    assert several.memory == 0.0
    assert "are followed and alarm nothing" not in several.statement
    assert "are followed and alarm nothing" in learned().statement
    assert obsynth.load_thresholds(learned().save(tmp_path / "t.json")).memory == 300.0


@pytest.mark.long
def test_an_offset_from_the_first_row_on_ends_and_a_jump_soon_after_the_start_does_not(tmp_path: Path) -> None:
    """A sensor that was off by one deviation from the first row on was in alarm for nine of ten rows."""
    monitor = obsynth.online_monitor(pumped(), "learned", normal=learned())
    whole = log(5)
    whole["y"] += NOISE
    run = obsynth.run_on_data(pumped(), whole, monitor=monitor)
    found = run.table["alarm"].ne("").to_numpy()
    assert found[:200].any()
    assert not found[200:].any()
    assert any("taken for what is usual in this log" in text for text in run.warnings)
    assert "ends there" in learned().statement
    parts = [
        obsynth.run_on_data(pumped(), part, monitor=monitor, state=tmp_path / "s.json").table
        for part in (whole[:150], whole[150:])
    ]
    np.testing.assert_array_equal(pd.concat(parts)["statistic"], run.table["statistic"])
    jump = log(8)
    jump.loc[150:, "y"] += 4.0 * NOISE
    later = obsynth.run_on_data(pumped(), jump, monitor=monitor)
    assert later.table["alarm"].ne("").to_numpy()[150:].mean() > 0.5
    # It stood at the second count of rows, and not at the first.
    assert any("when 200 rows had been decided" in text for text in later.warnings)
    quiet = obsynth.run_on_data(pumped(), log(6), monitor=monitor)
    assert not any("taken for what is usual" in text for text in quiet.warnings)


@pytest.mark.long
def test_two_logs_do_not_tell_an_offset_from_a_fault_either_and_three_do() -> None:
    """A sensor that was off from the first row on was in alarm for nine of ten rows with thresholds of two logs."""
    whole = log(5, rows=700)
    whole["y"] += NOISE
    runs = [
        obsynth.run_on_data(
            pumped(), whole, monitor=obsynth.online_monitor(pumped(), "learned", normal=replace(learned(), **few))
        )
        for few in ({"logs": 2, "memory": 0.0}, {"logs": 3, "memory": 0.0, "drift_limits": {}})
    ]
    two, three = (run.table["alarm"].ne("").to_numpy() for run in runs)
    assert two[:200].any()
    assert not two[200:].any()
    assert any("2 logs, which do not distinguish an offset" in text for text in runs[0].warnings)
    assert three[200:].mean() > 0.5
    assert "2 logs do not distinguish" in replace(learned(), logs=2, memory=0.0).statement


@functools.cache
def filtered() -> tuple[obsynth.ObserverDesign, obsynth.types.LearnedThresholds]:
    """Return a linear filter of an actuator fault, and thresholds of one log."""
    plant = obsynth.DescriptorSystem(
        A=[[0.9, 0.1], [0.0, 0.8]], B=[[0.0], [1.0]], C=np.eye(2), Bf=[[0.0], [1.0]], Bd=[[1.0], [0.0]], dt=1.0,
        sensor_noise={"y1": NOISE, "y2": NOISE},
    )  # fmt: skip
    design = obsynth.fault_estimation_filter(plant)
    return design, obsynth.learn_thresholds(design, lines(0), false_alarms="1 per 500 rows")


def lines(
    seed: int, *, rows: int = 1_000, off: float = 0.0, drift: float = 0.0, gain: float = 1.0, fault: float = 0.0
) -> pd.DataFrame:
    """Return a log of the linear plant whose second sensor is off from the first row on, or drifts over all rows."""
    rng, x, found = np.random.default_rng([41, seed]), np.zeros(2), []
    for k in range(rows):
        u = 0.2 * (-1.0) ** (k // 30)
        y = x * [1.0, gain] + NOISE * rng.standard_normal(2) + [0.0, NOISE * (off + drift * k / rows)]
        found.append([float(k), u, *y])
        x = np.array([0.9 * x[0] + 0.1 * x[1], 0.8 * x[1] + u + fault * (k >= AT)]) + 0.01 * rng.standard_normal(2)
    return pd.DataFrame(found, columns=["time", "u1", "y1", "y2"])


@pytest.mark.long
def test_a_linear_filter_follows_what_one_log_does_not_tell_from_drifts() -> None:
    """A sensor that was off was an alarm for the whole of a healthy log: of a two-mass drive for 99 % of it."""
    design, learned = filtered()
    assert learned.memory == 300.0
    assert "changes of the faults" not in learned.statement
    assert obsynth.learn_thresholds(design, lines(0), false_alarms="1 per 500 rows", sensor_drift=1.0).memory == 0.0
    before, now = (
        obsynth.online_monitor(design, "learned", normal=replace(learned, **few))
        for few in ({"memory": 0.0, "logs": 3, "drift_limits": {}}, {})
    )

    def alarmed(monitor: obsynth.types.Monitor, log: pd.DataFrame) -> np.ndarray:
        return obsynth.run_on_data(design, log, monitor=monitor).table["alarm"].ne("").to_numpy()

    off, drift = lines(1, off=4.0), lines(2, rows=ROWS, drift=0.8)
    assert alarmed(before, off)[200:].mean() > 0.9
    assert not alarmed(now, off)[200:].any()
    # What is larger than offsets are stays an alarm: levels rose by what it reached, and nothing was seen any more.
    assert alarmed(now, lines(1, rows=400, off=15.0))[200:].all()
    assert alarmed(before, drift).mean() > 0.1
    assert alarmed(now, drift).mean() < 0.02
    step = alarmed(now, lines(3, fault=0.2))
    assert not step[:AT].any()
    assert step[AT:].argmax() < 20
    assert step[AT:].mean() > 0.9


@pytest.mark.long
def test_levels_rise_where_what_a_start_is_off_by_follows_the_inputs(monkeypatch: pytest.MonkeyPatch) -> None:
    """A sensor of a stirred tank that was off by four deviations was an alarm for 91 % of a log all the same, as what
    it does to estimates of faults follows the inputs."""
    design, learned = filtered()
    monitor = obsynth.online_monitor(design, "learned", normal=learned)
    found = []
    for room in (learned_rule.ROOM_OF_START, 0.0):
        monkeypatch.setattr(learned_rule, "ROOM_OF_START", room)
        run = obsynth.run_on_data(design, lines(4, gain=2.0), monitor=monitor)
        alarm = run.table["alarm"].ne("").to_numpy()
        found.append((alarm[:200].mean(), alarm[200:].mean(), any("levels are raised" in x for x in run.warnings)))
    assert found[0][0] > 0.3
    assert found[0][1] == 0.0
    assert found[1][1] > 0.1
    assert [raised for _, _, raised in found] == [True, False]


@pytest.mark.long
def test_three_logs_without_offsets_end_an_alarm_of_the_start_and_three_with_offsets_do_not() -> None:
    """They said that 0 % of healthy time is in alarm, and a sensor that was off by one deviation was an alarm for 88 to
    94 % of a log of a two-mass drive."""
    design, _ = filtered()
    without, held = (
        obsynth.learn_thresholds(
            design, [lines(20 + i, rows=600, off=off) for i, off in enumerate(offs)], false_alarms="1 per 500 rows"
        )
        for offs in ((0.0, 0.0, 0.0), (-4.0, 4.0, 0.0))
    )
    assert 0.0 < without.drift_limits["y2"] < 2.0
    assert f"y2 by {without.drift_limits['y2']:.2g}" in without.statement
    assert "3 logs without offsets of sensors do not distinguish" in without.statement
    assert not held.drift_limits
    assert not held.takes_first_rows
    assert "none of these 3 logs" not in held.statement
    runs = []
    for learned in (without, held, replace(without, drift_limits={})):
        monitor = obsynth.online_monitor(design, "learned", normal=learned)
        run = obsynth.run_on_data(design, lines(5, rows=600, off=3.0), monitor=monitor)
        runs.append((run.table["alarm"].ne("").to_numpy(), run.warnings))
    assert runs[0][0][:200].any()
    assert not runs[0][0][200:].any()
    assert any("3 logs without offsets of sensors, which do not" in text for text in runs[0][1])
    assert runs[1][0].mean() < 0.02
    assert runs[2][0][200:].mean() > 0.5
