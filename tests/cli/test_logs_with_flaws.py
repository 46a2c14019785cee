"""The table of flaws: kinds of designs, what logs have that nobody cleaned, and every command that takes a log."""

from __future__ import annotations

import functools
import io
import tempfile
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest

import obsynth
from obsynth.cli.main import main

ROOT = Path(__file__).parents[2]
ROWS, AT = 220, 100
FLAWS = ("blank cell", "blank row", "gap", "repeated stamp", "jitter", "out of order", "outlier", "stuck sensor",
         "text cell", "column order")  # fmt: skip
#: A plant with an algebraic state, and a filter that estimates the fault with its deviation.
RECURSIVE = """
schema_version: 1
name: recursive
plant:
  dt: 0.1
  E: [[1, 0, 0], [0, 1, 0], [0, 0, 0]]
  A: [[0.95, 0.02, 0], [0.01, 0.96, 0.01], [1, 0.5, -1]]
  B: [[0.1], [0], [0]]
  C: [[1, 0, 0], [0, 1, 0]]
  Bf: [[0.1], [0], [0]]
  state_names: [a, b, c]
  input_names: [u]
  output_names: [ya, yb]
  fault_names: [f]
method:
  id: adaptive-observer
  options:
    early_constraints: true
    Q: [[1.0e-6, 0, 0], [0, 1.0e-6, 0], [0, 0, 0]]
    R: [[1.0e-4, 0], [0, 1.0e-4]]
    forgetting: 0.98
    initial_state: [0, 0, 0]
    initial_covariance: [[1.0e-4, 0, 0], [0, 1.0e-4, 0], [0, 0, 1.0e-4]]
    initial_parameter_covariance: [[0.01]]
scenario: {horizon: 3, faults: {f: {kind: step, size: 0.5, start: 1}}, noise: 1}
"""
#: The same plant without its algebraic state.
LINEAR = """
schema_version: 1
name: linear
plant:
  dt: 0.1
  A: [[0.95, 0.02], [0.02, 0.965]]
  B: [[0.1], [0]]
  C: [[1, 0], [0, 1]]
  Bf: [[0.1], [0]]
  state_names: [a, b]
  input_names: [u]
  output_names: [ya, yb]
  fault_names: [f]
  sensor_noise: {ya: 0.01, yb: 0.01}
method: {id: fault-estimation-filter}
scenario: {horizon: 3, faults: {f: {kind: step, size: 0.5, start: 1}}, noise: 1}
"""
KINDS = {"linear": LINEAR, "recursive": RECURSIVE, "nonlinear": ""}


