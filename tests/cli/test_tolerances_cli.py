"""Tolerances from the command line: design, run, prove-alarm, verify, evaluate."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from obsynth.cli.main import main
from obsynth.results.gain_sets import load
from obsynth.verification.over_tolerances.plants_of_the_box import plant_at

DRIVE = Path(__file__).parents[2] / "designs" / "drive" / "spec.yaml"
MONITOR = ["--disturbance", "load torque=0.2", "--noise-bound", "1.7320508",
           "--initial", "motor speed=0.2", "--initial", "load speed=-0.2:0.2", "--initial", "twist=0.2"]  # fmt: skip


@pytest.fixture(scope="module")
def gains(tmp_path_factory) -> Path:
    file = tmp_path_factory.mktemp("drive") / "gains.json"
    assert main(["design", "--system", str(DRIVE), "--output", str(file), "--quiet", "--json"]) == 0
    return file


def log(gains: Path, folder: Path, *, fault: float, steps: int = 150) -> Path:
    """Write a log of a drive at a vertex of its box."""
    plant = load(gains).plant
    true = plant_at(plant, plant.uncertainty.box.values(np.array([1.0, -1.0, 1.0, -1.0, 1.0])))
    generator = np.random.default_rng(0)
    x, rows = np.array([0.1, -0.1, 0.0]), []
    for k in range(steps):
        u = np.array([np.sin(0.1 * k)])
        y = true.C @ x + 0.002 * generator.choice([-1.0, 1.0], 2)
        rows.append([k * plant.dt, *u, *y])
        d = 0.2 * generator.choice([-1.0, 1.0], 1)
        x = true.A @ x + true.B @ u + true.Bd @ d + true.Bf @ [fault if k >= 80 else 0.0]
    file = folder / f"log_{fault}.csv"
    pd.DataFrame(rows, columns=["time", "torque", "motor speed", "load speed"]).to_csv(file, index=False)
    return file


@pytest.mark.long
def test_a_run_has_thresholds_intervals_and_shares(gains, tmp_path, capsys) -> None:
    out = tmp_path / "out.csv"
    data = str(log(gains, tmp_path, fault=0.0))
    command = ["run", "--gains", str(gains), "--data", data, "--out", str(out), "--monitor", "pointwise", *MONITOR]
    assert main([*command, "--warm-up", "0"]) == 0
    table = pd.read_csv(out)
    assert np.all(table["lowest loss of torque"] <= 0.0)
    assert np.all(table["highest loss of torque"] >= 0.0)
    assert np.all(table["threshold"] > 0.0)
    assert table["alarm"].isna().all()
    assert "share J2" in table
    assert "stated tolerance" in capsys.readouterr().out


@pytest.mark.long
def test_an_alarm_is_proved_written_and_verified(gains, tmp_path, capsys) -> None:
    data, out = str(log(gains, tmp_path, fault=2.0)), tmp_path / "alarm.json"
    command = ["prove-alarm", "--gains", str(gains), "--data", data, "--window", "12", *MONITOR]
    assert main([*command, "--row", "90", "--out", str(out), "--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    assert found["proved"]
    assert main(["verify", str(out), "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["passed"]
    out.write_text(out.read_text().replace('"row": 90', '"row": 91'))
    assert main(["verify", str(out)]) == 6
    assert main([*command, "--row", "60"]) == 0
    assert "Cannot be proved" in capsys.readouterr().out
    assert main([*command, "--row", "600"]) == 2


@pytest.mark.long
def test_a_run_proves_its_first_alarm(gains, tmp_path, capsys) -> None:
    data, certificate = str(log(gains, tmp_path, fault=2.0)), tmp_path / "alarm.json"
    command = ["run", "--gains", str(gains), "--data", data, "--out", str(tmp_path / "out.csv"), "--warm-up", "0"]
    command += ["--prove", str(certificate), "--force", "--json"]
    assert main([*command, "--monitor", "pointwise", "--window", "12", *MONITOR]) == 0
    proof = json.loads(capsys.readouterr().out)["proof"]
    assert proof["proved"]
    assert proof["file"] == str(certificate)
    assert main(["verify", str(certificate), "--json"]) == 0
    assert main([*command, "--monitor", "window"]) == 2
    assert "pointwise" in capsys.readouterr().err


@pytest.mark.long
def test_evaluate_draws_plants(gains, capsys) -> None:
    command = ["evaluate", "--system", str(DRIVE), "--gains", str(gains), "--runs", "10", "--plants", "10", "--quiet"]
    options = ["--monitor", "pointwise", "--noise-bound", "1.7320508", "--json"]
    assert main([*command, *options]) == 0
    found = json.loads(capsys.readouterr().out)
    assert found["false_alarm_rate"]["value"] == 0.0
    assert found["missed_detection_rate"]["value"] == 0.0


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ("nominal: 20.0, tolerance: 5 %", "range: [19.0, .inf]", "finite"),
        ("nominal: 20.0, tolerance: 5 %", "nominal: 0.0, tolerance: 5 %", "no per cent"),
        ("[J1, 0, 0]", "[J9, 0, 0]", "J9"),
        ("variation: constant", "variation: sometimes", "variation"),
    ],
)
def test_malformed_constants_are_refused(tmp_path, capsys, old: str, new: str, words: str) -> None:
    text = (DRIVE.parent / "plant.yaml").read_text()
    assert old in text
    (tmp_path / "plant.yaml").write_text(text.replace(old, new))
    (tmp_path / "spec.yaml").write_text(DRIVE.read_text())
    assert main(["check", "--system", str(tmp_path / "spec.yaml")]) == 2
    assert words in capsys.readouterr().err


HOIST = """
schema_version: 1
name: hoist
plant:
  dt: 0
  constants: {Jm: 0.01, Jd: 2, n: 10, k: K, m: 100, r: 0.2}
  state_names: [wm, wd, tau, F, v]
  E: [[Jm, 0, 0, 0, 0], [0, Jd, 0, 0, 0], [1, -n, 0, 0, 0], [0, 0, 0, 1, 0], [0, 0, 0, 0, m]]
  A: [[-0.02, 0, -1, 0, 0], [0, 0, n, -r, 0], [0, 0, 0, 0, 0], [0, k * r, 0, 0, -k], [0, 0, 0, 1, -300]]
  B: [[1], [0], [0], [0], [0]]
  C: {outputs: [wm, F, v]}
  Bf: [[-1], [0], [0], [0], [0]]
  sensor_noise: {wm: 0.05, F: 2, v: 0.005}
  transform: {eliminate_algebraic_states: true, sample_time: 0.01}
