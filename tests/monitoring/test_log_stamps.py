"""Logs as other programs write them: encodings, and stamps that are no plain seconds."""

from __future__ import annotations

import io
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from test_flaws_of_logs import DT, designed, log

import obsynth
from obsynth.monitoring.calibration.logs import read_log

#: A minute before midnight of the 25th: AM and PM, and the next day.
BEGIN = pd.Timestamp("2026-12-25T23:59:56.5")
STAMPS: dict[str, Callable[[pd.Timestamp], str]] = {
    "milliseconds": lambda at: f"{at.value / 1e6:.1f}",
    "microseconds": lambda at: str(at.value // 1000),
    "nanoseconds": lambda at: str(at.value),
    "ISO with PM": lambda at: at.strftime("%Y-%m-%d %I:%M:%S.%f %p"),
    "ISO with p.m.": lambda at: f"{at:%Y-%m-%d} {at.hour % 12 or 12}:{at:%M:%S.%f} {'ap'[at.hour >= 12]}.m.",
    "points with PM": lambda at: at.strftime("%d.%m.%Y %I:%M:%S,%f PM" if at.hour >= 12 else "%d.%m.%Y %I:%M:%S,%f AM"),
    "year first": lambda at: at.strftime("%Y/%m/%d %H:%M:%S.%f"),
    "month first": lambda at: at.strftime("%m/%d/%Y %I:%M:%S.%f %p"),
    "day first": lambda at: at.strftime("%d/%m/%Y %H:%M:%S.%f"),
    "day first with dashes": lambda at: at.strftime("%d-%m-%Y %H:%M:%S.%f"),
    "parts without zeros": lambda at: f"{at.year}-{at.month}-{at.day} {at.hour}:{at:%M:%S.%f}",
    "points with two digits": lambda at: at.strftime("%d.%m.%y %H:%M:%S,%f"),
    "name of the month": lambda at: at.strftime("%d-%b-%Y %H:%M:%S.%f"),
    "American with a name": lambda at: at.strftime("%B %d, %Y %I:%M:%S.%f %p"),
    "two columns": lambda at: at.strftime("%H:%M:%S.%f"),
    "two columns with PM": lambda at: at.strftime("%I:%M:%S.%f %p"),
    **{
        f"zone {zone}": lambda at, zone=zone: at.strftime(f"%Y-%m-%d %H:%M:%S.%f{zone}")
        for zone in ("Z", " UTC", " GMT", "+00:00", " +00:00", "+0000", " UTC+0", " GMT-00:00")
    },
    "PM and a zone": lambda at: at.strftime("%m/%d/%Y %I:%M:%S.%f %p UTC"),
}


def stamped(kind: str) -> pd.DataFrame:
    data = log(fault=0.5)
    moments = BEGIN + pd.to_timedelta(np.round(data["time"] * 1e9).astype("int64"), unit="ns")
    data = data.assign(time=[STAMPS[kind](at) for at in moments])
    return data.assign(Date=[at.strftime("%d.%m.%Y") for at in moments]) if kind.startswith("two columns") else data


@pytest.mark.one_in(4)
@pytest.mark.parametrize("kind", list(STAMPS))
def test_stamps_of_other_programs_are_read(tmp_path: Path, kind: str) -> None:
    data, design, file = stamped(kind), designed("ui-pi-observer"), tmp_path / "log.csv"
    data.to_csv(file, index=False, sep=";")
    wanted = obsynth.run_on_data(design, log(fault=0.5)).table
    numbers = kind.endswith("seconds")
    frames = [data, data.assign(time=data["time"].astype(float))] if numbers else [data]
    for source in (file, *frames, io.StringIO(data.to_csv(index=False, sep=";"))):
        out = io.StringIO()
        run = obsynth.run_on_data(design, source, out) if isinstance(source, io.StringIO) else None
        table = pd.read_csv(io.StringIO(out.getvalue())) if run else obsynth.run_on_data(design, source).table
        assert table is not None
        assert wanted is not None
        found = pd.to_datetime(table["time"], unit="s" if numbers else None, format=None if numbers else "ISO8601")
        assert (found.dt.tz is not None) == ("zone" in kind)
        found = found.dt.tz_localize(None) if "zone" in kind else found
        # Seconds since 1970 in double precision are known to a quarter of a microsecond.
        assert abs((found - BEGIN).dt.total_seconds() - wanted["time"]).max() <= 1e-6
        assert table["status"].tolist() == wanted["status"].tolist()
        np.testing.assert_allclose(table["fhat[f]"], wanted["fhat[f]"], rtol=1e-6, atol=1e-9)
    np.testing.assert_allclose(read_log(file, ["u"], ["a", "b"]).dt, DT, rtol=1e-6)


@pytest.mark.parametrize("encoding", ["utf-16", "utf-16-le", "utf-16-be"])
def test_a_log_in_utf_16_with_its_mark_is_read(tmp_path: Path, encoding: str) -> None:
    file, text = tmp_path / "log.csv", log(fault=0.5).to_csv(index=False, lineterminator="\r\n")
    mark = "" if encoding == "utf-16" else "\ufeff"
    file.write_bytes((mark + text).encode(encoding))
    wanted = obsynth.run_on_data(designed("ui-pi-observer"), log(fault=0.5)).table
    pd.testing.assert_frame_equal(obsynth.run_on_data(designed("ui-pi-observer"), file).table, wanted)
    assert read_log(file, ["u"], ["a", "b"]).samples == len(wanted)
    with pytest.raises(obsynth.SpecError, match="no column 'c'"):
        read_log(file, ["u"], ["a", "c"])
    file.write_bytes(file.read_bytes()[:-1])
    with pytest.raises(obsynth.SpecError, match=r"is no (text of its encoding|UTF-16 text)"):
        obsynth.run_on_data(designed("ui-pi-observer"), file)


@pytest.mark.parametrize(
    ("stamp", "words"),
    [
        ("05/03/2026 08:30:00 AM", "'05/03/2026 08:30:00 AM' may begin with the day or the month"),
        ("05/13/2026 13:30:00 PM", "is no time stamp"),
        ("05/13/2026 00:30:00 AM", "is no time stamp"),
        ("13/13/2026 01:30:00", "is no time stamp"),
        ("08:30:00 PM", "is no time stamp"),
    ],
)
def test_stamps_that_say_two_things_or_none_are_refused_by_name(stamp: str, words: str) -> None:
    data = log().astype({"time": object})
    data.loc[0, "time"] = stamp
    with pytest.raises(obsynth.SpecError, match=f"Row 1, column 'time': .*{words.split(maxsplit=1)[1]}"):
        obsynth.run_on_data(designed("ui-pi-observer"), data)


def test_the_first_date_with_slashes_says_what_is_the_day() -> None:
    data = stamped("day first")
    data.loc[40:, "time"] = [text.replace("26/12/2026", "12/26/2026") for text in data.loc[40:, "time"]]
    with pytest.raises(obsynth.SpecError, match=r"Row 41, .* is no time stamp"):
        obsynth.run_on_data(designed("ui-pi-observer"), data)


@pytest.mark.parametrize("zone", ["+02:00", " +0200", "+2", " UTC+2", " GMT+02:00"])
def test_an_offset_of_the_zone_is_kept(zone: str) -> None:
    data = log()
    moments = BEGIN + pd.to_timedelta(np.round(data["time"] * 1e9).astype("int64"), unit="ns")
    data["time"] = [f"{at:%Y-%m-%d %H:%M:%S.%f}{zone}" for at in moments]
    table = obsynth.run_on_data(designed("ui-pi-observer"), data).table
    assert table is not None
    assert str(table["time"].iloc[0]) == "2026-12-25 23:59:56.500000+02:00"


@pytest.mark.parametrize("text", ["2026-12-25 23:59:56 CET", "2026-12-25 23:59:56 UTC+1:5", "25-Dez-2026 23:59:56",
                                  "Foo Dec 2026", "24:61:00", "23:59", "31.02.26 08:00"])  # fmt: skip
def test_what_is_nearly_a_stamp_is_refused(text: str) -> None:
    data = log().astype({"time": object})
    data.loc[0, "time"] = text
    with pytest.raises(obsynth.SpecError, match="is no time stamp"):
        obsynth.run_on_data(designed("ui-pi-observer"), data)


@pytest.mark.parametrize("kind", ["hours", "beside dates"])
def test_hours_minutes_and_seconds_alone_count_as_seconds_and_the_date_beside_them_only_then(kind: str) -> None:
    data, wanted = log(fault=0.5), obsynth.run_on_data(designed("ui-pi-observer"), log(fault=0.5)).table
    data = data.assign(Date="25.12.2026") if kind == "beside dates" else data
    if kind == "hours":
        data["time"] = [f"00:{at // 60:02.0f}:{at % 60:05.2f}" for at in data["time"]]
    table = obsynth.run_on_data(designed("ui-pi-observer"), data).table
    pd.testing.assert_frame_equal(table, wanted, atol=1e-12)


def autumn(rows: int = 80, minutes: int = 2) -> pd.DataFrame:
    """Return a log over the end of summer time in Berlin, with local stamps that name no zone."""
    data = log()[:rows].reset_index(drop=True)
    moments = pd.date_range("2026-10-24T23:30:00Z", periods=rows, freq=f"{minutes}min").tz_convert("Europe/Berlin")
    return data.assign(time=[f"{at:%Y-%m-%d %H:%M:%S}" for at in moments])


def slow(minutes: int = 2) -> obsynth.ObserverDesign:
    plant = designed("ui-pi-observer").plant
    return obsynth.design(plant.replace(dt=60.0 * minutes), "ui-pi-observer")


def test_the_hour_that_comes_twice_in_autumn_is_told_apart_in_a_stated_zone(tmp_path: Path) -> None:
    data, design, file = autumn(), slow(), tmp_path / "log.csv"
    data.to_csv(file, index=False)
    utc = data.assign(time=pd.date_range("2026-10-24T23:30:00Z", periods=len(data), freq="2min"))
    wanted = obsynth.run_on_data(design, utc).table
    frames = (file, data, data.assign(time=pd.to_datetime(data["time"])))
    for source in frames:
        run = obsynth.run_on_data(design, source, time_zone="Europe/Berlin")
        assert set(run.statuses) == {"warm-up", "ok"}
        table = run.table
        assert str(table["time"].iloc[20]) == "2026-10-25 02:10:00+02:00"
        assert str(table["time"].iloc[50]) == "2026-10-25 02:10:00+01:00"
        pd.testing.assert_frame_equal(table.drop(columns="time"), wanted.drop(columns="time"))
    # In the middle of the second hour a run goes on where it was.
    state, parts = tmp_path / "state.json", []
    for part in (data[:55], data[55:]):
        parts.append(obsynth.run_on_data(design, part, state=state, time_zone="Europe/Berlin").table)
    pd.testing.assert_frame_equal(pd.concat(parts, ignore_index=True), run.table)


def test_rows_as_far_apart_as_clocks_go_back_repeat_a_stamp() -> None:
    data = autumn(rows=30, minutes=60)
    assert data["time"].duplicated().sum() == 1
    run = obsynth.run_on_data(slow(60), data, time_zone="Europe/Berlin")
    assert set(run.statuses) == {"warm-up"}
    # A stamp that repeats the one before it a minute later is no other hour.
    data = autumn()
    data.loc[21, "time"] = data.loc[20, "time"]
    run = obsynth.run_on_data(slow(), data, time_zone="Europe/Berlin")
    assert run.statuses["repeated stamp"] == 1
    assert run.table["time"].iloc[22] == pd.Timestamp("2026-10-25T02:14:00+02:00")


def test_what_is_lost_in_autumn_is_told_in_local_time() -> None:
    with pytest.raises(
        obsynth.SpecError, match=r"Row 56: the time falls from 2026-10-25T02:58:00 to 2026-10-25T02:2.*--time-zone"
    ):
        obsynth.run_on_data(slow(), autumn())
    with pytest.raises(obsynth.SpecError, match="sort the log by its time"):
        obsynth.run_on_data(slow(), autumn().iloc[::-1].reset_index(drop=True))
    run = obsynth.run_on_data(slow(10), autumn(rows=40, minutes=10))
    assert run.statuses["out of order"] + run.statuses["repeated stamp"] == 6
    (note,) = [text for text in run.warnings if "clocks go back" in text]
    assert "Row 10: the time falls from 2026-10-25 02:50:00 to 2026-10-25 02:00:00" in note
    assert "--time-zone" in note


def test_what_a_stated_zone_is_not_for_is_refused() -> None:
    data, design = autumn(), slow()
    spring = data.assign(time=[f"2026-03-29 02:{k:02}:00" for k in range(0, 60, 2)] * 2 + data["time"].tolist()[:20])
    with pytest.raises(obsynth.SpecError, match="there is no 2026-03-29 02:00:00 in Europe/Berlin"):
        obsynth.run_on_data(design, spring, time_zone="Europe/Berlin")
    assert obsynth.run_on_data(design, spring[:30], time_zone="+01:00").rows == 30
    with pytest.raises(obsynth.SpecError, match="'Europe/Bärlin' is no time zone"):
        obsynth.run_on_data(design, data, time_zone="Europe/Bärlin")
    zoned = data.assign(time=pd.date_range("2026-10-24T23:30:00Z", periods=len(data), freq="2min"))
    for stamps, text in (
        (zoned, "name their time zone"),
        (data.assign(time=120.0 * np.arange(len(data))), "are seconds"),
    ):
        with pytest.raises(obsynth.SpecError, match=text):
            obsynth.run_on_data(design, stamps, time_zone="Europe/Berlin")
    mixed = data.assign(time=[*data["time"][:50], *(f"{text}+01:00" for text in data["time"][50:])])
    with pytest.raises(obsynth.SpecError, match="cannot be mixed"):
        obsynth.run_on_data(design, mixed, time_zone="Europe/Berlin")


def test_alarms_after_hours_are_in_hours_beside_for_people_and_not_for_programs() -> None:
    """A log over days said 'First alarm 86760 s', whose picture has hours."""
    plant = obsynth.DescriptorSystem(A=[[0.9]], C=[[1]], Bf=[[1]], dt=600.0)
    design = obsynth.fault_estimation_filter(plant)
    table = pd.DataFrame({"time": 600.0 * np.arange(100), "y1": np.zeros(100)})
    table.loc[50:, "y1"] = 1.0
    run = obsynth.run_on_data(design, table, thresholds={"fhat[f1]": 0.05})
    assert "First alarm 30000 s (8.333 h)" in str(run)
    assert run.as_dict()["alarm_stamps"] == {"fhat[f1]": "30000 s"}
