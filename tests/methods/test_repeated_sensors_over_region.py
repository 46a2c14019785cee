"""One sensor more beside those of a filter over a region: ordinary gains, and no larger gain from disturbances."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pytest

import obsynth


def plant(*more: np.ndarray, seed: int = 7105, noise: Sequence[float] = ()) -> obsynth.PolytopicSystem:
    """Return two vertices with one disturbance; ``noise``: of each sensor, as further disturbances."""
    rng = np.random.default_rng(seed)
    a = rng.normal(size=(3, 3))
    a *= 0.8 / np.max(np.abs(np.linalg.eigvals(a)))
    moved, c, bf, bd = 0.1 * rng.normal(size=(3, 3)), *(rng.normal(size=size) for size in ((2, 3), (3, 1), (3, 1)))
    c = np.vstack([c, *(weights @ c for weights in more)])
    Bd = np.hstack([0.3 * bd, np.zeros((3, len(noise)))])
    Dd = np.hstack([np.zeros((len(c), 1)), np.diag(noise)[: len(c)]]) if noise else None
    return obsynth.PolytopicSystem(
        [obsynth.DescriptorSystem(A=a + s * moved, C=c, Bf=bf, Bd=Bd, Dd=Dd, dt=1.0) for s in (-1, 1)]
    )


@pytest.mark.parametrize("weights", [[[1.0, 0.0]], [[10.0, 0.0]], [[1.0, 1.0]], [[1e3, 0.0], [1.0, 1.0]]])
def test_repeated_sensors_leave_a_design_with_ordinary_gains(weights: list[list[float]]) -> None:
    alone = obsynth.fault_estimation_filter(plant())
    beside = obsynth.fault_estimation_filter(plant(np.array(weights)))
    assert alone.report.passed
    assert beside.report.passed
    # No disturbance need reach the estimate with either: what is left of the gain is rounding.
    assert beside.certificate.claims["gamma"] < 1e-5
    largest = [max(float(np.max(np.abs(gain))) for gain in design.gains.values()) for design in (alone, beside)]
    assert largest[1] < 1e3 * largest[0]


def test_the_paper_s_weight_does_not_lose_by_a_repeated_sensor() -> None:
    alone, beside = (
        obsynth.fault_estimation_filter(plant(*more), weight="paper").certificate.claims["gamma"]
        for more in ((), (np.array([[1.0, 0.0]]),))
    )
    assert beside <= 1.05 * alone


@pytest.mark.parametrize("seed", [7100, 7101])
@pytest.mark.parametrize("weights", [[[1.0, 0.0]], [[1.0, 1.0]]], ids=["copy", "sum"])
def test_a_disturbance_that_can_be_decoupled_stays_so_beside_a_repeated_sensor(
    seed: int, weights: list[list[float]]
) -> None:
    """The search for gains alone stopped at .349 beside a copy (.00105 without), and the exact gains were not tried."""
    design = obsynth.fault_estimation_filter(plant(np.array(weights), seed=seed))
    assert design.report.passed
    assert design.report["least gain"].kind == "equality"
    assert design.certificate.claims["gamma"] < 1e-5


@pytest.mark.parametrize("seed", [7100, 7101, 7102])
def test_a_copy_with_noise_of_its_own_increases_no_gain(seed: int) -> None:
    """The difference of both shows noise alone: what was left of the states there is rounding, and made units of it."""
    few, more = (
        obsynth.fault_estimation_filter(plant(*rows, seed=seed, noise=(0.05,) * (2 + len(rows))))
        for rows in ((), (np.array([[1.0, 0.0]]),))
    )
    assert few.report.passed
    assert more.report.passed
    assert more.certificate.claims["gamma"] <= few.certificate.claims["gamma"]
