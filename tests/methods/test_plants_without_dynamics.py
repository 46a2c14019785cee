"""Plants of algebraic equations alone: the observer answers a constant fault."""

from __future__ import annotations

import numpy as np

import obsynth
from obsynth import DescriptorSystem

STATIC = DescriptorSystem(
    E=np.zeros((2, 2)), A=[[2, -2], [-1, -1]], C=[[-2, -2], [-1, 1]], Bf=[[2], [-2]], Bd=[[0], [-1]], dt=0.5
)


def test_no_gain_of_an_observer_without_dynamics_is_rounding() -> None:
    # Where no equation has a derivative, a part of an inverse was all rounding, and full rank was read from it.
    design = obsynth.ui_pi_observer(STATIC)
    assert np.abs(design.observer.Az).max() < 10.0
    assert np.abs(design.observer.By).max() > 0.1
    y = STATIC.C @ np.linalg.solve(STATIC.A, -STATIC.Bf[:, 0])
    said = design.observer.run(np.tile(y, (200, 1)), np.zeros((200, 0)))
    assert abs(said.faults[-1, 0] - 1.0) < 1e-9
