"""Healthy time in alarm on logs as they are: sensors that drift, starts anywhere, several normal logs, every column."""

from __future__ import annotations

import functools
import json
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

import obsynth
from obsynth.cli.main import main
from obsynth.monitoring.thresholds.cross_validation import HeldOut, healthy_time, levels_of_other_parts
from obsynth.monitoring.thresholds.learned_statistics import AGES, Statistics
from obsynth.monitoring.thresholds.slow_offsets import offset_bound
from obsynth.numerics.autoregression import Autoregression

pytestmark = pytest.mark.usefixtures("taken_as_verified")
ROWS = 1_000


@functools.cache
def design() -> obsynth.ObserverDesign:
    """Return two lags in a row, with a loss of the input and an offset of the second sensor as faults that walk."""
    model = obsynth.DAEModel(
        {"a": "der(x1) = 0.1 * (u * (1 - loss) - x1)", "b": "der(x2) = 0.05 * (x1 - x2)"},
        {"y1": "x1", "y2": "x2 + bias"}, states={"x1": 1.0, "x2": 1.0}, inputs={"u": 1.0},
        parameters={"loss": 0.0, "bias": 0.0},
    )  # fmt: skip
    return obsynth.dae_adaptive_observer(
        model, dt=1.0, Q={"a": 1e-6, "b": 1e-6}, R={"y1": 0.0025, "y2": 0.0025},
        random_walk={"loss": 1e-7, "bias": 1e-7}, initial_parameter_covariance={"loss": 1e-3, "bias": 1e-3},
    )  # fmt: skip


def log(seed: int, *, drift: float = 0.0, start: float = 1.0, rows: int = ROWS, leak: float = 0.0) -> pd.DataFrame:
    """Return a log whose second sensor drifts by so many deviations, and which starts somewhere; ``leak``: a loss of
    the input from the middle on."""
    rng, x, found = np.random.default_rng(seed), np.full(2, start), []
    for k in range(rows):
        u = 1.0 + 0.5 * np.sign(np.sin(0.03 * k))
        lost = leak if 2 * k > rows else 0.0
        first = (x[0] + 0.1 * u * (1.0 - lost)) / 1.1
        x = np.array([first, (x[1] + 0.05 * first) / 1.05])
        noise = 0.05 * rng.standard_normal(2)
        found.append([float(k), u, x[0] + noise[0], x[1] + noise[1] + drift * 0.05 * k / rows])
    return pd.DataFrame(found, columns=["time", "u", "y1", "y2"])


def in_alarm(learned: obsynth.types.LearnedThresholds, data: pd.DataFrame) -> np.ndarray:
    """Return which rows of a log are in alarm."""
    monitor = obsynth.online_monitor(design(), "learned", normal=learned)
    statistic = obsynth.run_on_data(design(), data, monitor=monitor).table["statistic"].to_numpy(dtype=float)
    return np.asarray(np.nan_to_num(statistic) > 1.0)


