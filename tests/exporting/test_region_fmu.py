"""Designs over a region as functional mock-up units: the rows, statuses and alarms of a run on a log."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
from test_fmu_export import Stepped

import obsynth
from obsynth import ObserverDesign, PolytopicSystem
from obsynth.exporting.fmu import archive
from obsynth.numerics.arrays import FloatArray
from obsynth.observers.nonlinear import c_code

fmpy = pytest.importorskip("fmpy", reason="fmpy is not installed (obsynth[fmu])")
pytestmark = pytest.mark.skipif(c_code.compiler() is None, reason="no C compiler")

_STATUSES = ("ok", "warm-up", "gap", "recovering", "out")


@pytest.fixture(autouse=True, scope="module")
def _compiled_in_less_time() -> Any:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(archive, "FLAGS", tuple("-O0" if flag == "-O2" else flag for flag in archive.FLAGS))
        yield


def _plant(shift: str | None = None, **more: Any) -> PolytopicSystem:
    return PolytopicSystem(
        plant={
            "A": [["0.6 + 0.1 * v", 0.2, 0], [-0.1, "0.5 - 0.1 * v", 0.1], [0.1, 0, "0.4 + 0.2 * v"]],
            "B": [[1.0], [0.0], [0.5]], "C": [[1, 0, 0], [0, 1, 0]], "Bf": [[1], [0.3], [0.1]],
            "Bd": [[0.4], [1], [0.2]], "dt": 0.5, "Bw": np.zeros((3, 2)).tolist(), "Dw": [[0.01, 0], [0, 0.02]],
            **more,
        },
        scheduling={"v": {"range": [-1, 1], "unit": "m/s", "column": "speed"}},
        shift=shift,
    )  # fmt: skip


def _rows(design: ObserverDesign, count: int = 160) -> FloatArray:
    """Return u, parameter, y in columns, absolute, with a fault, missing samples and parameters outside the region."""
    plant, rng = design.scheduled[0], np.random.default_rng(1)
    before = np.array([plant.operating_point.get(name, 0.0) for name in (*plant.input_names, *plant.output_names)])
    nu = len(plant.input_names)
    v, x, rows = rng.uniform(-1, 1, count), np.zeros(plant.nx), []
    for k in range(count):
        own, u = plant.at([v[k]]), rng.standard_normal(nu)
        y = own.C @ x + own.Dw @ rng.uniform(-3, 3, own.nw) if own.nw else own.C @ x
        rows.append([*(u + before[:nu]), v[k], *(y + before[nu:])])
        x = own.A @ x + own.B @ u + own.Bd[:, 0] * rng.uniform(-0.1, 0.1) + own.Bf[:, 0] * (3.0 if k >= 100 else 0.0)
    table = np.array(rows)
    table[2:4, nu] = 1.5
    table[0, nu + 1], table[60:63, nu + 2], table[80, nu], table[130, nu] = np.nan, np.nan, np.nan, -2.0
    return table


def _in_unit(design: ObserverDesign, folder: Path, rows: FloatArray, version: str, **options: Any) -> pd.DataFrame:
    dt = options.get("sample_time", design.observer.dt)
    (path,) = obsynth.export(design, folder / "region.fmu", fmi=version, **options)
    assert fmpy.validation.validate_fmu(str(path)) == []
    observer, stepped = design.observer, Stepped(path, folder / "unpacked")
    assert stepped.description.modelVariables[1 + len(observer.input_names)].causality == "input"
    shown = [name for name in stepped.references if name.startswith(("xhat[", "fhat[", "r["))]
    shown += [name for name in ("status", "statistic") if name in stepped.references]
    stepped.begin()
    found = []
    for k, row in enumerate(rows):
        stepped.set([stepped.references[name] for name in (*observer.input_names, *observer.output_names)], list(row))
        stepped.unit.doStep(currentCommunicationPoint=k * dt, communicationStepSize=dt)
        found.append([*stepped.values(shown), stepped.flag("alarm"), stepped.flag("sample_used")])
    stepped.end()
    return pd.DataFrame(found, columns=[*shown, "alarm", "sample_used"])


def _on_a_log(
    design: ObserverDesign, folder: Path, rows: FloatArray, names: Sequence[str] = (), dt: float = 0.0, **options: Any
) -> pd.DataFrame:
    dt = dt or design.observer.dt
    names = names or (*design.observer.input_names, *design.observer.output_names)
    log = pd.DataFrame({"time": dt * np.arange(len(rows)), **dict(zip(names, rows.T, strict=True))})
    obsynth.run_on_data(design, log, out=folder / "run.csv", **options)
    return pd.read_csv(folder / "run.csv")


def _same(unit: pd.DataFrame, run: pd.DataFrame) -> None:
    assert [_STATUSES[int(status)] for status in unit.status] == run.status.tolist()
    shown = [name for name in unit if name.startswith(("xhat[", "fhat[", "r["))]
    one, other = unit[shown].to_numpy(), run[shown].to_numpy()
    assert np.array_equal(np.isnan(one), np.isnan(other))
    assert np.nanmax(np.abs(one - other)) <= 1e-12 * max(1.0, np.nanmax(np.abs(other)))
    assert unit.alarm.tolist() == run.alarm.notna().tolist()
    assert unit.sample_used.tolist() == (run.status != "gap").tolist()


@pytest.mark.long
@pytest.mark.parametrize("version", ["2.0", "3.0"])
def test_a_unit_has_the_rows_statuses_and_alarms_of_a_run(tmp_path: Path, version: str) -> None:
    design = obsynth.fault_estimation_filter(_plant(operating_point={"u1": 2.0, "y1": 3.0, "y2": -1.0, "x1": 3.0}))
    monitor = obsynth.online_monitor(design, disturbance_bounds={"d1": 0.1}, noise_bound=3.0, initial_error=0.0)
    rows = _rows(design)
    unit = _in_unit(design, tmp_path, rows, version, monitor=monitor, warm_up=0.0)
    run = _on_a_log(design, tmp_path, rows, monitor=monitor, warm_up=0.0)
    _same(unit, run)
    assert 20 < unit.alarm.sum() < 70
    claimed = run.status == "ok"
    ratio = (run.statistic / run.threshold)[claimed].to_numpy()
    assert unit.statistic[claimed].to_numpy() == pytest.approx(ratio, rel=1e-12)
    assert unit.statistic[~claimed].isna().all()


@pytest.mark.long
def test_faults_that_turn_and_levels_are_in_a_unit(tmp_path: Path) -> None:
    plant = {
        "A": [[0.9, 0.1, 0], [0, "0.7 + 0.1 * v", 0.1], [0.1, 0, 0.8]], "C": np.eye(3).tolist(),
        "Bf": [["0.5 - 0.5 * v"], ["0.5 + 0.5 * v"], [0.3]], "Bd": [[0.2], [0.1], [0]], "dt": 1.0,
    }  # fmt: skip
    design = obsynth.fault_estimation_filter(PolytopicSystem(plant=plant, scheduling={"v": [-1, 1]}))
    rows, levels = _rows(design), {"fhat[f1]": 1.5}
    unit = _in_unit(design, tmp_path, rows, "2.0", thresholds=levels)
    _same(unit, _on_a_log(design, tmp_path, rows, thresholds=levels))
    assert unit.alarm.any()


@pytest.mark.long
def test_a_unit_has_no_input_that_is_one_in_every_row(tmp_path: Path) -> None:
    plant = _plant("one", B=[[1.0, "0.2 * v"], [0.0, 0.3], [0.5, 0.1]], input_names=("heat", "one"))
    design = obsynth.fault_estimation_filter(plant)
    rows = _rows(design)
    rows[:, 1] = 1.0
    names = (*design.observer.input_names, *design.observer.output_names)
    (path,) = obsynth.export(design, tmp_path / "region.fmu")
    stepped = Stepped(path, tmp_path / "unpacked")
    assert "one" not in stepped.references
    stepped.begin()
    read = np.array([name != "one" for name in names])
    shown = ("xhat[x1]", "xhat[x2]", "xhat[x3]", "fhat[f1]", "status")
    found = stepped.run([name for name in names if name != "one"], rows[:, read], 0.5, shown)
    stepped.end()
    run = _on_a_log(design, tmp_path, np.array(rows)[:, read], names=[n for n in names if n != "one"])
    assert [_STATUSES[int(status)] for status in found[:, -1]] == run.status.tolist()
    wanted = run[list(shown[:4])].to_numpy()
    assert np.array_equal(np.isnan(wanted), np.isnan(found[:, :4]))
    assert np.nanmax(np.abs(wanted - found[:, :4])) <= 1e-12 * np.nanmax(np.abs(wanted))


@pytest.mark.long
@pytest.mark.parametrize("version", ["2.0", "3.0"])
def test_an_observer_in_continuous_time_is_a_unit_of_its_sample_time(tmp_path: Path, version: str) -> None:
    plant = PolytopicSystem(
        plant={
            "A": [["-1 - v", 1], [0.2, -2]], "B": [[1], [0.5]], "Bf": [[0], [1]], "Bd": [[1], [0]],
            "C": [[1, 0], [0, 1]], "operating_point": {"u1": 2.0, "y1": 3.0, "x1": 3.0},
        },
        scheduling={"v": {"range": [0, 1], "rate": 30.0}},
    )  # fmt: skip
    design, levels = obsynth.ui_pi_observer(plant), {"fhat[f1]": 2.0}
    rng = np.random.default_rng(2)
    rows = np.column_stack([rng.standard_normal(160), rng.uniform(0.0, 1.0, 160), 3.0 * rng.standard_normal((160, 2))])
    rows[0, 3], rows[60:63, 2], rows[80, 1], rows[130, 1] = np.nan, np.nan, np.nan, -2.0
    unit = _in_unit(design, tmp_path, rows, version, sample_time=0.05, thresholds=levels, warm_up=0.2)
    run = _on_a_log(design, tmp_path, rows, dt=0.05, thresholds=levels, warm_up=0.2)
    _same(unit, run)
    assert {"ok", "out", "gap", "warm-up"} <= set(run.status)
    assert unit.alarm.any()
