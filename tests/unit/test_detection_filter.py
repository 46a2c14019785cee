"""Detection against disturbance: the optimum by its property, a proved gain, and refusals."""

from __future__ import annotations

import numpy as np
import pytest

import obsynth
from obsynth.numerics.continuous import continuous_hinf_norm


def plant(seed: int = 0) -> obsynth.DescriptorSystem:
    rng = np.random.default_rng(seed)
    return obsynth.DescriptorSystem(
        None, rng.standard_normal((3, 3)) - 2 * np.eye(3), None, rng.standard_normal((2, 3)),
        Bf=rng.standard_normal((3, 1)), Df=[[1.0], [0.0]], Bd=rng.standard_normal((3, 1)), Dd=[[0.2], [0.0]],
        Bw=np.zeros((3, 2)), Dw=0.3 * np.eye(2),
    )  # fmt: skip


def transfer(system: obsynth.DescriptorSystem, gain: np.ndarray, b: np.ndarray, d: np.ndarray, w: float) -> np.ndarray:
    closed = system.A - gain @ system.C
    return system.C @ np.linalg.solve(1j * w * np.eye(3) - closed, b - gain @ d) + d


@pytest.mark.parametrize("seed", range(4))
def test_gain_is_one_everywhere_and_proved(seed: int) -> None:
    system = plant(seed)
    found = obsynth.detection_filter(system, band=(0.0, 10.0))
    assert found.proved
    b, d = np.hstack([system.Bd, system.Bw]), np.hstack([system.Dd, system.Dw])
    for w in (0.0, 0.3, 2.0, 40.0):
        values = np.linalg.svd(found.observer.Dy @ transfer(system, found.observer.By, b, d, w), compute_uv=False)
        assert values == pytest.approx([1.0, 1.0], abs=1e-9)


def test_no_other_filter_has_a_larger_ratio() -> None:
    system = plant()
    found = obsynth.detection_filter(system, band=(0.0, 10.0))
    b, d = np.hstack([system.Bd, system.Bw]), np.hstack([system.Dd, system.Dw])
    rng = np.random.default_rng(7)
    for _ in range(30):
        gain = found.observer.By + 0.3 * rng.standard_normal((3, 2))
        closed = system.A - gain @ system.C
        if np.max(np.linalg.eigvals(closed).real) >= 0.0:
            continue
        weight = rng.standard_normal((1, 2))
        norm = continuous_hinf_norm(closed, b - gain @ d, weight @ system.C, weight @ d).value
        shown = min(
            abs((weight @ transfer(system, gain, system.Bf, system.Df, w))[0, 0]) for w in np.linspace(0.0, 10.0, 60)
        )
        assert shown / norm <= found.ratio * (1 + 1e-6)


def test_refusals() -> None:
    system = plant()
    with pytest.raises(obsynth.PreconditionError, match="lacks row rank"):
        obsynth.detection_filter(system.replace(Dw=np.zeros((2, 2))))
    with pytest.raises(obsynth.SpecError, match="continuous plant"):
        obsynth.detection_filter(system.replace(dt=0.1))
    with pytest.raises(obsynth.SpecError, match="lowest and the highest"):
        obsynth.detection_filter(system, band=(3.0, 1.0))
