"""Numbers as they are printed."""

import numpy as np
import pytest

from obsynth.numerics.spectra import pole_text
from obsynth.results.layout import complex_numbers, upper_number


@pytest.mark.parametrize("seed", range(20))
def test_an_upper_number_is_not_below_what_it_stands_for(seed: int) -> None:
    rng = np.random.default_rng([46, 3, seed])
    value, digits = float(10.0 ** rng.uniform(-12, 12)), int(rng.integers(2, 6))
    told = float(upper_number(value, digits=digits).replace(",", ""))
    assert value <= told <= value * (1.0 + 10.0 ** (1 - digits))


def test_upper_numbers_that_are_exact_stay() -> None:
    assert [upper_number(value) for value in (0.1, 46.1, 46.108, 0.0, 9.996)] == ["0.1", "46.1", "46.2", "0", "10"]
    assert upper_number(float("inf")) == "inf"
    assert upper_number(float("nan")) == "-"


def test_what_is_rounding_of_a_number_is_not_printed() -> None:
    """An integrator was listed as 1.961e-17 beside 1, and a point of the unit circle as -1+1.225e-16j."""
    assert complex_numbers([1.0, 1.961e-17, 0.5 + 0.1j, 0.5 - 0.1j]) == "1, 0.5 +- 0.1j, 0"
    assert complex_numbers([1e-3, 2e-17]) == "0.001, 2e-17"
    assert complex_numbers([]) == "none"
    assert pole_text(np.exp(1j * np.pi)) == "-1"
    assert pole_text(complex(1e-17, 2.0), pair=True) == "0 +- 2j"
    assert pole_text(complex(1e-9, 1.0)) == "1e-09+1j"
