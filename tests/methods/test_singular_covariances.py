"""Covariances that are singular, or become so: the filter is right there, and its checks must see that."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

import obsynth
from obsynth import DescriptorSystem, ObserverDesign, TimeVaryingDescriptorSystem
from obsynth.methods.engines.recursive.checks import BATCH_TOLERANCE
from obsynth.numerics.ranks import covariance_factor
from obsynth.observers.recursive.gain_schedule import gain_steps
from obsynth.plants.sequences import MatrixSequence

TURN = [[0.9, 0.1], [-0.2, 0.7]]
SHIFT = [[0.5, 0.0], [0.0, 0.0]]
CASES = {
    "fast, Q = 0": ([[0.1]], [[1.0]], 0.0, 1.0),
    "fast, R = 0": ([[0.1]], [[1.0]], 1.0, 0.0),
    "slow, Q = 0": ([[0.5]], [[1.0]], 0.0, 1.0),
    "square C, R = 0": (TURN, np.eye(2), 1.0, 0.0),
    "one output, R = 0": (TURN, [[1.0, 0.0]], 1.0, 0.0),
    "zero eigenvalue, Q = 0": (SHIFT, [[1.0, 1.0]], 0.0, 1.0),
    "zero eigenvalue, Q nearly 0": (SHIFT, [[1.0, 1.0]], 1e-30, 1.0),
    "zero eigenvalue": (SHIFT, [[1.0, 1.0]], 1.0, 1.0),
    "all zero": (np.zeros((2, 2)), [[1.0, 1.0]], 0.0, 1.0),
    "two equal outputs, R = 0": (TURN, [[1.0, 0.0], [1.0, 0.0]], 1.0, 0.0),
    "no noise at all": (TURN, [[1.0, 0.0]], 0.0, 0.0),
}


def sampled(A, C, **fields) -> DescriptorSystem:
    return DescriptorSystem(None, A, C=C, dt=1.0, **fields)


@pytest.mark.one_in(2)
@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("name", CASES)
def test_singular_covariances_are_verified(name: str) -> None:
    A, C, Q, R = CASES[name]
    assert obsynth.descriptor_kalman(sampled(A, C), Q=Q, R=R).report.passed


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("first", range(4))
def test_no_stable_plant_is_refused_for_noise_that_is_missing(first: int, share: Callable[..., Any]) -> None:
    for seed in share(range(first, 24, 4), 6):
        rng = np.random.default_rng(seed)
        n, ny = int(rng.integers(1, 5)), int(rng.integers(1, 4))
        A = rng.standard_normal((n, n))
        A *= rng.uniform(0.1, 0.95) / max(abs(np.linalg.eigvals(A)))
        if seed % 3 == 0:
            A[:, 0] = 0.0
        C = rng.standard_normal((ny, n))
        root = rng.standard_normal((n, max(n - 1, 1)))
        noises = [(0.0, 1e-4), (1e-4, 0.0), (root @ root.T, 1e-2), (root @ root.T, 0.0)]
        # Half of them for each plant, the others for the next.
        for Q, R in share(noises[seed % 2 :] + noises[: seed % 2], 2):
            assert obsynth.descriptor_kalman(sampled(A, C), Q=Q, R=R).report.passed, seed


def known_exactly(seed: int) -> tuple[DescriptorSystem, np.ndarray, np.ndarray]:
    """A stable plant whose states a perfect sensor determines: with less process noise than states, or none."""
    rng = np.random.default_rng(1000 + seed)
    n, ny = int(rng.integers(2, 6)), int(rng.integers(1, 4))
    A = rng.standard_normal((n, n))
    A *= rng.uniform(0.3, 0.95) / max(abs(np.linalg.eigvals(A)))
    C, root = rng.standard_normal((ny, n)), rng.standard_normal((n, 1))
    variances = np.full(ny, 0.01)
    variances[: int(rng.integers(1, ny + 1))] = 0.0
    return sampled(A, C), (root @ root.T if seed % 2 else np.zeros((n, n))), np.diag(variances)


#: Plants of which rounding was taken for noise: each failed a check, or had gains without a steady state.
ROUNDED = (45, 50, 75, 85)


@pytest.mark.one_in(4)
@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("seed", ROUNDED)
def test_rounding_of_a_state_that_is_known_exactly_is_no_noise(seed: int) -> None:
    plant, Q, R = known_exactly(seed)
    design = obsynth.descriptor_kalman(plant, Q=Q, R=R)
    assert design.report.passed
    L = design.gains["L"]
    assert max(abs(np.linalg.eigvals(L @ plant.A))) < 1.0
    if not Q.any():
        # What is known exactly has the variance zero, not one of 1e-32.
        *_, last = gain_steps(design.observer, plant.nx + 1)
        assert not last.factor.any()


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("seed", [5001, 5041])
def test_an_algebraic_equation_without_noise_does_not_contradict_an_estimate_that_satisfies_it(seed: int) -> None:
    """Its terms cancel: what is left of them is rounding, however small the estimate is."""
    rng = np.random.default_rng(seed)
    n, ny = int(rng.integers(2, 5)), int(rng.integers(1, 4))
    E, A = np.eye(n), rng.standard_normal((n, n))
    A *= rng.uniform(0.3, 0.95) / max(abs(np.linalg.eigvals(A)))
    C = rng.standard_normal((ny, n))
    E[-1] = 0.0
    A[-1, -1] += 2.0
    plant = DescriptorSystem(E, A, C=C, dt=1.0)
    design = obsynth.descriptor_kalman(plant, Q=0.0, R=0.0)
    assert design.report.passed


@pytest.mark.long
def test_a_steady_state_that_is_known_exactly_has_gains_by_which_errors_of_rounding_decay() -> None:
    plant, Q, R = known_exactly(50)
    steady = obsynth.steady_state_filter(plant, Q=Q, R=R)
    assert not steady.P.any()
    assert max(abs(np.linalg.eigvals(steady.L @ plant.A))) < 1.0


@pytest.mark.parametrize("seed", [45, 50])
def test_errors_of_rounding_decay_where_outputs_without_noise_show_them(seed: int) -> None:
    """An estimate that is off by what rounding makes of it comes back, also of a plant that varies."""
    plant, Q, R = known_exactly(seed)
    varying = TimeVaryingDescriptorSystem(
        None, MatrixSequence.of([plant.A] * 80, "A"), None, plant.C, dt=1.0, horizon=80
    )
    design = obsynth.descriptor_kalman(varying, Q=Q, R=R)
    assert design.report.passed
    x, records = np.ones(plant.nx), []
    for _ in range(80):
        records.append(plant.C @ x)
        x = plant.A @ x
    observer = design.observer
    state = observer.init()
    for k in range(80):
        state, row = observer.advance(state, records[k], np.zeros(0))
        if k == 20:
            state = state._replace(x=state.x * (1.0 + 1e-12))
    start = np.linalg.norm(plant.A) * np.ones(plant.nx)
    assert np.all(np.abs(row.x - np.linalg.matrix_power(plant.A, 79) @ np.ones(plant.nx)) <= 1e-12 * start)


def test_a_singular_covariance_has_no_deviation_of_rounding() -> None:
    """The root of an eigenvalue of 1e-17 would be a deviation of 3e-9."""
    rng = np.random.default_rng(5)
    for n in range(2, 7):
        root = rng.standard_normal((n, 1))
        factor = covariance_factor(root @ root.T, "Q")
        assert np.count_nonzero(factor.any(axis=0)) == 1
        np.testing.assert_allclose(factor @ factor.T, root @ root.T, rtol=0, atol=1e-14 * np.max(root**2))


def failed(design: ObserverDesign, **changes) -> set[str]:
    observer = dataclasses.replace(design.observer, **changes)
    return {check.name for check in obsynth.verify(design.replace(observer=observer)).failures}


def test_what_is_claimed_to_be_known_must_be() -> None:
    """A filter that takes a noisy output as exact claims a covariance of zero, and errs."""
    design = obsynth.descriptor_kalman(sampled(TURN, [[1.0, 0.0]]), Q=1.0, R=1.0)
    found = failed(design, R=MatrixSequence.of(np.zeros((1, 1)), "R"))
    assert {"known directions", "batch: state", "batch: covariance"} <= found
    still = obsynth.descriptor_kalman(sampled([[0.5]], [[1.0]]), Q=0, R=1)
    wrong = failed(still, initial_covariance=0.01 * np.eye(1))
    assert {"NEES", "batch: covariance"} <= wrong


@pytest.mark.one_in(3)
@pytest.mark.parametrize("variance", [1e-8, 1e-12, 1e-16])
def test_a_regressor_that_tends_to_zero(variance: float) -> None:
    plant = sampled(TURN, np.eye(2), Bf=[[1], [0]])
    design = obsynth.adaptive_observer(plant, R=variance)
    assert design.report.passed
    if variance > BATCH_TOLERANCE:
        # The regressor is as large as the variance: below the tolerance any is as good as none.
        other = design.observer.plant.replace(Phi=[[5.0], [0.0]])
        assert "batch: regressor" in failed(design, plant=other)
