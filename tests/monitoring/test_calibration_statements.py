"""What a user states that there is none of is not searched for, and noise that is too large for noise is named."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

import obsynth
from obsynth.cli.main import main
from obsynth.monitoring.calibration import noise_proposals
from obsynth.specs.loader import load_plant

SPEC = """schema_version: 1
name: tank
plant:
  kind: dae
  equations: {balance: der(level) = gain * inflow - c * level}
  outputs: {gauge: level}
  states: {level: 1.0}
  inputs: {inflow: 0.5}
  constants: {gain: 1.0, c: 0.5}
  offset: {}
  sensor_noise: {}
method: {id: dae-adaptive-observer, options: {dt: 1.0, Q: {balance: 1.0e-6}, R: {gauge: 1.0e-4}}}
"""


def log(c: float, rows: int = 150, noise: float = 0.01) -> dict[str, np.ndarray]:
    """Return a log of a tank, by backward Euler, whose outflow has this constant."""
    rng, level, found = np.random.default_rng(0), 1.0, []
    inflow = 0.5 + 0.2 * np.sign(np.sin(0.1 * np.arange(rows)))
    for k, u in enumerate(inflow):
        level = (level + u) / (1.0 + c) if k else level
        found.append(level + noise * rng.standard_normal())
    return {"time": np.arange(float(rows)), "inflow": inflow, "gauge": np.array(found)}


def test_a_plant_that_states_no_offsets_says_so_to_calibrate(tmp_path: Path) -> None:
    """``offset: {}`` of a plant was read and forgotten: calibrate took an offset for a sensor that has none."""
    file = tmp_path / "spec.yaml"
    file.write_text(SPEC, encoding="utf-8")
    _, spec = load_plant(file)
    assert spec is not None
    assert spec.noise == {"offset": {}, "sensor_noise": {}}


@pytest.mark.long
def test_no_offset_is_taken_where_the_plant_states_none(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    import pandas as pd

    for name, text in (("none", SPEC), ("open", SPEC.replace("  offset: {}\n", ""))):
        (tmp_path / f"{name}.yaml").write_text(text, encoding="utf-8")
        data = pd.DataFrame(log(0.5))
        data["gauge"] += 0.2
        data.to_csv(tmp_path / "log.csv", index=False)
        arguments = ["--data", str(tmp_path / "log.csv"), "--unknown", "gain=0.5:2"]
        main(["calibrate", "--system", str(tmp_path / f"{name}.yaml"), *arguments])
        assert ("has an offset" in capsys.readouterr().out) == (name == "open")


@pytest.mark.long
def test_an_error_of_the_model_is_not_called_noise_alone(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(noise_proposals, "NATS_OF_MODEL_ERRORS", 1.5)  # a short log shows 1.9
    model = obsynth.DAEModel(
        {"balance": "der(level) = gain * inflow - c * level"}, {"gauge": "level"}, states={"level": 1.0},
        inputs={"inflow": 0.5}, constants={"gain": 1.0, "c": 0.5},
    )  # fmt: skip
    drifting = log(0.5, noise=0.001)
    drifting["gauge"] = drifting["gauge"] + 0.25 * np.sin(2.0 * np.pi * np.arange(150) / 150)
    right = obsynth.calibrate(model, log(0.5), {"gain": (0.5, 2.0)}, starts=1)
    wrong = obsynth.calibrate(model, drifting, {"gain": (0.5, 2.0)}, starts=1)
    text = "a constant that is not among the unknown ones"
    assert text not in str(right)
    assert text in str(wrong)
    assert "noise that lasts as long as the log" in str(wrong)
