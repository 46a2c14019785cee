"""Covariances that are singular, or become so: the filter is right there, and its checks must see that."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

import obsynth
from obsynth import DescriptorSystem, ObserverDesign
from obsynth.methods.engines.recursive.checks import BATCH_TOLERANCE
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


@pytest.mark.parametrize("variance", [1e-8, 1e-12, 1e-16])
def test_a_regressor_that_tends_to_zero(variance: float) -> None:
    plant = sampled(TURN, np.eye(2), Bf=[[1], [0]])
    design = obsynth.adaptive_observer(plant, R=variance)
    assert design.report.passed
    if variance > BATCH_TOLERANCE:
        # The regressor is as large as the variance: below the tolerance any is as good as none.
        other = design.observer.plant.replace(Phi=[[5.0], [0.0]])
        assert "batch: regressor" in failed(design, plant=other)
