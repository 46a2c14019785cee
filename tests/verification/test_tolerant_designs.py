"""Tolerances: what can never be distinguished from a fault, and options of old."""

from __future__ import annotations

import pytest
from uncertain_plants import drive

import obsynth
from obsynth.errors import SpecError
from obsynth.verification.over_tolerances.plants_of_the_box import acting_like_faults


@pytest.fixture(scope="module")
def wang() -> tuple:
    spec = obsynth.load_spec("designs/wang2015/spec.yaml")
    return spec.plant, spec.scenario


def test_columns_are_gone_and_the_message_says_what_to_take(wang) -> None:
    with pytest.raises(SpecError, match=r"no option 'model_error' any more: .* guaranteed-test"):
        obsynth.fault_estimation_filter(wang[0], model_error="columns")
    with pytest.raises(SpecError, match="no option 'delta_scan' any more: a scan is a sweep"):
        obsynth.pd_observer(wang[0], delta_scan=[0.1])


def test_what_acts_where_a_fault_acts_is_never_told_from_it(wang) -> None:
    assert acting_like_faults(drive()) == ("J1", "b")
    assert acting_like_faults(wang[0]) == ()
    found = obsynth.robustness(obsynth.fault_estimation_filter(drive()))
    assert found.sharing == ("J1", "b")
    assert "never distinguished from a fault" in dict(found.facts())
