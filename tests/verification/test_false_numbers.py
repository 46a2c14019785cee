"""Numbers of a stored design that hide what is claimed: constants added to estimates, negative gains, no numbers."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

import obsynth

PLANT = obsynth.DescriptorSystem(A=[[0.5]], C=[[1.0]], Bf=[[1.0]], Bw=[[0.1]], Dw=[[1.0]], dt=0.1)
DESIGNS = {
    "optimal-filter": lambda: obsynth.optimal_filter(PLANT),
    "ui-pi-observer": lambda: obsynth.ui_pi_observer(PLANT),
    "functional-filter": lambda: obsynth.functional_filter(PLANT),
    "fault-estimation-filter": lambda: obsynth.fault_estimation_filter(PLANT),
}


@pytest.mark.parametrize("method", DESIGNS)
def test_a_constant_that_is_added_to_an_estimate_fails(method: str) -> None:
    design = DESIGNS[method]()
    assert obsynth.verify(design).passed
    observer = replace(design.observer, constant=np.full(len(design.observer.Cz), 5.0))
    report = obsynth.verify(replace(design, observer=observer, report=None))
    assert not report.passed
    assert "error model" in {row.name for row in report.failures}


def test_a_negative_gain_is_no_bound() -> None:
    design = DESIGNS["optimal-filter"]()
    certificate = replace(
        design.certificate, claims={**design.certificate.claims, "gain": -design.certificate.claims["gain"]}
    )
    report = obsynth.verify(replace(design, certificate=certificate, report=None))
    assert "gain" in {row.name for row in report.failures}
