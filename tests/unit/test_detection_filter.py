"""Detection against disturbance: the optimum by its property, a proved gain, and refusals."""

from __future__ import annotations

from dataclasses import replace

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


@pytest.mark.parametrize("seed", range(3))
def test_sensitivity_is_proved_on_the_whole_range(seed: int) -> None:
    system = plant(seed)
    found = obsynth.detection_filter(system, band=(0.0, 1e3))
    assert found.proved
    assert found.report["fault sensitivity"].kind == "proved"
    shown = [
        np.linalg.svd(
            found.observer.Dy @ transfer(system, found.observer.By, system.Bf, system.Df, w), compute_uv=False
        )
        for w in (*np.linspace(0.0, 20.0, 400), *np.geomspace(20.0, 1e3, 200))
    ]
    least = float(np.min(shown))
    assert found.fault_sensitivity <= least <= found.fault_sensitivity * (1.0 + 3e-3)


CORRUPTED = {
    "state in the error": lambda found: {"observer": replace(found.observer, Az=found.observer.Az * 1.01)},
    "inputs in the error": lambda found: {"observer": replace(found.observer, Bu=found.observer.Bu + 1.0)},
    "state in the residuals": lambda found: {"observer": replace(found.observer, Cz=found.observer.Cz * 1.001)},
    "inputs in the residuals": lambda found: {"observer": replace(found.observer, Du=found.observer.Du + 1.0)},
    "disturbance gain": lambda found: {"disturbance_gain": 0.999},
    "fault sensitivity": lambda found: {"fault_sensitivity": found.fault_sensitivity * 1.001},
}


@pytest.mark.parametrize("row", CORRUPTED)
def test_every_row_can_fail(row: str) -> None:
    system = plant(1).replace(B=[[1.0], [0.0], [0.0]], D=None, input_names=None)
    found = obsynth.detection_filter(system, band=(0.0, 10.0))
    assert found.verify().passed
    wrong = replace(found, **CORRUPTED[row](found)).verify()
    assert not wrong[row].passed


def test_sensitivity_is_refuted_between_the_points_of_a_grid() -> None:
    # A notch far narrower than any grid: the proof must not pass over it.
    from obsynth.methods.functional_filter.detection import Transfer, sensitivity_is_proved
    from obsynth.proofs.balls import Ball

    a = np.array([[-1e-4, 1.2345], [-1.2345, -1e-4]])
    notch = Transfer(
        a, Ball.exact(np.array([[1.0], [0.0]])), Ball.exact(np.array([[-2e-4, 0.0]])), Ball.exact(np.eye(1))
    )
    assert abs(1.0 - 2e-4 / (1j * 1.2345 - a[0, 0] + 1.2345**2 / (1j * 1.2345 - a[0, 0]))) < 0.1
    assert not sensitivity_is_proved(notch, 0.2, 0.0, 10.0)
    assert sensitivity_is_proved(notch, 0.2, 2.0, 10.0)


def test_refusals() -> None:
    system = plant()
    with pytest.raises(obsynth.PreconditionError, match="lacks row rank"):
        obsynth.detection_filter(system.replace(Dw=np.zeros((2, 2))))
    with pytest.raises(obsynth.SpecError, match="continuous plant"):
        obsynth.detection_filter(system.replace(dt=0.1))
    with pytest.raises(obsynth.SpecError, match="lowest and the highest"):
        obsynth.detection_filter(system, band=(3.0, 1.0))
