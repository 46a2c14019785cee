"""A refusal says that nothing exists only where no method estimates the faults; else whose assumption it is."""

from __future__ import annotations

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
