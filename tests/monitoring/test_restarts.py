"""Where a sample leads a nonlinear observer to where its model has no solution it starts again, and the run says so."""

from __future__ import annotations

from functools import cache
from pathlib import Path

import numpy as np
import pandas as pd

import obsynth


def tank() -> obsynth.DAEModel:
    """Its outflow is defined for levels from the bottom, 0 m, to the brim, 2 m."""
    return obsynth.DAEModel(
        {"balance": "der(h) = pump - sqrt(h) + 0.1 * sqrt(2 - h)"}, {"level": "h"}, states={"h": 1.0},
        inputs={"pump": 0.9},
    )  # fmt: skip


@cache
def design(outliers: str) -> obsynth.ObserverDesign:
    return obsynth.extended_kalman(
        tank(), dt=0.5, Q=1e-3, R=1e-4, initial_covariance=1e-4, outliers=outliers, outlier_limit=1e-6
    )


def log(wrong: dict[int, float]) -> pd.DataFrame:
    level = np.full(40, 1.0)
    for row, value in wrong.items():
        level[row] = value
    return pd.DataFrame({"time": 0.5 * np.arange(40), "pump": 0.9, "level": level})


def told(run: obsynth.types.DataRun) -> list[str]:
    return [text for text in run.warnings if "started again" in text]


def test_a_run_says_how_often_the_observer_started_again_and_first_when() -> None:
    run = obsynth.run_on_data(design("none"), log({12: -30.0, 25: 40.0}))
    (text,) = told(run)
    assert text.startswith("In 2 rows (the first at 6.5 s) the model had no solution from the estimates before")
    assert not told(obsynth.run_on_data(design("none"), log({})))
    assert not told(obsynth.run_on_data(design("gate"), log({12: -30.0, 25: 40.0})))


def test_a_run_that_goes_on_counts_on(tmp_path: Path) -> None:
    whole, state = log({12: -30.0, 25: 40.0}), tmp_path / "state.json"
    obsynth.run_on_data(design("none"), whole[:20], state=state)
    assert told(obsynth.run_on_data(design("none"), whole[20:], state=state)) == told(
        obsynth.run_on_data(design("none"), whole)
    )


def test_outliers_are_counted_through_a_gap_after_which_the_observer_starts_again() -> None:
    rows = log({5: 1.9, 30: 1.9})
    rows.loc[16:, "time"] += 1e6
    assert obsynth.run_on_data(design("gate"), rows).outliers == {"level": 2}
