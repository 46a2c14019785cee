"""Fault estimates that are watched as they are, in deviations that the observer states: what residuals do not show."""

from __future__ import annotations

import functools
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
from scipy.signal import lfilter

import obsynth
from obsynth.data.log_run import LogRun
from obsynth.experiments.monitors.learned_levels import (
    Statistics,
    conformal_levels,
    count_alarms,
    is_conformal,
    learned_levels,
)
from obsynth.numerics.autoregression import fitted_autoregression

DT = 0.1
pytestmark = pytest.mark.usefixtures("taken_as_verified")


@functools.cache
def pumped() -> obsynth.ObserverDesign:
    """Return a tank whose pump loses a share of its flow."""
    model = obsynth.DAEModel(
        {"tank": "der(h) = 10 * (1 - f) * u - h"}, {"y": "h"}, states={"h": 0.0}, inputs={"u": 0.0},
        parameters={"f": 0.0},
    )  # fmt: skip
    return obsynth.dae_adaptive_observer(
        model, dt=DT, Q=[[1e-4]], R=[[0.01]], form="augmented-kalman", random_walk=[[1e-4]],
        initial_covariance=[[0.01]], initial_parameter_covariance=[[0.01]],
    )  # fmt: skip


def log(rows: int, seed: int, *, begin: int | None = None, size: float = 0.3) -> pd.DataFrame:
    """Return a log whose input changes sign every third row, so that what a fault does to innovations does too."""
    rng, h, found = np.random.default_rng(seed), 0.0, []
    for k in range(rows):
        u, f = 0.2 * (-1.0) ** (k // 3), size if begin is not None and k >= begin else 0.0
        h = (h + DT * 10.0 * (1.0 - f) * u) / (1.0 + DT) + 0.01 * rng.standard_normal()
        found.append([k * DT, u, h + 0.1 * rng.standard_normal()])
    return pd.DataFrame(found, columns=["time", "u", "y"])


@functools.cache
def learned() -> obsynth.types.LearnedThresholds:
    return obsynth.learn_thresholds(pumped(), log(3_000, 0), false_alarms="1 per 500 rows")


def test_a_fault_that_the_estimate_follows_is_an_alarm() -> None:
    found = learned()
    assert found.columns == ("r[y]",)
    assert found.statistics.names[-1] == "size of fhat[f]"
    assert found.left_out == ()
    assert "and in 1 fault estimate(s)" in found.statement
    alone = replace(
        found, statistics=replace(found.statistics, estimates=()), levels=found.levels[:-1], deviations=np.zeros(0)
    )
    for one, wanted in ((found, True), (alone, False)):
        monitor = obsynth.online_monitor(pumped(), "learned", normal=one)
        run = obsynth.run_on_data(pumped(), log(500, 2, begin=300), monitor=monitor)
        assert ("learned" in run.alarms) is wanted
    monitor = obsynth.online_monitor(pumped(), "learned", normal=found)
    quiet = obsynth.run_on_data(pumped(), log(5_000, 1), monitor=monitor)
    # Ten are stated; twice as many have a probability of .003 if the rate is kept, by Poisson's law.
    assert len(quiet.events) < 20


def test_the_statistic_is_that_of_its_definition_and_blank_rows_change_nothing_else() -> None:
    found, data = learned(), log(400, 3, begin=200, size=0.8)
    data.loc[[250, 251], "y"] = np.nan
    monitor = obsynth.online_monitor(pumped(), "learned", normal=found)
    table = obsynth.run_on_data(pumped(), data, monitor=monitor).table
    assert table is not None
    away = (table["fhat[f]"] - found.centres[0]) / (table["sd fhat[f]"] * found.deviations[0])
    sizes, decided = away**2 / found.levels[-1], table.statistic.notna()
    assert (table.statistic >= sizes * (1.0 - 1e-12))[decided].all()
    np.testing.assert_allclose(table.statistic[300:], sizes[300:], rtol=1e-12)
    assert decided[252:].all()
    assert not decided[250:252].any()


def test_normal_rows_have_mean_zero_and_deviation_one_in_these_units() -> None:
    found = learned()
    rows = LogRun(pumped()).read(log(3_000, 0).to_numpy())[100:]
    theta = np.array([row.evidence.theta[0] for row in rows])
    stated = np.array([row.evidence.covariance[0, 0] ** 0.5 for row in rows])
    away = (theta - found.centres[0]) / (stated * found.deviations[0])
    np.testing.assert_allclose([away.mean(), away.std()], [0.0, 1.0], atol=1e-9)


def test_estimates_that_remember_too_much_are_not_watched_and_that_is_told() -> None:
    short = obsynth.learn_thresholds(pumped(), log(700, 0), false_alarms="1 per 500 rows")
    assert short.left_out == ("fhat[f]",)
    assert len(short.deviations) == 0
    assert "fault estimate" not in short.statement


def test_files_keep_what_is_watched(tmp_path: Path) -> None:
    again = obsynth.load_thresholds(learned().save(tmp_path / "t.json"))
    assert again.statistics.names == learned().statistics.names
    np.testing.assert_array_equal(again.deviations, learned().deviations)
    np.testing.assert_array_equal(again.levels, learned().levels)
    monitor, data = obsynth.online_monitor(pumped(), "learned", normal=again), log(400, 2, begin=300, size=0.9)
    whole = obsynth.run_on_data(pumped(), data, monitor=monitor).table
    parts = [obsynth.run_on_data(pumped(), part, monitor=monitor, state=tmp_path / "s").table
             for part in (data.iloc[:320], data.iloc[320:])]  # fmt: skip
    pd.testing.assert_frame_equal(whole, pd.concat(parts, ignore_index=True))


def slow(rng: np.random.Generator, rows: int, memory: float) -> np.ndarray:
    """Return rows ``(rows, 1)`` of an estimate that moves in bursts, as one does whose gain follows the inputs."""
    bursts = np.repeat(rng.choice([0.3, 1.5], rows // 40 + 60), 40)[: rows + 2_000, None]
    return lfilter([1.0], [1.0, -memory], bursts * rng.standard_normal((rows + 2_000, 1)), axis=0)[2_000:]


@pytest.mark.parametrize("memory", [0.9, 0.98])
def test_the_stated_rate_is_kept_out_of_sample(memory: float, share: Callable[..., Any]) -> None:
    every, rates = 1_000.0, []
    for seed in share(range(8), 4):
        rng = np.random.default_rng([seed, 3])
        x, z = rng.standard_normal((2_000, 1)), slow(rng, 2_000, memory)
        statistics = Statistics(fitted_autoregression(x), np.eye(1), ("a",), ("f",))
        levels = learned_levels(x, every, statistics, seed, (z - z.mean()) / z.std())
        assert len(levels.own) == len(statistics.names)
        fresh, later = rng.standard_normal((50_000, 1)), (slow(rng, 50_000, memory) - z.mean()) / z.std()
        found = statistics.of_rows(statistics.model.whitened(fresh)[None])[:, 0]
        largest = (np.concatenate([found, later.T**2]) / levels.own[:, None]).max(axis=0)
        rates.append(every * count_alarms(largest, levels.factor) / 50_000)
    assert 0.2 <= np.mean(rates) <= 1.0
    assert max(rates) <= 2.0


def test_many_rows_show_the_rate_of_estimates_themselves() -> None:
    every, rates = 100.0, []
    for seed in range(4):
        rng = np.random.default_rng([seed, 9])
        x, z = rng.standard_normal((6_000, 1)), slow(rng, 6_000, 0.9)
        mean, size = z[:3_000].mean(), z[:3_000].std()
        assert is_conformal(len(x), every)
        statistics = Statistics(fitted_autoregression(x), np.eye(1), ("a",), ("f",))
        statistics, levels = conformal_levels(x, every, statistics, (z - mean) / size)
        assert statistics.estimates == ("f",)
        fresh, later = rng.standard_normal((40_000, 1)), (slow(rng, 40_000, 0.9) - mean) / size
        found = statistics.of_rows(statistics.model.whitened(fresh)[None])[:, 0]
        largest = (np.concatenate([found, later.T**2]) / levels.own[:, None]).max(axis=0)
        rates.append(every * count_alarms(largest, levels.factor) / 40_000)
    # Of 29 alarms that the second half may have: a deviation of .19 each, .1 of their mean.
    assert 0.7 <= np.mean(rates) <= 1.2
