"""Numbers as they are printed."""

import numpy as np
import pytest

from obsynth.results.layout import upper_number


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
