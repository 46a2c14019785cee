"""A sensor that repeats others, beside those of a filter over a region: the design stays one, with ordinary gains."""

from __future__ import annotations

import numpy as np
import pytest

import obsynth


def plant(*more: np.ndarray) -> obsynth.PolytopicSystem:
    rng = np.random.default_rng(7105)
    a = rng.normal(size=(3, 3))
    a *= 0.8 / np.max(np.abs(np.linalg.eigvals(a)))
    moved, c, bf, bd = 0.1 * rng.normal(size=(3, 3)), *(rng.normal(size=size) for size in ((2, 3), (3, 1), (3, 1)))
    c = np.vstack([c, *(weights @ c for weights in more)])
    return obsynth.PolytopicSystem(
        [obsynth.DescriptorSystem(A=a + s * moved, C=c, Bf=bf, Bd=0.3 * bd, dt=1.0) for s in (-1, 1)]
    )


@pytest.mark.parametrize("weights", [[[1.0, 0.0]], [[10.0, 0.0]], [[1.0, 1.0]], [[1e3, 0.0], [1.0, 1.0]]])
def test_repeated_sensors_leave_a_design_with_ordinary_gains(weights: list[list[float]]) -> None:
    alone = obsynth.fault_estimation_filter(plant())
    beside = obsynth.fault_estimation_filter(plant(np.array(weights)))
    assert alone.report.passed
    assert beside.report.passed
    # No disturbance need reach the estimate with either: what is left of the gain is the solver's.
    assert beside.certificate.claims["gamma"] < 0.01
    largest = [max(float(np.max(np.abs(gain))) for gain in design.gains.values()) for design in (alone, beside)]
    assert largest[1] < 1e3 * largest[0]


def test_the_paper_s_weight_does_not_lose_by_a_repeated_sensor() -> None:
    alone, beside = (
        obsynth.fault_estimation_filter(plant(*more), weight="paper").certificate.claims["gamma"]
        for more in ((), (np.array([[1.0, 0.0]]),))
    )
    assert beside <= 1.05 * alone
