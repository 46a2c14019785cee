"""Logs with flaws: blanks, gaps and what monitors say after them."""

from __future__ import annotations

import functools
import math
import shutil
import subprocess
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest

import obsynth
from obsynth.monitoring.logs.log_run import LogRun
from obsynth.observers.nonlinear.c_code import compiler

METHODS = ("functional-filter", "ui-pi-observer", "fault-estimation-filter")
DT, ROWS, BLANK = 0.1, 80, 50


@functools.cache
def heated() -> obsynth.DescriptorSystem:
    """Return two states that move and an algebraic one, reduced and sampled."""
    plant = obsynth.DescriptorSystem(
        E=[[1, 0, 0], [0, 1, 0], [0, 0, 0]], A=[[-0.5, 0.2, 0], [0.1, -0.4, 0.1], [1, 0.5, -1]], B=[[1], [0], [0]],
        C=["a", "b"], Bf=[[1], [0], [0]], Bd=[[0], [1], [0]], state_names=["a", "b", "c"], input_names=["u"],
        fault_names=["f"], disturbance_names=["d"], sensor_noise={"a": 0.01, "b": 0.01},
    )  # fmt: skip
    return obsynth.discretise(obsynth.eliminate_algebraic_states(plant), DT).plant


@functools.cache
def designed(method: str) -> obsynth.ObserverDesign:
    return obsynth.design(heated(), method)


def log(*, fault: float = 0.0, rows: int = ROWS) -> pd.DataFrame:
    """Return a log without noise, with a constant fault."""
    plant, x, found = heated(), np.zeros(2), []
    for k in range(rows):
        u = np.array([math.sin(k / 9.0)])
        found.append([k * DT, u[0], *(plant.C @ x)])
        x = plant.A @ x + plant.B @ u + plant.Bf @ np.array([fault])
    return pd.DataFrame(found, columns=["time", "u", "a", "b"])


@pytest.mark.one_in(6)
@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("blank", [["b"], ["a"], ["a", "b"], ["u"]])
def test_blank_cells_are_predicted_over_by_every_linear_method(method: str, blank: list[str]) -> None:
    data = log(fault=0.5)
    whole = obsynth.run_on_data(designed(method), data).table
    data.loc[BLANK, blank] = np.nan
    holed = obsynth.run_on_data(designed(method), data).table
    assert whole is not None
    assert holed is not None
    assert holed.status[BLANK] == "gap"
    # The model knows inputs and fault, so that nothing is lost by a blank output: the estimate goes on as it was.
    share = 0.02 if "u" not in blank else 0.2
    found = np.abs(holed["fhat[f]"] - whole["fhat[f]"]).to_numpy()
    assert found.max() <= share * 0.5


def test_a_state_of_a_filter_without_states_goes_on_as_if_it_had_not_been_saved(tmp_path: Path) -> None:
    data, state, design = log(fault=0.3), tmp_path / "state.json", designed("functional-filter")
    data.loc[BLANK : BLANK + 1, "a"] = np.nan
    whole = obsynth.run_on_data(design, data).table
    first = obsynth.run_on_data(design, data.iloc[: BLANK + 1], state=state).table
    second = obsynth.run_on_data(design, data.iloc[BLANK + 1 :], state=state).table
    pd.testing.assert_frame_equal(whole, pd.concat([first, second], ignore_index=True))


@pytest.mark.one_in(6)
@pytest.mark.parametrize("method", METHODS[1:])
@pytest.mark.parametrize("blank", [["a"], ["b"], ["a", "b"]])
def test_what_is_measured_is_taken_beside_blank_cells_and_rows_decide_again_within_noise(
    method: str, blank: list[str]
) -> None:
    plant, x, found = heated(), np.zeros(2), []
    for k in range(160):
        # A disturbance that the model of the plant does not know of while it stands in.
        found.append([k * DT, math.sin(k / 9.0), *(plant.C @ x)])
        x = plant.A @ x + plant.B @ [math.sin(k / 9.0)] + plant.Bf @ [0.5] + plant.Bd @ [0.3]
    data = pd.DataFrame(found, columns=["time", "u", "a", "b"])
    clean = obsynth.run_on_data(designed(method), data).table
    data.loc[100:104, blank] = np.nan
    holed = obsynth.run_on_data(designed(method), data).table
    assert clean is not None
    assert holed is not None
    assert (holed.status == "gap").sum() == 5
    after = holed.index > 104
    # Before, every one of these rows was blind for a whole warm-up, of 32 and 50 rows.
    assert (holed.status[after] == "recovering").sum() <= 25
    away = np.abs(holed["fhat[f]"] - clean["fhat[f]"])
    observer = designed(method).linear[1]
    rng = np.random.default_rng(0)
    noise = observer.run(0.01 * rng.standard_normal((4000, 2)), np.zeros((4000, 1))).faults[100:].std()
    # What a gap leaves where rows decide again is below what the stated noise of 0.01 makes of the estimate.
    assert away[after & (holed.status == "ok")].max() <= noise


