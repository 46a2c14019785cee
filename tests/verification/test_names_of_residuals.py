"""Names of residuals and the least gain over a region in saved designs: changed ones are refused."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

import obsynth

PLANT = obsynth.DescriptorSystem(
    A=[[0.9, 0.1], [0.0, 0.8]], C=np.eye(2), Bf=np.eye(2), dt=1.0, sensor_noise={"y1": 0.1, "y2": 0.1},
    fault_names=("leak", "clog: inlet"),
)  # fmt: skip
REGION = obsynth.PolytopicSystem(
    [
        obsynth.DescriptorSystem(A=[[0.9, 0.1], [0.0, a]], C=np.eye(2), Bf=[[1.0], [0.0]], Bd=[[0.1], [1.0]], dt=1.0)
        for a in (0.6, 0.8)
    ]
)


WHICH = ("ui-pi", "ui-pi over a region", "functional", "functional, each fault alone")


def designs() -> dict[str, obsynth.ObserverDesign]:
    return {
        "ui-pi": obsynth.ui_pi_observer(PLANT),
        "ui-pi over a region": obsynth.ui_pi_observer(REGION),
        "functional": obsynth.functional_filter(PLANT, faults=["leak"]),
        "functional, each fault alone": obsynth.functional_filter(PLANT, residuals="isolate"),
    }


@pytest.fixture(scope="module")
def made() -> dict[str, obsynth.ObserverDesign]:
    return designs()


@pytest.mark.parametrize("which", sorted(WHICH))
@pytest.mark.parametrize("change", ["another", "swapped"])
def test_a_residual_of_another_name_fails(made: dict[str, obsynth.ObserverDesign], which: str, change: str) -> None:
    design = made[which]
    names = design.observer.residual_names
    assert obsynth.verify(design).passed
    changed = (f"{names[0]}x", *names[1:]) if change == "another" else names[::-1]
    if changed == names:
        pytest.skip("one residual alone")
    forged = design.replace(observer=replace(design.observer, residual_names=changed))
    assert not obsynth.verify(forged).passed


@pytest.mark.parametrize("share", [2.0, -0.5])
def test_a_least_gain_over_a_region_is_no_more_than_the_gain(share: float) -> None:
    design = obsynth.fault_estimation_filter(REGION)
    claims = dict(design.certificate.claims)
    assert obsynth.verify(design).passed
    claims["gamma_min"] = share * claims["gamma"]
    forged = design.replace(certificate=obsynth.Certificate(design.certificate.matrices, claims))
    report = obsynth.verify(forged)
    assert not report.passed
