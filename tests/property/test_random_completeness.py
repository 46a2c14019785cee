"""Every plant that has a filter by construction gets one, with a report that passes."""

from collections.abc import Mapping
from functools import cache
from typing import Any

import numpy as np
import pytest

import obsynth
from plants import KnownPlant, Recipe, build, random_recipe

#: Fields of the recipe that a family fixes; None means that `hidden_mode` is drawn for each plant.
FAMILIES: Mapping[str, tuple[int, dict[str, Any]]] = {
    "random": (60, {}),
    "as many faults as outputs": (20, {"square": True}),
    "one output": (10, {"ny": 1}),
    "E = I": (20, {"explicit": True, "singularity": 0}),
    "unstable": (40, {"radius": 2.0}),
    "index 3": (20, {"indexes": (3,)}),
    "pencil of index two": (20, {"index_two": True}),
    "no disturbance": (10, {"nd": 0}),
    "no inputs": (10, {"nu": 0}),
    "hidden stable mode": (20, {"hidden_modes": (-0.6,)}),
    "slow zero": (10, {"zeros": (0.99,)}),
    "sensor fault": (20, {"sensor_faults": 1}),
    "two sensor faults that act on the states": (20, {"sensor_faults": 2, "mixed_sensor_faults": True}),
    "feedthrough": (20, {"feedthrough": True}),
    "disturbance in the sensors only": (10, {"disturbance": "sensor", "nd": 2}),
    "disturbance without effect": (5, {"disturbance": "zero", "nd": 1}),
    "disturbance that no output shows": (10, {"disturbance": "invisible", "nd": 1, "hidden_modes": (0.5,)}),
    "disturbance like a fault": (10, {"disturbance": "fault", "nd": 1}),
    "many large disturbances": (10, {"disturbance": "large", "nd": 6}),
    "noise": (20, {"noise": 3, "feedthrough": True}),
    "bad units": (20, {"scales": 1e3}),
    "bad units with sensor fault and feedthrough": (10, {"scales": 1e3, "sensor_faults": 1, "feedthrough": True}),
}  # fmt: skip


@cache
def plants_of(family: str) -> tuple[KnownPlant, ...]:
    count, fixed = FAMILIES[family]
    number = list(FAMILIES).index(family)
    found = []
    for i in range(count):
        rng = np.random.default_rng([2015, number, i])
        found.append(build(rng, random_recipe(rng, **fixed)))
    return tuple(found)


def outcome_of(known: KnownPlant, **options: Any) -> tuple[str, Recipe] | None:
    """Return the error of a design and the recipe of its plant, or nothing."""
    try:
        design = obsynth.fault_estimation_filter(known.plant, **options)
    except obsynth.ObsynthError as error:
        return f"{type(error).__name__}: {error}", known.recipe
    wrong = [row.name for row in design.report.checks if not row.passed]
    if wrong or not design.report.passed:
        return f"report: {wrong}", known.recipe
    if design.observer.fault_delays != known.indexes:
        return f"delays {design.observer.fault_delays} instead of {known.indexes}", known.recipe
    return None


@pytest.mark.long
def test_there_are_enough_plants():
    everything = [known for family in FAMILIES for known in plants_of(family)]
    assert len(everything) >= 200
    assert {known.plant.nx for known in everything} == set(range(3, 11))
    assert {index for known in everything for index in known.indexes} == {1, 2, 3}
    singular = [known for known in everything if known.recipe.singularity]
    unstable = [known for known in everything if not obsynth.analyse_structure(known.plant).stable]
    assert len(singular) >= 100
    assert len(unstable) >= 100


@pytest.mark.one_in(4)
@pytest.mark.parametrize("family", FAMILIES)
def test_every_plant_is_solved(family, share):
    plants = share(plants_of(family), 8)
    failures = [failure for failure in map(outcome_of, plants) if failure is not None]
    solved = len(plants) - len(failures)
    assert solved == len(plants), "\n".join(f"{text}\n    {recipe}" for text, recipe in failures)


@pytest.mark.one_in(4)
@pytest.mark.parametrize(
    "options",
    [
        {"weight": "free"},
        {"gamma_margin": 0.5},
        {"gamma_margin": 1e-2},
        {"gamma": 1e6},
        {"gamma_search": "bisection", "tolerance": 1e-2},
    ],
    ids=str,
)
def test_every_plant_is_solved_with_options(options, share):
    plants = share(plants_of("random")[:30], 10)
    failures = [failure for failure in (outcome_of(known, **options) for known in plants) if failure is not None]
    assert failures == []


@cache
def least_weight(number: int) -> float:
    """Norm of the least residual weight of a random plant."""
    design = obsynth.fault_estimation_filter(plants_of("random")[number].plant)
    return float(1.0 / np.linalg.svd(design.gains["Upsilon"])[1][-1])


@pytest.mark.one_in(3)
@pytest.mark.parametrize(("engine", "factor", "count"), [("lmi", 2.0, 30), ("auto", 2.0, 30), ("auto", 1.2, 10)])
def test_limit_on_the_residual_weight_is_kept(engine, factor, count, share):
    failures = []
    for number in share(range(count), 8):
        known, least = plants_of("random")[number], least_weight(number)
        design = obsynth.fault_estimation_filter(known.plant, residual_weight_limit=factor * least, engine=engine)
        if not design.report.passed or np.linalg.norm(design.gains["W"], 2) > factor * least:
            failures.append(known.recipe)
    assert failures == []
