"""The levels at which the filtering Riccati equation is solved on the way to the least gain."""

from __future__ import annotations

import numpy as np
import pytest

import obsynth
from obsynth.numerics import least_estimation


@pytest.mark.one_in(2)
@pytest.mark.parametrize("seed", [3, 8])
def test_few_equations_lead_to_the_least_gain(seed: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """A bisection to the same share takes 27 of them."""
    rng = np.random.default_rng([8, seed])
    a = rng.standard_normal((8, 8))
    plant = obsynth.DescriptorSystem(
        A=0.9 * a / max(abs(np.linalg.eigvals(a))),
        C=rng.standard_normal((3, 8)),
        Bf=rng.standard_normal((8, 2)),
        Bw=np.hstack([rng.standard_normal((8, 1)), np.zeros((8, 3))]),
        Dw=np.hstack([np.zeros((3, 1)), 0.05 * np.eye(3)]),
        dt=1.0,
    )
    solved = least_estimation._at_level
    levels: list[float] = []

    def counted(problem: least_estimation.EstimationProblem, level: float) -> object:
        levels.append(level)
        return solved(problem, level)

    monkeypatch.setattr(least_estimation, "_at_level", counted)
    design = obsynth.optimal_filter(plant, delay=1)
    assert design.least <= design.gain < design.least * (1.0 + 1e-7)
    # Of the delay and the next one, with five levels each for the worst noise.
    assert len(levels) <= 2 * (22 + 5)
