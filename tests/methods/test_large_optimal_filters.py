"""Optimal filters of a hundred states: an answer within seconds, next to the least gain of any filter."""

from __future__ import annotations

import numpy as np
import pytest

import obsynth


@pytest.mark.long
@pytest.mark.parametrize("seed", [1, 3])
def test_filters_of_a_hundred_states_are_proved(seed: int) -> None:
    """No level was proved of more than 100 states, and of others after one to two minutes."""
    rng = np.random.default_rng([98, 100, seed])
    a = rng.normal(size=(100, 100))
    a *= 0.95 / np.max(np.abs(np.linalg.eigvals(a)))
    b, c, faults = rng.normal(size=(100, 1)), rng.normal(size=(3, 100)), rng.normal(size=(100, 2))
    noise = np.hstack([rng.normal(size=(100, 1)), np.zeros((100, 3))])
    plant = obsynth.DescriptorSystem(
        A=a, B=b, C=c, Bf=faults, Bw=noise, Dw=np.hstack([np.zeros((3, 1)), 0.05 * np.eye(3)]), dt=1.0
    )
    design = obsynth.optimal_filter(plant, delay=1)
    assert design.report.passed
    assert design.gain < design.least * 1.002
