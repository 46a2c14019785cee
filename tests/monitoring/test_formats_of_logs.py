"""A log gives the same estimates in each format that holds it, and a damaged file one sentence that says what it is."""

from __future__ import annotations

import io
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

import obsynth
from obsynth import SpecError
from obsynth.cli.main import main
from obsynth.monitoring.logs.log_tables import log_table

ROWS = 30
SIGNALS = ["valve", "level", "flow"]


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
    columns = {"time": 0.5 * np.arange(ROWS), **{name: np.round(rng.normal(size=ROWS), 3) for name in SIGNALS}}
    return pd.DataFrame(columns)


def same(design: obsynth.ObserverDesign, found: object, wanted: object, **options: object) -> pd.DataFrame:
    """Two logs give the same estimates; those of the first are returned."""
    one, two = (obsynth.run_on_data(design, data, **options).table for data in (found, wanted))
    pd.testing.assert_frame_equal(one.drop(columns="time"), two.drop(columns="time"), check_dtype=False, atol=1e-12)
    return one


@pytest.mark.one_in(6)
@pytest.mark.parametrize(
    ("kind", "has_name"),
    [*((kind, True) for kind in ("dates", "zone", "differences", "numbers", "counted")),
     *((kind, False) for kind in ("dates", "zone", "differences"))],
)  # fmt: skip
def test_the_index_of_a_parquet_file_is_the_time_as_that_of_its_frame(design, frame, tmp_path, kind, has_name):
    pytest.importorskip("pyarrow")
    moments = pd.Timestamp("2026-03-28T23:59:50") + pd.to_timedelta(frame["time"], unit="s")
    index = {
        "dates": pd.DatetimeIndex(moments),
        "zone": pd.DatetimeIndex(moments).tz_localize("UTC").tz_convert("Europe/Berlin"),
        "differences": pd.TimedeltaIndex(pd.to_timedelta(frame["time"], unit="s")),
        "numbers": pd.Index(frame["time"].to_numpy()),
        "counted": pd.RangeIndex(ROWS),  # another sampling time than that of the design
    }[kind]
    log = frame[SIGNALS].set_index(index.rename("time" if has_name else None))
    log.to_parquet(tmp_path / "log.parquet")
    if kind == "counted":
        with pytest.raises(SpecError, match=r"sampled every 1 s, but the design needs 0\.5 s"):
            obsynth.run_on_data(design, tmp_path / "log.parquet")
        return
    found = same(design, tmp_path / "log.parquet", log)
    pd.testing.assert_series_equal(found["time"], obsynth.run_on_data(design, log).table["time"])


@pytest.mark.parametrize("year", [1601, 2600])
@pytest.mark.parametrize("unit", ["s", "ms", "us"])
def test_dates_that_nanoseconds_cannot_count_are_read(design, frame, year, unit):
    start = np.datetime64(f"{year}-03-01T00:00:00", unit)
    log = frame.assign(time=start + (np.arange(ROWS) * np.timedelta64(1, "s")).astype(f"timedelta64[{unit}]"))
    times = obsynth.run_on_data(design, log.iloc[:1]).table["time"]
    assert str(times.iloc[0]).startswith(f"{year}-03-01")


def test_dates_with_a_zone_of_another_kind_of_frame_are_read(design, frame):
    pytest.importorskip("pyarrow")
    moments = (pd.Timestamp("2026-01-01") + pd.to_timedelta(frame["time"], unit="s")).dt.tz_localize("UTC")
    log = frame.assign(time=moments)
    same(design, log.convert_dtypes(dtype_backend="pyarrow"), log)


@pytest.mark.one_in(6)
@pytest.mark.parametrize(
    ("unit", "per_second"), [("s", 1), ("[s]", 1), ("ms", 1000), ("(min)", 1 / 60), ("", 1), ("h", 1 / 3600)]
)
@pytest.mark.parametrize("separator", [",", ";"])
def test_a_line_of_units_is_no_row_and_says_what_the_times_are(design, frame, tmp_path, unit, per_second, separator):
    log = frame.assign(time=frame["time"] * per_second)
    head, *rows = log.to_csv(index=False).splitlines()
    text = "\n".join([head, f"{unit},%,m,m3/h", *rows]).replace(",", separator)
    (tmp_path / "log.csv").write_text(text, encoding="utf-8")
    run = obsynth.run_on_data(design, tmp_path / "log.csv")
    assert np.allclose(run.table["time"], frame["time"], rtol=0, atol=1e-9)
    assert any("units" in text and "'m3/h'" in text for text in run.warnings)
    same(design, tmp_path / "log.csv", frame)


