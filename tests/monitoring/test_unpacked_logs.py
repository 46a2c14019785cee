"""Workbooks, compressed texts, arrays and tables of other libraries are the log that their columns are."""

from __future__ import annotations

import gzip
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
import scipy.io

import obsynth
from obsynth import SpecError
from obsynth.cli.main import main
from obsynth.monitoring.logs.log_tables import log_table

ROWS = 40
DAY = 86400.0


@pytest.fixture(scope="module")
def design() -> obsynth.ObserverDesign:
    plant = obsynth.DescriptorSystem(
        None, [[0.8, 0.1], [0.0, 0.7]], [[0.0], [1.0]], ["level", "flow"], Bf=[[0.0], [1.0]], dt=0.5,
        state_names=["level", "flow"], input_names=["valve"], fault_names=["leak"],
        sensor_noise={"level": 0.01, "flow": 0.01},
    )  # fmt: skip
    return obsynth.fault_estimation_filter(plant, name="tank")


@pytest.fixture(scope="module")
def frame() -> pd.DataFrame:
    rng = np.random.default_rng(3)
    times = {"time": 0.5 * np.arange(ROWS)}
    return pd.DataFrame(times | {name: np.round(rng.normal(size=ROWS), 3) for name in ("valve", "level", "flow")})


def _same(
    design: obsynth.ObserverDesign, data: object, frame: pd.DataFrame, **options: object
) -> obsynth.types.DataRun:
    run = obsynth.run_on_data(design, data, **options)
    wanted = obsynth.run_on_data(design, frame).table
    found, wanted = (table.drop(columns=[name for name in table if "time" in name]) for table in (run.table, wanted))
    pd.testing.assert_frame_equal(found, wanted, check_dtype=False, atol=1e-12)
    return run


@pytest.mark.parametrize("suffix", [".csv.gz", ".tsv.gz", ".CSV.GZ"])
@pytest.mark.parametrize("encoding", ["utf-8", "utf-16"])
def test_a_compressed_text_is_the_text(design, frame, tmp_path: Path, suffix: str, encoding: str) -> None:
    separator = "\t" if "tsv" in suffix else ","
    path = tmp_path / f"log{suffix}"
    path.write_bytes(gzip.compress(frame.to_csv(index=False, sep=separator).encode(encoding)))
    _same(design, path, frame)
    found, header, _ = log_table(path, ["level"])
    assert header == list(frame.columns)
    assert np.array_equal(found["level"], frame["level"])