@functools.cache
def motor(name: str) -> obsynth.ObserverDesign:
    spec = obsynth.load_spec(f"designs/motor/{name}.yaml")
    return obsynth.design(spec.plant, spec.method, **dict(spec.options))


@pytest.mark.long
@pytest.mark.parametrize("name", ["spec", "sampled"])
def test_levels_decide_at_once_after_a_gap_by_what_it_can_have_left(name: str) -> None:
    design, data = motor(name), pd.read_csv("designs/motor/log.csv").iloc[:1100]
    clean = obsynth.run_on_data(design, data).table
    assert clean is not None
    columns = [name for name in clean.columns if name.startswith(("fhat[", "r["))]
    # Nothing passes it without a gap; rows that count again have up to a usual change more.
    level = 2.0 * float(clean["fhat[torque]"].iloc[100:].abs().max())
    for blank in (["voltage"], ["voltage", "theta l"], ["i"], ["theta l"], ["theta m", "theta l", "i"]):
        holed = data.copy()
        for first in (400, 420, 600, 800):
            holed.loc[first : first + 2, blank] = np.nan
        rows = LogRun(design).estimates(holed["time"].tolist(), holed.iloc[:, 1:].to_numpy())
        after = [k for k, row in enumerate(rows) if row.status == "recovering"]
        assert {403, 423, 603, 803} <= set(after)
        excess = np.array([rows[k].excess for k in after])
        away = np.abs([rows[k].values for k in after] - clean[columns].to_numpy()[after])
        # 1e-9: rounding of residuals that are differences of terms of 1e3.  In a residual, misses that are not the same
        # all through the gap may leave more, as those that are cancel there: 2 rows of 300.
        assert (away <= excess + 1e-9)[:, columns.index("fhat[torque]")].all()
        assert (away <= 2.5 * excess + 1e-9).all()
        run = obsynth.run_on_data(design, holed, thresholds={"fhat[torque]": level})
        assert run.silent == {"warm-up": run.statuses["warm-up"], "gap": run.statuses["gap"]}
        assert all(event.first_row < 100 for event in run.events)
    # A sensor that moves far in a row that was blind before.
    holed.loc[805:, "i"] += 60.0
    rows = LogRun(design).estimates(holed["time"].tolist(), holed.iloc[:, 1:].to_numpy())
    table = obsynth.run_on_data(design, holed, thresholds={"fhat[torque]": level}).table
    assert table is not None
    at, blind = columns.index("fhat[torque]"), [k for k in range(803, 860) if rows[k].status == "recovering"]
    passed = [k for k in blind if abs(rows[k].values[at]) > level + rows[k].excess[at]]
    assert passed
    assert [k for k in blind if table["alarm"][k]] == passed


def test_what_a_gap_has_left_goes_on_over_a_saved_state(tmp_path: Path) -> None:
    design, level, state = motor("sampled"), {"fhat[torque]": 0.03}, tmp_path / "state.json"
    data = pd.read_csv("designs/motor/log.csv").iloc[:460]
    data.loc[400:402, "i"] = data.loc[410, "theta m"] = np.nan
    whole = obsynth.run_on_data(design, data, thresholds=level).table
    parts = [obsynth.run_on_data(design, data.iloc[rows], thresholds=level, state=state).table
             for rows in (slice(0, 402), slice(402, 405), slice(405, 411), slice(411, None))]  # fmt: skip
    pd.testing.assert_frame_equal(whole, pd.concat(parts, ignore_index=True))


@functools.cache
def drive() -> obsynth.ObserverDesign:
    spec = obsynth.load_spec("designs/drive/spec.yaml")
    return obsynth.design(spec.plant, spec.method, **dict(spec.options))


@pytest.mark.one_in(4)
@pytest.mark.parametrize("start", [{"initial_set": 0.2}, {"initial_error": 0.5}, {}])
@pytest.mark.parametrize("gap", [["motor speed"], "row", "rows left out"])
def test_nothing_is_decided_until_a_gap_has_settled_whatever_the_warm_up(start: dict[str, float], gap: Any) -> None:
    design, plant = drive(), drive().plant
    told: dict[str, Any] = dict(start)
    if "initial_set" in told:
        told["initial_set"] = dict.fromkeys(plant.state_names, told["initial_set"])
    monitor = obsynth.online_monitor(design, disturbance_bounds={"load torque": 0.2}, noise_bound=3**0.5, **told)
    rng = np.random.default_rng(1)
    count = 110
    x, y = 0.2 * rng.uniform(-1, 1, 3), []
    u = np.sign(np.sin(2 * np.pi * np.arange(count) / 100))[:, None]
    for k in range(count):
        y.append(plant.C @ x + 0.002 * rng.uniform(-1, 1, 2))
        x = plant.A @ x + plant.B @ u[k] + plant.Bd @ (0.2 * rng.uniform(-1, 1, 1))
    signals = dict(zip(plant.output_names, np.array(y).T, strict=True))
    data = pd.DataFrame({"time": np.arange(count) * plant.dt, "torque": u[:, 0], **signals})
    if gap == "rows left out":
        data = data.drop(index=range(60, 65))
    else:
        data.loc[60:64, gap if gap != "row" else list(signals)] = np.nan
    run = obsynth.run_on_data(design, data, monitor=monitor, warm_up=0.0 if "initial_set" in start else None)
    assert run.alarms == {}


