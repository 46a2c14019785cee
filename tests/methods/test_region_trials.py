"""What a check says of a whole region: a certificate that is verified, none, or that a design decides."""

from __future__ import annotations

import numpy as np
import pytest

import obsynth
from obsynth import PolytopicSystem
from obsynth.methods import region_trials
from obsynth.methods.region_trials import REGION_CONDITION
from obsynth.report.plants import method_lines

ROW = f"exists: {REGION_CONDITION}"


def _plant(**changes: object) -> PolytopicSystem:
    plant = {"A": [["0.9 + 0.045 * v", 0.1], [0, 0.8]], "C": [[1, 0]], "Bf": [[1], [0.2]], "Bd": [[0.1], [0.3]]}
    return PolytopicSystem(plant={**plant, "dt": 1.0, **changes}, scheduling={"v": [-1, 1]})


@pytest.mark.long
def test_a_check_says_what_one_certificate_proves_over_the_region() -> None:
    reports = obsynth.check(_plant())
    row = reports["fault-estimation-filter"][ROW]
    design = obsynth.fault_estimation_filter(_plant())
    assert row.passed
    assert f"{design.certificate.claims['gamma']:.6g}" in row.detail
    assert "least" not in row.detail
    lines = {method: text for method, text, _ in method_lines(reports, over_region=True)}
    assert "one certificate covers every course of the parameters over v in [-1, 1]" in lines["fault-estimation-filter"]
    assert "so a design exists" not in "".join(lines.values())
    # A condition that fails at a point is named with the point: no trial is needed.
    assert "at vertex 1 (v = -1)" in lines["ui-pi-observer"]
    assert ROW not in [check.name for check in reports["ui-pi-observer"].checks]


def test_where_no_certificate_is_found_nothing_is_decided() -> None:
    # A spring whose stiffness switches between 1 and 8 grows, though it decays at each: nothing is measured.
    spring = PolytopicSystem(
        plant={"A": [[1, 0.1], ["-0.1 * v", 0.9]], "C": [[0, 0]], "dt": 0.1}, scheduling={"v": [1, 8]}
    )
    report = obsynth.check(spring, {"descriptor-kalman": {"Q": 1.0, "R": 1.0}})["descriptor-kalman"]
    assert not report.passed
    assert [check.name for check in report.failures] == [ROW]
    assert report[ROW].unclear
    (text,) = [
        text for method, text, _ in method_lines({"descriptor-kalman": report}, over_region=True) if method[0] == "d"
    ]
    assert text.startswith("UNCLEAR for this region: No common Lyapunov matrix was found")


def test_large_regions_are_left_to_a_design(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(region_trials, "MOST_TRIED", 1)
    report = obsynth.check(_plant())["fault-estimation-filter"]
    assert report.passed
    assert ROW not in [check.name for check in report.checks]
    ((_, text, _),) = method_lines({"fault-estimation-filter": report}, over_region=True)
    assert "whether one certificate covers all of it is decided by a design" in text


def test_a_nonlinear_region_is_left_to_a_design() -> None:
    tank = obsynth.DAEModel(
        {"balance": "2.0 * der(level) = inflow - 0.5 * sqrt(level) - leak"}, {"gauge": "level"},
        states={"level": 1.0}, inputs={"inflow": 0.5}, parameters={"leak": 0.0},
    )  # fmt: skip
    options = {"region": {"level": [0.2, 2.0]}, "sample_time": 1.0, "noise": {"gauge": 1e-3, "leak": 1e-4}}
    lines = {method: text for method, text, _ in method_lines(obsynth.check(tank, {"region-observer": options}))}
    assert "decided by a design" in lines["region-observer"]


@pytest.mark.one_in(3)
@pytest.mark.parametrize("seed", range(3))
def test_a_state_that_an_output_alone_determines_is_no_matter_of_rounding(seed: int) -> None:
    # One output, one unknown input that it shows: the innovation is nothing but rounding, and the filter is verified.
    rng = np.random.default_rng(seed)
    C, Bd = rng.uniform(0.5, 2.0, (1, 2)) * [1.0, 0.0], rng.uniform(0.1, 1.0, (2, 1))
    made = obsynth.descriptor_kalman(_plant(C=C.tolist(), Bd=Bd.tolist()), Q=0.1, R=0.1)
    assert made.report.passed
