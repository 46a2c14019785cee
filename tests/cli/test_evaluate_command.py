"""``obsynth evaluate`` and ``obsynth run --monitor``: what they print, count and refuse."""

from __future__ import annotations

import json
import re
from pathlib import Path

import pandas as pd
import pytest

import obsynth
from obsynth.cli.main import main
from obsynth.specs.loader import load_spec

ROOT = Path(__file__).parents[2]
WANG = str(ROOT / "designs" / "wang2015" / "spec.yaml")
FILASOVA = str(ROOT / "designs" / "filasova" / "spec.yaml")


@pytest.fixture(scope="module")
def gains(tmp_path_factory) -> str:
    path = str(tmp_path_factory.mktemp("gains") / "wang2015.json")
    assert main(["design", "--system", WANG, "--output", path, "--quiet"]) == 0
    return path


def evaluated(gains: str, *more: str) -> int:
    return main(["evaluate", "--system", WANG, "--gains", gains, "--quiet", *more])


def test_json_is_what_python_gives(gains, capsys):
    assert evaluated(gains, "--runs", "40", "--monitor", "pointwise", "--json") == 0
    printed = json.loads(capsys.readouterr().out)
    design, scenario = obsynth.load(gains), load_spec(WANG).scenario
    wanted = obsynth.evaluate(design, scenario, runs=40, monitor=obsynth.monitor(design, scenario)).as_dict()
    assert printed["detection_delay"] == wanted["detection_delay"]
    assert printed["fault_rmse"] == wanted["fault_rmse"]
    assert (printed["runs"], printed["confidence"]) == (40, 0.95)
    assert printed["monitor"]["kind"] == "pointwise"
    assert "never passed without a fault" in printed["monitor"]["statement"]
    # The constants have tolerances: the threshold adapts to the signals, and that of the exact model is not it.
    assert printed["monitor"]["final_threshold"] is None


def test_the_table_has_intervals_and_says_what_the_threshold_means(gains, capsys):
    assert evaluated(gains, "--runs", "40", "--monitor", "paper", "--confidence", "0.9") == 0
    printed = " ".join(capsys.readouterr().out.split())
    for text in ("wang2015: 40 runs", "90 % interval", "false alarms", "missed detections", "actuator 1", "x4"):
        assert text in printed
    assert "not a pointwise bound" in printed
    assert re.search(r"Its threshold \(\d[.\de-]* at the end of a run\):", printed)
    assert evaluated(gains, "--runs", "3") == 0
    printed = capsys.readouterr().out
    assert "false alarms" not in printed
    assert "RMSE after warm-up" in printed


def test_errors_of_a_recursive_design_are_from_the_start(tmp_path, capsys):
    """It states how uncertain it is from the first row on: no warm-up is left out, and the table says none is."""
    spec = tmp_path / "spec.yaml"
    spec.write_text(
        "schema_version: 1\nname: lag\n"
        "plant: {dt: 1.0, A: [[0.9]], C: [[1.0]], sensor_noise: {y1: 0.1}}\n"
        "method: {id: descriptor-kalman, options: {Q: 0.01}}\n"
        "scenario: {horizon: 20, noise: 1}\n"
    )
    assert main(["evaluate", "--system", str(spec), "--runs", "2", "--quiet"]) == 0
    printed = capsys.readouterr().out
    assert "RMSE from row 1 on" in printed
    assert "warm-up" not in printed


@pytest.mark.long
def test_processes_do_not_change_the_numbers(gains, capsys):
    found = []
    for jobs in ("1", "2"):
        assert evaluated(gains, "--runs", "340", "--monitor", "pointwise", "--json", "--jobs", jobs) == 0
        found.append(json.loads(capsys.readouterr().out))
    assert found[0] == found[1]


@pytest.mark.parametrize(
    ("more", "message"),
    [
        (["--runs", "0"], "runs is 0"),
        (["--confidence", "1"], "confidence is 1"),
        (["--monitor", "nonsense"], "use one of"),
        (["--monitor", "pointwise", "--disturbance", "v=1"], "no signal named 'v'"),
        (["--monitor", "pointwise", "--disturbance", "w=one"], "'one' is no number"),
    ],
)
def test_bad_options_are_refused(gains, capsys, more, message):
    assert evaluated(gains, *more) == 2
    assert message in capsys.readouterr().err


@pytest.mark.parametrize(
    ("more", "message"),
    [
        (["--jobs", "0"], "argument --jobs: 0 is less than 1"),
        (["--monitor", "cusum", "--false-alarms", "2"], "argument --false-alarms"),
    ],
)
def test_numbers_out_of_range_are_refused_by_the_command_line(gains, capsys, more, message):
    with pytest.raises(SystemExit) as ended:
        evaluated(gains, *more)
    assert ended.value.code == 2
    assert message in capsys.readouterr().err


@pytest.mark.long
def test_decisions_on_parameters_are_counted(capsys):
    spec = str(ROOT / "designs" / "moussaali2013_ltv" / "spec.yaml")
    assert main(["evaluate", "--system", spec, "--runs", "3", "--monitor", "nis", "--quiet"]) == 0
    printed = " ".join(capsys.readouterr().out.split())
    assert "moussaali2013_ltv: 3 runs" in printed
    assert "Monitor nis" in printed
    assert "theta" in printed


def test_a_spec_without_a_scenario_has_nothing_to_evaluate(capsys):
    spec = str(ROOT / "designs" / "moussaali2013_ltv" / "as_printed.yaml")
    assert main(["evaluate", "--system", spec, "--quiet"]) == 2
    assert "has no scenario" in capsys.readouterr().err


