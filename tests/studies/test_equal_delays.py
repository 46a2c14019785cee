"""Designs are ranked on a log by the delay of their alarms at equal healthy time in alarm."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pandas as pd
import pytest

import obsynth
from obsynth.studies.equal_delays import (
    HEALTHY_TIME,
    delay_of_scenario,
    delay_on_log,
    level_of_normal_rows,
    normal_rows,
)

#: A fast filter with noise, and a slow one with less.
METHODS = ("fault-estimation-filter", "ui-pi-observer")


def plant() -> obsynth.DescriptorSystem:
    return obsynth.DescriptorSystem(
        A=[[0.95, 0.0], [0.1, 0.9]], B=[[1.0], [0.0]], C=np.eye(2), Bf=[[1.0], [0.0]], dt=1.0,
        sensor_noise={"y1": 0.05, "y2": 0.05},
    )  # fmt: skip


def log(rows: int = 800, *, size: float = 0.6) -> pd.DataFrame:
    """Return a log of the plant with a fault in a hundred rows of its second half."""
    rng, x, found = np.random.default_rng(3), np.zeros(2), []
    for k in range(rows):
        fault = size * (rows // 2 <= k < rows // 2 + 100)
        u = 0.1 * np.sin(0.01 * k)
        found.append([float(k), u, *(x + 0.05 * rng.standard_normal(2)), fault])
        x = np.array([[0.95, 0.0], [0.1, 0.9]]) @ x + np.array([u + fault, 0.0])
    return pd.DataFrame(found, columns=["time", "u1", "y1", "y2", "f1"])


@pytest.mark.long
def test_the_soonest_alarm_is_first_though_another_design_has_less_noise(tmp_path: Path) -> None:
    file = tmp_path / "log.csv"
    log().to_csv(file, index=False)
    quiet = obsynth.compare(plant(), methods=METHODS, runs=2)
    assert quiet.methods[0].equal_delay is None
    assert "equal healthy time" not in " ".join(quiet.rows()[0])
    found = obsynth.compare(plant(), methods=METHODS, runs=2, data=file)
    first, second = found.methods
    assert (first.method, second.method) == METHODS
    assert first.equal_delay < second.equal_delay
    assert first.relative_error > second.relative_error
    assert "1 % of healthy time in alarm" in found.reason
    assert first.method in found.statement
    header, *rows = found.rows()
    place = header.index("delay at equal healthy time")
    assert [float(row[place]) for row in rows] == [entry.faults[0].equal_delay for entry in found.methods]
    assert "delay at equal healthy time" in found.page()
    assert first.label == f"{first.method} ({first.equal_delay[1]:g} s)"
    certificate = found.save(tmp_path / "c.json")
    for data in (None, file):
        assert obsynth.verify_certificate(certificate, data=data).passed, data


def test_the_scenarios_fault_is_added_to_a_log_without_one() -> None:
    found = obsynth.compare(plant(), methods=METHODS, runs=2, data=log(size=0.0).drop(columns="f1"))
    assert [entry.method for entry in found.methods] == list(METHODS)
    assert all(np.isfinite(entry.faults[0].equal_delay) for entry in found.methods)


def test_the_level_is_what_so_many_normal_rows_are_beyond() -> None:
    rng, truth = np.random.default_rng(0), np.zeros((1_000, 1))
    truth[600:700] = 1.0
    decided = np.ones(1_000, dtype=bool)
    decided[:20] = False
    normal = normal_rows(truth, decided)
    assert (int(normal.sum()), bool(normal[650:].any())) == (580, False)
    values = 5.0 + rng.standard_normal(1_000)
    centre, level = level_of_normal_rows(values, normal)
    share = float((np.abs(values[normal] - centre) > level).mean())
    assert 0.5 * HEALTHY_TIME < share <= HEALTHY_TIME
    # Without a hundred rows before the fault, those after it count.
    assert normal_rows(np.roll(truth, -590), decided).sum() == 1_000 - 20 - 90
    assert np.isnan(level_of_normal_rows(values, np.zeros(1_000, dtype=bool))[1])


def test_a_delay_is_that_of_the_median_begin_and_chance_finds_nothing() -> None:
    times, fault, values = 2.0 * np.arange(1_000), np.zeros(1_000), np.zeros(1_000)
    for begin, delay in ((100, 3), (300, 5), (700, 10)):
        fault[begin : begin + 100] = 1.0
        values[begin + delay : begin + 100] = 2.0
    # In the middle of a fault it passes through zero.
    fault[340:345] = 0.0
    assert delay_on_log(values, times, fault, 0.0, 1.0) == 10.0
    rare = np.zeros(1_000)
    rare[105::100] = 2.0
    assert delay_on_log(rare, times, fault, 0.0, 1.0) == np.inf
    assert np.isnan(delay_on_log(values, times, np.zeros(1_000), 0.0, 1.0))


@pytest.mark.parametrize(("size", "delay"), [(3.0, 8.0), (0.5, np.inf)])
def test_effects_of_a_scenario_are_added_at_every_place(size: float, delay: float) -> None:
    fault, effects = np.zeros(60), np.zeros((2, 60))
    fault[20:] = size
    effects[:, 24:] = size
    assert delay_of_scenario(np.full(500, 7.0), effects, fault, 2.0, 7.0, 1.0) == delay


def test_a_value_that_is_beyond_the_level_by_chance_is_no_alarm() -> None:
    rng, times = np.random.default_rng(3), np.arange(2000.0)
    values, fault = rng.standard_normal(2000), np.where(times >= 1000, 1.0, 0.0)
    values[1800:] += 6.0
    fault[990:1000] = np.nan
    delay = delay_on_log(values, times, fault, 0.0, float(np.quantile(np.abs(values[:990]), 0.99)))
    assert 780.0 <= delay <= 800.0
