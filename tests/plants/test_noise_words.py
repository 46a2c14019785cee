"""What a plant says of its noise, in numbers worked by hand."""

from __future__ import annotations

import math

import pytest

from obsynth.errors import SpecError
from obsynth.plants.noise import SensorNoise, process_variance, seconds, sensor_noises, successive_correlation


def test_times_and_sizes() -> None:
    times = {
        "200 ms": 0.2,
        "5 s": 5.0,
        "3 min": 180.0,
        "2 h": 7200.0,
        "1 d": 86400.0,
        "9 us": 9e-6,
        "9 \u00b5s": 9e-6,
        "9\u03bcs": 9e-6,
    }
    assert {text: seconds(text, "t") for text in times} == pytest.approx(times)
    assert SensorNoise(3.0, 1.0, 4.0).size == 5.0


def test_coloured_noise_keeps_its_share_and_its_variance() -> None:
    """A sample of one correlation keeps 1 / e; what is added to it is the rest of the variance."""
    assert successive_correlation(2.0, 2.0, "exact") == pytest.approx(math.exp(-1.0))
    assert process_variance(9.0, 2.0, 2.0, "exact") == pytest.approx(9.0 * (1.0 - math.exp(-2.0)))


@pytest.mark.parametrize(
    ("item", "words"),
    [({"deviation": 1.0, "colour": 2.0}, "has no 'colour'"), ({"white": 1.0}, "needs a deviation"), (-1.0, "above 0")],
)
def test_words_that_say_nothing_are_refused(item: object, words: str) -> None:
    with pytest.raises(SpecError, match=words):
        sensor_noises({"y": item}, ("y",))