@pytest.mark.one_in(3)
@pytest.mark.parametrize(
    ("normal", "tests"),
    [
        ({"drift": 1.0}, ({"drift": 1.0}, {"drift": -1.0}, {})),
        ({"start": 0.0}, ({"start": 0.0}, {"start": 0.5})),
        ({}, ({"start": 0.5}, {})),
    ],
)
@pytest.mark.long
def test_drifts_and_starts_are_no_alarms_and_faults_are(normal: dict, tests: tuple[dict, ...]) -> None:
    learned = obsynth.learn_thresholds(design(), log(0, **normal))
    assert in_alarm(learned, log(0, **normal)).mean() < 0.01
    for seed, test in enumerate(tests, 1):
        assert in_alarm(learned, log(seed, **test)).mean() < 0.02, test
        if learned.holds:
            assert in_alarm(learned, log(10 + seed, leak=0.4, **test))[ROWS // 2 + 100 :].mean() > 0.5, test


@pytest.mark.long
def test_several_logs_are_learned_from_and_say_how_logs_differ(tmp_path: Path) -> None:
    logs = [
        log(seed, start=start, drift=drift) for seed, start, drift in ((0, 0.7, 1.0), (1, 1.3, -1.0), (2, 1.0, 0.0))
    ]
    learned = obsynth.learn_thresholds(design(), logs)
    assert learned.logs == 3
    assert "between 3 logs" in learned.statement
    assert learned.rows > 2 * ROWS
    assert in_alarm(learned, log(7, start=0.8, drift=-0.7)).mean() < 0.02
    file = learned.save(tmp_path / "t.json")
    again = obsynth.load_thresholds(file)
    assert (again.logs, again.healthy_time) == (3, learned.healthy_time)
    assert again.save(tmp_path / "again.json").read_bytes() == file.read_bytes()


@pytest.mark.long
def test_a_folder_of_logs_is_the_logs_in_it_and_the_command_says_the_share(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    gains, folder = design().save(tmp_path / "g.json"), tmp_path / "logs"
    folder.mkdir()
    for seed in range(3):
        log(seed).to_csv(folder / f"{seed}.csv", index=False)
    files = sorted(str(file) for file in folder.iterdir())
    ways = {}
    for name, given in (("folder", [str(folder)]), ("files", files)):
        assert main(["thresholds", "--gains", str(gains), "--data", *given, "--json", "--quiet"]) == 0
        ways[name] = json.loads(capsys.readouterr().out)
    assert ways["folder"] == ways["files"]
    assert ways["files"]["logs"] == 3
    share = ways["files"]["healthy_time"]
    assert 0.0 <= share["low"] <= share["expected"] <= share["high"] <= 1.0
    assert main(["thresholds", "--gains", str(gains), "--data", files[0], "-", "--quiet"]) == 2
    assert "stream" in capsys.readouterr().err
    assert obsynth.learn_thresholds(design(), folder).logs == 3
    with pytest.raises(obsynth.SpecError, match="no log"):
        obsynth.learn_thresholds(design(), [])


def test_rows_that_were_not_learned_from_decide_whether_thresholds_hold() -> None:
    """One part in five is unlike the others: its rows are in alarm by levels of the others."""
    rng = np.random.default_rng(0)
    values = rng.chisquare(2, (1, 5_000))
    parts = tuple(slice(1_000 * i, 1_000 * (i + 1)) for i in range(5))
    levels, factors = np.full(1, 14.0), np.ones(1)
    like = healthy_time(levels, HeldOut(values, parts), 1_000.0, factors)
    assert like.expected < 0.01
    assert like.high > like.expected
    values[:, parts[2]] += 100.0
    unlike = healthy_time(levels, HeldOut(values, parts), 1_000.0, factors)
    assert unlike.expected == pytest.approx(0.2, abs=0.01)
    # A new log is to be expected to be like the worst of them: the level is above it.
    assert levels_of_other_parts(levels, HeldOut(values, parts), 1_000.0)[0] > values.max()


def test_the_bound_on_an_offset_is_nothing_for_noise_and_holds_what_drifts() -> None:
    rng, n = np.random.default_rng(1), 4_000
    one = (slice(0, n),)
    noise = [offset_bound(rng.standard_normal(n), np.ones(n), one) for _ in range(100)]
    assert np.mean(np.array(noise) > 0.0) < 0.1
    drifts = [offset_bound(rng.standard_normal(n) + np.linspace(-0.5, 0.5, n), np.ones(n), one) for _ in range(50)]
    assert np.mean(np.array(drifts) >= 0.5) > 0.9
    logs = tuple(slice(1_000 * i, 1_000 * (i + 1)) for i in range(4))
    between = [offset_bound(rng.standard_normal(n) + np.repeat(rng.standard_normal(4), 1_000), np.ones(n), logs)
               for _ in range(50)]  # fmt: skip
    assert np.mean(np.array(between) >= 1.0) > 0.9


def test_an_offset_within_its_band_raises_no_ratio_and_one_beyond_it_does() -> None:
    model = Autoregression(np.zeros(1), np.zeros((0, 1, 1)), np.eye(1))
    plain = Statistics(model, np.eye(1), ("y",))
    banded = Statistics(model, np.eye(1), ("y",), bands=np.array([0.5]))
    e = np.full((1, 300, 1), 0.5)
    step = list(plain.names).index("GLR of a step in y")
    assert plain.of_rows(e)[step].max() == pytest.approx(0.25 * max(AGES))
    assert banded.of_rows(e)[step].max() == pytest.approx(0.0, abs=1e-12)
    assert banded.of_rows(3.0 * e)[step].max() == pytest.approx(max(AGES))


@pytest.mark.long
def test_a_step_of_any_of_many_sensors_is_seen() -> None:
    count = 14
    rng, names = np.random.default_rng(0), [f"y{i}" for i in range(count)]
    plant = obsynth.DescriptorSystem(A=0.5 * np.eye(count), C=np.eye(count), dt=1.0, output_names=names)
    filtered = obsynth.descriptor_kalman(plant, Q=0.75 * np.eye(count), R=0.05 * np.eye(count))

    def many(rows: int, step: int | None = None) -> pd.DataFrame:
        x, found = np.zeros(count), []
        for k in range(rows):
            x = 0.5 * x + np.sqrt(0.75) * rng.standard_normal(count)
            y = x + 0.22 * rng.standard_normal(count)
            if step is not None and 2 * k >= rows:
                y[step] += 8.0
            found.append([float(k), *y])
        return pd.DataFrame(found, columns=["time", *names])

    learned = obsynth.learn_thresholds(filtered, many(800), false_alarms="1 per 200 rows")
    assert len(learned.columns) == count
    assert not learned.left_out
    monitor = obsynth.online_monitor(filtered, "learned", normal=learned)
    for step in (0, 9, count - 1):
        statistic = obsynth.run_on_data(filtered, many(300, step), monitor=monitor).table["statistic"]
        assert (statistic.to_numpy(float)[150:] > 1.0).mean() > 0.8
