"""The least gain: the same by every route, never beaten, and what lies below it is refused with a sound bound."""

import numpy as np
import pytest
from reference_gain import ErrorProblem

import obsynth
from plants import build, random_recipe

#: Gains below this share of the one with a fixed weight count as a decoupled disturbance: their digits mean nothing.
NEGLIGIBLE = 1e-3
#: A SolverError is honest ("nothing is known") but should be the exception.
SHARE_TO_BE_PROVED = 0.95


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
    return obsynth.fault_estimation_filter(plant, **{"weight": "paper"} | options).certificate.claims["gamma_min"]


@pytest.fixture(scope="module")
def solved(share):
    """Plants with their least gain, fixed weight."""
    plants = [*disturbed_plants(14, 7, largest=8), *disturbed_plants(6, 8, feedthrough=True)]
    return [(plant, least(plant)) for plant in share(plants, 4)]


@pytest.mark.long
def test_bisection_agrees_with_the_direct_solution(share):
    tolerance = 1e-4
    for plant in share([*disturbed_plants(10, 0), *disturbed_plants(5, 1, feedthrough=True)], 3):
        direct = least(plant)
        design = obsynth.fault_estimation_filter(plant, gamma_search="bisection", tolerance=tolerance)
        claims = design.certificate.claims
        low, high = claims["gamma_bracket_low"], claims["gamma_bracket_high"]
        assert high - low <= tolerance * high
        assert claims["gamma_min"] <= high * (1.0 + 1e-6)
        # 1e-5: what the direct search itself leaves open.
        assert claims["gamma_min"] == pytest.approx(direct, rel=tolerance + 1e-5)


def test_two_solvers_agree():
    for plant in disturbed_plants(4, 2, largest=4):
        assert least(plant, solver="SCS") == pytest.approx(least(plant, solver="CLARABEL"), rel=1e-3)


@pytest.mark.long
@pytest.mark.parametrize("fixed", [{}, {"feedthrough": True}, {"explicit": True, "singularity": 0}], ids=str)
def test_no_filter_beats_the_least_gain(fixed, share):
    beaten = []
    for plant in share(disturbed_plants(10, 3, largest=8, **fixed), 5):
        design = obsynth.fault_estimation_filter(plant, weight="paper")
        found = design.certificate.claims["gamma_min"]
        better = ErrorProblem.of(design).best(found)
        if better < found * (1.0 - 1e-3):
            beaten.append((repr(plant), found, better))
    assert beaten == []


@pytest.mark.long
def test_free_weight_never_costs_gain_and_is_not_beaten(solved, share):
    worse, beaten = [], []
    for plant, fixed in share(solved, 3):
        design = obsynth.fault_estimation_filter(plant, weight="free")
        found = design.certificate.claims["gamma_min"]
        if found > fixed * (1.0 + 1e-5):
            worse.append((repr(plant), fixed, found))
        better = max(ErrorProblem.of(design, free_weight=True).best(found), NEGLIGIBLE * fixed)
        if better < found * (1.0 - 1e-3):
            beaten.append((repr(plant), found, better))
    assert worse == []
    assert beaten == []


@pytest.mark.one_in(3)
@pytest.mark.parametrize("part", [0.5, 0.9, 0.9999])
def test_gamma_below_the_least_is_refused_with_a_sound_bound(solved, part):
    proved = 0
    for plant, found in solved:
        with pytest.raises((obsynth.InfeasibleError, obsynth.SolverError)) as refusal:
            obsynth.fault_estimation_filter(plant, weight="paper", gamma=part * found)
        if isinstance(refusal.value, obsynth.InfeasibleError):
            proved += 1
            assert part * found < refusal.value.lower_bound <= found * (1.0 + 1e-9)
            assert not refusal.value.necessary
    assert proved >= SHARE_TO_BE_PROVED * len(solved)


def test_gamma_below_the_least_is_always_proved_without_freedom(share):
    rng = np.random.default_rng(9)
    plants = [build(rng, random_recipe(rng, square=True, nd=2)).plant for _ in range(15)]
    for plant in share(plants, 3):
        found = least(plant)
        with pytest.raises(obsynth.InfeasibleError) as refusal:
            obsynth.fault_estimation_filter(plant, weight="paper", gamma=0.99 * found)
        assert 0.99 * found < refusal.value.lower_bound <= found


@pytest.mark.parametrize("factor", [1.001, 1e6])
def test_gamma_above_the_least_is_reached(solved, factor):
    failures = []
    for plant, found in solved:
        try:
            design = obsynth.fault_estimation_filter(plant, weight="paper", gamma=factor * found)
        except obsynth.ObsynthError as error:
            failures.append((repr(plant), found, str(error)))
            continue
        assert design.report.passed
        assert design.certificate.claims["gamma"] <= factor * found * (1.0 + 1e-12)
    assert failures == []


@pytest.mark.one_in(4)
@pytest.mark.parametrize("options", [{}, {"gamma": 1.0}, {"weight": "free"}], ids=str)
@pytest.mark.parametrize("square", [False, True])
def test_disturbance_without_any_effect_is_served(options, square):
    for i in range(4):
        rng = np.random.default_rng([46, i])
        recipe = random_recipe(rng, disturbance="invisible", nd=1, hidden_modes=(0.5,), square=square)
        design = obsynth.fault_estimation_filter(build(rng, recipe).plant, **options)
        assert design.report.passed
        assert design.certificate.claims["gamma_min"] <= 1e-9
