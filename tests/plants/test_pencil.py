"""Regularity and index where E is nonsingular: no rank beside fast rates may say that the states are not determined."""

from __future__ import annotations

import numpy as np
import pytest

from obsynth import DescriptorSystem
from obsynth.analysis.existence.filasova import pd_observer_conditions
from obsynth.plants.pencil import regularity_of, structure_of
from obsynth.proofs.nonsingular import is_proved_nonsingular


def with_fast_exchange(states: int, rate: float, seed: int) -> DescriptorSystem:
    """Slow states, two of which exchange what they hold at a rate: A alone is nearly singular beside it."""
    rng = np.random.default_rng([46, seed])
    a = 0.1 * rng.standard_normal((states, states)) - np.diag(rng.uniform(0.5, 2.0, states))
    a[0, :2] += [-rate, rate]
    a[1, :2] += [rate, -rate]
    c = np.eye(3, states) + 0.1 * rng.standard_normal((3, states))
    return DescriptorSystem(A=a, C=c, Bf=np.eye(states)[:, 5:6])


@pytest.mark.parametrize("rate", [1e3, 1e11, 1e15])
@pytest.mark.parametrize("states", [10, 70])
def test_with_an_identity_every_plant_is_regular_and_of_index_zero(states: int, rate: float) -> None:
    for seed in range(2):
        plant = with_fast_exchange(states, rate, seed)
        found = structure_of(plant)
        assert (found.regular, found.normal_rank, found.index) == (True, states, 0)
        assert len(found.finite_eigenvalues) == states
        assert regularity_of(plant) == (True, states)
        named = {condition.name: condition for condition in pd_observer_conditions(plant)}
        assert all(named[name].holds for name in ("regularity", "index", "dynamic states"))


def test_a_plant_that_is_not_regular_is_refused_as_unclear_where_ranks_are_floating() -> None:
    for states, unclear in ((8, False), (80, True)):
        e = np.eye(states)
        e[-1, -1] = 0.0
        a = -np.eye(states)
        a[-1, -1] = 0.0
        plant = DescriptorSystem(E=e, A=a, C=np.eye(2, states), Bf=np.eye(states)[:, :1])
        last = pd_observer_conditions(plant)[-1]
        assert (last.name, last.holds, bool(last.unclear)) == ("regularity", False, unclear)


def test_nonsingular_is_said_only_where_it_is() -> None:
    rng = np.random.default_rng(46)
    for n in (1, 3, 20, 120):
        matrix = rng.standard_normal((n, n))
        assert is_proved_nonsingular(matrix)
        assert is_proved_nonsingular(np.exp2(rng.integers(-300, 300, n))[:, None] * matrix)
        singular = matrix.copy()
        singular[-1] = singular[:-1].sum(axis=0)
        assert not is_proved_nonsingular(singular)
    for diagonal, verdict in (([1.0, 2.0], True), ([1.0, 0.0], False), ([1.0, 1e-20], True)):
        assert is_proved_nonsingular(np.diag(diagonal)) is verdict
    assert not is_proved_nonsingular(np.ones((2, 3)))
