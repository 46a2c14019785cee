"""Inputs and outputs beyond the range that thresholds were learned from: higher levels, and names in warnings."""

from __future__ import annotations

import functools
from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

import obsynth

ROWS, FAULT_AT, MISMATCH = 600, 400, 0.1


@functools.cache
def design() -> obsynth.ObserverDesign:
    """Return a filter of a plant whose input gain is 10 % off in the logs."""
    plant = obsynth.DescriptorSystem(
        A=[[0.9, 0.1], [0.0, 0.8]], B=[[1.0], [0.5]], C=["a", "b"], Bf=[[1.0], [0.0]], dt=1.0, input_names=["u"],
        state_names=["a", "b"], fault_names=["f"], sensor_noise={"a": 0.1, "b": 0.1},
        operating_point={"u": 5.0},
    )  # fmt: skip
    return obsynth.fault_estimation_filter(plant)


def log(seed: int, span: float, *, fault: float = 0.0, mismatch: float = MISMATCH, rows: int = ROWS) -> pd.DataFrame:
    rng = np.random.default_rng(seed)
    u = np.repeat(rng.uniform(-span, span, rows // 50), 50)
    u[:50], u[50:100] = span, -span
    x, table = np.zeros(2), []
    plant = design().plant
    for k in range(rows):
        table.append([float(k), 5.0 + u[k], *(x + 0.1 * rng.standard_normal(2))])
        x = plant.A @ x + (1.0 + mismatch) * plant.B @ u[k : k + 1] + plant.Bf @ [fault * (k >= FAULT_AT)]
    return pd.DataFrame(table, columns=["time", "u", "a", "b"])


@functools.cache
def learned() -> obsynth.types.LearnedThresholds:
    return obsynth.learn_thresholds(design(), log(0, 1.0), false_alarms="1 per 200 rows")


@pytest.mark.long
def test_set_points_beyond_those_of_the_normal_log_do_not_alarm_and_are_named() -> None:
    monitor = obsynth.online_monitor(design(), "learned", normal=learned())
    run = obsynth.run_on_data(design(), log(1, 5.0), monitor=monitor)
    assert run.events == ()
    (text,) = [text for text in run.warnings if text.startswith("u leaves the range")]
    assert "(4 to 6)" in text
    assert "reaches" in text
    assert "levels are up to" in text
    # It said "levels are up to 1.92 (the least) to 3.4 (the largest) times as high there".
    assert "the least" not in text.replace("matter least to", "")
    assert "times as high" in text
    # As thresholds were before ranges were among them.
    without = obsynth.online_monitor(design(), "learned", normal=replace(learned(), ranges=None))
    assert obsynth.run_on_data(design(), log(1, 5.0), monitor=without).events != ()


def test_one_log_says_before_a_run_that_it_does_not_show_drifts_of_the_plant() -> None:
    assert "one log does not say how far constants of the plant drift in others" in learned().statement
    assert "three normal logs" in learned().statement
    assert "constants of the plant" not in replace(learned(), logs=3).statement


@pytest.mark.long
def test_levels_rise_beyond_the_range_by_what_the_logs_say_of_the_model_alone() -> None:
    """A model without an error that follows the input: rates are small, and a fault alarms beyond the range."""
    exact = obsynth.learn_thresholds(design(), log(0, 1.0, mismatch=0.0, rows=2000), false_alarms="1 per 200 rows")
    wrong = obsynth.learn_thresholds(design(), log(0, 1.0, mismatch=0.3, rows=2000), false_alarms="1 per 200 rows")
    assert exact.ranges is not None
    assert exact.ranges.rates is not None
    assert wrong.ranges is not None
    assert wrong.ranges.rates is not None
    assert exact.ranges.rates.shape == (1, len(exact.levels))
    assert exact.ranges.rates.max() < 0.5
    assert wrong.ranges.rates.min() > 0.6
    faulty = log(5, 5.0, fault=0.15, mismatch=0.0)
    as_before = replace(exact, ranges=exact.ranges._replace(rates=None))
    alarmed = [
        (obsynth.run_on_data(design(), faulty, monitor=obsynth.online_monitor(design(), "learned", normal=each)))
        .table["alarm"].ne("").to_numpy()
        for each in (exact, as_before)
    ]  # fmt: skip
    assert not alarmed[0][:FAULT_AT].any()
    delays = [int(rows[FAULT_AT:].argmax()) for rows in alarmed]
    assert 2 * delays[0] < delays[1]


@pytest.mark.long
def test_within_the_range_nothing_changes_and_a_large_fault_beyond_it_alarms_with_a_note() -> None:
    monitor = obsynth.online_monitor(design(), "learned", normal=learned())
    without = obsynth.online_monitor(design(), "learned", normal=replace(learned(), ranges=None))
    usual = [obsynth.run_on_data(design(), log(2, 0.9, fault=1.0), monitor=each) for each in (monitor, without)]
    pd.testing.assert_frame_equal(usual[0].table, usual[1].table)
    assert all(event.beyond == () for event in usual[0].events)
    run = obsynth.run_on_data(design(), log(3, 3.0, fault=8.0), monitor=monitor)
    assert run.events
    assert all(event.beyond == ("u",) for event in run.events)
    assert run.as_dict()["events"][0]["beyond"] == ["u"]


@pytest.mark.long
def test_ranges_are_saved_and_a_resumed_run_goes_on_with_them(tmp_path: Path) -> None:
    saved = obsynth.load_thresholds(learned().save(tmp_path / "t.json"))
    assert saved.ranges is not None
    assert saved.ranges.names == ("u", "a", "b")
    np.testing.assert_allclose((saved.ranges.low[0], saved.ranges.high[0], saved.ranges.point[0]), (-1.0, 1.0, 5.0),
                               atol=0.2)  # fmt: skip
    monitor = obsynth.online_monitor(design(), "learned", normal=saved)
    data = log(3, 3.0, fault=8.0)
    together = obsynth.run_on_data(design(), data, monitor=monitor)
    parts = [
        obsynth.run_on_data(design(), part, monitor=monitor, state=tmp_path / "s.json")
        for part in (data[: FAULT_AT + 10], data[FAULT_AT + 10 :])
    ]
    pd.testing.assert_frame_equal(pd.concat([part.table for part in parts], ignore_index=True), together.table)
    assert all(event.beyond == ("u",) for event in parts[1].events)


@pytest.mark.one_in(2)
@pytest.mark.parametrize("column", ["a", "b"])
def test_an_output_is_named_where_two_samples_in_a_row_leave_its_range(column: str) -> None:
    monitor = obsynth.online_monitor(design(), "learned", normal=learned())
    data = log(4, 0.5)
    data.loc[300, column] += 100.0
    run = obsynth.run_on_data(design(), data, monitor=monitor)
    assert not [text for text in run.warnings if text.startswith(f"{column} leaves")]
    data.loc[300:320, column] += 100.0
    run = obsynth.run_on_data(design(), data, monitor=monitor)
    (text,) = [text for text in run.warnings if text.startswith(f"{column} leaves")]
    assert "no level is raised for an output" in text