def call(*arguments: Any) -> None:
    """Run a command: 0 is success."""
    assert main([str(argument) for argument in arguments]) == 0


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Specs and gain sets of each kind."""
    found = tmp_path_factory.mktemp("flaws")
    diode = (ROOT / "designs/diode_circuit/spec.yaml").read_text()
    plant = (ROOT / "designs/diode_circuit/plant.yaml").as_posix()
    nonlinear = (
        diode.replace("plant.yaml", plant).replace("horizon: 4 ", "horizon: 0.1 ").replace("start: 2", "start: 0.05")
    )
    for kind, text in {**KINDS, "nonlinear": nonlinear}.items():
        (found / f"{kind}.yaml").write_text(text)
        call("design", "--system", found / f"{kind}.yaml", "--out", found / f"{kind}.gains.json", "--quiet")
    return found


def clean(kind: str) -> pd.DataFrame:
    """Return a log of the plant, with the noise that the design assumes and an input that stays."""
    rng = np.random.default_rng(5)
    if kind == "nonlinear":
        spec = obsynth.load_spec(ROOT / "designs/diode_circuit/spec.yaml")
        y = obsynth.simulate_dae(spec.plant, np.full((ROWS, 1), 2.0), dt=1e-3, Q=[[0.0, 0.0], [0.0, 1e-10]], R=[[1e-6]],
                                 seed=2, integration="backward-euler").outputs[:ROWS]  # fmt: skip
        return pd.DataFrame({"time": 1e-3 * np.arange(ROWS), "source": 2.0, "seen": y[:, 0]})
    x, rows, A = np.zeros(2), [], np.array([[0.95, 0.02], [0.02, 0.965]])
    for k in range(ROWS):
        rows.append([0.1 * k, 1.0, *(x + 0.01 * rng.standard_normal(2))])
        x = A @ x + [0.1, 0.0] + 1e-3 * rng.standard_normal(2)
    return pd.DataFrame(rows, columns=["time", "u", "ya", "yb"])


def flawed(data: pd.DataFrame, *flaws: str) -> pd.DataFrame:
    """Return the log with flaws of its last sensor."""
    data, y, dt = data.copy(), data.columns[-1], data["time"][1]
    usual = float(data[y].diff().std())
    for flaw in flaws:
        if flaw == "blank cell":
            data.loc[AT, y] = np.nan
        if flaw == "blank row":
            data.loc[AT + 10, list(data.columns[1:])] = np.nan
        if flaw == "outlier":
            data.loc[AT + 30, y] += 1e4 * usual
        if flaw == "stuck sensor":
            data.loc[AT + 50 :, y] = data.loc[AT + 50, y] + 100.0 * usual
        if flaw == "jitter":
            data["time"] += dt * np.random.default_rng(5).uniform(-0.2, 0.2, len(data))
        if flaw == "text cell":
            data[y] = data[y].astype(object)
            data.loc[AT + 40, y] = "I/O Timeout"
    parts = [data.loc[: AT + 20]]
    if "repeated stamp" in flaws:
        parts.append(data.loc[AT + 20 : AT + 20])
    if "out of order" in flaws:
        parts.append(data.loc[AT + 14 : AT + 14])
    parts.append(data.loc[AT + 21 + (5 if "gap" in flaws else 0) :])
    data = pd.concat(parts)
    return data[list(data.columns[::-1])] if "column order" in flaws else data


@pytest.fixture(params=KINDS)
def kind(request: pytest.FixtureRequest) -> str:
    return str(request.param)


@pytest.mark.one_in(20)
@pytest.mark.parametrize("flaw", FLAWS)
@pytest.mark.parametrize("kind", ["recursive", "nonlinear"])
def test_run_thresholds_validate_and_smoothing_take_each_flaw(
    folder: Path, tmp_path: Path, kind: str, flaw: str, capsys: pytest.CaptureFixture[str]
) -> None:
    """Those of linear designs, by method, are in tests/monitoring/test_flaws_of_logs.py."""
    gains, log, out = folder / f"{kind}.gains.json", tmp_path / "log.csv", tmp_path / "out.csv"
    data = flawed(clean(kind), flaw)
    data.to_csv(log, index=False)
    fault = "load" if kind == "nonlinear" else "f"
    given = ("--gains", gains, "--data", log, "--quiet")
    call("run", *given, "--out", out, "--monitor", "nis")
    table = pd.read_csv(out, keep_default_na=False)
    assert len(table) == len(data)
    told = {"blank row": "gap", "repeated stamp": flaw, "out of order": flaw}.get(flaw, "ok")
    if flaw in ("blank cell", "text cell", "outlier"):
        # The diode has one sensor, of which nothing is left.
        told = "partial" if kind == "recursive" else "gap"
    assert told in set(table["status"])
    # What is not wrong for ever is over after thirty rows, and no alarm stays for it.
    after = table[table["time"] > data["time"].min() + (AT + 75) * data["time"].diff().median()]
    if flaw == "stuck sensor":
        assert (table["alarm"] != "").any()
    else:
        assert (after["status"] == "ok").all()
        assert (table["alarm"] == "").all()
        assert np.abs(after[f"fhat[{fault}]"].astype(float)).max() < (2e-3 if kind == "nonlinear" else 0.5)
    if (kind, flaw) == ("nonlinear", "stuck sensor"):
        # The diode's one sensor repeats 70 of 220 rows, which count as not measured.
        assert main([str(part) for part in ("thresholds", *given, "--out", tmp_path / "normal.json")]) == 2
        assert "Only 50 rows of the log can be used" in capsys.readouterr().err
    else:
        call("thresholds", *given, "--out", tmp_path / "normal.json")
        call("run", *given, "--out", out, "--force", "--monitor", "learned", "--normal", tmp_path / "normal.json")
    call("run", *given, "--out", out, "--force", "--smooth")
    assert main([str(part) for part in ("validate", *given)]) == (6 if flaw == "stuck sensor" else 0)
    assert "Traceback" not in "".join(capsys.readouterr())


@pytest.fixture(scope="module")
def dirty(folder: Path) -> dict[str, Path]:
    """A log of each kind with all flaws at once, but for the sensor that sticks."""
    found = {}
    for kind in KINDS:
        found[kind] = folder / f"{kind}.csv"
        flawed(clean(kind), *(flaw for flaw in FLAWS if flaw != "stuck sensor")).to_csv(found[kind], index=False)
    return found


@pytest.mark.one_in(3)
def test_pictures_and_pages_show_all_flaws_at_once(
    folder: Path, dirty: dict[str, Path], tmp_path: Path, kind: str
) -> None:
    given = ("--gains", folder / f"{kind}.gains.json", "--data", dirty[kind])
    call("plot", *given, "--out", tmp_path / "log.png", "--quiet")
    call("report", *given, "--out", tmp_path / "page.html")
    assert (tmp_path / "log.png").stat().st_size > 10_000
    assert "data:image" in (tmp_path / "page.html").read_text()


def test_a_stream_with_all_flaws_at_once_is_the_file_row_by_row(
    folder: Path, dirty: dict[str, Path], tmp_path: Path, kind: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    gains = ("--gains", folder / f"{kind}.gains.json")
    call("run", *gains, "--data", dirty[kind], "--out", tmp_path / "file.csv", "--quiet")
    monkeypatch.setattr("sys.stdin", io.StringIO(dirty[kind].read_text()))
    call("run", *gains, "--data", "-", "--out", tmp_path / "stream.csv", "--quiet")
    assert (tmp_path / "stream.csv").read_text() == (tmp_path / "file.csv").read_text()


@pytest.mark.one_in(3)
def test_comparisons_and_calibrations_take_all_flaws_at_once(
    folder: Path, dirty: dict[str, Path], tmp_path: Path, kind: str
) -> None:
    given = ("--system", folder / f"{kind}.yaml", "--data", dirty[kind], "--quiet")
    if kind != "nonlinear":
        call("compare", *given, "--out", tmp_path / "page.html")
    call("calibrate", *given, "--out", tmp_path / "found.json")


@functools.cache
def spec_of(kind: str) -> obsynth.Spec:
    with tempfile.TemporaryDirectory() as folder:
        (Path(folder) / "spec.yaml").write_text(KINDS[kind])
        return obsynth.load_spec(Path(folder) / "spec.yaml")


@functools.cache
def errors(kind: str, flaw: str) -> tuple[dict[str, float], tuple[str, ...]]:
    """Return the error of each method on a log without a fault, and what is said of the log."""
    data = flawed(clean(kind).assign(f=0.0)[["time", "u", "f", "ya", "yb"]], *([flaw] if flaw else []))
    found = obsynth.compare(spec_of(kind).plant, data=data, runs=1, scenario=spec_of(kind).scenario)
    return {entry.method: entry.faults[0].rms for entry in found.methods if not entry.refused}, found.notes


@pytest.mark.one_in(20)
@pytest.mark.parametrize("flaw", FLAWS)
@pytest.mark.parametrize("kind", ["linear", "recursive"])
def test_comparisons_have_the_errors_of_the_clean_log_with_each_flaw(kind: str, flaw: str) -> None:
    wanted, nothing = errors(kind, "")
    found, notes = errors(kind, flaw)
    assert len(wanted) >= 3
    assert found.keys() == wanted.keys()
    assert nothing == ()
    if flaw in ("outlier", "stuck sensor"):
        # Linear designs take each sample as it is; so does the rest of the table.
        assert found["fault-estimation-filter"] > 1.5 * wanted["fault-estimation-filter"]
    else:
        assert all(abs(rms / wanted[method] - 1.0) <= 0.05 for method, rms in found.items())
    told = {"stuck sensor": "yb repeats one value in rows 150 to 219", "text cell": "'I/O Timeout' in row 141"}.get(
        flaw
    )
    assert (len(notes), bool(told)) == (1 if told else 0, any(told in note for note in notes) if told else False)


@pytest.mark.one_in(15)
@pytest.mark.parametrize("flaw", FLAWS)
@pytest.mark.parametrize("kind", KINDS)
def test_calibrations_find_the_noise_of_the_clean_log_with_each_flaw(folder: Path, kind: str, flaw: str) -> None:
    plant = obsynth.load_spec(folder / f"{kind}.yaml").plant
    data = flawed(clean(kind), flaw)
    found = obsynth.calibrate(plant, data, {}, input_delay=0, starts=1)
    told = " ".join(found.verdict)
    true = 1e-6 if kind == "nonlinear" else 1e-4
    assert all(0.75 * true <= variance <= 1.25 * true for variance in found.R.values())
    assert found.log["dt"] == pytest.approx(1e-3 if kind == "nonlinear" else 0.1, rel=1e-4)
    said = {"gap": "5 rows are missing", "jitter": "The stamps jitter", "text cell": "counted as missing",
            "repeated stamp": "1 row left out", "out of order": "1 row left out",
            "outlier": "counted as not measured", "stuck sensor": "a stuck sensor repeats counts as not measured",
            "blank row": "missing: the last one before is held"}  # fmt: skip
    assert said.get(flaw, "") in told


@pytest.mark.long
def test_a_log_of_another_sampling_time_is_refused_by_calibrations_as_by_runs() -> None:
    plant, data = spec_of("linear").plant, clean("linear")
    with pytest.raises(obsynth.SpecError, match=r"a step takes 0\.1 s: the sampling time does not fit"):
        obsynth.calibrate(plant, data.assign(time=2.0 * data["time"]), {})
    # Rows that are left out are no other sampling time.
    assert obsynth.calibrate(plant, data.drop(index=range(1, 60)), {}, input_delay=0, starts=1).R["ya"] > 5e-5


@pytest.mark.long
@pytest.mark.parametrize("which", ["yb", "both in turn"])
def test_calibrations_take_a_sensor_that_is_slower_than_the_rows(which: str) -> None:
    """Numpy warned of differences that do not exist, and the noise of the sensor was taken as none."""
    plant, data = spec_of("linear").plant, clean("linear")
    data.loc[1::2, "yb"] = np.nan
    if which != "yb":
        data.loc[::2, "ya"] = np.nan
    R = obsynth.calibrate(plant, data, {}, input_delay=0, starts=1).R
    assert 0.7e-4 <= R["yb"] <= 1.3e-4


@pytest.mark.long
def test_infinite_outputs_count_as_not_measured_and_rows_without_stamps_are_named() -> None:
    plant, data = spec_of("linear").plant, clean("linear")
    data.loc[60, "yb"] = np.inf
    found = obsynth.calibrate(plant, data, {}, input_delay=0, starts=1)
    assert "1 infinite cell of 'yb' counted as missing, first in row 61." in found.verdict
    data.loc[61, "time"] = np.nan
    with pytest.raises(obsynth.SpecError, match="Row 61, counted from 0, has no time stamp"):
        obsynth.calibrate(plant, data, {})


@pytest.mark.long
def test_comparisons_refuse_signals_that_are_never_measured_and_show_truths_with_blanks(tmp_path: Path) -> None:
    plant, data = spec_of("linear").plant, clean("linear").assign(f=0.5)
    for name in ("u", "yb"):
        with pytest.raises(obsynth.SpecError, match=f"'{name}' is never measured"):
            obsynth.compare(plant, data=data.assign(**{name: np.nan}), runs=1)
    data.loc[AT:, "f"] = np.nan
    found = obsynth.compare(plant, data=data, runs=1, methods=["fault-estimation-filter"])
    assert np.isfinite(found.methods[0].faults[0].rms)
    # Limits of the panel were not numbers.
    assert np.isfinite(found.plot().axes[1].get_ylim()).all()


def test_only_faults_that_a_log_has_are_compared_on_it() -> None:
    """The other one was taken to be zero in the log."""
    plant = obsynth.DescriptorSystem(
        None, np.diag([0.8, 0.7]), None, ["a", "b"], Bf=np.eye(2), dt=0.1, state_names=["a", "b"],
        fault_names=["leak", "clog"], sensor_noise={"a": 0.01, "b": 0.01},
    )  # fmt: skip
    x, rows = np.zeros(2), []
    for k in range(80):
        rows.append([0.1 * k, *x, 1.0 * (k >= 20)])
        x = plant.A @ x + plant.Bf @ [1.0 * (k >= 20), 40.0]
    log = pd.DataFrame(rows, columns=["time", "a", "b", "leak"])
    found, drawn = (
        obsynth.compare(plant, data=data, runs=2, methods=["fault-estimation-filter"]).methods[0].faults
        for data in (log, None)
    )
    assert found[0].rms != drawn[0].rms
    assert found[1].rms == drawn[1].rms
