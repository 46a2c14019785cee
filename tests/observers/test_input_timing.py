"""Inputs of a row act during the step that begins there, or the one that ends there: the spec says which."""

from __future__ import annotations

import functools
import io
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest

import obsynth
from obsynth.cli.main import main

DT, ROWS = 0.1, 120
PLANT = """
schema_version: 1
name: heated
plant:
  dt: 0.1
  E: [[1, 0], [0, 1]]
  A: [[0.95, 0.02], [0.01, 0.9]]
  B: [[0.5], [0.2]]
  C: {outputs: [a, b]}
  Bf: [[0.1], [0]]
  state_names: [a, b]
  input_names: [u]
  output_names: [a, b]
  fault_names: [f]
method: {id: ui-pi-observer}
"""


@functools.cache
def heated() -> obsynth.ObserverDesign:
    plant = obsynth.DescriptorSystem(
        E=np.eye(2), A=[[0.95, 0.02], [0.01, 0.9]], B=[[0.5], [0.2]], C=np.eye(2), Bf=[[0.1], [0.0]], dt=DT,
        state_names=["a", "b"], input_names=["u"], output_names=["a", "b"], fault_names=["f"],
    )  # fmt: skip
    return obsynth.design(plant, "ui-pi-observer")


def log(delay: int, *, fault: float = 0.5) -> pd.DataFrame:
    """Return a log whose inputs act ``delay`` rows later than from their row on."""
    plant, x, found = heated().plant, np.zeros(2), []
    u = np.sign(np.sin(np.arange(ROWS + 20) / 3.0)) + np.cos(np.arange(ROWS + 20) / 5.0)
    for k in range(ROWS):
        found.append([k * DT, u[k + 10 + delay], *(plant.C @ x)])
        x = plant.A @ x + plant.B @ u[k + 10 : k + 11] + plant.Bf @ np.array([fault])
    return pd.DataFrame(found, columns=["time", "u", "a", "b"])


@pytest.mark.one_in(4)
@pytest.mark.parametrize("delay", [-2, -1, 0, 1, 3])
@pytest.mark.parametrize("way", ["frame", "small chunks", "stream"])
def test_inputs_are_taken_when_they_act(delay: int, way: str) -> None:
    design, data = heated().replace(input_delay=delay), log(delay)
    if way == "stream":
        out = io.StringIO()
        obsynth.run_on_data(design, io.StringIO(data.to_csv(index=False)), out)
        table = pd.read_csv(io.StringIO(out.getvalue()))
    else:
        table = obsynth.run_on_data(design, data, chunk_rows=7 if way == "small chunks" else 10_000).table
    assert table is not None
    assert len(table) == ROWS
    late = slice(60, ROWS - 5)
    np.testing.assert_allclose(table["fhat[f]"][late], 0.5, atol=2e-3)
    if delay:
        wrong = obsynth.run_on_data(heated(), data).table
        assert wrong is not None
        assert np.abs(wrong["fhat[f]"][late] - 0.5).max() > 0.5


def test_a_saved_state_goes_on_with_the_inputs_of_the_rows_before(tmp_path: Path) -> None:
    design, data, state = heated().replace(input_delay=2), log(2), tmp_path / "state.json"
    whole = obsynth.run_on_data(design, data).table
    parts = [obsynth.run_on_data(design, part, state=state).table for part in (data.iloc[:50], data.iloc[50:])]
    pd.testing.assert_frame_equal(whole, pd.concat(parts, ignore_index=True))
    with pytest.raises(obsynth.SpecError, match="another gain set"):
        obsynth.run_on_data(heated(), data, state=state)


@pytest.mark.one_in(4)
@pytest.mark.parametrize(
    ("inputs", "delay"),
    [("{hold: begins}", 0), ("{hold: ends}", -1), ("{hold: ends, delay: 2}", 1), ("{delay: 3}", 3)],
)
def test_the_spec_says_when_inputs_act(tmp_path: Path, monkeypatch: Any, inputs: str, delay: int) -> None:
    monkeypatch.chdir(tmp_path)
    Path("spec.yaml").write_text(PLANT + f"inputs: {inputs}\n")
    assert main(["design", "--system", "spec.yaml", "--output", "gains.json", "--quiet"]) == 0
    assert obsynth.load("gains.json").input_delay == delay
    log(delay).to_csv("log.csv", index=False)
    assert main(["run", "--gains", "gains.json", "--data", "log.csv", "--out", "own.csv"]) == 0
    found = pd.read_csv("own.csv")["fhat[f]"][60 : ROWS - 5]
    np.testing.assert_allclose(found, 0.5, atol=2e-3)
    # The command line overrides what the spec says.
    assert main(["run", "--gains", "gains.json", "--data", "log.csv", "--out", "o.csv", "--input-delay", "0"]) == 0
    other = pd.read_csv("o.csv")["fhat[f]"][60 : ROWS - 5]
    assert np.abs(other - 0.5).max() < 2e-3 if delay == 0 else np.abs(other - 0.5).max() > 0.1


NONLINEAR = """
schema_version: 1
name: tank
plant:
  kind: dae
  states: {h: 1.0}
  inputs: {u: 0.5}
  parameters: {c: 0.5}
  equations:
    der(h): u - c * sqrt(h)
  outputs: {level: h}
method:
  id: dae-adaptive-observer
  options: {dt: 0.5, Q: {h: 1e-4}, R: {level: 1e-4}}
"""


def test_nonlinear_plants_take_the_step_that_ends(tmp_path: Path) -> None:
    for hold, delay in (("begins", 1), ("ends", 0)):
        (tmp_path / "spec.yaml").write_text(NONLINEAR + f"inputs: {{hold: {hold}}}\n")
        spec = obsynth.load_spec(tmp_path / "spec.yaml")
        assert spec.input_delay(spec.plant) == delay