def test_a_damaged_compressed_text_is_refused_in_a_sentence(design, frame, tmp_path: Path) -> None:
    path = tmp_path / "log.csv.gz"
    whole = gzip.compress(frame.to_csv(index=False).encode())
    for data in (whole[: len(whole) // 2], b"time,valve\n", whole[:20] + b"\0\xff" * 40 + whole[60:]):
        path.write_bytes(data)
        with pytest.raises(SpecError, match=r"log\.csv\.gz cannot be read"):
            obsynth.run_on_data(design, path)


def _struct(frame: pd.DataFrame, path: Path) -> None:
    scipy.io.savemat(path, {"rig": {name: frame[[name]].to_numpy() for name in frame}, "note": "x"})


def _columns(frame: pd.DataFrame, path: Path) -> None:
    scipy.io.savemat(path, {name: frame[name].to_numpy() for name in frame} | {"gain": np.eye(3)})


def _npz(frame: pd.DataFrame, path: Path) -> None:
    np.savez(path, **{name: frame[name].to_numpy() for name in frame}, gain=np.eye(3))


@pytest.mark.parametrize(("name", "write"), [("a.mat", _struct), ("b.mat", _columns), ("c.npz", _npz)])
def test_arrays_in_files_are_columns_by_their_names(design, frame, tmp_path: Path, name: str, write) -> None:
    write(frame, tmp_path / name)
    _same(design, tmp_path / name, frame)
    found, header, _ = log_table(tmp_path / name, ["level"])
    assert {"time", "valve", "level", "flow"} <= set(header)
    assert np.array_equal(found["level"], frame["level"])
    with pytest.raises(SpecError, match=r"no column 'heat'; they have .*level"):
        obsynth.run_on_data(design, tmp_path / name, columns={"level": "heat"})


def test_files_of_arrays_that_are_no_log_are_refused(design, frame, tmp_path: Path) -> None:
    columns = {name: frame[name].to_numpy() for name in frame}
    wrong = {
        "shape": (columns | {"level": np.ones((ROWS, 2))}, r"'level' is an array of shape \(40, 2\)"),
        "length": (columns | {"level": np.ones(ROWS + 1)}, "different numbers of rows.*'level' 41"),
    }
    for case, (data, told) in wrong.items():
        np.savez(tmp_path / f"{case}.npz", **data)
        scipy.io.savemat(tmp_path / f"{case}.mat", data)
        for path in (tmp_path / f"{case}.npz", tmp_path / f"{case}.mat"):
            with pytest.raises(SpecError, match=told):
                obsynth.run_on_data(design, path)
        with pytest.raises(SpecError, match=told):
            obsynth.run_on_data(design, data)
    (tmp_path / "new.mat").write_bytes(b"MATLAB 7.3 MAT-file".ljust(124) + b"\0\2IM" + bytes(400))
    with pytest.raises(SpecError, match=r"version 7\.3.*-v7"):
        obsynth.run_on_data(design, tmp_path / "new.mat")
    for name in ("bad.mat", "bad.npz", "bad.xlsx"):
        (tmp_path / name).write_bytes(b"time,level\n1,2\n")
        with pytest.raises(SpecError, match=r"cannot be read|files need openpyxl: pip install .*or use CSV"):
            obsynth.run_on_data(design, tmp_path / name)


def test_a_mapping_of_columns_is_the_frame(design, frame) -> None:
    _same(design, {name: frame[name].tolist() for name in frame}, frame)
    _same(design, {name: frame[[name]].to_numpy() for name in frame}, frame)
    dates = np.datetime64("2026-05-01T00:00:00", "ms") + (500 * np.arange(ROWS)).astype("timedelta64[ms]")
    assert _same(design, {**frame, "time": dates}, frame).table["time"].iloc[1] == pd.Timestamp("2026-05-01T00:00:00.5")


def test_an_array_with_names_is_the_frame(design, frame) -> None:
    _same(design, frame.to_records(index=False), frame)


def test_a_date_that_is_missing_is_no_time(design, frame) -> None:
    dates = pd.Series(pd.date_range("2026-05-01", periods=ROWS, freq="500ms"))
    with pytest.raises(SpecError, match="Row 5 has no time"):
        obsynth.run_on_data(design, frame.assign(time=dates.where(dates.index != 4)))


def test_tables_of_other_libraries_are_the_frame(design, frame) -> None:
    pyarrow = pytest.importorskip("pyarrow")
    _same(design, pyarrow.Table.from_pandas(frame), frame)
    polars = pytest.importorskip("polars")
    own = polars.DataFrame(frame.to_dict("list"))
    _same(design, own, frame)
    _same(design, own.lazy(), frame)
    found, header, _ = log_table(own, ["level"])
    assert header == list(frame.columns)
    assert np.array_equal(found["level"], frame["level"])


@pytest.mark.parametrize("dated", [False, True])
def test_a_sheet_of_a_workbook_is_read_as_its_text(design, frame, tmp_path: Path, dated: bool) -> None:
    openpyxl = pytest.importorskip("openpyxl")
    book = openpyxl.Workbook()
    book.active.append(["made by", "me"])
    sheet = book.create_sheet("log")
    for row in (["Plant 7"], [], list(frame.columns), ["" if dated else "s", "%", "m", "m3/h"]):
        sheet.append(row)
    for row in frame.itertuples(index=False):
        moment = pd.Timestamp("2026-05-01") + pd.Timedelta(row[0], "s")
        sheet.append([moment.to_pydatetime() if dated else row[0], *row[1:]])
    book.save(tmp_path / "log.xlsx")
    run = _same(design, tmp_path / "log.xlsx", frame)
    assert any("before the header" in text and "'Plant 7'" in text for text in run.warnings)
    assert any("units" in text for text in run.warnings)


def test_remarks_before_the_header_are_passed_over_and_told(design, frame, tmp_path: Path) -> None:
    text = frame.to_csv(index=False)
    path = tmp_path / "log.csv"
    path.write_text(f"Logger: X, serial 12\nStarted,2026-05-01\n\n{text}", encoding="utf-8")
    run = _same(design, path, frame)
    assert any("3 lines before the header" in told and "'Logger: X, serial 12'" in told for told in run.warnings)
    assert log_table(path, ["level"])[1] == list(frame.columns)
    # What names no column anywhere is told by its own first line.
    path.write_text("a,b\n1,2\n3,4\n", encoding="utf-8")
    with pytest.raises(SpecError, match=r"no columns .*they have 'a', 'b'"):
        obsynth.run_on_data(design, path)


def test_serial_days_are_converted_where_that_is_stated(design, frame, tmp_path: Path) -> None:
    log = frame.assign(time=45000.0 + frame["time"] / DAY)
    with pytest.raises(SpecError, match=r"serial days.*--time-unit days"):
        obsynth.run_on_data(design, log)
    run = _same(design, log, frame, time_unit="days")
    assert np.allclose(np.diff(run.table["time"]), 0.5, atol=1e-5)
    _same(design, frame.assign(time=1e3 * frame["time"]), frame, time_unit="ms")
    path, gains, out = tmp_path / "log.csv", tmp_path / "tank.gains.json", tmp_path / "out.csv"
    log.to_csv(path, index=False)
    design.save(gains)
    asked = ["run", "--gains", str(gains), "--data", str(path), "--out", str(out)]
    assert main(asked) == 2
    assert main([*asked, "--time-unit", "days"]) == 0
    assert len(pd.read_csv(out)) == ROWS
    rng = np.random.default_rng(2)
    healthy = {"time": 45000.0 + 0.5 * np.arange(300) / DAY, "valve": np.zeros(300)}
    healthy |= {name: 0.01 * rng.normal(size=300) for name in ("level", "flow")}
    assert 0 < obsynth.learn_thresholds(design, healthy, time_unit="d").rows <= 300


@pytest.mark.parametrize(
    ("change", "unit", "told"),
    [
        ({}, "fortnights", "'fortnights' is no unit of time"),
        ({}, "", "'' is no unit of time"),
        ({"time": pd.date_range("2026-05-01", periods=ROWS, freq="500ms")}, "d", "dates, which have no unit"),
        ({"rename": "time [ms]"}, "d", r"'time \[ms\]', but its unit is stated as 'd'"),
    ],
)
def test_a_unit_that_cannot_be_is_refused(design, frame, change: dict, unit: str, told: str) -> None:
    log = frame.rename(columns={"time": change["rename"]}) if "rename" in change else frame.assign(**change)
    with pytest.raises(SpecError, match=told):
        obsynth.run_on_data(design, log, time_unit=unit)


def test_a_name_is_one_however_its_letters_are_encoded(tmp_path: Path) -> None:
    mu, micro, composed, apart = "\u03bc-flow", "\u00b5-flow", "Fl\u00fcssigkeit", "Flu\u0308ssigkeit"
    plant = obsynth.DescriptorSystem(
        None, [[0.8, 0.1], [0.0, 0.7]], [[0.0], [1.0]], np.eye(2), Bf=[[0.0], [1.0]], dt=0.5,
        input_names=["valve"], fault_names=["leak"], output_names=[mu, apart],
    )  # fmt: skip
    design = obsynth.fault_estimation_filter(plant)
    rng = np.random.default_rng(1)
    log = pd.DataFrame({"time": 0.5 * np.arange(9), "valve": 0.0, mu: rng.normal(size=9), apart: rng.normal(size=9)})
    wanted = obsynth.run_on_data(design, log).table
    other = log.rename(columns={mu: micro, apart: composed})
    pd.testing.assert_frame_equal(obsynth.run_on_data(design, other).table, wanted)
    other.rename(columns={composed: f"{composed} [m3]"}).to_csv(tmp_path / "log.csv", index=False)
    found = obsynth.run_on_data(design, tmp_path / "log.csv").table
    pd.testing.assert_frame_equal(found, wanted, check_dtype=False)
    with pytest.raises(SpecError, match="no column"):
        obsynth.run_on_data(design, log.rename(columns={mu: "u-flow"}))


def test_units_of_a_frame_are_those_of_a_header(design, frame) -> None:
    plant = design.plant.replace(units={"level": "m", "valve": "V"})
    made = obsynth.fault_estimation_filter(plant, name="tank")
    other = frame.assign(level=100.0 * frame["level"], valve=1000.0 * frame["valve"])
    units = {"time": "s", "valve": "mV", "level": "cm", "flow": ""}
    marked = other.copy()
    marked.attrs["units"] = units
    two_rows = other.set_axis(pd.MultiIndex.from_tuples([(name, units[name]) for name in other]), axis=1)
    _same(made, marked, frame)
    _same(made, two_rows, frame)
    assert np.allclose(log_table(two_rows, ["level"], units={"level": "m"})[0]["level"], frame["level"], rtol=1e-12)
    wrong = other.copy()
    wrong.attrs["units"] = {"level": "kg"}
    with pytest.raises(SpecError, match="level"):
        obsynth.run_on_data(made, wrong)
    with pytest.raises(SpecError, match="3 levels"):
        obsynth.run_on_data(made, frame.set_axis(pd.MultiIndex.from_tuples([(name, "", "") for name in frame]), axis=1))
