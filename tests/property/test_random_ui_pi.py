"""Random plants with unknown inputs: the verdict against brute force, placed poles, estimates that do not see d."""

from __future__ import annotations

from collections import Counter

import numpy as np
import pytest

from obsynth import PreconditionError, ui_pi_observer
from obsynth.analysis.unknown_input_conditions import existence
from obsynth.models.exosystems import exosystem
from property.ui_pi_plants import KINDS, Case, brute_force, exosystem_of, random_case

BATCHES, SIZE = 16, 24
ALL = range(BATCHES * SIZE)


def batch(number: int) -> list[tuple[int, Case]]:
    return [(seed, random_case(seed)) for seed in range(number * SIZE, (number + 1) * SIZE)]


def decided(case: Case) -> bool:
    model = exosystem(case.model, case.plant.fault_names, case.plant.dt)
    return all(condition.holds for condition in existence(case.plant, model).conditions)


@pytest.mark.parametrize("number", range(BATCHES))
def test_the_verdict_is_that_of_the_pencil(number: int) -> None:
    for seed, case in batch(number):
        assert decided(case) == brute_force(case)[0], (seed, case.kind, case.model)
