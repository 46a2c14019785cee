"""Logs as people have them: separators, decimal commas, dates and zones, TDMS and MDF files, and their pictures."""

from __future__ import annotations

import io
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from matplotlib.figure import Figure

import obsynth
from obsynth import SpecError
from obsynth.cli.main import main
from obsynth.plotting import plot_data

ROWS = 40


@pytest.fixture(scope="module")
def design() -> obsynth.ObserverDesign:
    """One fault, one known input, an operating point."""
    plant = obsynth.DescriptorSystem(
        None, [[0.8, 0.1], [0.0, 0.7]], [[0.0], [1.0]], ["level", "flow"], Bf=[[0.0], [1.0]], dt=0.5,
        state_names=["level", "flow"], input_names=["valve"], fault_names=["leak"], operating_point={"level": 2.0},
        sensor_noise={"level": 0.01, "flow": 0.01}, units={"level": "m", "leak": "kg/s"},
    )  # fmt: skip
    return obsynth.fault_estimation_filter(plant, name="tank")


@pytest.fixture(scope="module")
def frame(design) -> pd.DataFrame:
    plant = design.plant
    x, rows = np.zeros(2), []
    rng = np.random.default_rng(0)
    for k in range(ROWS):
        y = plant.C @ x + 0.01 * rng.normal(size=2)
        rows.append([0.5 * k, 0.3, y[0] + 2.0, y[1]])
        x = plant.A @ x + plant.B[:, 0] * 0.3 + plant.Bf[:, 0] * (0.5 if k >= 20 else 0.0)
    return pd.DataFrame(rows, columns=["time", "valve", "level", "flow"])


@pytest.fixture(scope="module")
def wanted(design, frame) -> pd.DataFrame:
    return obsynth.run_on_data(design, frame, thresholds={"fhat[leak]": 0.25}).table


def same(found: obsynth.types.DataRun, wanted: pd.DataFrame) -> None:
    pd.testing.assert_frame_equal(
        found.table.drop(columns=["time", "time of fhat[leak]"]), wanted.drop(columns=["time", "time of fhat[leak]"]),
        check_dtype=False, atol=1e-12,
    )  # fmt: skip


THRESHOLDS = {"fhat[leak]": 0.25}


@pytest.mark.parametrize("separator", [",", ";", "\t", "|"])
def test_any_separator(design, frame, wanted, tmp_path, separator):
    frame.to_csv(tmp_path / "log.csv", sep=separator, index=False)
    same(obsynth.run_on_data(design, tmp_path / "log.csv", thresholds=THRESHOLDS), wanted)


@pytest.mark.parametrize("head", ["", "sep=;\n", "# logger 7; north\r\n# in kW, degC\n"])
def test_decimal_commas(design, frame, wanted, tmp_path, head):
    text = head + frame.to_csv(sep=";", index=False, decimal=",")
    (tmp_path / "log.csv").write_text(text)
    same(obsynth.run_on_data(design, tmp_path / "log.csv", thresholds=THRESHOLDS), wanted)
    same(obsynth.run_on_data(design, io.StringIO(text), thresholds=THRESHOLDS), wanted)


def test_a_decimal_comma_between_commas_says_what_to_do(design):
    text = 'time,valve,level,flow\n0,"0,3",2,0\n'
    with pytest.raises(SpecError, match=r"Row 1, column 'valve': '0,3' is no number\. Separate the columns by semi"):
        obsynth.run_on_data(design, io.StringIO(text))


@pytest.mark.parametrize("zone", [None, "UTC", "+02:00", "Z"])
def test_dates_come_in_and_go_out(design, frame, wanted, tmp_path, zone):
    begin = pd.Timestamp("2026-05-01T08:30:00")
    stamps = [(begin + pd.Timedelta(seconds=t)).isoformat() for t in frame["time"]]
    ending = {None: "", "UTC": "+00:00"}.get(zone, zone)
    log = frame.assign(time=[stamp + ending for stamp in stamps])
    log.to_csv(tmp_path / "log.csv", index=False)
    found = obsynth.run_on_data(design, tmp_path / "log.csv", tmp_path / "out.csv", thresholds=THRESHOLDS)
    out = pd.read_csv(tmp_path / "out.csv")
    assert out["time"].iloc[1] == "2026-05-01T08:30:00.500000" + ending.replace("Z", "+00:00")
    assert out["time of fhat[leak]"].iloc[1] == "2026-05-01T08:30:00" + ending.replace("Z", "+00:00")
    alarm = wanted["time"][wanted["alarm"] != ""].iloc[0]
    assert found.stamps.shown(found.alarms["fhat[leak]"]).startswith(
        (begin + pd.Timedelta(seconds=alarm)).isoformat()[:19]
    )
    same(obsynth.run_on_data(design, tmp_path / "log.csv", thresholds=THRESHOLDS), wanted)


