"""An offset that a log without faults has shown is known to the design: a fault of its sensor looks the same later."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
import yaml

import obsynth
from obsynth.cli.main import main

OFFSET, ROWS = 0.06, 300


def log(seed: int) -> pd.DataFrame:
    """Return rows without faults of a room with a heater, whose sensor shows too much."""
    rng = np.random.default_rng(seed)
    power = np.repeat(rng.uniform(0.5, 1.5, ROWS // 25 + 1), 25)[:ROWS]
    x, shown = 1.0, np.zeros(ROWS)
    for k in range(ROWS):
        # Backward Euler with a step of one second, as the design has it.
        x = (x + 0.1 * power[k] + 1e-3 * rng.standard_normal() * (k > 0)) / 1.1 if k else x
        shown[k] = x + OFFSET + 0.01 * rng.standard_normal()
    return pd.DataFrame({"time": np.arange(float(ROWS)), "power": power, "y": shown})


SPEC = {
    "schema_version": 1,
    "name": "room",
    "plant": {
        "kind": "dae", "equations": {"heat": "der(x) = c * (power - x)"}, "outputs": {"y": "x + bias"},
        "states": {"x": 1.0}, "inputs": {"power": 1.0}, "parameters": {"bias": 0.0}, "constants": {"c": 0.1},
        "offset": {"y": "unknown"}, "sensor_noise": {"y": 0.01},
    },
    "method": {
        "id": "dae-adaptive-observer",
        "options": {
            "dt": 1.0, "form": "augmented-kalman", "Q": {"heat": 1.0e-6}, "R": {"y": 1.0e-4},
            "random_walk": {"bias": 1.0e-5}, "initial_parameter_covariance": {"bias": 1.0e-4},
            "integration": "backward-euler",
        },
    },
    "calibrate": {"log": "normal.csv", "input_delay": 0, "unknown": {"c": [0.05, 0.2]}},
}  # fmt: skip


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    found = tmp_path_factory.mktemp("room")
    log(1).to_csv(found / "normal.csv", index=False)
    (found / "spec.yaml").write_text(yaml.safe_dump(SPEC, sort_keys=False))
    asked = ["calibrate", "--system", str(found / "spec.yaml"), "--out", str(found / "c.json")]
    assert main([*asked, "--write-spec", str(found / "found.yaml"), "--quiet"]) == 0
    return found


@pytest.mark.long
def test_the_offset_of_the_log_and_its_deviation_are_told_and_written(folder: Path) -> None:
    value, deviation = json.loads((folder / "c.json").read_text())["found_offsets"]["y"]
    assert abs(value - OFFSET) <= 3.0 * deviation
    assert deviation <= 0.02
    options = yaml.safe_load((folder / "found.yaml").read_text())["method"]["options"]
    assert options["initial_state"] == {"offset_y": value}
    assert options["initial_covariance"]["offset_y"] == pytest.approx(deviation**2)


@pytest.mark.long
def test_the_design_takes_the_offset_for_no_fault_of_its_sensor(folder: Path) -> None:
    spec = obsynth.load_spec(folder / "found.yaml")
    design = obsynth.design(spec.plant, spec.method, **dict(spec.options))
    for seed in range(2, 6):
        table = obsynth.run_on_data(design, log(seed)).table
        assert table is not None
        # Of an unknown offset the fault took its share: a deviation of 0.019, and as large an error for the whole log.
        deviations = table["sd fhat[bias]"]
        assert deviations.iloc[-1] <= 0.01
        assert (np.abs(table["fhat[bias]"]) <= 4.0 * deviations).all()
        assert np.abs(table["xhat[offset_y]"] - OFFSET).max() <= 0.005


@pytest.mark.long
def test_another_log_shows_its_own_offset(folder: Path) -> None:
    data = log(9)
    data["y"] += 0.1
    data.to_csv(folder / "other.csv", index=False)
    written = folder / "again.json"
    spec = yaml.safe_load((folder / "found.yaml").read_text())
    del spec["calibrate"]["digest"]
    (folder / "again.yaml").write_text(yaml.safe_dump(spec, sort_keys=False))
    asked = ["calibrate", "--system", str(folder / "again.yaml"), "--data", str(folder / "other.csv")]
    assert main([*asked, "--out", str(written), "--quiet"]) == 0
    value, deviation = json.loads(written.read_text())["found_offsets"]["y"]
    assert abs(value - OFFSET - 0.1) <= 3.0 * deviation


def of_two_states(seed: int, offset: float) -> pd.DataFrame:
    """Return a log of a linear plant, whose first sensor shows too much."""
    rng = np.random.default_rng(seed)
    u = np.repeat(rng.uniform(-1.0, 1.0, ROWS // 20), 20)
    A, B, x, shown = np.array([[0.9, 0.05], [0.0, 0.8]]), np.array([0.1, 0.2]), np.zeros(2), np.zeros((ROWS, 2))
    for k in range(ROWS):
        shown[k] = x + [offset, 0.0] + 0.01 * rng.standard_normal(2)
        x = A @ x + B * u[k] + 1e-3 * rng.standard_normal(2)
    return pd.DataFrame({"time": np.arange(float(ROWS)), "u": u, "ya": shown[:, 0], "yb": shown[:, 1]})


LINEAR = {
    "schema_version": 1,
    "name": "two",
    "plant": {
        "dt": 1.0, "A": [[0.9, 0.05], [0.0, 0.8]], "B": [[0.1], [0.2]], "C": [[1, 0], [0, 1]],
        "Bw": [[0.001, 0.0], [0.0, 0.001]], "input_names": ["u"], "output_names": ["ya", "yb"],
        "offset": {"ya": "unknown"}, "sensor_noise": {"ya": 0.01, "yb": 0.01}, "operating_point": {"ya": 0.2},
    },
    "method": {"id": "descriptor-kalman"},
    "calibrate": {"input_delay": 0},
}  # fmt: skip


@pytest.mark.long
def test_an_offset_of_a_linear_plant_is_part_of_its_operating_point(tmp_path: Path) -> None:
    """The filter took hundreds of samples of each run to find it, from a deviation of 0.1 on."""
    of_two_states(1, 0.5).to_csv(tmp_path / "normal.csv", index=False)
    (tmp_path / "spec.yaml").write_text(yaml.safe_dump(LINEAR, sort_keys=False))
    asked = ["calibrate", "--system", str(tmp_path / "spec.yaml"), "--data", str(tmp_path / "normal.csv")]
    assert main([*asked, "--write-spec", str(tmp_path / "found.yaml"), "--quiet"]) == 0
    plant = yaml.safe_load((tmp_path / "found.yaml").read_text())["plant"]
    assert plant["offset"]["ya"] <= 0.003
    assert abs(plant["operating_point"]["ya"] - 0.5) <= 4.0 * plant["offset"]["ya"]
    spec = obsynth.load_spec(tmp_path / "found.yaml")
    design = obsynth.design(spec.plant, spec.method, **dict(spec.options))
    table = obsynth.run_on_data(design, of_two_states(3, 0.5)).table
    assert table is not None
    # From the first row on.
    assert np.abs(table["xhat[offset_ya]"]).max() <= 0.01


@pytest.mark.parametrize("method", ["descriptor-kalman", "dae-adaptive-observer"])
@pytest.mark.long
def test_a_start_that_is_stated_has_room_for_states_that_a_calibration_adds(method: str, tmp_path: Path) -> None:
    """The written spec kept a start and covariances without the state of the offset, and no design took them."""
    if method == "descriptor-kalman":
        document = json.loads(json.dumps(LINEAR))
        document["method"]["options"] = {
            "Q": [[1e-6, 0.0], [0.0, 1e-6]], "R": [[1e-4, 0.0], [0.0, 1e-4]], "initial_state": [0.1, 0.2],
            "initial_covariance": [[0.01, 0.001], [0.001, 0.01]],
        }  # fmt: skip
        data, start = of_two_states(1, 0.5), [0.1, 0.2, 0.0]
    else:
        document = json.loads(json.dumps(SPEC))
        del document["plant"]["offset"]
        document["plant"]["sensor_noise"] = {"y": {"deviation": "unknown", "correlation": "unknown"}}
        document["method"]["options"]["initial_state"] = [1.1]
        data, start = log(1), {"x": 1.1}
    data.to_csv(tmp_path / "normal.csv", index=False)
    (tmp_path / "spec.yaml").write_text(yaml.safe_dump(document, sort_keys=False))
    asked = ["calibrate", "--system", str(tmp_path / "spec.yaml"), "--data", str(tmp_path / "normal.csv")]
    assert main([*asked, "--write-spec", str(tmp_path / "found.yaml"), "--quiet"]) == 0
    options = yaml.safe_load((tmp_path / "found.yaml").read_text())["method"]["options"]
    assert options["initial_state"] == start
    spec = obsynth.load_spec(tmp_path / "found.yaml")
    design = obsynth.design(spec.plant, spec.method, **dict(spec.options))
    if method == "descriptor-kalman":
        deviation = yaml.safe_load((tmp_path / "found.yaml").read_text())["plant"]["offset"]["ya"]
        wanted = np.diag([0.01, 0.01, deviation**2])
        wanted[0, 1] = wanted[1, 0] = 0.001
        np.testing.assert_allclose(design.observer.initial_covariance, wanted, rtol=1e-12)
        # Of the noise that was found, and not of that which was stated.
        np.testing.assert_allclose(design.observer.R.at(0), spec.plant.Dw @ spec.plant.Dw.T, rtol=1e-12)
    assert obsynth.run_on_data(design, data).table is not None


def lagging(seed, offset, n=100):
    """Return a log of a first-order lag whose sensor reads so many deviations too much."""
    rng = np.random.default_rng(seed)
    u, x, y = np.repeat(rng.uniform(0.0, 2.0, n // 10 + 1), 10)[:n], 0.5, []
    for j in range(n):
        if j:
            x = np.exp(-0.5 / 2.2) * x + (1.0 - np.exp(-0.5 / 2.2)) * 1.3 * u[j] + 0.002 * rng.normal()
        y.append(x + 0.02 * (offset + rng.normal()))
    return {"time": 0.5 * np.arange(n), "u": u, "y": np.array(y)}


@pytest.mark.long
@pytest.mark.parametrize("offset", [0.0, 1.0, 2.0])
def test_boxes_hold_beside_offsets_that_are_too_small_to_be_seen(offset, share):
    model = obsynth.DAEModel(
        {"balance": "T * der(x) = k * u - x"}, {"y": "x"}, states={"x": 0.5}, inputs={"u": 1.0},
        constants={"T": 3.0, "k": 1.0}, units=dict.fromkeys(("x", "u", "k", "y", "T"), "1"),
    )  # fmt: skip
    bounds = {"T": (0.5, 10.0), "k": (0.2, 5.0)}
    found = [
        obsynth.calibrate(model, lagging(6_100 + seed, offset), bounds, input_delay=0, starts=1)
        for seed in share(range(10), 2)
    ]
    held = [one.box.holds({"T": 2.2, "k": 1.3}) for one in found]
    assert np.mean(held) >= 0.8
    # Where the offset has no state of its own the verdict says what the box holds for.
    assert all(one.offset or any("too small to be seen" in line for line in one.verdict) for one in found)
    stated = obsynth.calibrate(model, lagging(6_100, offset), bounds, input_delay=0, starts=1, offset={})
    assert not any("too small to be seen" in line for line in stated.verdict)
    if not found[0].offset:
        widths = [one.box.high["k"] - one.box.low["k"] for one in (stated, found[0])]
        assert widths[0] < widths[1]