method: {id: fault-estimation-filter}
"""


@pytest.mark.long
def test_constants_without_a_tolerance_are_an_exact_model_and_rounding_is_no_tolerance(tmp_path, capsys) -> None:
    # A rigid gear, differentiated: E is singular by a combination of its rows, which is known up to rounding.
    data = tmp_path / "log.csv"
    data.write_text("time,u1,wm,F,v\n" + "".join(f"{k / 100},0,0,0,0\n" for k in range(50)), encoding="utf-8")
    for k, code, said in (("5000", 0, "assumes an exact model"), ("{nominal: 5000, tolerance: 2 %}", 3, "by hand")):
        spec, gains, out = tmp_path / "spec.yaml", str(tmp_path / "g.json"), str(tmp_path / "out.csv")
        spec.write_text(HOIST.replace("k: K", f"k: {k}"), encoding="utf-8")
        assert main(["design", "--system", str(spec), "--output", gains, "--force", "--quiet"]) == 0
        capsys.readouterr()
        run = ["run", "--gains", gains, "--data", str(data), "--out", out, "--force", "--monitor", "pointwise"]
        assert main([*run, "--noise-bound", "3"]) == code
        printed = capsys.readouterr()
        assert said in " ".join((printed.out + printed.err).split())
        assert "Give E no tolerance" not in printed.err
