"""One profile for every property: the same examples in each run, and no clock in the verdict."""

from hypothesis import HealthCheck, settings

settings.register_profile(
    "obsynth",
    deadline=None,
    derandomize=True,
    database=None,
    max_examples=15,
    suppress_health_check=[HealthCheck.too_slow],
)
settings.load_profile("obsynth")