def test_a_run_has_threshold_and_alarm_columns(gains, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    assert main(["simulate", "--system", WANG, "--gains", gains, "--out", "log.csv", "--quiet"]) == 0
    capsys.readouterr()
    run = ["run", "--gains", gains, "--data", "log.csv", "--out", "out.csv"]
    assert main([*run, "--monitor", "pointwise", "--system", WANG, "--threshold", "fhat[actuator 1]=0.9"]) == 0
    printed = capsys.readouterr().out
    assert "First alarm 81 s (monitor: pointwise). Probable fault: actuator 1." in printed
    assert "The pointwise threshold: never passed without a fault" in printed
    found = pd.read_csv("out.csv")
    assert list(found.columns[-3:]) == ["statistic", "threshold", "alarm"]
    assert found["alarm"][81] == "fhat[actuator 1]; pointwise: actuator 1"
    assert found["alarm"][:81].isna().all()
    above = found["statistic"] > found["threshold"]
    assert (found["alarm"].fillna("").str.contains("pointwise") == above).all()
    assert main([*run, "--monitor", "cusum", "--system", WANG, "--json"]) == 0
    printed = json.loads(capsys.readouterr().out)
    assert printed["isolated"] == "actuator 1"
    assert printed["monitor"]["kind"] == "cusum"
    assert 81.0 <= printed["alarms"]["cusum"] <= 90.0


def test_parquet_holds_the_columns_as_well(gains, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    assert main(["simulate", "--system", WANG, "--gains", gains, "--out", "log.csv", "--quiet"]) == 0
    run = ["run", "--gains", gains, "--data", "log.csv", "--quiet", "--monitor", "window", "--disturbance", "w=0.1"]
    for out in ("out.csv", "out.parquet"):
        assert main([*run, "--out", out]) == 0
    pd.testing.assert_frame_equal(
        pd.read_parquet("out.parquet").fillna({"alarm": ""}), pd.read_csv("out.csv").fillna({"alarm": ""})
    )


@pytest.mark.parametrize(
    ("more", "message"),
    [
        (["--system", WANG], "--system is for a monitor"),
        (["--noise-bound", "3"], "--noise-bound is for a monitor"),
        (["--disturbance", "w=1"], "--disturbance is for a monitor"),
        (["--monitor", "pointwise"], "No bound is given on "),
        (["--monitor", "nis"], "for this design: use one of"),
        (["--monitor", "pointwise", "--system", "bare.yaml"], "has no scenario"),
        (["--monitor", "pointwise", "--system", FILASOVA], "other signals"),
    ],
)
def test_a_monitor_that_makes_no_sense_is_refused_before_anything_is_written(
    gains, tmp_path, monkeypatch, capsys, more, message
):
    monkeypatch.chdir(tmp_path)
    Path("log.csv").write_text("time,u1,u2,x2,x3,x4\n0,0,0,0,0,0\n", encoding="utf-8")
    plant = f"plant: {{file: {Path(WANG).parent / 'plant.yaml'}}}"
    bare = f"schema_version: 1\nname: bare\n{plant}\nmethod: {{id: fault-estimation-filter}}\n"
    Path("bare.yaml").write_text(bare, encoding="utf-8")
    assert main(["run", "--gains", gains, "--data", "log.csv", "--out", "out.csv", *more]) == 2
    assert message in capsys.readouterr().err
    assert not Path("out.csv").exists()


LAG = (
    "schema_version: 1\nname: lag\n"
    "plant: {dt: 1.0, A: [[0.9]], C: [[1.0], [1.0]], Bf: [[1.0]], sensor_noise: {y1: 0.1, y2: 0.1}}\n"
    "method: {id: fault-estimation-filter}\n"
)


def test_a_plant_without_disturbances_has_no_sentence_on_them(tmp_path, capsys):
    spec = tmp_path / "spec.yaml"
    spec.write_text(LAG + "scenario: {horizon: 40, noise: 1}\n")
    assert main(["evaluate", "--system", str(spec), "--runs", "2", "--quiet"]) == 0
    printed = " ".join(capsys.readouterr().out.split())
    assert "if the model is exact, with noise within 3 standard deviations, |estimate of f1| <=" in printed
    assert "disturbances" not in printed


def test_errors_before_the_start_is_forgotten_are_not_called_after_warm_up(tmp_path, capsys):
    """`simulate` said that the response to the start had not settled, `evaluate` that errors came after warm-up."""
    spec = tmp_path / "spec.yaml"
    spec.write_text(
        "schema_version: 1\nname: slow\n"
        "plant: {dt: 1.0, A: [[0.999]], C: [[1.0]], Bf: [[1.0]], sensor_noise: {y1: 1}}\n"
        "method: {id: functional-filter, options: {fault_rate: 1.0e-5}}\nscenario: {horizon: 20, noise: 1}\n"
    )
    assert main(["evaluate", "--system", str(spec), "--runs", "2", "--quiet"]) == 0
    printed = " ".join(capsys.readouterr().out.split())
    assert "the initial-condition response has not settled: errors of the whole record" in printed
    assert "warm-up" not in printed


def test_what_a_recursive_design_estimates_are_parameters(tmp_path, capsys):
    """`simulate` named them so, `evaluate` called them faults."""
    spec = tmp_path / "spec.yaml"
    spec.write_text(
        LAG.replace("fault-estimation-filter", "adaptive-observer, options: {Q: 0.01, forgetting: 0.95}")
        + "scenario: {horizon: 20, noise: 1}\n"
    )
    for command in (["simulate"], ["evaluate", "--runs", "2"]):
        assert main([*command, "--system", str(spec), "--quiet"]) == 0
        printed = capsys.readouterr().out
        assert "Parameter estimates" in printed
        assert "Fault estimates" not in printed
