"""Filters of large plants follow one parity relation."""

from __future__ import annotations

import numpy as np
import pytest

import obsynth
from obsynth.methods.functional_filter import parity_relation


def _plant() -> obsynth.DescriptorSystem:
    rng = np.random.default_rng(52)
    n, outputs = 12, 4
    turn = np.linalg.qr(rng.normal(size=(n, n)))[0]
    a = turn @ np.diag(np.linspace(0.5, 0.95, n)) @ turn.T
    return obsynth.DescriptorSystem(
        A=a,
        B=rng.normal(size=(n, 1)),
        C=rng.normal(size=(outputs, n)),
        Bf=rng.normal(size=(n, 1)),
        Dd=np.eye(outputs, 1),
        dt=0.1,
        sensor_noise={f"y{i + 1}": 0.01 for i in range(outputs)},
    )


def test_a_large_plant_gets_a_verified_filter_of_one_relation(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(parity_relation, "LARGE_ORDER", 10)
    monkeypatch.setattr(parity_relation, "SAMPLES", 8)
    plant = _plant()
    design = obsynth.functional_filter(plant)
    assert design.report.passed
    assert design.observer.order == parity_relation.SAMPLES + 1 == 9
    assert any("parity relation" in note for note in design.notes)
    # A stated rate asks for the filter of least noise.
    whole = obsynth.functional_filter(plant, fault_rate=float(np.max(design.certificate.matrices["walks"])))
    assert whole.observer.order > design.observer.order
    deviations = [float(item.certificate.matrices["deviations"][0, 1]) for item in (design, whole)]
    assert deviations[1] <= deviations[0] * 1.000001
