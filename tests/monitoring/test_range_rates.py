"""Which share of a level follows each input: of several inputs, late answers, gaps, and statistics of faults."""

from __future__ import annotations

import functools
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

import obsynth

ROWS = 1500
INPUTS = ("u1", "u2")


def plant() -> obsynth.DescriptorSystem:
    """Return a plant with two inputs and a fault."""
    return obsynth.DescriptorSystem(
        A=[[0.9, 0.1], [0.0, 0.8]], B=[[1.0, 0.0], [0.5, 1.0]], C=["a", "b"], Bf=[[1.0], [0.0]], dt=1.0,
        input_names=INPUTS, state_names=["a", "b"], fault_names=["f"], sensor_noise={"a": 0.1, "b": 0.1},
        operating_point=dict.fromkeys(INPUTS, 5.0),
    )  # fmt: skip


@functools.cache
def filter_of_faults() -> obsynth.ObserverDesign:
    return obsynth.fault_estimation_filter(plant())


@functools.cache
def observer_of_faults() -> obsynth.ObserverDesign:
    """Return an observer whose fault estimates walk, so that what each sample says of the fault is watched."""
    return obsynth.adaptive_observer(
        plant(), Q=1e-4 * np.eye(2), R=0.01 * np.eye(2), random_walk=[[1e-5]], form="random-walk"
    )


def log(gains: tuple[float, float], *, late: int = 0, seed: int = 0) -> pd.DataFrame:
    """Return a log of a plant whose inputs have gains that are off; ``late``: what is off comes so many rows later."""
    rng = np.random.default_rng(seed)
    u = np.repeat(rng.uniform(-1.0, 1.0, (ROWS // 50, 2)), 50, axis=0)
    model, x, table = plant(), np.zeros(2), []
    for k in range(ROWS):
        table.append([float(k), *(5.0 + u[k]), *(x + 0.1 * rng.standard_normal(2))])
        x = model.A @ x + model.B @ u[k] + model.B @ (np.array(gains) * u[max(k - late, 0)])
    return pd.DataFrame(table, columns=["time", *INPUTS, "a", "b"])


@functools.cache
def thresholds() -> obsynth.types.LearnedThresholds:
    """Return those of the filter, where the first input's gain is wrong."""
    return learned_from(log((0.3, 0.0)))


def learned_from(data: pd.DataFrame, design: obsynth.ObserverDesign | None = None) -> obsynth.types.LearnedThresholds:
    """Return thresholds of a design, by default the filter."""
    return obsynth.learn_thresholds(design or filter_of_faults(), data, false_alarms="1 per 200 rows")


def rates(learned: obsynth.types.LearnedThresholds) -> np.ndarray:
    """Return the learned shares, one row each input."""
    assert learned.ranges is not None
    assert learned.ranges.rates is not None
    assert learned.ranges.rates.shape == (2, len(learned.levels))
    return learned.ranges.rates


@pytest.mark.long
def test_levels_follow_the_input_whose_gain_is_wrong_and_no_other() -> None:
    first, second = rates(thresholds()), rates(learned_from(log((0.0, 0.3))))
    assert first[0].min() > 2.0 * first[1].max()
    assert np.median(second[1]) > 1.5 * np.median(second[0])


def test_errors_that_come_late_are_followed() -> None:
    late = rates(learned_from(log((0.3, 0.0), late=12)))
    assert np.median(late[0]) > 1.5 * np.median(late[1])


def test_a_missing_cell_of_an_input_counts_as_the_one_before() -> None:
    data = log((0.3, 0.0))
    rng = np.random.default_rng(7)
    data.loc[rng.choice(np.arange(1, ROWS), 60, replace=False), "u2"] = np.nan
    np.testing.assert_allclose(rates(learned_from(data)), rates(thresholds()), atol=0.12)


@pytest.mark.long
def test_statistics_of_faults_follow_inputs_as_residuals_do() -> None:
    learned = learned_from(log((0.3, 0.0)), observer_of_faults())
    assert learned.statistics.estimates == ("fhat[f]",)
    of_fault = rates(learned)[:, -2:]  # a change of it, and the square of its estimate
    assert of_fault[0].min() > 2.0 * of_fault[1].max()


def test_nothing_was_beyond_its_range_before_the_first_row() -> None:
    learned = thresholds()
    monitor = obsynth.online_monitor(filter_of_faults(), "learned", normal=learned)
    data = log((0.0, 0.0), seed=3)
    data.loc[:, "a"] += 40.0  # an alarm within the rows that statistics look back
    run = obsynth.run_on_data(filter_of_faults(), data[:60], monitor=monitor)
    assert run.events
    assert all(event.beyond == () for event in run.events)


def test_an_input_is_named_where_it_leaves_its_range_by_more_than_noise_does() -> None:
    learned = thresholds()
    assert learned.ranges is not None
    monitor = obsynth.online_monitor(filter_of_faults(), "learned", normal=learned)
    low, high = learned.ranges.low[0], learned.ranges.high[0]
    for share, is_named in ((0.03, False), (0.08, True)):
        for end in (high + share * (high - low), low - share * (high - low)):
            data = log((0.0, 0.0), seed=3)[:80].copy()
            data.loc[40:, "u1"] = 5.0 + end
            run = obsynth.run_on_data(filter_of_faults(), data, monitor=monitor)
            assert any(text.startswith("u1 leaves the range") for text in run.warnings) is is_named


def test_a_resumed_run_remembers_how_long_ago_an_input_was_beyond(tmp_path: Path) -> None:
    learned = thresholds()
    monitor = obsynth.online_monitor(filter_of_faults(), "learned", normal=learned)
    data = log((0.0, 0.0), seed=3)[:120].copy()
    data.loc[20:39, "u1"] = 9.0
    data.loc[46:, "a"] += 80.0  # an alarm in spite of the higher levels
    parts = [
        obsynth.run_on_data(filter_of_faults(), part, monitor=monitor, state=tmp_path / "state.json")
        for part in (data[:45], data[45:])
    ]
    event = parts[1].events[0]
    assert event.beyond == ("u1",)