@pytest.mark.parametrize("hour", ["%H", "%-H"])
def test_dates_with_points_have_the_day_first(design, frame, wanted, hour):
    """A log as a German spreadsheet writes it: semicolons, decimal commas, and those in the seconds too."""
    begin = pd.Timestamp("2026-05-03T08:30:00")
    stamps = [begin + pd.Timedelta(seconds=t) for t in frame["time"]]
    told = [f"{stamp.strftime(f'%d.%m.%Y {hour}:%M:%S')},{stamp.microsecond // 1000:03d}" for stamp in stamps]
    text = frame.assign(time=told).to_csv(index=False, sep=";", decimal=",")
    found = obsynth.run_on_data(design, io.StringIO(text), thresholds=THRESHOLDS)
    same(found, wanted)
    assert found.stamps.shown(found.alarms["fhat[leak]"]).startswith("2026-05-03T08:30")


def test_dates_are_written_alike_in_every_row(design, frame, tmp_path):
    """Dates of whole seconds were written without a fraction, which `pandas.to_datetime` refuses beside others."""
    stamps = pd.Timestamp("2026-05-03T08:30:00") + pd.to_timedelta(frame["time"], unit="s")
    for times in (stamps, [f"{stamp:%d.%m.%Y %H:%M:%S},{stamp.microsecond // 1000:03d}" for stamp in stamps]):
        obsynth.run_on_data(design, frame.assign(time=times), tmp_path / "out.csv")
        out = pd.read_csv(tmp_path / "out.csv")["time"]
        assert out.iloc[0] == "2026-05-03T08:30:00.000000"
        assert (pd.to_datetime(out) == stamps).all()


def test_an_index_of_dates_is_the_time(design, frame, wanted):
    index = pd.to_datetime("2026-05-01") + pd.to_timedelta(frame["time"], unit="s")
    log = frame.drop(columns="time").set_index(pd.DatetimeIndex(index).tz_localize("Europe/Berlin"))
    found = obsynth.run_on_data(design, log, thresholds=THRESHOLDS)
    same(found, wanted)
    assert found.table["time"].iloc[0] == pd.Timestamp("2026-05-01T00:00:00+02:00")
    same(obsynth.run_on_data(design, frame.set_index("time"), thresholds=THRESHOLDS), wanted)


@pytest.mark.parametrize(
    ("cells", "message"),
    [
        (["0", "2026-05-01T00:00:00"], r"Row 2, column 'time': .* is no time stamp: the rows before hold seconds"),
        (["2026-05-01T00:00:00", "1.5"], r"Row 2, .*the rows before hold dates and times"),
        (["01/05/2026 08:00", "2"], r"Row 1, .*may begin with the day or the month: write dates with the year first"),
        (["31.02.2026 08:00", "2"], r"Row 1, .*give seconds, such as 12\.5, or a date"),
        (["2026-05-01T00:00:00", "2026-05-01T00:00:01Z"], r"Row 2, .*with a time zone and without one"),
    ],
)
def test_wrong_stamps_are_named_with_the_row(design, cells, message):
    text = "time,valve,level,flow\n" + "".join(f"{cell},0,2,0\n" for cell in cells)
    with pytest.raises(SpecError, match=message):
        obsynth.run_on_data(design, io.StringIO(text))


def test_the_time_column_may_be_called_otherwise(design, frame, wanted):
    log = frame.rename(columns={"time": "Timestamp"})
    with pytest.raises(SpecError, match=r"If 'Timestamp' is the time: --time-column Timestamp"):
        obsynth.run_on_data(design, log)
    same(obsynth.run_on_data(design, log, time_column="Timestamp", thresholds=THRESHOLDS), wanted)


