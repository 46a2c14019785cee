"""Numbers that come as something else: quantities with units, lengths of time, fractions."""

from __future__ import annotations

from datetime import timedelta
from decimal import Decimal
from fractions import Fraction
from typing import Any

import numpy as np
import pint
import pytest
import sympy

import obsynth

UNITS = pint.UnitRegistry()
PLANT: dict[str, Any] = {"A": [[0.9, 0.1], [0.0, 0.8]], "C": np.eye(2), "Bf": [[0.0], [1.0]], "dt": 0.1}


@pytest.mark.parametrize(
    "length", [100 * UNITS.ms, timedelta(milliseconds=100), np.timedelta64(100, "ms"), np.float32(0.1)]
)
def test_a_sampling_time_is_a_length_of_time(length: Any) -> None:
    assert obsynth.DescriptorSystem(**{**PLANT, "dt": length}).dt == pytest.approx(0.1, rel=1e-7)


@pytest.mark.parametrize("length", [5 * UNITS.mV, "100 ms", None, True])
def test_what_is_no_length_of_time_is_no_sampling_time(length: Any) -> None:
    with pytest.raises(obsynth.SpecError, match="dt"):
        obsynth.DescriptorSystem(**{**PLANT, "dt": length})


def test_numpys_lengths_of_time_are_no_plain_numbers() -> None:
    with pytest.raises(obsynth.SpecError, match="decay"):
        obsynth.ui_pi_observer(obsynth.DescriptorSystem(**PLANT), decay=np.timedelta64(5, "s"))
    plant = obsynth.DescriptorSystem(**PLANT, delays={"y1": np.timedelta64(200, "ms")})
    assert plant.delays == {"y1": 0.2}


@pytest.mark.parametrize(
    ("deviation", "number"),
    [
        (0.1 * UNITS.kelvin, 0.1),
        (UNITS.Quantity(9.0, "degF"), 5.0),
        (UNITS.Quantity(0.5, "delta_degC"), 0.5),
        (UNITS.Quantity(0.5, "degC"), 0.5),
    ],
)
def test_a_deviation_of_a_temperature_has_no_zero_of_its_own(deviation: Any, number: float) -> None:
    units = {"y1": "degC", "y2": "V"}
    noise = {"y1": deviation, "y2": 5.0 * UNITS.mV}
    expected = np.diag([number, 0.005])
    plant = obsynth.DescriptorSystem(**PLANT, units=units, sensor_noise=noise)
    np.testing.assert_allclose(plant.Dw, expected, rtol=1e-11)
    made, _ = obsynth.with_noise(obsynth.DescriptorSystem(**PLANT, units=units), sensor_noise=noise)
    np.testing.assert_allclose(made.plant.Dw, expected, rtol=1e-11)


def test_an_operating_point_of_a_temperature_has() -> None:
    plant = obsynth.DescriptorSystem(**PLANT, units={"x1": "degC"}, operating_point={"x1": 300.0 * UNITS.kelvin})
    assert plant.operating_point["x1"] == pytest.approx(26.85)


def test_noise_in_another_kind_of_unit_is_refused() -> None:
    plant = obsynth.DescriptorSystem(**PLANT, units={"y1": "V"})
    with pytest.raises(obsynth.SpecError, match="cannot be converted to 'V'"):
        obsynth.with_noise(plant, sensor_noise={"y1": {"deviation": 5.0 * UNITS.mA, "correlation": "5 s"}})
    with pytest.raises(obsynth.SpecError, match="states no unit"):
        obsynth.with_noise(plant, offset={"y2": 5.0 * UNITS.mV})


@pytest.mark.parametrize(
    "matrix",
    [
        [[Fraction(-1, 3)]],
        [[Decimal("-0.25")]],
        sympy.Matrix([[-sympy.Rational(1, 3)]]),
        [[-sympy.sqrt(2)]],
        [[-1 + 0j]],
    ],
)
def test_matrices_of_other_real_numbers_are_read(matrix: Any) -> None:
    entry = np.array(matrix, dtype=object).ravel()[0]
    assert obsynth.DescriptorSystem(A=matrix, C=[[1.0]], Bf=[[1.0]]).A[0, 0] == float(np.real(complex(entry)))


@pytest.mark.parametrize("entry", [sympy.Symbol("x"), sympy.I, None, {}, True, "1", 1j, 10**400])
def test_what_is_no_real_number_is_refused(entry: Any) -> None:
    with pytest.raises(obsynth.SpecError, match="every entry must be"):
        obsynth.DescriptorSystem(A=[[entry]], C=[[1.0]], Bf=[[1.0]])


@pytest.mark.parametrize("entry", [np.complex128(1 + 2j), np.True_, np.str_("3"), UNITS.Quantity(1.0, "ms/s")])
def test_one_entry_that_is_no_real_number_is_refused_beside_others(entry: Any) -> None:
    rows = np.empty((1, 1), dtype=object)
    rows[0, 0] = entry
    with pytest.raises(obsynth.SpecError, match="A holds"):
        obsynth.DescriptorSystem(A=rows, C=[[1.0]], Bf=[[1.0]])


@pytest.mark.parametrize("length", [np.timedelta64(1, "M"), np.timedelta64(300)])
def test_a_length_of_time_without_seconds_is_refused(length: Any) -> None:
    with pytest.raises(obsynth.SpecError, match="no number of seconds"):
        obsynth.DescriptorSystem(**PLANT, delays={"y1": length})


def test_degrees_of_a_difference_are_kelvins() -> None:
    noise = {"y1": UNITS.Quantity(0.1, "delta_degC")}
    plant = obsynth.DescriptorSystem(**PLANT, units={"y1": "K"}, sensor_noise=noise)
    assert plant.Dw[0, 0] == pytest.approx(0.1)
