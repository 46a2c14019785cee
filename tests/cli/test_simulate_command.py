"""The verb ``simulate``: tables, JSON, files, and specs whose scenario is wrong."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from obsynth.cli.main import main

ROOT = Path(__file__).parents[2]
WANG = str(ROOT / "designs" / "wang2015" / "spec.yaml")
PLANT = """\
schema_version: 1
name: small
plant:
  dt: 0.1
  A: [[0.5, 0.1], [0, 0.8]]
  B: [[0], [1]]
  C: [[1, 0], [0, 1]]
  Bf: [[0], [1]]
  fault_names: [valve]
method: {id: fault-estimation-filter}
"""


def test_the_table_names_every_signal(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["simulate", "--system", WANG, "--quiet"]) == 0
    printed = capsys.readouterr().out
    assert "301 samples, 300 s" in printed
    assert "errors from 4 s on, when less than 1 % of the start is left" in printed
    for name in ("actuator 1", "actuator 2", "x4"):
        assert name in printed


def test_json_and_file(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    target = tmp_path / "run.csv"
    assert main(["simulate", "--system", WANG, "--quiet", "--json", "--out", str(target)]) == 0
    found = json.loads(capsys.readouterr().out)
    assert found["file"] == str(target)
    assert found["samples"] == 301
    assert found["faults"]["actuator 1"]["rmse"] == pytest.approx(0.0440, abs=1e-4)
    head = target.read_text(encoding="utf-8").splitlines()[0].split(",")
    assert head[:6] == ["time", "u1", "u2", "x2", "x3", "x4"]


@pytest.mark.one_in(4)
@pytest.mark.parametrize("name", ["wang2015_printed_psi", "sharepasand", "filasova", "smib", "kundur"])
def test_every_shipped_scenario_runs(name: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["simulate", "--system", str(ROOT / "designs" / name / "spec.yaml"), "--quiet", "--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    assert found["fault_warm_up"] is not None
    assert all(row["rmse"] < row["largest"] for row in found["faults"].values())


BAD = [
    ("{}", "scenario.horizon", "this key is missing"),
    ("{horizon: 5, seeds: 3}", "scenario.seeds", "unknown key. Did you mean 'seed'?"),
    ("{horizon: .nan}", "scenario.horizon", "must be"),
    ("{horizon: 5, seed: 1.5}", "scenario.seed", "a whole number"),
    ("{horizon: 5, noise: -1}", "scenario.noise", "at least 0"),
    ("{horizon: 5, sample_time: 0.2}", "scenario.sample_time", "but the plant has 0.1 s"),
    ("{horizon: 5, inputs: {u2: {kind: step, size: 1}}}", "scenario.inputs.u2", "no signal named 'u2'"),
    ("{horizon: 5, faults: {valv: {kind: step, size: 1}}}", "scenario.faults.valv", "Did you mean 'valve'?"),
    ("{horizon: 5, faults: {valve: {kind: stp, size: 1}}}", "scenario.faults.valve.kind", "one of 'step', 'ramp'"),
    ("{horizon: 5, faults: {valve: {kind: step}}}", "scenario.faults.valve.size", "a step needs this key"),
    ("{horizon: 5, faults: {valve: {kind: step, size: one}}}", "scenario.faults.valve.size", "must be a number"),
    ("{horizon: 5, faults: {valve: {kind: step, size: .inf}}}", "scenario.faults.valve.size", "finite number"),
    ("{horizon: 5, faults: {valve: {kind: step, size: 1, rate: 2}}}", "scenario.faults.valve.rate", "has no rate"),
    ("{horizon: 5, faults: {valve: {kind: step, sise: 1}}}", "scenario.faults.valve.sise", "Did you mean 'size'?"),
    ("{horizon: 5, faults: {valve: {kind: step, size: 1, start: 2, end: 1}}}", "scenario.faults.valve.end", "after"),
    ("{horizon: 5, faults: {valve: []}}", "scenario.faults.valve", "at least one entry"),
    ("{horizon: 5, faults: {valve: [{kind: step, sise: 1}]}}", "scenario.faults.valve.sise", "Did you mean 'size'?"),
    ("{horizon: 5, faults: {valve: 1}}", "scenario.faults.valve", "must be a mapping"),
    ("{horizon: 5, faults: {valve: {kind: uniform, low: 0, high: 1}}}", "scenario.faults.valve", "no meaning"),
    ("{horizon: 5, initial_state: {x9: 1}}", "scenario.initial_state.x9", "no signal named 'x9'"),
    ("{horizon: 5, sensor_noise: {y9: 1}}", "scenario.sensor_noise.y9", "no signal named 'y9'"),
    ("5", "scenario", "must be a mapping"),
]


@pytest.mark.parametrize(("scenario", "path", "fragment"), BAD, ids=[case[0] for case in BAD])
def test_bad_scenarios(
    scenario: str, path: str, fragment: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    spec = tmp_path / "spec.yaml"
    spec.write_text(f"{PLANT}scenario: {scenario}\n", encoding="utf-8")
    assert main(["simulate", "--system", str(spec), "--json", "--quiet", "--out", str(tmp_path / "run.csv")]) == 2
    error = json.loads(capsys.readouterr().out)
    assert error["error"] == "SpecError"
    assert error["path"] == path
    assert fragment in error["message"]
    assert [item.name for item in tmp_path.iterdir()] == ["spec.yaml"]


@pytest.mark.parametrize(
    ("scenario", "out", "fragment"),
    [
        ("", "run.csv", "has no scenario"),
        ("scenario: {horizon: 5, observer_state: [1]}", "run.csv", "observer_state needs"),
        ("scenario: {horizon: 5}", "missing/run.csv", "does not exist"),
        ("scenario: {horizon: 5}", "spec.yaml", "is the spec itself"),
        ("scenario: {horizon: 5}", ".", "give the name of a file to --out"),
    ],
)
def test_what_cannot_be_simulated_or_written(
    scenario: str, out: str, fragment: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    spec = tmp_path / "spec.yaml"
    spec.write_text(f"{PLANT}{scenario}\n", encoding="utf-8")
    assert main(["simulate", "--system", str(spec), "--quiet", "--out", str(tmp_path / out)]) == 2
    assert fragment in capsys.readouterr().err
    assert [item.name for item in tmp_path.iterdir()] == ["spec.yaml"]


def test_a_scenario_that_does_not_fit_a_plant_that_changes(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    source = (ROOT / "designs" / "moussaali2013_ltv" / "spec.yaml").read_text(encoding="utf-8").split("scenario:")[0]
    plant = (ROOT / "designs" / "moussaali2013_ltv" / "plant.yaml").read_text(encoding="utf-8")
    (tmp_path / "plant.yaml").write_text(plant, encoding="utf-8")
    (tmp_path / "spec.yaml").write_text(source + "scenario: {horizon: 5, stabilise: true}\n", encoding="utf-8")
    assert main(["simulate", "--system", str(tmp_path / "spec.yaml"), "--quiet"]) == 2
    error = capsys.readouterr().err
    assert "scenario.stabilise" in error
    assert "No feedback" in error


def test_gains_of_another_plant_are_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    gains = str(tmp_path / "gains.json")
    assert main(["design", "--system", str(ROOT / "designs/filasova/spec.yaml"), "--output", gains, "--quiet"]) == 0
    assert main(["simulate", "--system", WANG, "--gains", gains, "--quiet"]) == 2
    assert "is for a plant with other signals" in capsys.readouterr().err