@pytest.mark.parametrize("line", ["Bad,Bad,Bad,Bad", "s,%,m,0.3", "furlong,%,m,m"])
def test_a_line_that_holds_no_units_of_time_is_a_row(design, frame, tmp_path, line):
    head, *rows = frame.to_csv(index=False).splitlines()
    (tmp_path / "log.csv").write_text("\n".join([head, line, *rows]), encoding="utf-8")
    with pytest.raises(SpecError, match=r"Row 1, column 'time': .* is no time stamp"):
        obsynth.run_on_data(design, tmp_path / "log.csv")


@pytest.mark.parametrize("encoding", ["utf-16-le", "utf-16-be", "utf-32", "utf-8-sig"])
def test_other_encodings_of_a_text(design, frame, tmp_path, encoding):
    (tmp_path / "log.csv").write_bytes(frame.to_csv(index=False).encode(encoding))
    same(design, tmp_path / "log.csv", frame)


def test_a_text_of_windows_is_read_and_bytes_that_are_no_text_are_refused(design, frame, tmp_path):
    text = frame.rename(columns={"level": "level [°C]"}).assign(remark="Prüfung").to_csv(index=False)
    (tmp_path / "log.csv").write_bytes(text.encode("cp1252"))
    same(design, tmp_path / "log.csv", frame)
    # Some letters in UTF-8 beside it, as of a logger that writes names of its own.
    (tmp_path / "log.csv").write_bytes(text.encode("cp1252").replace(b"remark", "Maß".encode()))
    same(design, tmp_path / "log.csv", frame)
    (tmp_path / "log.csv").write_bytes(text.encode("cp1252") + b"\x81")
    with pytest.raises(SpecError, match="is no UTF-8 text"):
        obsynth.run_on_data(design, tmp_path / "log.csv")


def test_a_text_of_windows_comes_through_standard_input_too(design, frame, monkeypatch):
    text = frame.rename(columns={"level": "level [°C]"}).to_csv(index=False)
    stdin = io.TextIOWrapper(io.BytesIO(text.encode("cp1252")), encoding="utf-8")
    monkeypatch.setattr("sys.stdin", stdin)
    out = io.StringIO()
    obsynth.run_on_data(design, stdin, out)
    pd.testing.assert_frame_equal(
        pd.read_csv(io.StringIO(out.getvalue())), same(design, frame, frame), check_dtype=False
    )


@pytest.mark.parametrize("kind", ["frame", "csv", "parquet", "calibrate"])
def test_units_behind_names_are_left_out_and_say_what_the_times_are(design, frame, tmp_path, kind):
    units = {"time": "time [ms]", "level": "level (m)", "flow": "flow[m3/h]"}
    log = frame.assign(time=1000.0 * frame["time"]).rename(columns=units)
    data = log if kind == "frame" else tmp_path / f"log.{kind.replace('calibrate', 'csv')}"
    if kind == "parquet":
        pytest.importorskip("pyarrow")
        log.to_parquet(data)
    elif kind != "frame":
        log.to_csv(data, index=False)
    if kind == "calibrate":
        found, _, said = log_table(data, SIGNALS)
        assert np.allclose(found["time"], frame["time"], rtol=0, atol=1e-9)
        assert np.array_equal(found["flow"], frame["flow"])
        assert "'time [ms]', 'level (m)', 'flow[m3/h]'" in said[0]
        return
    run = obsynth.run_on_data(design, data)
    assert np.allclose(run.table["time"], frame["time"], rtol=0, atol=1e-9)
    assert any("'level (m)'" in text for text in run.warnings)
    same(design, data, frame)
    # The name itself is meant where it is there; of two with units neither is.
    same(design, log.assign(level=frame["level"]), frame)
    with pytest.raises(SpecError, match="no column 'level'"):
        obsynth.run_on_data(design, log.assign(**{"level (ft)": 0.0}))


