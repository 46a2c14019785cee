"""Random descriptor plants for the recursive methods: verdicts by construction, designs that must exist."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import pytest

import obsynth
from obsynth import PreconditionError, TimeVaryingDescriptorSystem
from obsynth.analysis.existence.recursive import recursive_conditions

STEPS = 60
MODES = (0.5, 0.99, 1.0, -1.0, 1.05, 3.0)


class Case(NamedTuple):
    """Matrices in random coordinates, with an unobservable mode in the last dynamic state."""

    E: np.ndarray
    A: np.ndarray
    C: np.ndarray
    Phi: np.ndarray
    Psi: np.ndarray
    Q: np.ndarray
    R: np.ndarray

    def plant(self, *, parameters: bool = False) -> TimeVaryingDescriptorSystem:
        added = {"Phi": self.Phi, "Psi": self.Psi} if parameters else {}
        return TimeVaryingDescriptorSystem(self.E, self.A, C=self.C, **added, dt=1.0, horizon=STEPS)


def case(seed: int, mode: float) -> Case:
    rng = np.random.default_rng(seed)
    dynamic, algebraic = int(rng.integers(2, 5)), int(rng.integers(0, 3))
    outputs, n = algebraic + int(rng.integers(1, 3)), dynamic + algebraic
    A1 = rng.standard_normal((dynamic, dynamic))
    A1[:, -1] = 0.0
    A1[-1, -1] = mode
    C = rng.standard_normal((outputs, n))
    C[:, dynamic - 1] = 0.0
    E, A = np.zeros((n, n)), np.zeros((n, n))
    E[:dynamic, :dynamic], A[:dynamic, :dynamic] = np.eye(dynamic), A1
    A[dynamic:, dynamic:] = -np.eye(algebraic)
    # Well-conditioned coordinates with units of their own.
    left = np.linalg.qr(rng.standard_normal((n, n)))[0] * 10.0 ** rng.uniform(-2, 2, n)[:, None]
    right = np.linalg.qr(rng.standard_normal((n, n)))[0] * 10.0 ** rng.uniform(-2, 2, n)
    root = rng.standard_normal((n, n - seed % 2))
    Phi, Psi = rng.standard_normal((n, outputs)), rng.standard_normal((outputs, outputs))
    return Case(
        left @ E @ right, left @ A @ right, C @ right, left @ Phi, Psi, left @ root @ root.T @ left.T,
        np.diag(rng.uniform(0.1, 1.0, outputs)),
    )  # fmt: skip


@pytest.mark.one_in(4)
@pytest.mark.parametrize("mode", MODES)
@pytest.mark.parametrize("seed", range(12))
def test_detectability_decides(seed: int, mode: float) -> None:
    found = case(seed, mode)
    if abs(mode) < 1.0:
        design = obsynth.descriptor_kalman(found.plant(), Q=found.Q, R=found.R)
        assert design.report.passed
    else:
        with pytest.raises(PreconditionError) as caught:
            obsynth.descriptor_kalman(found.plant(), Q=found.Q, R=found.R)
        assert caught.value.condition == "detectability"
        assert caught.value.mode == pytest.approx(mode, abs=1e-5)


@pytest.mark.parametrize("mode", MODES)
@pytest.mark.parametrize("seed", range(6))
def test_of_plants_that_change_the_product_decides(seed: int, mode: float) -> None:
    """The same matrices as a stack, in very different units: a hidden mode that does not decay is recognised."""
    found = case(seed, mode)
    plant = TimeVaryingDescriptorSystem(found.E, np.tile(found.A, (STEPS, 1, 1)), C=found.C, dt=1.0)
    if abs(mode) < 1.0:
        assert obsynth.descriptor_kalman(plant, Q=found.Q, R=found.R).report.passed
    else:
        with pytest.raises(PreconditionError) as caught:
            obsynth.descriptor_kalman(plant, Q=found.Q, R=found.R)
        assert caught.value.condition == "contraction"


@pytest.mark.one_in(4)
@pytest.mark.parametrize("seed", range(12))
def test_as_many_parameters_as_outputs_and_not_one_more(seed: int) -> None:
    """At rest ny outputs determine ny random parameters, unless the last one is made to cancel the others."""
    found = case(seed, 0.5)
    design = obsynth.adaptive_observer(found.plant(parameters=True), Q=found.Q, R=found.R, window=20)
    assert design.report.passed
    rng = np.random.default_rng(seed)
    n, nq = len(found.A), len(found.C)
    state, theta = rng.standard_normal(n), rng.uniform(0.5, 2.0, nq)
    Phi, Psi = found.Phi.copy(), found.Psi.copy()
    Phi[:, -1] = -((found.A - found.E) @ state + Phi[:, :-1] @ theta[:-1]) / theta[-1]
    Psi[:, -1] = -(found.C @ state + Psi[:, :-1] @ theta[:-1]) / theta[-1]
    with pytest.raises(PreconditionError) as caught:
        obsynth.adaptive_observer(found._replace(Phi=Phi, Psi=Psi).plant(parameters=True), Q=found.Q, R=found.R)
    assert caught.value.condition == "identifiable parameters"
    assert caught.value.signals == tuple(f"theta{i + 1}" for i in range(nq))


@pytest.mark.parametrize("seed", range(12))
def test_the_numeric_test_of_plants_that_change_agrees(seed: int) -> None:
    """The same matrices as stacks: parameters without effect are found by their traces, the others are accepted."""
    found = case(seed, 0.5)
    stacked = TimeVaryingDescriptorSystem(
        found.E, np.tile(found.A, (STEPS, 1, 1)), C=found.C, Phi=found.Phi, Psi=found.Psi, dt=1.0
    )
    twins_phi, twins_psi = found.Phi.copy(), found.Psi.copy()
    twins_phi[:, -1], twins_psi[:, -1] = 3.0 * twins_phi[:, 0], 3.0 * twins_psi[:, 0]
    both = (stacked, True), (stacked.replace(Phi=twins_phi, Psi=twins_psi), len(found.C) == 1)
    for plant, holds in both:
        rows = {row.name: row for row in recursive_conditions(plant, parameters=True)}
        assert rows["identifiable parameters"].holds == holds
