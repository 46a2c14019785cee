"""Tolerances: what can never be distinguished from a fault, and options of old."""

from __future__ import annotations

import pytest
from uncertain_plants import drive

import obsynth
from obsynth.verification.over_tolerances.constants_like_faults import acting_like_faults


@pytest.fixture(scope="module")
def wang() -> tuple:
    spec = obsynth.load_spec("designs/wang2015/spec.yaml")
    return spec.plant, spec.scenario


def test_what_acts_where_a_fault_acts_is_never_told_from_it(wang) -> None:
    assert acting_like_faults(drive()) == ("J1", "b")
    assert acting_like_faults(wang[0]) == ()
    found = obsynth.robustness(obsynth.fault_estimation_filter(drive()))
    assert found.sharing == ("J1", "b")
    assert "never distinguished from a fault" in dict(found.facts())
