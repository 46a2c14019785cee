"""A seeded share of the campaign on noise: variances from logs, with nothing else unknown."""

from __future__ import annotations

import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

sys.path.insert(0, str(Path(__file__).parents[2]))

from benchmarks.campaigns._calibration_noise import CASES, calibrated, errors

import obsynth
from obsynth.monitoring.calibration.variance_names import limited_names, variance_names, with_letter


@pytest.mark.long
def test_variances_of_a_plant_with_one_sensor_are_found(share):
    case = CASES["3 states, 1 noise, 1 sensor"]
    found = [calibrated(case, seed) for seed in share(range(5), 2)]
    assert (np.median([errors(case, one) for one in found], axis=0) < [0.5, 0.15]).all()
    assert all(one.nominal == {} and one.nis.holds for one in found)


@pytest.mark.long
def test_a_variance_far_below_the_sensors_is_found_or_bounded_and_never_zero(share):
    case = CASES["R = 1000 Q"]
    found = [calibrated(case, seed) for seed in share(range(3), 2)]
    assert any(one.upper_limits for one in found)
    for one in found:
        for name, true in zip(("x1", "x2"), case.Q, strict=True):
            assert one.Q[name] > 0.1 * true
            if name in one.upper_limits:
                assert one.Q[name] > true


@pytest.mark.long
def test_variances_of_an_equation_and_a_sensor_of_the_same_name_are_apart():
    rng, x, rows = np.random.default_rng(0), 0.0, []
    for k in range(1_500):
        u = np.sign(np.sin(0.05 * k))
        rows.append([float(k), u, x + 0.1 * rng.standard_normal()])
        x = 0.9 * x + u + 0.5 * rng.standard_normal()
    written = {"A": [["a"]], "B": [[1]], "C": [[1]], "dt": 1.0, "state_names": ["level"], "input_names": ["u"]}
    found = {}
    for sensor in ("level", "gauge"):
        log = pd.DataFrame(rows, columns=["time", "u", sensor])
        plant = obsynth.uncertain_system(
            {**written, "output_names": [sensor]}, {"a": {"range": [0.5, 0.99], "nominal": 0.8}}
        )
        found[sensor] = obsynth.calibrate(plant, log, {"a": (0.5, 0.99)}, input_delay=0)
    same, other = found["level"], found["gauge"]
    assert same.Q == other.Q
    assert list(same.R.values()) == list(other.R.values())
    assert f"Q per step: level {same.Q['level']:.3g}\n  R: level {same.R['level']:.3g}" in str(same)
    limited = str(replace(same, upper_limits=("Q of level",)))
    assert f"Q per step: level <= {same.Q['level']:.3g}\n  R: level {same.R['level']:.3g}" in limited


def test_names_of_variances_have_their_letter_only_where_one_is_shared():
    assert variance_names(["a", "b"], ["b", "c"]) == (["a", "Q of b"], ["R of b", "c"])
    assert limited_names(["a", "Q of b"], "Q", ["a", "b"], ["b", "c"]) == {"a", "b"}
    assert limited_names(["a", "Q of b"], "R", ["b", "c"], ["a", "b"]) == set()
    assert [with_letter(name, ["b", "c"]) for name in ("a", "c", "R of b")] == ["Q of a", "R of c", "R of b"]
