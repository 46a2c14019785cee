"""Tolerances from the command line: design, run, prove-alarm, verify, evaluate."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from obsynth.cli.main import main
from obsynth.results.gain_sets import load
from obsynth.tolerances.exact_plant import plant_at

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
