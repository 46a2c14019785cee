"""Alarms of guaranteed tests, proved by a fraction for each equation: what an auditor adds up, and what fails."""

from __future__ import annotations

import json
from collections.abc import Callable
from fractions import Fraction
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest

import obsynth
from obsynth.cli.main import main
from obsynth.results.gain_set_writing import digest_of

DT = 0.1


@cache
def tank(**more: Any) -> obsynth.GuaranteedTest:
    plant = obsynth.DescriptorSystem(
        None, [[0.95, 0.04], [0.04, 0.95]], B=[[0.1], [0.0]], C=np.eye(2), Bd=[[0.02], [0.0]],
        Bf=[[-0.1, 0.0], [0.0, -0.1]], dt=DT, state_names=["h1", "h2"], input_names=["pump"],
        output_names=["level 1", "level 2"], fault_names=["leak 1", "leak 2"], disturbance_names=["inflow"],
    )  # fmt: skip
    options = {"disturbance_bounds": 0.5, "noise_bound": {"level 1": 0.01, "level 2": 0.01}, "course": "constant"}
    return obsynth.guaranteed_test(plant, **{"fault": "leak 2", "samples": 6, **options, **more})


def record(leak: float, seed: int = 1) -> pd.DataFrame:
    plant, rng = tank().linear[0], np.random.default_rng(seed)
    x, rows = np.array([1.0, 0.5]), []
    for k in range(25):
        u = np.array([1.0 + 0.5 * np.sin(k)])
        rows.append([k * DT, *u, *(plant.C @ x + rng.uniform(-0.01, 0.01, 2))])
        fault = np.array([0.0, leak if k >= 10 else 0.0])
        x = plant.A @ x + plant.B @ u + plant.Bd[:, 0] * rng.uniform(-0.5, 0.5) + plant.Bf @ fault
    return pd.DataFrame(rows, columns=["time", "pump", "level 1", "level 2"])


