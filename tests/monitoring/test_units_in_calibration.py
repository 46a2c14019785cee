"""Units in the header of a log count where a plant is calibrated or validated as they do where a design runs."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest

import obsynth
from obsynth.monitoring.calibration.logs import read_log
from obsynth.studies.compared_records import ComparedLog

pytest.importorskip("pint")


def tank() -> obsynth.DAEModel:
    """Return a vessel that is heated and loses heat to a room at zero."""
    return obsynth.DAEModel(
        {"heat": "der(T) = power - c * T"},
        {"gauge": "T"},
        states={"T": 100.0},
        inputs={"power": 50.0},
        parameters={"c": 0.5},
        units={"T": "degC", "gauge": "degC", "power": "W"},
    )


def log(samples: int = 300) -> pd.DataFrame:
    rng, k = np.random.default_rng(5), np.arange(samples)
    power = 50.0 + 20.0 * np.sign(np.sin(0.1 * k))
    level = [100.0]
    for u in power[1:]:
        level.append((level[-1] + u) / 1.5)
    return pd.DataFrame({"time": k, "power": power, "gauge": np.array(level) + 0.2 * rng.normal(size=samples)})


#: By name: headers, and values as a log of them has.
HEADERS: dict[str, Any] = {
    "kelvin": ({"gauge": "gauge (K)"}, {"gauge": lambda values: values + 273.15}),
    "kilowatts": ({"power": "power [kW]"}, {"power": lambda values: values / 1000.0}),
    "both": (
        {"gauge": "gauge (K)", "power": "power [kW]"},
        {"gauge": lambda values: values + 273.15, "power": lambda values: values / 1000.0},
    ),
}


def in_other_units(name: str, own: pd.DataFrame) -> pd.DataFrame:
    header, changed = HEADERS[name]
    return own.assign(**{column: change(own[column]) for column, change in changed.items()}).rename(columns=header)


@pytest.mark.parametrize("name", HEADERS)
def test_a_log_in_other_units_is_read_as_the_same_log_in_the_plants(name: str, tmp_path: Path) -> None:
    plant, own, path = tank(), log(), tmp_path / "log.csv"
    other = in_other_units(name, own)
    other.to_csv(path, index=False)
    names = plant.input_names, plant.output_names
    expected = read_log(own, *names, units=plant.units)
    for data in (other, path):
        record = read_log(data, *names, units=plant.units)
        np.testing.assert_allclose(record.u, expected.u, rtol=1e-12)
        np.testing.assert_allclose(record.y, expected.y, rtol=1e-11)
        assert any("is converted from" in note for note in record.notes)


@pytest.mark.long
def test_a_log_in_other_units_is_calibrated_as_the_same_log_in_the_plants() -> None:
    own, box = log(), {"c": (0.1, 1.0)}
    found, expected = (obsynth.calibrate(tank(), data, box) for data in (in_other_units("both", own), own))
    assert found.nominal["c"] == pytest.approx(expected.nominal["c"], rel=1e-5)


def test_a_unit_that_cannot_be_converted_is_refused_where_no_factor_is_stated() -> None:
    plant, wrong = tank(), log().rename(columns={"gauge": "gauge (bar)"})
    with pytest.raises(obsynth.SpecError, match="gauge is in bar in the data, and in degC in the plant"):
        obsynth.calibrate(plant, wrong, {"c": (0.1, 1.0)})
    names = plant.input_names, plant.output_names
    assert read_log(wrong, *names, units=plant.units, scales={"gauge": 2.0}).y[0, 0] == 2.0 * wrong["gauge (bar)"][0]


def test_a_design_is_validated_on_a_log_in_other_units_as_on_the_same_log_in_the_plants() -> None:
    design = obsynth.dae_adaptive_observer(tank(), dt=1.0, Q=[[1e-4]], R=[[0.04]])
    own = log(120)
    values = [obsynth.validate(design, data).nis.value for data in (own, in_other_units("both", own))]
    assert values[0] == pytest.approx(values[1], rel=1e-6)


def test_designs_are_compared_on_a_log_in_other_units_as_on_the_same_log_in_the_plants() -> None:
    plant = obsynth.DescriptorSystem(
        A=[[0.8]], B=[[0.2]], C=[[1.0]], Bf=[[1.0]], dt=1.0, input_names=["power"], output_names=["gauge"],
        units={"power": "W", "gauge": "degC"}, sensor_noise={"gauge": 0.1},
    )  # fmt: skip
    own = log(60)
    other = own.assign(gauge=own.gauge + 273.15).rename(columns={"gauge": "gauge (K)"})
    record, converted = (ComparedLog(data).record(plant) for data in (own, other))
    np.testing.assert_allclose(converted.y, record.y, atol=1e-9)