def test_tdms(design, frame, wanted, tmp_path):
    nptdms = pytest.importorskip("nptdms", reason="nptdms is not installed (obsynth[tdms])")
    for name, columns, properties in (
        ("own.tdms", list(frame.columns), {}),
        ("waveform.tdms", ["valve", "level", "flow"], {"wf_increment": 0.5, "wf_start_offset": 0.0}),
    ):
        with nptdms.TdmsWriter(tmp_path / name) as writer:
            writer.write_segment([
                nptdms.ChannelObject("rig", column, frame[column].to_numpy(), properties={
                    **properties, **({"wf_samples": ROWS} if properties else {})}) for column in columns
            ])  # fmt: skip
        same(obsynth.run_on_data(design, tmp_path / name, thresholds=THRESHOLDS), wanted)
    with nptdms.TdmsWriter(tmp_path / "less.tdms") as writer:
        writer.write_segment([nptdms.ChannelObject("rig", c, frame["time"].to_numpy()) for c in ("time", "level")])
    with pytest.raises(SpecError, match=r"no column 'flow'; they have 'time', 'level'"):
        obsynth.run_on_data(design, tmp_path / "less.tdms", columns={"valve": "time"})


@pytest.mark.filterwarnings("ignore::DeprecationWarning:asammdf", "ignore::DeprecationWarning:numpy")
def test_mdf(design, frame, wanted, tmp_path):
    asammdf = pytest.importorskip("asammdf", reason="asammdf is not installed (obsynth[mdf])")
    log = asammdf.MDF(version="4.10")
    log.append([
        asammdf.Signal(frame[name].to_numpy(), frame["time"].to_numpy(), name=name) for name in frame.columns[1:]
    ])  # fmt: skip
    log.save(tmp_path / "log.mf4")
    log.close()
    same(obsynth.run_on_data(design, tmp_path / "log.mf4", thresholds=THRESHOLDS), wanted)


def test_a_broken_file_is_refused(design, tmp_path):
    for name, module in (("a.tdms", "nptdms"), ("a.mf4", "asammdf")):
        pytest.importorskip(module)
        (tmp_path / name).write_bytes(b"nothing of the kind")
        with pytest.raises(SpecError, match=r"cannot be read"):
            obsynth.run_on_data(design, tmp_path / name)


def test_a_picture_of_one_s_own_data(design, frame):
    monitor = obsynth.online_monitor(design, "chi-square")
    run = obsynth.run_on_data(design, frame, monitor=monitor, thresholds=THRESHOLDS)
    figure = Figure()
    # The valve stands still, so that it has no panel.
    axes = list(figure.subplots(5, 1))
    panels = plot_data(run, design=design, axes=axes)
    labels = [panel.get_ylabel() for panel in panels]
    assert [label.replace("\n", " ") for label in labels] == [
        "level (m)", "flow", "leak (kg/s)", "residuals (kg/s)", "statistic",
    ]  # fmt: skip
    assert design.plant.input_names == ("valve",)
    drawn = [panel.get_lines()[0].get_label() for panel in panels[:2]]
    assert drawn == ["measured", "measured"]
    (estimate,) = [line for line in panels[2].get_lines() if line.get_label() == "estimate"]
    assert np.array_equal(estimate.get_ydata(), run.table["fhat[leak]"])
    assert np.array_equal(estimate.get_xdata(), run.table["time of fhat[leak]"])
    texts = [text.get_text() for text in panels[2].get_legend().get_texts()]
    assert "95 % interval of the stated noise" in texts
    assert "threshold" in texts
    assert "alarm at 10.5 s" in texts
    assert len(plot_data(run, show=["faults"], axes=list(Figure().subplots(1, 1, squeeze=False)[0]))) == 1
    with pytest.raises(SpecError, match=r"outputs, faults"):
        plot_data(run, show=["states"])
    with pytest.raises(SpecError, match=r"run_on_data"):
        plot_data(run.table)


