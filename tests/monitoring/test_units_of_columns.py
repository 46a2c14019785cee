"""Columns of a log in other units than those of the plant are converted, or refused: kelvin beside degC."""

import importlib.util

import numpy as np
import pandas as pd
import pytest

import obsynth
from obsynth.numerics import measurement_units
from obsynth.numerics.measurement_units import conversion

with_pint = pytest.mark.skipif(importlib.util.find_spec("pint") is None, reason="pint is not installed")


@pytest.fixture(scope="module")
def design():
    plant = obsynth.DescriptorSystem(
        A=[[0.9, 0.1], [0.0, 0.8]],
        B=[[0.0], [0.1]],
        C=[[1, 0], [0, 1]],
        Bf=[[1], [0]],
        dt=1.0,
        input_names=["power"],
        output_names=["wall", "air"],
        units={"power": "W", "wall": "degC", "air": "degC"},
        operating_point={"wall": 20.0, "air": 20.0},
        sensor_noise={"wall": 0.1, "air": 0.1},
    )
    return obsynth.ui_pi_observer(plant)


def log(design, tmp_path, header, *, units="", factor=(1.0, 1.0, 1.0), shift=(0.0, 0.0, 0.0)):
    """A log in other units, and its estimates in those of the plant."""
    rng = np.random.default_rng(1)
    own = np.column_stack([rng.uniform(50, 60, 30), 20.0 + rng.normal(size=(30, 2))])
    shown = own * factor + shift
    path = tmp_path / "log.csv"
    rows = [
        header,
        *([units] if units else []),
        *(f"{k},{a!r},{b!r},{c!r}" for k, (a, b, c) in enumerate(shown.tolist())),
    ]
    path.write_text("\n".join(rows) + "\n")
    table = pd.DataFrame({"time": np.arange(30.0), "power": own[:, 0], "wall": own[:, 1], "air": own[:, 2]})
    return path, obsynth.run_on_data(design, table).table


@with_pint
@pytest.mark.parametrize(
    ("header", "units"),
    [("time,power (kW),wall [K],air (degF)", ""), ("time,power,wall,air", "s,kW,K,degF")],
)
def test_values_are_converted_to_the_unit_of_the_plant(design, tmp_path, header, units):
    path, expected = log(design, tmp_path, header, units=units, factor=(1e-3, 1.0, 1.8), shift=(0.0, 273.15, 32.0))
    for data in [path] + ([] if units else [pd.read_csv(path)]):
        found = obsynth.run_on_data(design, data)
        np.testing.assert_allclose(found.table["fhat[f1]"], expected["fhat[f1]"], atol=1e-9)
        assert any("wall is converted from K" in text for text in found.warnings)


@with_pint
def test_a_stated_scale_goes_before_and_another_quantity_is_refused(design, tmp_path):
    path, expected = log(design, tmp_path, "time,power (kW),wall,air", factor=(1e-3, 1.0, 1.0))
    found = obsynth.run_on_data(design, path, scales={"power": 1000.0})
    np.testing.assert_allclose(found.table["fhat[f1]"], expected["fhat[f1]"], atol=1e-9)
    path, _ = log(design, tmp_path, "time,power,wall (bar),air")
    with pytest.raises(obsynth.SpecError, match=r"wall is in bar in the data, and in degC in the plant.*--scale wall="):
        obsynth.run_on_data(design, path)
    # What is no unit is a remark, as before.
    path, expected = log(design, tmp_path, "time,power,wall (north side),air")
    np.testing.assert_array_equal(obsynth.run_on_data(design, path).table["fhat[f1]"], expected["fhat[f1]"])


def test_without_pint_kelvin_beside_degrees_is_refused(design, tmp_path, monkeypatch):
    monkeypatch.setattr(measurement_units, "find_spec", lambda name: None)
    path, _ = log(design, tmp_path, "time,power,wall (K),air", shift=(0.0, 273.15, 0.0))
    with pytest.raises(obsynth.SpecError, match=r"obsynth\[units\]"):
        obsynth.run_on_data(design, path)
    path, expected = log(design, tmp_path, "time,power,wall (°C),air")
    np.testing.assert_array_equal(obsynth.run_on_data(design, path).table["fhat[f1]"], expected["fhat[f1]"])


def test_both_signs_of_micro_are_one_unit_without_pint(monkeypatch):
    monkeypatch.setattr(measurement_units, "find_spec", lambda name: None)
    assert conversion("\u00b5V", "\u03bcV") == (1.0, 0.0)


@with_pint
def test_conversions_are_exact_where_they_are_factors():
    assert conversion("mV", "V") == pytest.approx((1e-3, 0.0))
    assert conversion("K", "degC") == (1.0, -273.15)
    assert conversion("C", "K")[1] == 273.15
    assert conversion("degC", "°C") == (1.0, 0.0)
    assert conversion("north side", "degC") is None
    assert conversion("1 +", "V") is None


