"""A seeded share of the campaign on noise: variances from logs, with nothing else unknown."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).parents[2]))

from benchmarks.campaigns._calibration_noise import CASES, calibrated, errors


def test_variances_of_a_plant_with_one_sensor_are_found(share):
    case = CASES["3 states, 1 noise, 1 sensor"]
    found = [calibrated(case, seed) for seed in share(range(5), 2)]
    assert (np.median([errors(case, one) for one in found], axis=0) < [0.5, 0.15]).all()
    assert all(one.nominal == {} and one.nis.holds for one in found)


def test_a_variance_far_below_the_sensors_is_found_or_bounded_and_never_zero(share):
    case = CASES["R = 1000 Q"]
    found = [calibrated(case, seed) for seed in share(range(3), 2)]
    assert any(one.upper_limits for one in found)
    for one in found:
        for name, true in zip(("x1", "x2"), case.Q, strict=True):
            assert one.Q[name] > 0.1 * true
            if name in one.upper_limits:
                assert one.Q[name] > true