def test_what_makes_no_sense_is_refused(tmp_path: Path, monkeypatch: Any, capsys: Any) -> None:
    monkeypatch.chdir(tmp_path)
    Path("spec.yaml").write_text(PLANT.replace("dt: 0.1", "dt: 0").replace("0.95", "-0.95").replace("0.9]", "-0.9]")
                                 + "inputs: {hold: ends}\n")  # fmt: skip
    with pytest.raises(obsynth.SpecError, match="straight lines"):
        obsynth.load_spec("spec.yaml")
    Path("spec.yaml").write_text(PLANT + "inputs: {hold: middle}\n")
    with pytest.raises(obsynth.SpecError, match="hold"):
        obsynth.load_spec("spec.yaml")
    for delay in (1.5, True, 10**6):
        with pytest.raises(obsynth.SpecError, match="input_delay"):
            heated().replace(input_delay=delay)
    heated().save("gains.json")
    log(0).to_csv("log.csv", index=False)
    assert main(["run", "--gains", "gains.json", "--data", "log.csv", "--input-delay", "auto", "--out", "o.csv"]) == 2
    assert "calibrate" in capsys.readouterr().err


CALIBRATED = """
schema_version: 1
name: tank
plant:
  kind: dae
  states: {h: 1.0}
  inputs: {u: 0.5}
  parameters: {loss: 0.0}
  constants: {c: 0.5}
  equations:
    balance: der(h) = u * (1 - loss) - c * h
  outputs: {level: h}
  sensor_noise: {level: 0.01}
  LINEAR
calibrate: {unknown: {c: [0.3, 0.9]}, log: log.csv, starts: 1, integration: radau, offset: {}}
method: METHOD
inputs: {delay: 0}
"""


def tank_log(path: Path, seed: int, *, delay: int, loss: float = 0.0, rows: int = 200) -> None:
    """Write a log whose inputs act during the step that ends ``delay`` rows later, the loss from row 100 on."""
    rng, h, found = np.random.default_rng(seed), 1.0, []
    u = np.repeat(rng.uniform(0.3, 0.7, rows), 6)
    for k in range(rows):
        flow = u[20 + k - delay] * (1.0 - loss * (k >= 100))
        # The exact solution of a step of half a second with c = 0.55.
        h = flow / 0.55 + (h - flow / 0.55) * np.exp(-0.55 * 0.5) if k else h
        found.append([0.5 * k, u[20 + k], h + 0.01 * rng.standard_normal()])
    pd.DataFrame(found, columns=["time", "u", "level"]).to_csv(path, index=False)


@pytest.mark.long
def test_a_delay_that_calibrate_finds_is_taken_by_every_command(tmp_path: Path, monkeypatch: Any) -> None:
    monkeypatch.chdir(tmp_path)
    method = (
        "{id: dae-adaptive-observer, options: {dt: 0.5, Q: {balance: 1.0e-6}, R: {level: 1.0e-4}, "
        "random_walk: {loss: 1.0e-7}, initial_parameter_covariance: {loss: 1.0e-5}}}"
    )
    Path("spec.yaml").write_text(CALIBRATED.replace("METHOD", method).replace("LINEAR", ""))
    tank_log(Path("log.csv"), 0, delay=2)
    tank_log(Path("normal.csv"), 3, delay=2)
    tank_log(Path("faulty.csv"), 2, delay=2, loss=0.05)
    # What the command line asks for, and what is found, takes the place of what the spec said.
    calibrate = ["calibrate", "--system", "spec.yaml", "--write-spec", "found.yaml", "--input-delay", "auto"]
    assert main([*calibrate, "--quiet"]) == 0
    # The file that --force replaces may be the spec alone.
    assert main([*calibrate, "--quiet", "--force"]) == 0
    assert obsynth.load_spec("found.yaml").inputs == {"hold": "ends", "delay": 2}
    assert main(["design", "--system", "found.yaml", "--output", "gains.json", "--quiet"]) == 0
    assert obsynth.load("gains.json").input_delay == 2
    assert main(["validate", "--gains", "gains.json", "--data", "normal.csv", "--quiet"]) == 0
    assert main(["validate", "--gains", "gains.json", "--data", "normal.csv", "--input-delay", "0", "--quiet"]) == 6
    assert main(["run", "--gains", "gains.json", "--data", "faulty.csv", "--out", "out.csv", "--quiet"]) == 0
    loss = pd.read_csv("out.csv")["fhat[loss]"]
    assert loss[180:].mean() == pytest.approx(0.05, abs=0.01)
    assert loss[50:100].mean() == pytest.approx(0.0, abs=0.01)


def test_a_delay_without_a_word_is_by_the_convention_of_the_plant_that_is_designed_for(tmp_path: Path) -> None:
    linear = "transform: {linearise: {faults: [loss]}, sample_time: 0.5}"
    text = CALIBRATED.replace("METHOD", "{id: fault-estimation-filter}").replace("LINEAR", linear)
    for inputs, designed, written in (("{delay: 1}", 1, 2), ("{hold: ends, delay: 2}", 1, 2), ("{hold: begins}", 0, 1)):
        (tmp_path / "spec.yaml").write_text(text.replace("inputs: {delay: 0}", f"inputs: {inputs}"))
        spec = obsynth.load_spec(tmp_path / "spec.yaml")
        # Both say the same of the log: a step that begins with a row ends with the next one.
        assert spec.input_delay(spec.plant) == designed
        assert spec.input_delay(spec.model) == written
