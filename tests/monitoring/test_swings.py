"""Levels rise where residuals swing to both sides, as noise does that has become slower; a fault stays on one side."""

from __future__ import annotations

import numpy as np
import pandas as pd
import pytest
from scipy.signal import lfilter

import obsynth
from obsynth.monitoring.thresholds.learned import LearnedThresholds
from obsynth.monitoring.thresholds.learned_rule import LearnedRule
from obsynth.monitoring.thresholds.learned_statistics import Statistics
from obsynth.monitoring.thresholds.monitor import LinearSample, Sample
from obsynth.monitoring.thresholds.swings import SWING, SWING_MEMORY, SWING_ROOM, Swings
from obsynth.numerics.autoregression import Autoregression
from obsynth.results.gain_set_writing import gain_set_digest

ROWS, AT = 1_200, 600


def factors(values: list[float], row: float = 0.0) -> np.ndarray:
    """Return the factors of levels in rows in which one statistic has so many times its level, and a ``row`` itself."""
    swings, found = Swings.none(1), []
    for number, value in enumerate(values):
        swings, factor = swings.after(np.array([value]), row, float(number))
        found.append(factor)
    return np.array(found)


def test_levels_rise_at_the_third_side_and_not_before() -> None:
    one_side, other, back = [3.0] * 100, [-2.0] * 100, [1.0] * 100
    assert (factors(one_side) == 1.0).all()
    assert (factors([*one_side, *other]) == 1.0).all()
    found = factors([*one_side, *other, *back])
    assert (found[:200] == 1.0).all()
    assert (found[200:] > 1.0).all()
    # What is reached on both sides is the lesser of both, and fades.
    kept = (1.0 - 1.0 / SWING_MEMORY) ** np.arange(1, 101)
    np.testing.assert_allclose(found[200:], 1.0 + SWING_ROOM * (np.minimum(2.0 * kept, 3.0 * kept**2) - SWING))


def test_what_is_small_or_no_number_or_long_ago_is_no_swing() -> None:
    small = 0.99 * SWING
    assert (factors([3.0, -small, 3.0, -small] * 10) == 1.0).all()
    assert (factors([3.0, np.nan, np.inf, -np.inf, 3.0]) == 1.0).all()
    assert factors([3.0, -3.0, 3.0])[-1] > 1.0
    assert factors([3.0, -3.0, *[0.0] * int(2.0 * SWING_MEMORY), 3.0])[-1] == 1.0


def test_single_rows_that_are_as_large_are_no_slow_noise() -> None:
    swings = [3.0, -3.0] * 20
    usual, large = factors(swings)[-1], factors(swings, row=6.0)[-1]
    assert usual > 10.0
    assert large == 1.0


def thresholds(columns: tuple[str, ...], deviation: float = 1.0, gains: str = "", faults: int = 0) -> LearnedThresholds:
    """Return thresholds of white residuals of a deviation: at a level of 20, four and a half deviations."""
    m = len(columns)
    white = Autoregression(np.zeros(m), np.zeros((0, m, m)), np.eye(m) / deviation)
    statistics = Statistics(white, deviation * np.eye(m), columns)
    levels = np.full(len(statistics.names), 20.0)
    return LearnedThresholds(
        columns, statistics, levels, 2_500.0, 5_000, 2_500, 1.0, np.zeros(faults), np.ones(faults), gains
    )


def slower(seed: int, *, first: int = 0, size: float = 1.0) -> np.ndarray:
    """Return white residuals, to which noise of a size that follows itself is added from a row on."""
    rng = np.random.default_rng(seed)
    added = lfilter([np.sqrt(1.0 - 0.9**2)], [1.0, -0.9], rng.standard_normal((ROWS, 2)), axis=0)
    added[:first] = 0.0
    return rng.standard_normal((ROWS, 2)) + size * added


def alarms(residuals: np.ndarray) -> np.ndarray:
    names = ("r[y1]", "r[y2]")
    rule = LearnedRule(thresholds(names), names)
    state, found = rule.init(), []
    for row, values in enumerate(residuals):
        sample = LinearSample(values, np.zeros(0), values, 0)
        state, output = rule.step(state, Sample(float(row), values, np.zeros(0), sample))
        found.append(output.statistic > 1.0)
    return np.array(found)


@pytest.mark.long
def test_noise_that_became_slower_is_an_alarm_until_it_has_swung_and_faults_are_found(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Noise of a learned deviation and .9 of the row before was an alarm for a quarter of the time and more."""
    logs = [slower(seed) for seed in range(3)]
    white = np.random.default_rng(7).standard_normal((ROWS, 2))
    shifted, jump = white.copy(), logs[0].copy()
    shifted[AT:, 0] += 2.0
    jump[AT:, 0] += 8.0
    healthy = np.array([alarms(log) for log in logs])
    found, found_in_slow_noise = alarms(shifted), alarms(jump)
    monkeypatch.setattr("obsynth.monitoring.thresholds.swings.LEAST_SWINGS", np.inf)
    before = np.array([alarms(log) for log in logs])
    assert before.mean() > 0.2
    assert healthy[:, 400:].mean() < 0.05
    assert healthy.mean() < 0.3 * before.mean()
    # Where noise is as it was, nothing changes.
    np.testing.assert_array_equal(found, alarms(shifted))
    assert not found[:AT].any()
    assert found[AT + 20 :].all()
    assert found_in_slow_noise[AT : AT + 5].any()
    assert found_in_slow_noise[AT:].mean() > 0.9


@pytest.mark.long
@pytest.mark.usefixtures("taken_as_verified")
def test_a_run_says_since_when_levels_are_raised() -> None:
    plant = obsynth.DescriptorSystem(
        A=[[0.9, 0.1], [0.05, 0.8]], B=[[1.0], [0.5]], C=np.eye(2), Bf=[[1], [0]], dt=1.0,
        sensor_noise={"y1": 0.05, "y2": 0.05},
    )  # fmt: skip
    design = obsynth.fault_estimation_filter(plant)

    def run(noise: np.ndarray, deviation: float) -> obsynth.types.Run:
        learned = thresholds(("r[f1]",), deviation, gain_set_digest(design), 1)
        data = pd.DataFrame(0.05 * noise, columns=["y1", "y2"]).assign(time=np.arange(ROWS), u1=0.0)
        monitor = obsynth.online_monitor(design, "learned", normal=learned, sensor_faults=False)
        return obsynth.run_on_data(design, data, monitor=monitor)

    white = slower(3, first=ROWS)
    deviation = float(run(white, 1.0).table["r[f1]"].std())
    assert not any("swing" in text for text in run(white, deviation).warnings)
    (text,) = (
        text for text in run(slower(3, first=400, size=3.0), deviation).warnings if "swing to both sides" in text
    )
    since = float(text.partition(" since ")[2].partition(" s:")[0])
    assert 400.0 <= since < ROWS
    assert "learn the thresholds again with this log among the normal ones" in text
