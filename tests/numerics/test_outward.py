"""Bounds as texts."""

import numpy as np
import pytest

from obsynth.numerics.outward import lower_text, upper_text


@pytest.mark.parametrize("seed", range(20))
def test_texts_of_bounds_are_bounds(seed: int) -> None:
    rng = np.random.default_rng([51, seed])
    value, digits = float(rng.choice([-1, 1]) * 10.0 ** rng.uniform(-12, 12)), int(rng.integers(2, 7))
    one_digit = abs(value) * 10.0 ** (1 - digits)
    assert value <= float(upper_text(value, digits)) <= value + one_digit
    assert value - one_digit <= float(lower_text(value, digits)) <= value


def test_numbers_of_few_digits_stay() -> None:
    assert [upper_text(value) for value in (0.3, 1.46451, 0.0, float("inf"))] == ["0.3", "1.465", "0", "inf"]
    assert [lower_text(value) for value in (0.3, -1.46551, float("nan"))] == ["0.3", "-1.466", "nan"]
