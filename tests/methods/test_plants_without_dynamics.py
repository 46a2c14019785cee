"""Plants of algebraic equations alone: the observer answers a constant fault."""

from __future__ import annotations

import numpy as np
import pytest

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


def static_plant(seed: int) -> DescriptorSystem:
    """Whole numbers, two or three algebraic states, one fault and one disturbance, which two outputs tell apart."""
    rng = np.random.default_rng([46, seed])
    n = int(rng.integers(2, 4))
    while True:
        a, c, bf, bd = (rng.integers(-2, 3, shape) for shape in ((n, n), (2, n), (n, 1), (n, 1)))
        if abs(np.linalg.det(a)) > 0.5:
            seen = c @ np.linalg.solve(a, np.hstack([bf, bd]))
            if abs(np.linalg.det(seen)) > 0.1:
                return DescriptorSystem(E=np.zeros((n, n)), A=a, C=c, Bf=bf, Bd=bd, dt=0.5)


@pytest.mark.long
def test_every_verified_observer_tells_a_constant_fault() -> None:
    designed = 0
    for seed in range(24):
        plant = static_plant(seed)
        try:
            design = obsynth.ui_pi_observer(plant)
        except obsynth.PreconditionError:
            continue
        designed += 1
        y = plant.C @ np.linalg.solve(plant.A, -plant.Bf[:, 0])
        observer = design.observer
        # The gain in the end: where disturbance and fault look much alike it takes thousands of samples.
        z = np.linalg.solve(np.eye(observer.order) - observer.Az, observer.By @ y)
        row = observer.fault_rows.start
        assert abs(observer.Cz[row] @ z + observer.Dy[row] @ y - 1.0) < 1e-6, seed
    assert designed >= 8