def test_a_panel_is_shaded_red_at_its_own_alarms_alone():
    """Only the second fault occurs: the panels of the first fault, and of residuals without a threshold, stay white."""
    plant = obsynth.DescriptorSystem(
        None, np.diag([0.8, 0.7]), None, ["level", "flow"], Bf=np.eye(2), dt=0.5, state_names=["level", "flow"],
        fault_names=["leak", "clog"],
    )  # fmt: skip
    rows, x = [], np.zeros(2)
    for k in range(ROWS):
        rows.append([0.5 * k, *x])
        x = plant.A @ x + plant.Bf[:, 1] * (k >= 20)
    log = pd.DataFrame(rows, columns=["time", "level", "flow"])
    design = obsynth.fault_estimation_filter(plant)
    faults = {"fhat[leak]": 0.25, "fhat[clog]": 0.25}
    for thresholds, shaded in ((faults, [0, 1, 0]), ({**faults, "r[leak]": 0.25, "r[clog]": 0.25}, [0, 1, 1])):
        run = obsynth.run_on_data(design, log, thresholds=thresholds)
        panels = plot_data(run, show=["faults", "residuals"], axes=list(Figure().subplots(3, 1)))
        assert [sum(patch.get_alpha() == 0.15 for patch in panel.patches) for panel in panels] == shaded


def test_residuals_of_unlike_units_have_panels_of_their_own():
    """A residual of a few kelvins beside one of a thousand pascals would be a line at zero."""
    plant = obsynth.DescriptorSystem(
        None, np.diag([0.8, 0.7]), None, ["level", "flow"], Bf=[[1.0], [1.0]], dt=0.5, state_names=["level", "flow"],
        units={"level": "m", "flow": "m3/s"},
    )  # fmt: skip
    design = obsynth.ui_pi_observer(plant)
    log = pd.DataFrame(np.zeros((ROWS, 3)), columns=["time", "level", "flow"]).assign(time=0.5 * np.arange(ROWS))
    run = obsynth.run_on_data(design, log)
    panels = plot_data(run, design=design, show=["residuals"])
    drawn = {panel.get_ylabel(): [line.get_label() for line in panel.get_lines()] for panel in panels}
    assert drawn == {"residuals (m)": ["r[level]"], "residuals (m3/s)": ["r[flow]"]}


@pytest.mark.one_in(3)
@pytest.mark.parametrize(("zone", "label"), [(None, "time"), ("+02:00", "time (UTC+02:00)"), ("UTC", "time (UTC)")])
def test_dates_are_drawn_in_the_zone_of_the_log(design, frame, zone, label):
    dates = pd.Timestamp("2026-05-01T06:29:50").tz_localize(zone) + pd.to_timedelta(frame["time"], unit="s")
    (panel, *_, last) = plot_data(obsynth.run_on_data(design, frame.assign(time=dates)), show=["outputs"])
    last.figure.canvas.draw()
    assert panel.get_shared_x_axes().joined(panel, last)
    assert last.get_xlabel() == label
    assert "06:30" in [text.get_text() for text in last.get_xticklabels()]


def test_a_run_to_a_file_holds_no_table(design, frame, tmp_path):
    with pytest.raises(SpecError, match=r"holds no table"):
        plot_data(obsynth.run_on_data(design, frame, tmp_path / "out.csv"))


@pytest.mark.one_in(3)
@pytest.mark.parametrize("suffix", [".png", ".svg", ".pdf"])
def test_the_command_draws_a_file(design, frame, tmp_path, monkeypatch, capsys, suffix):
    monkeypatch.chdir(tmp_path)
    design.save("tank.gains.json")
    log = frame.assign(time=[f"2026-05-01T00:00:{t:04.1f}Z" for t in frame["time"]])
    log.to_csv("log.csv", index=False, sep=";", decimal=",")
    arguments = ["plot", "--gains", "tank.gains.json", "--data", "log.csv", "--threshold", "fhat[leak]=0.25"]
    assert main([*arguments, "--out", f"log{suffix}"]) == 0
    printed = capsys.readouterr().out
    assert "First alarm 2026-05-01T00:00:1" in printed
    assert f"Written: log{suffix}" in printed
    assert Path(f"log{suffix}").stat().st_size > 5000
    if suffix == ".png":
        assert main([*arguments, "--out", "log.bmp"]) == 2
        assert main([*arguments, "--out", "log.csv"]) == 2


