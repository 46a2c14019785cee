"""The least gain: the same by every route, never beaten, and what lies below it is refused with a sound bound."""

import numpy as np
import pytest
from plants import build, random_recipe

import obsynth

#: Gains below this share of the one with a fixed weight count as a decoupled disturbance: their digits mean nothing.
NEGLIGIBLE = 1e-3
#: A SolverError is honest ("nothing is known") but should be the exception.
SHARE_TO_BE_PROVED = 0.9


def disturbed_plants(count, stream, **fixed):
    """Return plants on which the gains are free: more outputs than faults, and a disturbance."""
    found = []
    i = 0
    while len(found) < count:
        rng = np.random.default_rng([45, stream, i])
        i += 1
        recipe = random_recipe(rng, **{"largest": 6, "nd": int(rng.integers(1, 4)), **fixed})
        if recipe.ny > len(recipe.indexes):
            found.append(build(rng, recipe).plant)
    return found


def least(plant, **options):
    return obsynth.fault_estimation_filter(plant, **options).certificate.claims["gamma_min"]


@pytest.fixture(scope="module")
def solved():
    """Plants with their least gain, fixed weight."""
    plants = [*disturbed_plants(14, 7, largest=8), *disturbed_plants(6, 8, feedthrough=True)]
    return [(plant, least(plant)) for plant in plants]


def test_gamma_below_the_least_is_always_proved_without_freedom():
    rng = np.random.default_rng(9)
    for _ in range(15):
        plant = build(rng, random_recipe(rng, square=True, nd=2)).plant
        found = least(plant)
        with pytest.raises(obsynth.InfeasibleError) as refusal:
            obsynth.fault_estimation_filter(plant, gamma=0.99 * found)
        assert 0.99 * found < refusal.value.lower_bound <= found


@pytest.mark.parametrize("factor", [1.001, 1e6])
def test_gamma_above_the_least_is_reached(solved, factor):
    failures = []
    for plant, found in solved:
        try:
            design = obsynth.fault_estimation_filter(plant, gamma=factor * found)
        except obsynth.ObsynthError as error:
            failures.append((repr(plant), found, str(error)))
            continue
        assert design.report.passed
        assert design.certificate.claims["gamma"] <= factor * found * (1.0 + 1e-12)
    assert failures == []


@pytest.mark.parametrize("options", [{}, {"gamma": 1.0}, {"free_residual_weight": True}], ids=str)
@pytest.mark.parametrize("square", [False, True])
def test_disturbance_without_any_effect_is_served(options, square):
    for i in range(4):
        rng = np.random.default_rng([46, i])
        recipe = random_recipe(rng, disturbance="invisible", nd=1, hidden_modes=(0.5,), square=square)
        design = obsynth.fault_estimation_filter(build(rng, recipe).plant, **options)
        assert design.report.passed
        assert design.certificate.claims["gamma_min"] <= 1e-9