@pytest.mark.one_in(6)
@pytest.mark.parametrize("name", ["level status", "level.Quality", "LEVEL_STATUS", "level [Quality]", "Status"])
@pytest.mark.parametrize("kind", ["frame", "csv", "parquet"])
def test_values_that_their_status_calls_bad_are_missing(design, frame, tmp_path, name, kind):
    if kind == "parquet":
        pytest.importorskip("pyarrow")
    bad = (frame.index >= 12) & (frame.index < 15)
    log = frame.copy()
    log.insert(list(log.columns).index("level") + 1, name, np.where(bad, "Bad (no data)", "Good"))
    data = log if kind == "frame" else tmp_path / f"log.{kind}"
    if kind != "frame":
        getattr(log, f"to_{kind}")(data, index=False)
    same(design, data, frame.assign(level=frame["level"].where(~bad)))
    (text,) = obsynth.run_on_data(design, data).warnings
    assert text.startswith(
        f"3 cells of 'level' counted as missing, as '{name}' says so, first 'Bad (no data)' in row 13"
    )


@pytest.mark.parametrize("words", [["Bad", "Bad"], ["on", "off"], ["192", "0"]])
def test_other_columns_are_no_status(design, frame, words):
    """One of another signal, words that do not say that a value is bad, and numbers, which have no common meaning."""
    name = "pump status" if words[0] == "Bad" else "level status"
    log = frame.assign(**{name: np.where(frame.index % 2, *words)})
    same(design, log, frame)


@pytest.mark.parametrize(
    ("separator", "cells"),
    [(";", ["1.234,5", "-12.345,25", "999,5"]), (";", ["1 234,5", "-12\u00a0345,25", "999,5"]),
     (";", ["1'234.5", "-12'345.25", "999.5"]), (",", ["1,234.5", "-12,345.25", "999.5"]),
     ("\t", ["1,234.5", "-12,345.25", "999.5"])],
)  # fmt: skip
def test_what_groups_thousands_is_left_out(design, frame, tmp_path, separator, cells):
    log = frame.astype({"level": object})
    log.loc[3:5, "level"] = cells
    log.to_csv(tmp_path / "log.csv", sep=separator, index=False)
    wanted = frame.copy()
    wanted.loc[3:5, "level"] = [1234.5, -12345.25, 999.5]
    same(design, tmp_path / "log.csv", wanted)


@pytest.mark.parametrize("cells", [["1.234", "0,5"], ["999,5", "1.234"], ["1,234", "1,234.5"], ["1.234", "12.345,5"]])
@pytest.mark.parametrize("across", [False, True])
def test_a_mark_that_may_group_thousands_is_no_decimal_mark(design, frame, cells, across):
    """1.234 was read as 1.234 where the numbers beside it have decimal commas."""
    log = frame.round(0).astype(int).astype({name: object for name in SIGNALS})
    log.loc[3, "level"] = cells[0]
    log.loc[4, "flow" if across else "level"] = cells[1]
    with pytest.raises(SpecError, match=r"the mark may group thousands.* Leave out what groups thousands"):
        obsynth.run_on_data(design, io.StringIO(log.assign(time=frame["time"]).to_csv(sep=";", index=False)))


def test_blank_lines_before_the_header_and_separators_behind_the_last_cell(design, frame, tmp_path):
    head, *rows = frame.to_csv(index=False).splitlines()
    (tmp_path / "log.csv").write_text("\n".join(["", " ", head, *(f"{row},," for row in rows)]), encoding="utf-8")
    same(design, tmp_path / "log.csv", frame)
    (tmp_path / "blank.csv").write_text("\n\n", encoding="utf-8")
    with pytest.raises(SpecError, match="The data are empty"):
        obsynth.run_on_data(design, tmp_path / "blank.csv")