@functools.cache
def pointwise(name: str) -> tuple[obsynth.ObserverDesign, Any]:
    design = drive() if name == "drive" else designed(name)
    (disturbance,) = design.plant.disturbance_names
    return design, obsynth.online_monitor(design, disturbance_bounds={disturbance: 0.2}, noise_bound=3**0.5)


def turning(design: obsynth.ObserverDesign, *, rows: int = 330, fault: float = 0.0) -> pd.DataFrame:
    """A log whose disturbance changes its sign at row 250, where a fault begins, too."""
    plant = design.linear[0]
    x, y, u = np.zeros(plant.nx), [], np.sign(np.sin(2 * np.pi * np.arange(rows) / 100))
    for k in range(rows):
        y.append(plant.C @ x)
        sign = 1.0 if k < 250 else -1.0
        x = plant.A @ x + plant.B @ u[k : k + 1] + plant.Bd @ [0.2 * sign] + plant.Bf @ [fault * (k >= 250)]
    signals = dict(zip(plant.output_names, np.array(y).T, strict=True))
    return pd.DataFrame({"time": np.arange(rows) * plant.dt, plant.input_names[0]: u, **signals})


@pytest.mark.one_in(6)
@pytest.mark.parametrize("blank", [(0,), (1,), (0, 1)])
@pytest.mark.parametrize("name", ["drive", *METHODS[1:]])
def test_a_pointwise_threshold_grows_by_what_missing_outputs_hide_and_decides_at_once(name: str, blank: Any) -> None:
    design, monitor = pointwise(name)
    data = turning(design)
    data.loc[250:269, [design.plant.output_names[i] for i in blank]] = np.nan
    run = obsynth.run_on_data(design, data, monitor=monitor)
    assert run.table is not None
    assert run.alarms == {}
    after = run.table[data.index >= 270]
    assert np.isfinite(after["statistic"]).all()
    assert set(run.silent) == {"warm-up", "gap"}
    # The bound without the gap would have been passed by a log without a fault.
    assert after["statistic"].max() > monitor.rule.limit or name == "fault-estimation-filter"
    assert monitor.rule.limit < after["threshold"].iloc[-1] < after["threshold"].max()


def test_a_fault_is_told_in_rows_that_were_blind_after_a_gap() -> None:
    design, monitor = pointwise("drive")
    data = turning(design, fault=20.0)
    data.loc[255:257, ["motor speed"]] = np.nan
    run = obsynth.run_on_data(design, data, monitor=monitor)
    assert run.table is not None
    told = run.table.index[run.table["alarm"] != ""]
    assert run.table["status"][258] == "recovering"
    assert 258 in told


def test_what_a_pointwise_threshold_has_grown_by_goes_on_over_a_saved_state(tmp_path: Path) -> None:
    design, monitor = pointwise("ui-pi-observer")
    data, state = turning(design), tmp_path / "state.json"
    data.loc[250:252, "a"] = data.loc[258, "b"] = np.nan
    whole = obsynth.run_on_data(design, data, monitor=monitor).table
    parts = [obsynth.run_on_data(design, data.iloc[rows], monitor=monitor, state=state).table
             for rows in (slice(0, 251), slice(251, 255), slice(255, None))]  # fmt: skip
    pd.testing.assert_frame_equal(whole, pd.concat(parts, ignore_index=True))


def test_a_pointwise_threshold_waits_where_nothing_bounds_what_is_missing() -> None:
    design, monitor = pointwise("drive")
    data = turning(design)
    holed = data.copy()
    holed.loc[250, "torque"] = np.nan
    # A row that is left out has no inputs either.
    for flawed_log in (holed, data.drop(index=250)):
        table = obsynth.run_on_data(design, flawed_log, monitor=monitor).table
        assert table is not None
        assert np.isnan(table["statistic"].to_numpy()[251])
        assert np.isfinite(table["statistic"].iloc[-1])
    waits = obsynth.online_monitor(motor("spec"), sample_time=0.005, disturbance_bounds={"load torque": 1.0},
                                   noise_bound=3.0)  # fmt: skip
    assert "nothing is decided, as between samples of a continuous design" in waits.statement
    assert "it is larger by the possible error of the plant's model" in monitor.statement


