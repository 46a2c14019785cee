"""Guaranteed thresholds over a region in C: norm, threshold, alarm and fault of every row as in a run on a log."""

from __future__ import annotations

import shutil
import subprocess
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest

import obsynth
from obsynth import ObserverDesign, PolytopicSystem, SpecError
from obsynth.numerics.arrays import FloatArray

_MAIN = """
#include <stdio.h>
#include "region.h"
int main(void)
{
    region_state s;
    double u[1], y[2], states[3], faults[1], residuals[1];
    region_reset(&s);
    while (scanf("%lf %lf %lf", &u[0], &y[0], &y[1]) == 3) {
        region_step(&s, u, y, states, faults, residuals);
        printf("%d %d %d", s.status, s.any_alarm, s.alarm[0]);
        MORE
        printf("\\n");
    }
    return 0;
}
"""
_MONITOR = """printf(" %.17g %.17g %d", s.monitor.norm, s.monitor.threshold, s.monitor.alarm);
        printf(" %d %.17g", s.monitor.fault, s.monitor.statistic);"""
_FLAGS = ("-std=c99", "-Wall", "-Wextra", "-Werror", "-O1", "-fsanitize=undefined", "-fno-sanitize-recover")
_STATUSES = ("ok", "warm-up", "gap", "recovering", "out")

pytestmark = pytest.mark.skipif(shutil.which("gcc") is None, reason="no C compiler")


@pytest.fixture(scope="module")
def design() -> ObserverDesign:
    plant = PolytopicSystem(
        plant={
            "A": [["0.6 + 0.1 * v", 0.2, 0], [-0.1, "0.5 - 0.1 * v", 0.1], [0.1, 0, "0.4 + 0.2 * v"]],
            "C": [[1, 0, 0], [0, 1, 0]], "Bf": [[1], [0.3], [0.1]], "Bd": [[0.4], [1], [0.2]], "dt": 0.5,
            "Bw": np.zeros((3, 2)).tolist(), "Dw": [[0.01, 0], [0, 0.02]],
        },
        scheduling={"v": [-1, 1]},
    )  # fmt: skip
    return obsynth.fault_estimation_filter(plant)


def _rows(design: ObserverDesign) -> FloatArray:
    """Return rows with a fault, missing samples at the start and later, and parameters outside, at the start too."""
    plant, rng = design.scheduled[0], np.random.default_rng(1)
    v = rng.uniform(-1, 1, 260)
    x, rows = np.zeros(3), []
    for k in range(260):
        own = plant.at([v[k]])
        y = own.C @ x + own.Dw @ rng.uniform(-3, 3, 2)
        rows.append([v[k], *y])
        x = own.A @ x + own.Bd[:, 0] * rng.uniform(-0.1, 0.1) + own.Bf[:, 0] * (3.0 if k >= 150 else 0.0)
    table = np.array(rows)
    table[2:5, 0] = 1.5
    table[0, 1], table[60:63, 2] = np.nan, np.nan
    table[100, 0], table[180, 0], table[220, 1] = np.nan, -2.0, np.nan
    return table


def _in_c(design: ObserverDesign, folder: Path, rows: FloatArray, more: str = _MONITOR, **options: Any) -> FloatArray:
    obsynth.export(design, folder / "region.c", **options)
    (folder / "main.c").write_text(_MAIN.replace("MORE", more))
    compiled = ["gcc", *_FLAGS, "main.c", "region.c", "-lm", "-o", "region"]
    made = subprocess.run(compiled, cwd=folder, capture_output=True, text=True)
    assert made.returncode == 0, made.stderr
    text = "\n".join(" ".join(repr(float(value)) for value in row) for row in rows)
    lines = subprocess.run([folder / "region"], input=text, capture_output=True, text=True, check=True).stdout
    return np.array([[float(value) for value in line.split()] for line in lines.splitlines()])


def _on_a_log(design: ObserverDesign, folder: Path, rows: FloatArray, **options: Any) -> pd.DataFrame:
    log = pd.DataFrame({"time": 0.5 * np.arange(len(rows)), "v": rows[:, 0], "y1": rows[:, 1], "y2": rows[:, 2]})
    obsynth.run_on_data(design, log, out=folder / "run.csv", **options)
    return pd.read_csv(folder / "run.csv")


@pytest.mark.one_in(4)
@pytest.mark.parametrize(("initial_error", "warm_up"), [(None, None), (0.0, 0.0), (2.0, 1.0), (0.5, 40.0)], ids=str)
def test_c_decides_as_a_run_does(
    design: ObserverDesign, tmp_path: Path, initial_error: float | None, warm_up: float | None
) -> None:
    monitor = obsynth.online_monitor(design, disturbance_bounds={"d1": 0.1}, noise_bound=3, initial_error=initial_error)
    rows = _rows(design)
    in_c = _in_c(design, tmp_path, rows, monitor=monitor, warm_up=warm_up)
    run = _on_a_log(design, tmp_path, rows, monitor=monitor, warm_up=warm_up)
    assert [_STATUSES[int(status)] for status in in_c[:, 0]] == run.status.tolist()
    assert {"ok", "out", "gap", "recovering"} <= set(run.status)
    numbers = run[["statistic", "threshold"]].to_numpy()
    assert np.array_equal(np.isnan(numbers), np.isnan(in_c[:, 3:5]))
    assert np.nanmax(np.abs(numbers - in_c[:, 3:5]) / np.maximum(np.abs(numbers), 1.0)) < 1e-12
    alarms = run.alarm.notna().to_numpy()
    assert 20 < alarms.sum() < 110
    for column in (1, 5):
        assert np.array_equal(in_c[:, column] == 1.0, alarms)
    assert np.array_equal(in_c[:, 6] == 0.0, alarms)
    assert np.array_equal(in_c[:, 7] > 1.0, alarms)


def test_levels_of_outputs_are_passed_as_in_a_run(design: ObserverDesign, tmp_path: Path) -> None:
    rows, levels = _rows(design), {"fhat[f1]": 1.5}
    in_c = _in_c(design, tmp_path, rows, more="", thresholds=levels)
    run = _on_a_log(design, tmp_path, rows, thresholds=levels)
    alarms = run.alarm.notna().to_numpy()
    assert 20 < alarms.sum() < 110
    assert np.array_equal(in_c[:, 1] == 1.0, alarms)
    assert np.array_equal(in_c[:, 2] == 1.0, alarms)


def test_other_monitors_are_refused_by_name(design: ObserverDesign, tmp_path: Path) -> None:
    vertex = obsynth.fault_estimation_filter(design.scheduled[0].vertices[0])
    window = obsynth.online_monitor(vertex, "window", disturbance_bounds={"d1": 0.1}, noise_bound=3)
    with pytest.raises(SpecError, match="guaranteed thresholds"):
        obsynth.export(design, tmp_path / "region.c", monitor=window)
    monitor = obsynth.online_monitor(design, disturbance_bounds={"d1": 0.1}, noise_bound=3)
    plant = vertex.linear[0]
    leak = obsynth.DescriptorSystem(A=plant.A, C=plant.C, Bf=plant.Bf, Bd=plant.Bd, dt=0.5, fault_names=("leak",))
    other = obsynth.fault_estimation_filter(PolytopicSystem([leak]))
    with pytest.raises(SpecError, match="another design"):
        obsynth.export(other, tmp_path / "other.c", monitor=monitor)