@pytest.mark.parametrize("data", ["complex", "levels"])
def test_frames_that_are_no_log_are_refused(design, frame, data):
    if data == "complex":
        log, told = frame.assign(level=frame["level"].astype(complex)), "'level' holds complex numbers"
    else:
        log, told = frame.set_index("time"), "no column"
        log.columns = pd.MultiIndex.from_product([["rig"], SIGNALS])
    with pytest.raises(SpecError, match=told):
        obsynth.run_on_data(design, log)


def test_a_column_that_begins_as_time_does_is_not_proposed_as_the_time(design, frame):
    with pytest.raises(SpecError) as error:
        obsynth.run_on_data(design, frame.drop(columns="time").assign(**{"T core": 1.0}))
    assert "--time-column" not in str(error.value)


def tdms(path: Path, channels: list[tuple[str, str, np.ndarray, dict[str, object]]]) -> Path:
    nptdms = pytest.importorskip("nptdms", reason="nptdms is not installed (obsynth[tdms])")
    with nptdms.TdmsWriter(path) as writer:
        writer.write_segment([nptdms.ChannelObject(group, name, values, properties=properties)
                              for group, name, values, properties in channels])  # fmt: skip
    return path


def test_a_channel_of_two_groups_is_named_with_its_group(design, frame, tmp_path):
    channels = [("rig", name, frame[name].to_numpy(), {}) for name in frame.columns]
    path = tdms(tmp_path / "log.tdms", [*channels, ("spare", "level", np.zeros(ROWS), {})])
    with pytest.raises(SpecError, match=r"more than one channel 'level', in the groups 'rig', 'spare'"):
        obsynth.run_on_data(design, path)
    found = obsynth.run_on_data(design, path, columns={"level": "rig/level"}).table
    pd.testing.assert_frame_equal(found, obsynth.run_on_data(design, frame).table)


@pytest.mark.parametrize("other", [{"wf_increment": 1.0}, {"wf_start_time": np.datetime64("2026-01-01T00:00:01")}])
def test_waveforms_at_other_times_are_no_rows(design, frame, tmp_path, other):
    usual = {"wf_increment": 0.5, "wf_start_offset": 0.0, "wf_samples": ROWS,
             "wf_start_time": np.datetime64("2026-01-01T00:00:00")}  # fmt: skip
    channels = [("rig", name, frame[name].to_numpy(), usual) for name in SIGNALS]
    same(design, tdms(tmp_path / "log.tdms", channels), frame)
    channels[1] = (*channels[1][:3], {**usual, **other})
    with pytest.raises(SpecError, match="the waveforms 'valve' and 'level' have other times"):
        obsynth.run_on_data(design, tdms(tmp_path / "other.tdms", channels))


def mdf(path: Path, *groups: list[object]) -> Path:
    asammdf = pytest.importorskip("asammdf", reason="asammdf is not installed (obsynth[mdf])")
    log = asammdf.MDF(version="4.10")
    for group in groups:
        log.append(group)
    log.save(path)
    log.close()
    return path


def channel(frame: pd.DataFrame, name: str, **options: object) -> object:
    asammdf = pytest.importorskip("asammdf", reason="asammdf is not installed (obsynth[mdf])")
    return asammdf.Signal(frame[name].to_numpy(), frame["time"].to_numpy(), name=name, **options)


of_asammdf = pytest.mark.filterwarnings("ignore::DeprecationWarning:asammdf", "ignore::DeprecationWarning:numpy")


@pytest.mark.one_in(4)
@of_asammdf
@pytest.mark.parametrize("name", ["valve", "level"])
@pytest.mark.parametrize("apart", [False, True])
def test_samples_that_an_mdf_file_calls_invalid_are_missing(design, frame, tmp_path, name, apart):
    bits = np.arange(ROWS) == 12
    channels = {each: channel(frame, each, **({"invalidation_bits": bits} if each == name else {})) for each in SIGNALS}
    groups = [[one] for one in channels.values()] if apart else [list(channels.values())]
    blank = frame.assign(**{name: frame[name].where(~bits)})
    same(design, mdf(tmp_path / "log.mf4", *groups), blank)