def test_a_bound_of_the_noise_needs_noise_that_is_stated() -> None:
    plant = obsynth.DescriptorSystem(
        E=np.eye(2), A=[[0.9, 0.1], [0, 0.8]], B=[[0], [1]], C=np.eye(2), Bf=[[0], [1]], Bd=[[1], [0]], dt=1.0,
        state_names=["a", "b"], input_names=["u"], fault_names=["f"], disturbance_names=["d"],
    )  # fmt: skip
    design = obsynth.design(plant, "fault-estimation-filter")
    for kind in ("pointwise", "window"):
        with pytest.raises(obsynth.SpecError, match="sensor_noise"):
            obsynth.online_monitor(design, kind, disturbance_bounds={"d": 0.1}, noise_bound=4.0)


def test_powers_of_matrices_whose_entries_cancel_are_those_of_their_eigenvalues() -> None:
    from obsynth.monitoring.thresholds.residual_model import schur_form
    from obsynth.monitoring.thresholds.residual_norm_bounds import samples_of

    turned = np.array([[1.0, 1e7], [0.0, 1.0]])
    matrix = turned @ np.diag([0.5, 0.4]) @ np.linalg.inv(turned)
    triangular, basis = schur_form(matrix)
    np.testing.assert_allclose((basis @ triangular @ basis.conj().T).real, matrix, atol=1e-8 * 1e7)
    count = samples_of(matrix, 1)
    assert 16 <= count <= 129


@pytest.mark.parametrize("name", ["wang2015", "filasova"])
def test_shipped_designs_are_compared(name: str) -> None:
    spec = obsynth.load_spec(f"designs/{name}/spec.yaml")
    scenario = spec.scenario.replace(horizon=min(spec.scenario.horizon, 120.0 if name == "wang2015" else 13.0))
    found = obsynth.compare(spec.plant, scenario=scenario, runs=1, methods=["fault-estimation-filter"])
    assert np.isfinite(found.methods[0].relative_error)


@pytest.mark.skipif(compiler() is None, reason="no C compiler")
def test_all_that_casadi_writes_is_static(tmp_path: Path) -> None:
    import casadi as ca

    from obsynth.observers.nonlinear.c_code import _generated

    x = ca.SX.sym("x", 2)
    code = _generated(
        {"project": ca.Function("project", [x], [ca.fmax(ca.fabs(x), ca.sign(x)), ca.solve(ca.diag(x), x)])}
    )
    (tmp_path / "one.c").write_text(code)
    command = compiler()
    assert command is not None
    subprocess.run([*command, "-std=c99", "-c", "one.c"], cwd=tmp_path, check=True)
    symbols = subprocess.run(["nm", "-g", "--defined-only", "one.o"], cwd=tmp_path, check=True, capture_output=True)
    assert symbols.stdout.decode().strip() == ""


@pytest.mark.skipif(shutil.which("g++") is None or compiler() is None, reason="no compiler of C++")
def test_exported_observers_are_called_from_cplusplus(tmp_path: Path) -> None:
    for name in ("one", "two"):
        obsynth.export(designed("fault-estimation-filter"), tmp_path / f"{name}.c")
    main = "int main() { one_state a; two_state b; one_reset(&a); two_reset(&b); return 0; }\n"
    (tmp_path / "main.cpp").write_text(f'#include "one.h"\n#include "two.h"\n{main}')
    command = compiler()
    assert command is not None
    subprocess.run([*command, "-std=c99", "-c", "one.c", "two.c"], cwd=tmp_path, check=True)
    subprocess.run(["g++", "-Wall", "main.cpp", "one.o", "two.o", "-o", "main"], cwd=tmp_path, check=True)
    subprocess.run([tmp_path / "main"], check=True)


DIALECTS = {
    "commas": {"sep": ","},
    "semicolons and decimal commas": {"sep": ";", "decimal": ","},
    "tabs": {"sep": "\t"},
    "bars": {"sep": "|"},
}


@pytest.mark.parametrize("dialect", DIALECTS)
@pytest.mark.parametrize("dated", [False, True])
def test_all_commands_read_the_same_logs(tmp_path: Path, dialect: str, dated: bool) -> None:
    from obsynth.monitoring.calibration.logs import read_log
    from obsynth.studies.compared_records import ComparedLog

    data, plain = log(), log()
    if dated:
        data["time"] = pd.to_datetime(data["time"], unit="s", origin="2026-05-01").dt.strftime("%Y-%m-%dT%H:%M:%S.%f")
    data = data.rename(columns={"time": "stamp", "a": "sensor a"})[["b", "sensor a", "stamp", "u"]]
    data["remark"] = "some text"
    file, columns = tmp_path / "log.csv", {"time": "stamp", "a": "sensor a"}
    data.to_csv(file, index=False, **DIALECTS[dialect])
    read = read_log(file, ["u"], ["a", "b"], columns=columns)
    np.testing.assert_allclose(read.y, plain[["a", "b"]].to_numpy())
    np.testing.assert_allclose(read.dt, DT)
    compared = ComparedLog(file, columns, {"b": 2.0}).record(heated())
    np.testing.assert_allclose(compared.y, plain[["a", "b"]].to_numpy() * [1.0, 2.0])
    found = obsynth.run_on_data(designed("ui-pi-observer"), file, columns=columns).measured
    assert found is not None
    np.testing.assert_allclose(found[["u", "a", "b"]], plain[["u", "a", "b"]])
    frame = read_log(pd.read_csv(file, **DIALECTS[dialect]), ["u"], ["a", "b"], columns=columns)
    np.testing.assert_allclose(frame.u, read.u)


