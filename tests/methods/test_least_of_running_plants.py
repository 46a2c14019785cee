"""Least thresholds of plants that have been running: nothing that uses the same samples may do better."""

from __future__ import annotations

import numpy as np
import pytest

import obsynth
from obsynth.proofs.nonsingular import is_nonsingular_exactly

#: x1+ = 0.9 x1 + d and a sensor that is so many samples late; y1 sees it with the fault, y2 the fault with noise.
DISTURBANCE, NOISE = 0.1, 0.5


def late_sensor(delay: int) -> obsynth.DescriptorSystem:
    n = delay + 1
    a = np.eye(n, k=-1)
    a[0, 0] = 0.9
    return obsynth.DescriptorSystem(
        A=a, C=np.vstack([np.eye(n)[-1], np.zeros(n)]), Bf=np.zeros((n, 1)), Df=[[1.0], [1.0]], Bd=np.eye(n)[:, :1],
        Bw=np.zeros((n, 1)), Dw=[[0.0], [1.0]], dt=1.0,
    )  # fmt: skip


@pytest.mark.one_in(4)
@pytest.mark.parametrize("delay", [0, 1, 2, 3])
def test_no_other_test_on_the_same_samples_is_below_the_least(delay: int) -> None:
    plant = late_sensor(delay)
    test = obsynth.guaranteed_test(
        plant, course="step", before=1, samples=2, disturbance_bounds=DISTURBANCE, noise_bound=NOISE
    )
    rng, x, y = np.random.default_rng(46), np.zeros(delay + 1), []
    for _ in range(5_000):
        y.append(x[-1])
        x = plant.A @ x + plant.Bd[:, 0] * rng.choice([-DISTURBANCE, DISTURBANCE])
    # A function of the two samples of y1, of which a step adds the fault once.
    other = float(np.max(np.abs(np.array(y[1:]) - 0.9 * np.array(y[:-1]))))
    assert np.isnan(test.least) or test.least <= other * (1.0 + 1e-9)
    words = obsynth.online_monitor(test).statement
    assert ("no function of these samples" in words) is (delay == 0)
    assert bool(np.isnan(test.least)) is (delay > 0)
    if delay:
        assert any("before the window" in note for note in test.notes)
    assert test.report.passed


def test_a_plant_that_starts_with_the_window_has_a_least_threshold() -> None:
    options = {"course": "step", "before": 1, "samples": 2, "disturbance_bounds": 0.1, "noise_bound": 0.5}
    test = obsynth.guaranteed_test(late_sensor(1), initial_bounds={"x1": 10.0, "x2": 10.0}, **options)
    assert test.least == pytest.approx(test.threshold)


def test_a_least_that_is_claimed_for_a_delay_fails() -> None:
    test = obsynth.guaranteed_test(
        late_sensor(1), course="step", before=1, samples=2, disturbance_bounds=0.1, noise_bound=0.5
    )
    claims = {**test.certificate.claims, "least": test.threshold}
    changed = test.replace(certificate=obsynth.Certificate(test.certificate.matrices, claims))
    assert not obsynth.verify(changed).passed


def test_determinants_of_doubles_are_decided_exactly() -> None:
    rng = np.random.default_rng(46)
    for n in (1, 2, 5, 60):
        matrix = rng.standard_normal((n, n)) * 10.0 ** rng.integers(-150, 150, (n, 1))
        assert is_nonsingular_exactly(matrix)
        whole = rng.integers(-9, 10, (n, n)).astype(float)
        whole[-1] = whole[:-1].sum(axis=0)
        assert not is_nonsingular_exactly(whole)
    assert is_nonsingular_exactly(np.diag([1.0, 1e-300]))
    assert not is_nonsingular_exactly(np.ones((2, 3)))
    # Singular but for one rounding.
    assert is_nonsingular_exactly(np.array([[0.1, 0.3], [0.1 * 3, 0.9]]))