@of_asammdf
def test_no_samples_are_made_up_before_a_channel_of_an_mdf_file_begins(design, frame, tmp_path):
    late = channel(frame.iloc[10:], "level")
    path = mdf(tmp_path / "log.mf4", [channel(frame, "valve"), channel(frame, "flow")], [late])
    same(design, path, frame.assign(level=frame["level"].where(frame.index >= 10)))


@of_asammdf
def test_the_time_of_an_mdf_file_is_the_channel_that_is_asked_for(design, frame, tmp_path):
    asammdf = pytest.importorskip("asammdf")
    stamp = asammdf.Signal(frame["time"].to_numpy(), 2.0 * frame["time"].to_numpy(), name="stamp")
    others = [asammdf.Signal(frame[n].to_numpy(), 2.0 * frame["time"].to_numpy(), name=n) for n in SIGNALS]
    path = mdf(tmp_path / "log.mf4", [stamp, *others])
    same(design, path, frame.rename(columns={"time": "stamp"}), time_column="stamp")
    with pytest.raises(SpecError, match="no column 'clock'"):
        obsynth.run_on_data(design, path, time_column="clock")


@of_asammdf
def test_a_channel_of_two_groups_of_an_mdf_file_is_named_with_its_group(design, frame, tmp_path):
    zero = channel(frame.assign(level=0.0), "level")
    path = mdf(tmp_path / "log.mf4", [channel(frame, name) for name in SIGNALS], [zero])
    with pytest.raises(SpecError, match=r"more than one channel 'level', in the groups '0', '1'"):
        obsynth.run_on_data(design, path)
    found = obsynth.run_on_data(design, path, columns={"level": "0/level"}).table
    pd.testing.assert_frame_equal(found, obsynth.run_on_data(design, frame).table)


@of_asammdf
def test_words_of_an_mdf_file_are_told_as_those_of_a_text(design, frame, tmp_path):
    words = {"val_0": 0, "val_1": 1, "text_0": b"off", "text_1": b"on", "default": b""}
    on = channel(frame.assign(valve=np.ones(ROWS, dtype=np.uint8)), "valve", conversion=words)
    path = mdf(tmp_path / "log.mf4", [on, channel(frame, "level"), channel(frame, "flow")])
    with pytest.raises(SpecError, match="The column 'valve' holds no number: row 1 has 'on'"):
        obsynth.run_on_data(design, path)


@of_asammdf
@pytest.mark.parametrize("suffix", [".csv", ".parquet", ".tdms", ".mf4"])
def test_columns_that_a_log_need_not_have_are_found_missing_in_every_format(frame, tmp_path, suffix):
    path = tmp_path / f"log{suffix}"
    if suffix == ".csv":
        frame.to_csv(path, index=False)
    elif suffix == ".parquet":
        pytest.importorskip("pyarrow")
        frame.set_index("time").to_parquet(path)
    elif suffix == ".tdms":
        waves = {"wf_increment": 0.5, "wf_start_offset": 0.0, "wf_samples": ROWS}
        tdms(path, [("rig", name, frame[name].to_numpy(), waves) for name in SIGNALS])
    else:
        mdf(path, [channel(frame, name) for name in SIGNALS])
    table, header, _ = log_table(path, ["level", "leak", "flow"])
    assert sorted(table) == ["flow", "level", "time"]
    assert sorted(header) == sorted(frame.columns)
    assert np.array_equal(table["time"], frame["time"])


@of_asammdf
@pytest.mark.parametrize("version", ["2.14", "3.30", "4.00", "4.20"])
def test_all_versions_of_mdf_are_read(design, frame, tmp_path, version):
    asammdf = pytest.importorskip("asammdf")
    log = asammdf.MDF(version=version)
    log.append([channel(frame, name) for name in SIGNALS])
    log.save(tmp_path / f"log.{'mf4' if version >= '4' else 'mdf'}")
    log.close()
    (path,) = tmp_path.iterdir()
    same(design, path, frame)