def test_a_log_without_stamps_takes_those_that_are_told(tmp_path: Path) -> None:
    from obsynth.monitoring.calibration.logs import read_log

    log().drop(columns="time").to_csv(tmp_path / "log.csv", index=False, sep=";", decimal=",")
    read = read_log(tmp_path / "log.csv", ["u"], ["a", "b"], dt=DT)
    np.testing.assert_allclose(read.time, log()["time"])
    with pytest.raises(obsynth.SpecError, match="has no column 'time'"):
        read_log(tmp_path / "log.csv", ["u"], ["a", "b"])
    with pytest.raises(obsynth.SpecError, match="has no column 'c'"):
        read_log(tmp_path / "log.csv", ["u"], ["a", "c"], dt=DT)


def test_the_summary_lists_alarms_and_rows_that_could_not_alarm() -> None:
    from obsynth.monitoring.run_summary import summary_of_run

    data = log(rows=160)
    data.loc[60:80, "a"] += 1.0
    data.loc[130:, "a"] += 2.0
    data.loc[100, "b"] = np.nan
    run = obsynth.run_on_data(designed("ui-pi-observer"), data, thresholds={"fhat[f]": 0.5})
    first, *_, last = run.events
    table = run.table
    assert table is not None
    assert (first.by, first.fault) == ("fhat[f]", "f")
    assert last.last_row <= 160
    alarmed = table.index[table["alarm"] != ""] + 1
    assert sum(event.rows for event in run.events) == len(alarmed)
    assert (first.first_row, last.last_row) == (alarmed[0], alarmed[-1])
    largest = table.loc[first.first_row - 1 : first.last_row - 1, "fhat[f]"]
    assert abs(first.size) == largest[table["alarm"] != ""].abs().max()
    assert first.evidence == pytest.approx(abs(first.size) / 0.5)
    could = table["status"].isin(["ok", "partial", "recovering"]).sum()
    assert sum(run.silent.values()) == len(table) - could
    printed = summary_of_run(run, None)
    assert "alarm by" in printed
    assert " kW" not in printed
    rows = [line for line in summary_of_run(run, None, {"f": "kW"}).splitlines() if line.startswith("  fhat[f]")]
    assert len(rows) == len(run.events)
    assert all(" kW" in row for row in rows)
    assert f"{len(table) - could} of 160 rows: " in printed
    quiet = summary_of_run(obsynth.run_on_data(designed("ui-pi-observer"), log(), thresholds={"fhat[f]": 50.0}), None)
    assert "No alarm by any threshold in the" in quiet
    short = summary_of_run(obsynth.run_on_data(designed("ui-pi-observer"), log(rows=5), thresholds={"r[a]": 9.0}), None)
    assert "No alarm" not in short
    assert "No decision in the first 5 of 5 rows" in short


