"""A refusal says that nothing exists only where no method estimates the faults; else whose assumption it is."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest

import obsynth

#: A mode that nothing shows and that does not decay: no observer of the whole state, and yet the fault shows.
HIDDEN = obsynth.DescriptorSystem(A=[[-1.0, 0.0], [0.0, 1.0]], C=[[1.0, 0.0]], Bf=[[1.0], [0.0]])


@pytest.mark.parametrize("method", ["ui-pi-observer", "pd-observer"])
def test_a_method_that_assumes_more_is_named_with_one_that_does_not(method):
    with pytest.raises(obsynth.PreconditionError) as caught:
        obsynth.design(HIDDEN, method)
    text = str(caught.value)
    assert text.startswith(f"{method} assumes more than this plant has: the condition ")
    assert "No observer" not in text
    assert "The faults can be estimated: functional-filter exists." in text
    assert "Measure one of: x2." in text
    assert caught.value.exit_code == 3
    # What is printed was tried.
    assert obsynth.functional_filter(HIDDEN).report.passed
    measured = HIDDEN.replace(C=np.eye(2), output_names=["y1", "x2"], D=None, Df=None, Dd=None, Dw=None)
    assert obsynth.design(measured, method).report.passed


@pytest.mark.parametrize("method", ["ui-pi-observer", "pd-observer", "functional-filter"])
def test_nothing_exists_only_where_no_method_does(method):
    plant = obsynth.DescriptorSystem(A=[[-1.0, 0.0], [0.0, -2.0]], C=[[0.0, 1.0]], Bf=[[1.0], [0.0]])
    with pytest.raises(obsynth.PreconditionError) as caught:
        obsynth.design(plant, method)
    assert "assumes more" not in str(caught.value)
    assert not any(report.passed for name, report in obsynth.check(plant).items() if name == method)


def _spring() -> obsynth.PolytopicSystem:
    return obsynth.PolytopicSystem(
        plant={
            "A": [[1.0, 0.1], ["-0.1 * k", 0.9]], "C": [[1, 0], [0, 1]], "Bf": [[0], [1]], "dt": 1.0,
            "output_names": ["x", "v"], "fault_names": ["push"],
        },
        scheduling={"k": [1.0, 2.0]},
    )  # fmt: skip


@cache
def _named_are_designed() -> bool:
    """Whether the methods that are named design: one takes noise of sensors as the Kalman filter would."""
    noise = {"measurement": {"x": 0.1, "v": 0.2}}
    designs = obsynth.ui_pi_observer(_spring(), noise=noise), obsynth.fault_estimation_filter(_spring())
    return all(design.report.passed for design in designs)


@pytest.mark.parametrize("method", ["adaptive_observer", "pd_observer", "functional_filter", "optimal_filter"])
def test_a_method_that_does_not_take_a_region_says_nothing_of_other_observers(method: str) -> None:
    with pytest.raises(obsynth.PreconditionError, match=r"^This method does not take the plant") as e:
        getattr(obsynth, method)(_spring())
    assert "methods for such plants are: fault-estimation-filter, ui-pi-observer" in str(e.value)
    # What is named was tried.
    assert _named_are_designed()


def test_a_continuous_plant_is_no_plant_without_an_observer() -> None:
    plant = obsynth.DescriptorSystem(None, [[-1.0, 0.0], [1.0, -2.0]], None, [[0.0, 1.0]], Bf=[[1.0], [0.0]])
    with pytest.raises(obsynth.PreconditionError) as caught:
        obsynth.fault_estimation_filter(plant)
    text = str(caught.value)
    assert "No observer of this kind exists" not in text
    assert "'discrete time' fails" in text
    assert obsynth.fault_estimation_filter(obsynth.discretise(plant, 0.1)) is not None
