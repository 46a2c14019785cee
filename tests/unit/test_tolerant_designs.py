"""Tolerances: what can never be distinguished from a fault, and options of old."""

from __future__ import annotations

import pytest
from uncertain_plants import drive

import obsynth
from obsynth.errors import SpecError
from obsynth.tolerances.exact_plant import told_from_faults


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
    told = told_from_faults(drive())
    assert {name for name, found in told.items() if found.shares} == {"J1", "b"}
    assert not any(told[name].separable for name in ("J2", "k", "c"))
    # The test of the reference: e1 can be decoupled, e2 and e3 have a zero at 1.
    rows = told_from_faults(wang[0])
    assert rows["A[1,1]"].separable
    assert not rows["A[2,2]"].separable
    assert "zero at 1" in rows["A[3,3]"].reason
    found = obsynth.robustness(obsynth.fault_estimation_filter(drive()))
    assert found.sharing == ("J1", "b")
    assert "never distinguished from a fault" in dict(found.facts())
