"""Numbers as they are printed."""

import numpy as np
import pytest

from obsynth.numerics.spectra import pole_text
from obsynth.results.checks import information, lower_bound_check, upper_bound_check
from obsynth.results.layout import shown_numbers
from obsynth.results.number_texts import (
    bound_number,
    complex_numbers,
    lower_number,
    number,
    point_in_time,
    upper_number,
)


@pytest.mark.parametrize("seed", range(20))
def test_an_upper_number_is_not_below_what_it_stands_for(seed: int) -> None:
    rng = np.random.default_rng([46, 3, seed])
    value, digits = float(10.0 ** rng.uniform(-12, 12)), int(rng.integers(2, 6))
    told = float(upper_number(value, digits=digits).replace(",", ""))
    assert value <= told <= value * (1.0 + 10.0 ** (1 - digits))
    told = float(lower_number(value, digits=digits).replace(",", ""))
    assert value * (1.0 - 10.0 ** (1 - digits)) <= told <= value
    told = float(lower_number(-value, digits=digits).replace(",", ""))
    assert -value * (1.0 + 10.0 ** (1 - digits)) <= told <= -value


def test_upper_numbers_that_are_exact_stay() -> None:
    assert [upper_number(value) for value in (0.1, 46.1, 46.108, 0.0, 9.996)] == ["0.1", "46.1", "46.2", "0", "10"]
    assert upper_number(float("inf")) == "inf"
    assert upper_number(float("nan")) == "-"


def test_numbers_are_rounded_to_the_side_of_what_they_bound() -> None:
    assert [bound_number(1.23449, side) for side in ("at most", "at least", "")] == ["1.235", "1.234", "1.234"]
    assert bound_number(1.23451, "at least") == "1.234"
    assert bound_number(float("nan"), "at most") == bound_number("x", "at least") == "-"  # type: ignore[arg-type]


def test_proved_numbers_of_a_row_are_rounded_outwards() -> None:
    row = upper_bound_check("gain", "at most", 0.990142, 1.234449, source="here", kind="proved")
    assert shown_numbers(row)[:2] == ("0.9902", "1.235")
    row = lower_bound_check("decay", "at least", 0.0351904, 0.0351869, source="here", kind="proved")
    assert shown_numbers(row)[:2] == ("0.03519", "0.03518")
    row = upper_bound_check("residual", "small", 0.990142, 1.234449, source="here", kind="equality")
    assert shown_numbers(row)[:2] == (number(0.990142), number(1.234449))
    assert shown_numbers(information("mean", "of a run", 0.99014, source="here", status="proved"))[0] == "0.9901"


def test_what_is_rounding_of_a_number_is_not_printed() -> None:
    """An integrator was listed as 1.961e-17 beside 1, and a point of the unit circle as -1+1.225e-16j."""
    assert complex_numbers([1.0, 1.961e-17, 0.5 + 0.1j, 0.5 - 0.1j]) == "1, 0.5 +- 0.1j, 0"
    assert complex_numbers([1e-3, 2e-17]) == "0.001, 2e-17"
    assert complex_numbers([]) == "none"
    assert pole_text(np.exp(1j * np.pi)) == "-1"
    assert pole_text(complex(1e-17, 2.0), pair=True) == "0 +- 2j"
    assert pole_text(complex(1e-9, 1.0)) == "1e-09+1j"


def test_long_times_are_in_hours_beside() -> None:
    """Alarms of a log over days were reported as '86760 s' and '2.59326e+06 s', below a picture in hours."""
    assert [point_in_time(value) for value in (7199.0, 7200.0, 86760.0, 2593260.0)] == [
        "7199 s",
        "7200 s (2 h)",
        "86760 s (24.1 h)",
        "2593260 s (720.4 h)",
    ]
    # Seconds since 1970 are no time since a start.
    assert point_in_time(1.7e9) == "1700000000 s"
    assert point_in_time(float("nan")) == "nan s"
