"""Guaranteed tests that run: monitors of records and of data, gaps, C; and the bank that isolates."""

from __future__ import annotations

from functools import cache
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

import obsynth

ROOT = Path(__file__).parents[2]


@cache
def spec() -> obsynth.Spec:
    return obsynth.load_spec(ROOT / "designs/drive/guaranteed_test.yaml")


@cache
def drive() -> obsynth.ObserverDesign:
    return obsynth.design(spec().plant, "guaranteed-test", **spec().options)


def test_the_step_is_found_and_nothing_before_it() -> None:
    watched = obsynth.monitor(drive(), spec().scenario)
    assert "no function of these samples has one below 0.045456" in watched.statement
    found = watched.watch(obsynth.simulate(drive(), spec().scenario).estimates)
    # 0.1 N m are more than twice the threshold: found at the latest 19 samples after the step at 4 s.
    assert found.time is not None
    assert 4.0 < found.time <= 4.0 + 0.38 + 1e-9
    assert np.isinf(found.threshold[:29]).all()
    many = obsynth.evaluate(drive(), spec().scenario, runs=20, monitor=watched)
    assert many.false_alarm_rate.value == 0.0


def log() -> pd.DataFrame:
    run = obsynth.simulate(drive(), spec().scenario)
    plant = drive().linear[0]
    columns = {"time": np.arange(len(run.outputs)) * plant.dt}
    columns |= dict(zip(plant.input_names, run.inputs.T, strict=True))
    columns |= dict(zip(plant.output_names, run.outputs.T, strict=True))
    return pd.DataFrame(columns)


def test_a_log_alarms_once_and_rows_after_a_gap_give_no_verdict() -> None:
    data = log()
    table = obsynth.run_on_data(drive(), data, monitor=obsynth.online_monitor(drive())).table
    alarms = table.loc[table["alarm"] != "", "time"]
    assert 4.0 < alarms.min() <= 4.38 + 1e-9
    thresholds = table["threshold"].to_numpy(dtype=float)
    assert np.isnan(thresholds[:29]).all()
    # Rounding is in the threshold, and does not count.
    assert np.all(thresholds[29:] >= drive().certificate.claims["threshold"])
    assert np.nanmax(thresholds) < drive().certificate.claims["threshold"] * (1.0 + 1e-9)
    gapped = data.drop(index=range(100, 103))
    table = obsynth.run_on_data(drive(), gapped, monitor=obsynth.online_monitor(drive())).table
    undecided = np.isnan(table["threshold"].to_numpy(dtype=float))
    assert undecided[100:129].all()
    assert not undecided[130:].any()


def test_bounds_of_a_design_are_not_changed_by_its_monitor() -> None:
    with pytest.raises(obsynth.SpecError, match="noise_bound cannot be given"):
        obsynth.monitor(drive(), spec().scenario, noise_bound=2.0)
    with pytest.raises(obsynth.SpecError, match="its own threshold"):
        obsynth.online_monitor(drive(), "cusum")