@with_pint
@pytest.mark.parametrize(
    ("header", "factor", "told", "scale"),
    [
        # The header is wrong: the values are in the unit of the plant.
        (
            "power (kW),wall,air",
            1.0,
            r"power .*its header says kW, and the values are in W already.*power=1,",
            1.0,
        ),
        ("power (mW),wall,air", 1.0, r"power .*its header says mW, and the values are in W already.*power=1,", 1.0),
        # Megawatts under a header of kilowatts.
        ("power (kW),wall,air", 1e-6, r"give the factor .*power=1000000,", 1e6),
    ],
)
def test_a_factor_that_is_advised_stands_instead_of_a_header_that_is_wrong(header, factor, told, scale):
    plant = obsynth.DescriptorSystem(
        A=[[0.9, 0.1], [0.0, 0.8]], B=[[0.0], [1e-4]], C=np.eye(2), Bf=[[1], [0]], dt=1.0,
        input_names=["power"], output_names=["wall", "air"], units={"power": "W", "wall": "degC", "air": "degC"},
        operating_point={"power": 5000.0, "wall": 20.0, "air": 20.0}, sensor_noise={"wall": 0.1, "air": 0.1},
    )  # fmt: skip
    heated = obsynth.ui_pi_observer(plant)
    rng = np.random.default_rng(1)
    own = np.column_stack([np.arange(30.0), 5000.0 + rng.normal(size=30), 20.0 + rng.normal(size=(30, 2))])
    expected = obsynth.run_on_data(heated, pd.DataFrame(own, columns=["time", "power", "wall", "air"])).table
    data = pd.DataFrame(own, columns=["time", *header.split(",")])
    data.iloc[:, 1] = own[:, 1] * factor
    with pytest.raises(obsynth.SpecError, match=told):
        obsynth.run_on_data(heated, data)
    found = obsynth.run_on_data(heated, data, scales={"power": scale})
    np.testing.assert_allclose(found.table["fhat[f1]"], expected["fhat[f1]"], atol=1e-9)


@with_pint
def test_kelvin_in_a_header_above_degrees_is_told():
    plant = obsynth.DescriptorSystem(
        A=[[0.9, 0.1], [0.0, 0.8]], C=np.eye(2), Bf=[[1], [0]], dt=1.0, output_names=["wall", "air"],
        units={"wall": "degC", "air": "degC"}, operating_point={"wall": 20.0, "air": 20.0},
        sensor_noise={"wall": 0.1, "air": 0.1},
    )  # fmt: skip
    cold = obsynth.ui_pi_observer(plant)
    own = np.column_stack([np.arange(30.0), 20.0 + np.random.default_rng(1).normal(size=(30, 2))])
    data = pd.DataFrame(own, columns=["time", "wall (K)", "air"])
    with pytest.raises(
        obsynth.SpecError, match=r"wall .*its header says K, and the values are in degC already.*wall=1"
    ):
        obsynth.run_on_data(cold, data)
    expected = obsynth.run_on_data(cold, pd.DataFrame(own, columns=["time", "wall", "air"])).table
    found = obsynth.run_on_data(cold, data, scales={"wall": 1.0}).table
    np.testing.assert_allclose(found["fhat[f1]"], expected["fhat[f1]"], atol=1e-9)


@with_pint
@pytest.mark.parametrize(("header", "factor"), [("power (kW),wall,air", 1.0), ("power [kW],wall,air", 1e-6)])
def test_validate_reads_the_unit_in_a_header_before_it_advises_a_factor(header, factor):
    """A stated factor stands instead of the header's unit: 0.001 was advised, with which watts were milliwatts."""
    plant = obsynth.DescriptorSystem(
        A=[[0.9, 0.1], [0.0, 0.8]], B=[[0.0], [1e-4]], C=np.eye(2), Bf=[[1], [0]], dt=1.0,
        input_names=["power"], output_names=["wall", "air"], units={"power": "W", "wall": "degC", "air": "degC"},
        operating_point={"power": 5000.0, "wall": 20.0, "air": 20.0}, sensor_noise={"wall": 0.1, "air": 0.1},
    )  # fmt: skip
    heated, rng, x, rows = obsynth.ui_pi_observer(plant), np.random.default_rng(3), np.zeros(2), []
    for k in range(300):
        power = 1000.0 * np.sin(k / 15.0)
        rows.append([k, factor * (5000.0 + power), *(20.0 + x + 0.1 * rng.standard_normal(2))])
        x = np.array([0.9 * x[0] + 0.1 * x[1], 0.8 * x[1] + 1e-4 * power])
    data = pd.DataFrame(rows, columns=["time", *header.split(",")])
    told = str(obsynth.validate(heated, data))
    assert f"scales={{'power': {1.0 / factor:.15g}}}" in told
    assert ("its header says kW, and the values are in W already" in told) == (factor == 1.0)
    read = str(obsynth.validate(heated, data, scales={"power": 1.0 / factor}))
    assert "scales=" not in read


@with_pint
def test_validate_tells_a_wrong_unit_of_a_nonlinear_plant_as_a_run_does():
    """It said that Q was thousands of times too small."""
    model = obsynth.DAEModel(
        {"room": "2e5 * der(a) = power + 200 * (5.0 - a)"}, {"air": "a"}, states={"a": 20.0},
        inputs={"power": 3000.0}, units={"power": "W", "air": "degC"},
    )  # fmt: skip
    heated = obsynth.dae_adaptive_observer(model, dt=60.0, Q={"room": 100.0}, R={"air": 0.01})
    rng, a, rows = np.random.default_rng(3), 20.0, []
    for k in range(300):
        power = 3000.0 + 1500.0 * np.sin(k / 15.0)
        rows.append([60.0 * k, power, a + 0.1 * rng.standard_normal()])
        for _ in range(10):
            a += 6.0 * (power + 200.0 * (5.0 - a)) / 2e5
    data = pd.DataFrame(rows, columns=["time", "power [kW]", "air"])
    with pytest.raises(obsynth.SpecError, match="its header says kW, and the values are in W already"):
        obsynth.run_on_data(heated, data)
    told = str(obsynth.validate(heated, data))
    assert "its header says kW, and the values are in W already" in told
