"""A log that fits the design after a usual change of unit is stopped with the likely factor."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pandas as pd
import pytest

import obsynth
from obsynth.cli.main import main
from obsynth.errors import SpecError

ROWS = 60


@pytest.fixture(scope="module")
def vessel():
    """Return a vessel with a valve in bar and degrees Celsius."""
    model = obsynth.DAEModel(
        {"mass": "20 * der(p) = speed - (0.2 + leak) * valve * p", "metal": "40 * der(T) = 20 + 4 * speed * p - T"},
        {"press": "p", "temp": "T"}, states={"p": 5.0, "T": 40.0}, inputs={"speed": 1.0, "valve": 1.0},
        parameters={"leak": 0.0},
    )  # fmt: skip
    return obsynth.dae_adaptive_observer(
        model, dt=1.0, Q={"mass": 1e-4, "metal": 1e-4}, R={"press": 1e-3, "temp": 0.04}, form="augmented-kalman",
        random_walk={"leak": 1e-8}, initial_parameter_covariance={"leak": 1e-6},
        initial_covariance={"p": 0.01, "T": 1.0},
    )  # fmt: skip


def log(start=(5.0, 40.0), length=ROWS) -> pd.DataFrame:
    """Return rows of the vessel, by small steps of Euler."""
    rng, x, rows = np.random.default_rng(3), np.array(start), []
    for k in range(length):
        speed, valve = 1.0 + 0.2 * np.sign(np.sin(0.3 * k)), 1.0
        for _ in range(20 if k else 0):
            x = x + 0.05 * np.array([(speed - 0.2 * valve * x[0]) / 20.0, (20.0 + 4.0 * speed * x[0] - x[1]) / 40.0])
        rows.append([k, speed, valve, x[0] + 0.03 * rng.standard_normal(), x[1] + 0.2 * rng.standard_normal()])
    return pd.DataFrame(rows, columns=["time", "speed", "valve", "press", "temp"])


@pytest.mark.one_in(4)
@pytest.mark.parametrize(
    ("name", "change", "told"),
    [
        ("press", lambda y: 1e5 * y, r"multiplying by 1e-05 \(Pa for bar\).*--scale press=1e-05"),
        ("temp", lambda y: y + 273.15, r"adding -273.15 \(kelvin for degrees Celsius\).*temp \(K\)"),
        ("valve", lambda u: 100.0 * u, r"multiplying by 0.01 \(percent for shares of one\).*--scale valve=0.01"),
        ("press", lambda y: -y, r"multiplying by -1 \(the other sign\)"),
        ("speed", lambda u: 60.0 * u, r"multiplying by 0.0166667 .*--scale speed=0.0166666666666667"),
    ],
)
def test_a_log_in_another_unit_is_stopped_with_the_factor(vessel, name, change, told):
    data = log()
    data[name] = change(data[name])
    with pytest.raises(SpecError, match=told) as refused:
        obsynth.run_on_data(vessel, data)
    assert refused.value.path == f"columns.{name}"
    assert obsynth.run_on_data(vessel, data, units_as_is=True).rows == ROWS


def test_the_remedy_works(vessel):
    data = log()
    data["press"] *= 1e5
    found = obsynth.run_on_data(vessel, data, scales={"press": 1e-5}).table
    assert np.abs(found["xhat[p]"] - obsynth.run_on_data(vessel, log()).table["xhat[p]"]).max() < 1e-9


@pytest.mark.one_in(5)
@pytest.mark.parametrize("start", [(5.0, 40.0), (3.0, 60.0), (0.05, 40.0), (5.0, 313.15), (500.0, 40.0)])
def test_a_start_that_is_not_the_designs_is_no_change_of_unit(vessel, start):
    assert obsynth.run_on_data(vessel, log(start)).rows == ROWS


@pytest.mark.parametrize("name", ["press", "speed"])
def test_what_any_small_factor_would_explain_is_no_change_of_unit(name):
    """Near an operating point of zero a signal that is far off is as good as zero after any small factor."""
    plant = obsynth.DescriptorSystem(
        A=[[0.9]], B=[[1.0]], C=[[1.0]], Bw=[[0.1, 0.0]], Dw=[[0.0, 0.1]], dt=1.0,
        input_names=["speed"], output_names=["press"],
    )  # fmt: skip
    design = obsynth.descriptor_kalman(plant)
    rng = np.random.default_rng(4)
    frame = pd.DataFrame({"time": np.arange(40.0), "speed": 0.0, "press": 0.1 * rng.standard_normal(40)})
    frame[name] = 50.0 * rng.standard_normal(40)
    assert len(obsynth.run_on_data(design, frame, outliers="none").table) == 40


def test_a_sensor_that_is_stuck_at_zero_is_in_no_other_unit():
    plant = obsynth.DescriptorSystem(
        A=[[0.9]], C=[[1.0]], Bf=[[1.0]], dt=1.0, output_names=["T"], operating_point={"T": 300.0}
    )  # fmt: skip
    frame = pd.DataFrame({"time": np.arange(40.0), "T": np.zeros(40)})
    assert len(obsynth.run_on_data(obsynth.fault_estimation_filter(plant), frame).table) == 40


def test_outliers_and_blanks_at_the_start_are_none(vessel):
    data = log()
    data.loc[0, "press"], data.loc[3, "temp"] = 500.0, np.nan
    assert obsynth.run_on_data(vessel, data).rows == ROWS


def test_a_linear_design_is_asked_for_its_operating_point():
    plant = obsynth.DescriptorSystem(
        A=[[0.9, 0.1], [0.0, 0.8]], C=np.eye(2), Bf=[[1], [0]], dt=1.0, output_names=["wall", "flow"],
        operating_point={"wall": 20.0}, sensor_noise={"wall": 0.1, "flow": 0.1},
    )  # fmt: skip
    design = obsynth.ui_pi_observer(plant)
    data = pd.DataFrame({"time": np.arange(30.0), "wall": 293.15 + 0.1 * np.cos(np.arange(30.0)), "flow": np.zeros(30)})
    with pytest.raises(SpecError, match=r"wall.*adding -273.15"):
        obsynth.run_on_data(design, data)
    # What moves from 0 to its operating point is a start.
    data["wall"] = np.linspace(0.0, 20.0, 30)
    assert obsynth.run_on_data(design, data).rows == 30
    # What is infinite is not measured, and no number to compare.
    infinite = data.assign(wall=np.where(data.index < 29, np.inf, 20.0))
    assert obsynth.run_on_data(design, infinite).statuses["gap"] == 29


def test_levels_are_not_learned_from_a_log_in_another_unit(vessel):
    normal, kelvin = log(), log()
    kelvin["temp"] += 273.15
    # Every log is looked at, not only the first.
    for data in (kelvin, [normal, kelvin]):
        with pytest.raises(SpecError, match=r"adding -273.15 \(kelvin for degrees Celsius\)") as refused:
            obsynth.learn_thresholds(vessel, data)
        assert refused.value.path == "columns.temp"
    # A monitor takes no option of logs: it says whose result it takes.
    with pytest.raises(SpecError, match=r"adding -273.15.*obsynth.learn_thresholds"):
        obsynth.online_monitor(vessel, "learned", normal=kelvin)


@pytest.mark.long
def test_levels_are_learned_after_either_remedy(vessel, tmp_path: Path, capsys):
    vessel.save(tmp_path / "g.json")
    data = log(length=400)
    expected = obsynth.learn_thresholds(vessel, data).levels
    data["press"] *= 1e5
    data.to_csv(tmp_path / "log.csv", index=False)
    scaled = obsynth.learn_thresholds(vessel, data, scales={"press": 1e-5}).levels
    np.testing.assert_allclose(scaled, expected, rtol=1e-6)
    given = ["thresholds", "--gains", str(tmp_path / "g.json"), "--data", str(tmp_path / "log.csv")]
    assert main(given) == 2
    assert "--scale press=1e-05" in capsys.readouterr().err
    assert main([*given, "--units-as-is"]) == 0
    assert main([*given, "--scale", "press=1e-05"]) == 0


@pytest.mark.long
def test_a_command_stops_and_goes_on_where_told(vessel, tmp_path: Path, capsys):
    vessel.save(tmp_path / "g.json")
    data = log()
    data["press"] *= 1e5
    data.to_csv(tmp_path / "log.csv", index=False)
    given = ["run", "--gains", str(tmp_path / "g.json"), "--data", str(tmp_path / "log.csv"), "--out"]
    assert main([*given, str(tmp_path / "o.csv")]) == 2
    assert "--scale press=1e-05" in capsys.readouterr().err
    assert not (tmp_path / "o.csv").exists()
    assert main([*given, str(tmp_path / "o.csv"), "--units-as-is"]) == 0
    assert main([*given, str(tmp_path / "o.csv"), "--force", "--scale", "press=1e-05"]) == 0