@pytest.fixture(scope="module")
def proved(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a folder with a gain set, a log and the certificate of its alarm."""
    folder = tmp_path_factory.mktemp("alarm")
    record(3.0 * tank().threshold).to_csv(folder / "log.csv", index=False)
    tank().save(folder / "test.gains.json")
    arguments = ["--gains", str(folder / "test.gains.json"), "--data", str(folder / "log.csv"), "--row", "20"]
    assert main(["prove-alarm", *arguments, "--out", str(folder / "alarm.json")]) == 0
    return folder


def test_a_certificate_holds_beside_its_log_and_is_all_additions(proved: Path) -> None:
    assert main(["verify", str(proved / "alarm.json"), "--data", str(proved / "log.csv")]) == 0
    body = json.loads((proved / "alarm.json").read_text())["certificate"]
    assert "rows 15 to 20" in body["statement"]
    assert "whatever leak 1 does" in body["statement"]
    # What an auditor does: equations x(k+1) - A x(k) = ..., then y = C x + v, each times its number.
    plant, mu = tank().linear[0], [Fraction(text) for text in body["multipliers"]]
    equations, outputs = np.array(mu[:10]).reshape(5, 2), np.array(mu[10:]).reshape(6, 2)

    def exact(matrix: np.ndarray) -> np.ndarray:
        return np.array([[Fraction(value) for value in row] for row in matrix.tolist()], dtype=object)

    A, B, Bd, Bf, C = (exact(part) for part in (plant.A, plant.B, plant.Bd, plant.Bf, plant.C))
    for k in range(6):
        before = equations[k - 1] if k else np.zeros(2, dtype=int)
        after = equations[k] @ A if k < 5 else np.zeros(2, dtype=int)
        assert not any(before - after + outputs[k] @ C)
    assert not any(equations @ Bf[:, 0])
    log = pd.read_csv(proved / "log.csv").iloc[14:20]
    u, y = exact(log[["pump"]].to_numpy()), exact(log[["level 1", "level 2"]].to_numpy())
    total = sum((equations @ B * u[:5]).ravel()) + sum((outputs * y).ravel())
    allowed = Fraction(1, 2) * sum(abs(equations @ Bd[:, 0])) + Fraction(0.01) * sum(abs(outputs).ravel())
    assert abs(total) > allowed
    assert body["margin"] == pytest.approx(float(abs(total) / allowed - 1), rel=1e-12)


def test_a_run_alarms_and_proves_it(proved: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    arguments = ["--gains", str(proved / "test.gains.json"), "--data", str(proved / "log.csv")]
    written = ["--out", str(tmp_path / "out.csv"), "--prove", str(tmp_path / "alarm.json")]
    assert main(["run", *arguments, "--monitor", "pointwise", *written]) == 0
    assert "Probable fault: leak 2." in capsys.readouterr().out
    assert main(["verify", str(tmp_path / "alarm.json"), "--data", str(proved / "log.csv")]) == 0
    assert main(["run", *arguments, "--monitor", "pointwise", "--noise-bound", "2"]) == 2
    assert "noise_bound cannot be given for a guaranteed test" in capsys.readouterr().err


CHANGES: dict[str, tuple[Callable[[dict[str, Any]], Any], str]] = {
    "a multiplier": (lambda body: body["multipliers"].__setitem__(3, "1/3"), "proof"),
    "one equation less": (lambda body: body["multipliers"].pop(), "proof"),
    "the margin": (lambda body: body.update(margin=2.0 * body["margin"]), "margin"),
    "no margin": (lambda body: body.update(margin=0.0), "margin"),
    "the statement": (lambda body: body.update(statement=body["statement"].replace("leak 2", "leak 1")), "statement"),
    "the test": (lambda body: body.update(test="leak 1"), "contents"),
    "the row": (lambda body: body.update(row=19), "statement"),
    "no number": (lambda body: body["multipliers"].__setitem__(0, "1/0"), "contents"),
}


@pytest.mark.parametrize("change", CHANGES)
def test_what_is_changed_fails_though_its_digest_is_right(proved: Path, tmp_path: Path, change: str) -> None:
    document = json.loads((proved / "alarm.json").read_text())
    done, row = CHANGES[change]
    done(document["certificate"])
    document["sha256"] = digest_of(document["certificate"])
    (tmp_path / "alarm.json").write_text(json.dumps(document))
    report = obsynth.verify_alarm(tmp_path / "alarm.json")
    assert row in {check.name for check in report.failures}


def test_another_log_and_other_samples_fail(proved: Path, tmp_path: Path) -> None:
    log = pd.read_csv(proved / "log.csv")
    log.loc[16, "level 2"] += 0.1
    log.to_csv(tmp_path / "log.csv", index=False)
    assert "log" in {
        check.name for check in obsynth.verify_alarm(proved / "alarm.json", data=tmp_path / "log.csv").failures
    }
    healthy = obsynth.prove_alarm(tank(), record(0.0), 20)
    assert not healthy.proved
    assert "may be without a fault" in healthy.statement
    assert not obsynth.prove_alarm(tank(), record(3.0 * tank().threshold), 4).proved


def test_gaps_before_the_window_do_not_matter_and_in_it_are_refused() -> None:
    data = record(3.0 * tank().threshold).drop(index=[2, 3])
    assert obsynth.prove_alarm(tank(), data, 18).proved
    data.iloc[16, 2] = np.nan
    with pytest.raises(obsynth.SpecError, match="Row 17 has a gap before it or misses a sample"):
        obsynth.prove_alarm(tank(), data, 18)


def test_an_exact_interval_proves_alarms_that_the_fixed_test_does_not_raise() -> None:
    data, found = record(0.3 * tank().threshold, seed=2), tank(exact=True)
    fixed = obsynth.run_on_data(tank(), data, monitor=obsynth.online_monitor(tank()))
    exact = obsynth.run_on_data(found, data, monitor=obsynth.online_monitor(found))
    row = exact.alarm_rows["pointwise"]
    assert not fixed.alarms
    assert obsynth.prove_alarm(found, data, row).proved


def test_gains_of_a_bank_are_those_of_its_tests() -> None:
    bank = tank(isolate=True, fault=None)
    name, gain = next((name, gain) for name, gain in bank.gains.items() if name.startswith("h["))
    for gains, row in (({name: 1.001 * gain}, name.replace("h", "gains")), ({"K[none]": gain}, "bank")):
        report = obsynth.verify(bank.replace(gains={**bank.gains, **gains}))
        assert row in {check.name for check in report.failures}


def test_a_bank_proves_which_fault_it_is_and_bounds_are_those_of_the_design() -> None:
    bank = tank(isolate=True, fault=None)
    proof = obsynth.prove_alarm(bank, record(3.0 * tank().threshold), 20)
    assert "without leak 2, whatever leak 1 does" in proof.statement
    with pytest.raises(obsynth.SpecError, match="noise_bound cannot be given for a guaranteed test"):
        obsynth.prove_alarm(tank(), record(0.0), 20, noise_bound=1.0)
    with pytest.raises(obsynth.SpecError, match="the window of this test has 6 samples"):
        obsynth.prove_alarm(tank(), record(0.0), 20, window=9)


def test_a_statement_names_the_start_and_the_noise_of_each_sensor_whatever_its_sign() -> None:
    plant = obsynth.DescriptorSystem(
        None, [[0.9]], C=[[1.0], [1.0]], Bf=[[1.0]], Bw=np.zeros((1, 2)), Dw=[[-0.02, 0.0], [0.01, -0.03]], dt=1.0,
        output_names=["a", "b"],
    )  # fmt: skip
    test = obsynth.guaranteed_test(plant, course="constant", samples=3, noise_bound=2.0, initial_bounds={"x1": 4.0})
    proof = obsynth.prove_alarm(
        test, pd.DataFrame({"time": range(5), "a": [0, 9, 99, 9, 99], "b": [9, 0, 0, 99, 9]}), 5
    )
    assert "noise of a within 0.04, noise of b within 0.08, x1 at first within 4:" in proof.statement
