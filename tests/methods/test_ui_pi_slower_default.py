"""A default whose stability double precision does not prove gives way to a slower one."""

from __future__ import annotations

import numpy as np
import pytest

import obsynth
from obsynth.methods.ui_pi_observer import synthesis


@pytest.fixture
def plant() -> obsynth.DescriptorSystem:
    return obsynth.DescriptorSystem(
        A=[[0.9, 0.1], [0.0, 0.8]], C=np.eye(2), Bf=[[1.0], [0.0]], Bd=[[0.0], [1.0]], dt=1.0,
        sensor_noise={"y1": 0.1, "y2": 0.1},
    )  # fmt: skip


@pytest.mark.parametrize("unproved", [1, 2])
def test_the_next_rate_that_is_proved_is_taken_and_told(
    plant: obsynth.DescriptorSystem, unproved: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    usual = obsynth.ui_pi_observer(plant).certificate.claims["decay"]
    proofs, asked = synthesis.contraction_of, []

    def failing(observer: obsynth.LinearObserver) -> object:
        asked.append(observer)
        return None if len({id(each) for each in asked}) <= unproved else proofs(observer)

    monkeypatch.setattr(synthesis, "contraction_of", failing)
    design = obsynth.ui_pi_observer(plant)
    assert design.report.passed
    assert design.certificate.claims["decay"] >= 0.999 * usual / 2**unproved
    assert design.options["decay"] == pytest.approx(usual / 2**unproved)
    assert any("stability is not proved in double precision" in note for note in design.notes)


def test_a_rate_that_is_asked_for_is_not_changed(
    plant: obsynth.DescriptorSystem, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(synthesis, "contraction_of", lambda observer: pytest.fail("asked"))
    assert obsynth.ui_pi_observer(plant, decay=0.3).report.passed
