"""Plants of the campaign on existence that a method once lost, though an observer exists: they are designed."""

from __future__ import annotations

import sys
from pathlib import Path

import pytest

sys.path.insert(0, str(Path(__file__).parents[2]))

from benchmarks.campaigns import existence, recursive_existence

LOST = {
    # An equation that is small beside an output of the same state.
    "fault-estimation-filter": (2188, 5656, 6684, 2008),
    # Ahat is unstable in the nine digits that are commonly printed.
    "ui-pi-observer": (386, 162, 3054),
    # All digits of the deviation under noise are rounding; a pole that stays for good; gains whose entries cancel; a
    # pole beside the fault model.
    "functional-filter": (2755, 4083, 923, 2203, 1187, 2171, 495, 2819),
}


@pytest.mark.one_in(4)
@pytest.mark.parametrize(("method", "seed"), [(method, seed) for method, seeds in LOST.items() for seed in seeds])
def test_is_designed(method: str, seed: int) -> None:
    found = existence.case(seed)
    assert (found.group, found.result, found.wrong) == (method, "designed", "")


@pytest.mark.one_in(4)
@pytest.mark.parametrize("seed", [4, 32, 398, 19, 243, 781])
def test_covariances_near_singular_ones_are_proved_by_their_noise(seed: int) -> None:
    assert recursive_existence.case(seed).result == "designed"