@pytest.mark.long
def test_the_page_shows_one_s_own_data_first(design, frame, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    design.save("tank.gains.json")
    frame.to_csv("log.csv", index=False)
    assert main([
        "report", "--gains", "tank.gains.json", "--data", "log.csv", "--threshold", "fhat[leak]=0.25",
        "--monitor", "chi-square", "--out", "page.html",
    ]) == 0  # fmt: skip
    page = Path("page.html").read_text(encoding="utf-8")
    places = [page.index(text) for text in ("On your data", "Summary", ">Pictures<", "Claims", ">Checks<")]
    assert places == sorted(places)
    assert "Statistics" in page
    assert "--data log.csv" in page


WORD_ROWS = 1000


def with_words(rows: list[int], count: int = WORD_ROWS) -> pd.DataFrame:
    """Return a log, some of whose cells of one output are words."""
    rng = np.random.default_rng(3)
    log = pd.DataFrame({"time": 0.5 * np.arange(count), "valve": 0.3, "level": 2.0, "flow": 0.2})
    log[["level", "flow"]] += 0.01 * rng.standard_normal((count, 2))
    log["flow"] = [repr(value) for value in log["flow"]]
    log.loc[rows, "flow"] = "Bad"
    return log


@pytest.mark.one_in(4)
@pytest.mark.parametrize("way", ["frame", "csv", "stream", "parquet"])
@pytest.mark.parametrize("first", [0, 300])
def test_words_are_bad_samples_wherever_they_stand_and_however_a_log_is_read(design, tmp_path, way, first):
    """From the first row on, and over a whole piece that is read at once."""
    bad = list(range(first, first + 150))
    log = with_words(bad)
    numbers = log.assign(flow=pd.to_numeric(log["flow"], errors="coerce"))
    path = tmp_path / f"log.{way}"
    if way == "csv":
        log.to_csv(path, index=False)
    if way == "parquet":
        log.to_parquet(path)
    wanted = obsynth.run_on_data(design, numbers).table
    for rows in (100, WORD_ROWS):
        data = {"frame": log, "stream": io.StringIO(log.to_csv(index=False))}.get(way, path)
        found = obsynth.run_on_data(design, data, chunk_rows=rows)
        pd.testing.assert_frame_equal(found.table, wanted)
        (said,) = (text for text in found.warnings if "flow" in text)
        assert said.startswith("150 cells of 'flow'")
        assert said.endswith(f"first 'Bad' in row {first + 1}.")


@pytest.mark.one_in(4)
@pytest.mark.parametrize("way", ["frame", "csv", "stream", "parquet"])
def test_a_column_of_words_is_no_signal(design, tmp_path, way):
    log = with_words(list(range(WORD_ROWS)))
    path = tmp_path / f"log.{way}"
    if way == "csv":
        log.to_csv(path, index=False)
    if way == "parquet":
        log.to_parquet(path)
    data = {"frame": log, "stream": io.StringIO(log.to_csv(index=False))}.get(way, path)
    with pytest.raises(SpecError, match="The column 'flow' holds no number: row 1 has 'Bad'"):
        obsynth.run_on_data(design, data, chunk_rows=100)


def test_a_log_that_goes_on_with_words_alone_has_shown_numbers(design, tmp_path):
    log, state = with_words([*range(500, WORD_ROWS)]), tmp_path / "state.json"
    whole = obsynth.run_on_data(design, log).table
    parts = [obsynth.run_on_data(design, log.iloc[rows], state=state).table for rows in (slice(500), slice(500, None))]
    pd.testing.assert_frame_equal(whole, pd.concat(parts, ignore_index=True))


def test_words_without_stamps_and_in_a_mapping_are_bad_samples_of_a_calibration(tmp_path):
    from obsynth.monitoring.calibration.logs import read_log

    log = with_words([*range(50), 700]).drop(columns="time")[["flow", "valve", "level"]]
    log.to_csv(tmp_path / "log.csv", index=False)
    log.to_parquet(tmp_path / "log.parquet")
    mapping = {name: list(values) for name, values in log.items()}
    for data in (tmp_path / "log.csv", tmp_path / "log.parquet", log, mapping):
        found = read_log(data, ["valve"], ["flow", "level"], dt=0.5)
        assert np.flatnonzero(np.isnan(found.y[:, 0])).tolist() == [*range(50), 700]
        assert any(note.startswith("51 cells of 'flow'") for note in found.notes)