@of_asammdf
def test_a_channel_outside_of_its_records_is_refused_before_asammdf_reads_it(design, frame, tmp_path):
    """Its code in C read there: the process ended."""
    asammdf = pytest.importorskip("asammdf")
    path = mdf(tmp_path / "log.mf4", [channel(frame, name) for name in SIGNALS])
    with asammdf.MDF(path) as file:
        places = [one.address + 24 + 8 * one.links_nr for one in file.groups[0].channels]
    whole = bytearray(path.read_bytes())
    for place in places:
        # The offset in bytes stands four bytes behind the links of the block.
        damaged = whole.copy()
        damaged[place + 4 : place + 8] = (1 << 30).to_bytes(4, "little")
        path.write_bytes(damaged)
        with pytest.raises(SpecError, match=r"its channel '\w+' lies outside of its records"):
            obsynth.run_on_data(design, path)


def damaged(whole: bytes, rng: np.random.Generator, kinds: int) -> bytes:
    """A file that lacks its end, some bytes in between, or has other ones."""
    place, kind = int(rng.integers(8, len(whole))), int(rng.integers(kinds))
    if kind == 0:
        return whole[:place]
    if kind == 1:
        return whole[:place] + whole[place + int(rng.integers(1, 64)) :]
    if kind == 2:
        return whole[:place] + rng.bytes(int(rng.integers(1, 64))) + whole[place:]
    some = bytearray(whole)
    for at in rng.integers(8, len(whole), 4):
        some[at] = int(rng.integers(256))
    return bytes(some)


@of_asammdf
@pytest.mark.parametrize("suffix", [".parquet", ".tdms", ".mf4", ".csv"])
@pytest.mark.long
def test_damaged_files_are_read_or_refused_in_a_sentence(design, frame, tmp_path, capfd, suffix):
    log, out = tmp_path / f"log{suffix}", tmp_path / "estimates.csv"
    if suffix == ".parquet":
        pytest.importorskip("pyarrow")
        frame.to_parquet(log)
    elif suffix == ".tdms":
        tdms(log, [("rig", name, frame[name].to_numpy(), {}) for name in frame.columns])
    elif suffix == ".mf4":
        mdf(log, [channel(frame, name) for name in SIGNALS])
    else:
        frame.to_csv(log, index=False)
    design.save(tmp_path / "tank.gains.json")
    whole, rng = log.read_bytes(), np.random.default_rng(5)
    kept = {"tank.gains.json", log.name}
    for _ in range(15):
        log.write_bytes(damaged(whole, rng, 4))
        out.unlink(missing_ok=True)
        capfd.readouterr()
        code = main(["run", "--gains", str(tmp_path / "tank.gains.json"), "--data", str(log), "--out", str(out)])
        told = capfd.readouterr().err
        assert code in (0, 2)
        assert "Traceback" not in told
        assert "ERROR" not in told
        if code == 2:
            assert told.startswith("Error: ")
            assert {path.name for path in tmp_path.iterdir()} == kept


@pytest.mark.parametrize("kind", ["random", "random after a mark of UTF-16", "zeros", "a picture"])
def test_binary_data_is_called_so(kind: str, design, tmp_path, capsys, monkeypatch) -> None:
    """It was "no UTF-16 text: save it as UTF-8"; of zeros, 4,000 of them stood in the message."""
    random = np.random.default_rng(5).bytes(4001)
    content = {
        "random": random, "random after a mark of UTF-16": b"\xff\xfe" + random, "zeros": bytes(4000),
        "a picture": b"\x89PNG\r\n\x1a\n\0\0\0\rIHDR" + random,
    }[kind]  # fmt: skip
    (tmp_path / "log.csv").write_bytes(content)
    with pytest.raises(SpecError, match=r"log\.csv holds binary data, and no table of text") as caught:
        obsynth.run_on_data(design, tmp_path / "log.csv")
    assert len(str(caught.value)) < 600
    gains = design.save(tmp_path / "tank.gains.json")
    monkeypatch.setattr("sys.stdin", io.TextIOWrapper(io.BytesIO(content), encoding="utf-8"))
    assert main(["run", "--gains", str(gains), "--data", "-", "--out", str(tmp_path / "out.csv")]) == 2
    assert "binary data" in capsys.readouterr().err
