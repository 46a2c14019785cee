"""One profile for every property: the same examples in each run, and no clock in the verdict."""

import pytest
from hypothesis import HealthCheck, settings

#: Examples of each property with ``--whole`` or ``--rest``, and without: CI runs both.
EXAMPLES, FEWER = 15, 5


def pytest_configure(config: pytest.Config) -> None:
    settings.register_profile(
        "obsynth",
        deadline=None,
        derandomize=True,
        database=None,
        max_examples=EXAMPLES if config.option.whole or config.option.rest else FEWER,
        suppress_health_check=[HealthCheck.too_slow],
    )
    settings.load_profile("obsynth")
