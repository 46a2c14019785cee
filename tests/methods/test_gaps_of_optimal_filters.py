"""Random plants whose optimal filters had a gap, or were inconclusive, before what is named here was mended."""

from __future__ import annotations

import pytest
from benchmarks.campaigns import optimal_filters


@pytest.mark.parametrize(
    "seed",
    [
        pytest.param(50272, id="the least gain is that of infinite frequency"),
        pytest.param(60865, id="the least gain needs the worst noise of a nearer level"),
        pytest.param(60917, id="an entry of 1e-53 among those of a Riccati equation"),
    ],
)
def test_gain_and_least_gain_of_a_random_plant_meet(seed: int) -> None:
    outcome = optimal_filters.case(seed)
    assert (outcome.result, outcome.wrong) == ("designed", "")
    assert outcome.value is not None
    assert outcome.value < 1e-7