def test_a_stream_keeps_its_state_every_few_rows(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    import io

    from obsynth.monitoring.logs import run as runs

    saved: list[int] = []
    real = runs.save_state

    def spied(path: Path, job: Any, digest: str) -> None:
        saved.append(job.rows)
        real(path, job, digest)

    monkeypatch.setattr(runs, "save_state", spied)
    text, state, out = io.StringIO(log().to_csv(index=False)), tmp_path / "state.json", io.StringIO()
    obsynth.run_on_data(designed("ui-pi-observer"), text, out, state=state, state_every=20)
    assert saved[:4] == [20, 40, 60, 80]
    with pytest.raises(obsynth.SpecError, match="state_every"):
        obsynth.run_on_data(designed("ui-pi-observer"), log(), state_every=0)


def flawed(flaw: str, rows: int = 200) -> pd.DataFrame:
    """Return a log with one flaw after row 40; what is measured there is as it would be without."""
    data, rng = log(fault=0.5, rows=rows), np.random.default_rng(5)
    if flaw == "blank cell":
        data.loc[60, "b"] = np.nan
    if flaw == "blank row":
        data.loc[60, ["u", "a", "b"]] = np.nan
    if flaw == "gap":
        data = data.drop(index=range(60, 65))
    if flaw == "repeated stamp":
        data = pd.concat([data.iloc[:61], data.iloc[60:]])
    if flaw == "out of order":
        data = pd.concat([data.iloc[:61], data.iloc[55:56], data.iloc[61:]])
    if flaw == "jitter":
        data["time"] += DT * rng.uniform(-0.2, 0.2, len(data))
    if flaw == "text cell":
        data["b"] = data["b"].astype(object)
        data.loc[60, "b"] = "I/O Timeout"
    if flaw == "column order":
        data = data[["b", "u", "time", "a"]]
    return data.reset_index(drop=True)


FLAWS = ("blank cell", "blank row", "gap", "repeated stamp", "out of order", "jitter", "text cell", "column order")


@pytest.mark.one_in(4)
@pytest.mark.parametrize("flaw", FLAWS)
@pytest.mark.parametrize("method", METHODS[1:])
@pytest.mark.parametrize("way", ["frame", "stream"])
def test_runs_live_on_over_flaws_and_keep_the_estimate(tmp_path: Path, method: str, flaw: str, way: str) -> None:
    import io

    data = flawed(flaw)
    text = io.StringIO(data.to_csv(index=False))
    if way == "frame":
        table = obsynth.run_on_data(designed(method), data).table
    else:
        out = io.StringIO()
        obsynth.run_on_data(designed(method), text, out)
        table = pd.read_csv(io.StringIO(out.getvalue()))
    assert table is not None
    assert len(table) == len(data)
    told = {
        "blank cell": "gap",
        "blank row": "gap",
        "text cell": "gap",
        "repeated stamp": flaw,
        "out of order": flaw,
    }.get(flaw, "ok")
    assert told in set(table["status"])
    # Rows that may alarm say what they say of a clean log, but for the 2 % that a gap leaves of the states.
    clean = obsynth.run_on_data(designed(method), log(fault=0.5, rows=200)).table
    assert clean is not None
    well = table[(table["status"] == "ok") & (table.index > 62)]
    assert len(well) >= 20
    same = clean["fhat[f]"].to_numpy()[np.round(well["time"] / DT).astype(int)]
    np.testing.assert_allclose(well["fhat[f]"], same, atol=0.02)


@pytest.mark.one_in(6)
@pytest.mark.parametrize("flaw", FLAWS)
def test_a_slow_filter_lives_on_too(flaw: str) -> None:
    data = flawed(flaw)
    table = obsynth.run_on_data(designed("functional-filter"), data, warm_up=0.0).table
    clean = obsynth.run_on_data(designed("functional-filter"), log(fault=0.5, rows=200), warm_up=0.0).table
    assert table is not None
    assert clean is not None
    well = table[(table["status"] == "ok") & (table.index > 70)]
    same = clean["fhat[f]"].to_numpy()[np.round(well["time"] / DT).astype(int)]
    np.testing.assert_allclose(well["fhat[f]"], same, atol=0.05)


def test_stamps_that_never_rise_or_of_another_sampling_time_are_errors() -> None:
    data = log()
    stuck = data.assign(time=np.minimum(data["time"], 3.0))
    with pytest.raises(obsynth.SpecError, match="repeats the time"):
        obsynth.run_on_data(designed("ui-pi-observer"), stuck)
    for factor in (1.05, 1.1, 1.3, 1.5, 2.0, 0.5):
        with pytest.raises(obsynth.SpecError, match=r"dt = 0\.1|needs 0\.1 s"):
            obsynth.run_on_data(designed("ui-pi-observer"), data.assign(time=factor * data["time"]))


def test_rows_are_left_out_across_a_saved_state(tmp_path: Path) -> None:
    data, state = flawed("out of order"), tmp_path / "state.json"
    whole = obsynth.run_on_data(designed("ui-pi-observer"), data).table
    parts = [obsynth.run_on_data(designed("ui-pi-observer"), part, state=state).table
             for part in (data.iloc[:61], data.iloc[61:])]  # fmt: skip
    pd.testing.assert_frame_equal(whole, pd.concat(parts, ignore_index=True))


@pytest.mark.parametrize("method", METHODS[1:])
def test_one_blank_cell_does_not_blind_for_a_warm_up(method: str) -> None:
    rng, blanks = np.random.default_rng(6), range(90, 240, 15)
    data = log(fault=0.5, rows=260)
    data[["a", "b"]] += 0.01 * rng.standard_normal((260, 2))
    clean = obsynth.run_on_data(designed(method), data).table
    for row in blanks:
        data.loc[row, "b"] = np.nan
    table = obsynth.run_on_data(designed(method), data).table
    assert table is not None
    assert clean is not None
    counts = table["status"].value_counts()
    assert counts["gap"] == len(blanks)
    assert counts.get("recovering", 0) <= 10 * len(blanks)
    well = table["status"] == "ok"
    away = (table["fhat[f]"] - clean["fhat[f]"])[well]
    # What is left of a gap stays below half of what the estimate changes by from row to row; gaps may add up.
    usual = np.sqrt(np.mean(np.diff(clean["fhat[f]"][60:]) ** 2))
    assert np.sqrt(np.mean(away**2)) <= usual


@functools.cache
def recursive() -> obsynth.ObserverDesign:
    plant = heated()
    varying = obsynth.TimeVaryingDescriptorSystem(
        E=plant.E, A=plant.A, B=plant.B, C=plant.C, Phi=plant.Bf, dt=plant.dt, parameter_names=["f"],
        input_names=["u"], output_names=["a", "b"], state_names=["a", "b"],
    )  # fmt: skip
    return obsynth.adaptive_observer(
        varying, Q=1e-4 * np.eye(2), R=1e-4 * np.eye(2), forgetting=0.98, initial_state=[0.0, 0.0],
        initial_covariance=np.eye(2), initial_parameters=[0.0], initial_parameter_covariance=[[1.0]],
    )  # fmt: skip


MORE_FLAWS = (*FLAWS, "outlier", "stuck sensor")


def more_flawed(flaw: str, rows: int = 200) -> pd.DataFrame:
    data = flawed(flaw, rows)
    if flaw == "outlier":
        data.loc[60, "b"] += 50.0
    if flaw == "stuck sensor":
        data.loc[150:, "b"] = data.loc[150, "b"]
    return data


@pytest.mark.one_in(4)
@pytest.mark.parametrize("flaw", MORE_FLAWS)
def test_recursive_designs_live_on_over_flaws(flaw: str) -> None:
    data = more_flawed(flaw)
    run = obsynth.run_on_data(recursive(), data)
    table = run.table
    assert table is not None
    assert len(table) == len(data)
    if flaw == "stuck sensor":
        return
    # One sample, or some rows, cost no more than three of the deviations that the observer states.
    away = np.abs(table["fhat[f]"] - 0.5)[70:]
    assert (away <= 3.0 * table["sd fhat[f]"][70:] + 0.05).all()
    assert run.outliers == ({"b": 1} if flaw == "outlier" else {})


@pytest.mark.one_in(9)
@pytest.mark.parametrize("flaw", MORE_FLAWS)
@pytest.mark.parametrize("kind", ["linear", "recursive"])
def test_thresholds_are_learned_over_flaws(flaw: str, kind: str) -> None:
    design, rng = recursive() if kind == "recursive" else designed("ui-pi-observer"), np.random.default_rng(8)
    data = more_flawed(flaw, 300)
    for name in ("a", "b"):
        noisy = [cell if isinstance(cell, str) else cell + 0.01 * rng.standard_normal() for cell in data[name]]
        data[name] = noisy
    learned = obsynth.learn_thresholds(design, data)
    assert np.isfinite(learned.levels).all()
    assert learned.rows >= 100


@pytest.mark.parametrize("flaw", ["repeated stamp", "out of order"])
def test_an_alarm_is_proved_from_the_rows_that_a_run_takes(flaw: str) -> None:
    from obsynth.monitoring.alarms.proving import rows_of

    data = flawed(flaw)
    design = designed("fault-estimation-filter")
    found, clean = rows_of(design, data, 100), rows_of(design, log(fault=0.5, rows=200), 99)
    np.testing.assert_array_equal(found, clean)
    with pytest.raises(obsynth.SpecError, match="is left out"):
        rows_of(design, data, 62)


@pytest.mark.parametrize("flaw", ["blank cell", "blank row", "gap", "repeated stamp", "out of order", "jitter"])
def test_calibration_reads_the_rows_that_a_run_takes(flaw: str) -> None:
    from obsynth.monitoring.calibration.logs import read_log

    data, clean = flawed(flaw), read_log(log(fault=0.5, rows=200), ["u"], ["a", "b"])
    found = read_log(data, ["u"], ["a", "b"], dt=DT)
    assert found.samples == 200
    same = np.isfinite(found.y).all(axis=1)
    assert same.sum() >= 195
    np.testing.assert_array_equal(found.y[same], clean.y[same])
    assert np.isfinite(found.u).all()
    if flaw in ("blank row", "repeated stamp", "out of order"):
        assert found.notes
    stuck = data.assign(time=np.minimum(data["time"], 3.0))
    with pytest.raises(obsynth.SpecError, match="must rise"):
        read_log(stuck, ["u"], ["a", "b"], dt=DT)


@pytest.mark.one_in(4)
@pytest.mark.parametrize("flaw", ["blank cell", "blank row", "gap", "text cell"])
def test_a_comparison_replays_a_log_with_flaws(flaw: str) -> None:
    data = flawed(flaw)
    data["f"] = 0.5
    plant = heated()
    scenario = obsynth.Scenario(horizon=10.0, faults={"f": obsynth.Step(size=0.5, start=0.0)})
    found = obsynth.compare(plant, scenario=scenario, runs=1, methods=["ui-pi-observer"], data=data)
    assert np.isfinite(found.methods[0].relative_error)
    assert found.methods[0].faults[0].rms < 0.2


@pytest.mark.long
def test_rows_after_a_missing_sample_count_by_no_more_than_the_observer_says() -> None:
    from obsynth.monitoring.thresholds.monitor import Sample
    from obsynth.numerics.square_root_estimation import ParameterState
    from obsynth.observers.recursive.sample import RawEstimate

    design, rng, data = recursive(), np.random.default_rng(8), log(fault=0.5, rows=300)
    data[["a", "b"]] += 0.01 * rng.standard_normal((300, 2))
    rule = obsynth.online_monitor(design, "learned", normal=obsynth.learn_thresholds(design, data)).rule
    state, none, nothing = rule.init(), np.zeros((0, 0)), np.zeros(0)
    for k in range(200):
        lost, far = k == 150, 50.0 if k in (151, 199) else 0.0
        residuals = np.array([far, np.nan if lost else 0.0])
        known = ParameterState(np.zeros(1), np.zeros((1, 1)), np.zeros((1, 1)))
        innovation = np.array([0.3, 0.4])
        said = RawEstimate(k, nothing, none, none, known, innovation, np.zeros((2, 1)), innovation, residuals)
        state, judged = rule.step(state, Sample(k * DT, residuals, np.zeros(1), said))
        if k == 150:
            assert 0.0 <= judged.statistic < 0.1  # decided by the rows before it, which hold nothing
        if k == 151:
            assert np.linalg.norm(state.white[-1]) <= 0.5 + 1e-12
    assert np.linalg.norm(state.white[-1]) > 5.0


def test_linear_observers_run_in_batches_and_say_what_decides_of_them() -> None:
    design = designed("fault-estimation-filter")
    observer, rng = design.linear[1], np.random.default_rng(2)
    y, u = rng.standard_normal((3, 20, 2)), rng.standard_normal((20, 1))
    batch = obsynth.run_batch(observer, y, u)
    for i in range(3):
        alone = observer.run(y[i], u)
        for name in ("states", "faults", "residuals"):
            np.testing.assert_array_equal(getattr(batch, name)[i], getattr(alone, name))
    each = obsynth.run_batch(observer, y, np.stack([u, 2.0 * u, u]))
    np.testing.assert_array_equal(each.faults[1], observer.run(y[1], 2.0 * u).faults)
    y[1, 4, 0] = np.nan
    with pytest.raises(obsynth.SpecError, match="y"):
        obsynth.run_batch(observer, y, u)
    with pytest.raises(obsynth.SpecError, match="compiled"):
        obsynth.run_batch(observer, y[:1], u, compiled=True)
    for what in (design, None):
        with pytest.raises(obsynth.SpecError, match=r"design\.observer"):
            obsynth.run_batch(what, y[:1], u)
    for what in (design, observer):
        with pytest.raises(obsynth.SpecError, match="online_monitor"):
            obsynth.decide(what, alone)
    with pytest.raises(obsynth.SpecError, match="Estimates"):
        obsynth.decide(recursive().observer, [1.0])


@pytest.mark.one_in(6)
@pytest.mark.parametrize("blank", [["a"], ["b"], ["a", "b"]])
@pytest.mark.parametrize("method", METHODS[1:])
def test_a_blank_cell_of_a_plant_at_rest_starts_nothing_again(method: str, blank: list[str]) -> None:
    """Its log is noise alone, which the plant's model misses by about its whole size."""
    data = log(rows=400)
    data[["u", "a", "b"]] = np.hstack([np.zeros((400, 1)), 0.01 * np.random.default_rng(4).standard_normal((400, 2))])
    clean = obsynth.run_on_data(designed(method), data).table
    assert clean is not None
    columns = [name for name in clean.columns if name.startswith(("fhat[", "r["))]
    data.loc[100:390:29, blank] = np.nan
    rows = LogRun(designed(method)).estimates(data["time"].tolist(), data.iloc[:, 1:].to_numpy())
    assert "warm-up" not in {row.status for row in rows[100:]}
    places = [list(LogRun(designed(method)).observer.columns).index(name) for name in columns]
    after = [k for k, row in enumerate(rows) if row.status == "recovering"]
    assert {101 + 29 * i for i in range(10)} <= set(after)
    # What is left where rows decide again is within what the stated noise makes of these columns.
    observer = designed(method).linear[1]
    rng = np.random.default_rng(0)
    found = observer.run(0.01 * rng.standard_normal((4000, 2)), np.zeros((4000, 1)))
    noise = np.hstack([found.faults, found.residuals])[100:].std(axis=0)
    decided = [k for k, row in enumerate(rows) if row.status == "ok" and k > 100]
    left = np.abs([rows[k].values[places] for k in decided] - clean[columns].to_numpy()[decided])
    assert (left <= 2.0 * noise).all()
