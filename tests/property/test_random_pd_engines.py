"""Every engine of the PD observer finds an observer where there is one, and none where there is none."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
import pytest
from pd_plants import build, random_recipe

import obsynth

Share = Callable[..., Sequence[Any]]
ENGINES = ("lmi", "riccati")
FAMILIES: Mapping[str, dict[str, Any]] = {
    "random": {},
    "one output": {"ny": 1},
    "unstable": {"radius": 6.0},
    "hidden stable pair": {"hidden": (-0.4 + 2.0j,)},
    "sensor fault": {"sensor_faults": 1},
    "algebraic states": {"algebraic": 2},
    "bad units": {"units": 30.0},
    "milliseconds": {"time_unit": 1e-3},
    "slow and fast modes": {"spread": 30.0},
    "chain of integrators": {"chain": True, "ny": 2},
}
PLANTS_OF_EACH = 4


def plants_of(family: str, **more: Any) -> list[obsynth.DescriptorSystem]:
    generators = [np.random.default_rng([77, list(FAMILIES).index(family), i]) for i in range(PLANTS_OF_EACH)]
    return [build(rng, random_recipe(rng, **{**FAMILIES[family], **more})) for rng in generators]


def outcome(plant: obsynth.DescriptorSystem, engine: str, **options: Any) -> tuple[str, str]:
    """Return the kind of result and, of a refusal, the condition; what was found has been verified."""
    try:
        design = obsynth.pd_observer(plant, engine=engine, **options)
    except obsynth.PreconditionError as error:
        return "refused", error.condition
    except obsynth.ObsynthError as error:
        return type(error).__name__, str(error)
    assert design.report.passed
    return "found", design.solver["engine"]


@pytest.mark.one_in(4)
@pytest.mark.parametrize("theorem", [1, 2])
@pytest.mark.parametrize("family", FAMILIES)
def test_where_there_is_an_observer_every_engine_finds_one(family: str, theorem: int, share: Share) -> None:
    replaced = 0
    for plant in share(plants_of(family), 4)[:: 1 if theorem == 1 else 4]:
        for engine in ENGINES:
            kind, ran = outcome(plant, engine, theorem=theorem)
            # Where the semidefinite solver gives up, the closed form takes its place.
            assert (kind, ran) in (("found", engine), ("found", "riccati"))
            replaced += ran != engine
    assert replaced <= 2


@pytest.mark.parametrize("mode", [0.3, 0.1 + 1.0j])
def test_where_there_is_none_every_engine_says_why(mode: complex) -> None:
    for plant in plants_of("random", hidden=(mode,)):
        assert {outcome(plant, engine) for engine in ENGINES} == {("refused", "detectability")}


@pytest.mark.parametrize("delta", [1e-2, 20.0])
def test_theorem_1_has_a_solution_for_every_delta_by_every_engine(delta: float, share: Share) -> None:
    for plant in share(plants_of("random"), 2):
        for engine in ENGINES:
            assert outcome(plant, engine, delta=delta, decay=0.0) == ("found", engine)


def test_a_decay_rate_beyond_that_of_a_hidden_mode_is_refused_by_all() -> None:
    for plant in plants_of("hidden stable pair"):
        kinds = {outcome(plant, engine, decay=0.41)[0] for engine in ENGINES}
        assert kinds == {"InfeasibleError"}
