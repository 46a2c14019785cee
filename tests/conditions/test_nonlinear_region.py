"""Inequalities of observers of nonlinear plants over a region: corners, full and diagonal multipliers."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from tests.methods.test_region_observer import REGION, tanks

import obsynth
from obsynth import SpecError
from obsynth.conditions import ErrorPolytope, SlopedErrors, nonlinear_region, slope_inequality

_NOISE = {"l1": 0.1, "l2": 0.1, "leak": 0.1}


def _least(goal: str, multiplier: str) -> float:
    found = nonlinear_region(tanks(), REGION, sample_time=2.0, noise=_NOISE, goal=goal, multiplier=multiplier)
    found.solve()
    assert found.problem.status in ("optimal", "optimal_inaccurate")
    return float(np.sqrt(found.problem.value))


@pytest.mark.one_in(2)
@pytest.mark.parametrize("goal", ["gain", "power"])
def test_a_full_multiplier_is_as_good_as_the_corners_and_a_diagonal_one_nearly(goal: str) -> None:
    corners, full, diagonal = (_least(goal, multiplier) for multiplier in ("vertices", "full", "diagonal"))
    assert full == pytest.approx(corners, rel=1e-3)
    assert corners * (1 - 1e-3) <= diagonal <= 1.2 * corners


@pytest.mark.long
def test_the_design_reaches_what_the_inequalities_allow() -> None:
    made = obsynth.region_observer(tanks(), region=REGION, sample_time=2.0, noise=_NOISE)
    assert made.certificate.claims["region_deviation"] == pytest.approx(_least("power", "vertices"), rel=0.03)


def test_a_spring_ends_where_it_must() -> None:
    # x'' + x' + k x, k in [1, b]: one P up to b = 4 (sqrt b - 1 < 1), by a multiplier of either kind.
    for kind in ("full", "diagonal"):
        for b, holds in ((3.9, True), (4.1, False)):
            nominal = ErrorPolytope([[[0, 1], [-(1 + b) / 2, -1]]], np.zeros((0, 2)), dt=0.0)
            errors = SlopedErrors(nominal, np.array([[0], [(1 - b) / 2]]), np.zeros((0, 1)), np.array([[1.0, 0]]))
            found = slope_inequality(errors, goal="decay", decay=0.0, multiplier=kind)
            found.solve()
            assert (float(found.variables["room"].value) > 1e-6) is holds


def test_region_of_a_model_is_the_same_problem() -> None:
    options: dict[str, Any] = {"sample_time": 2.0, "noise": _NOISE, "goal": "power", "multiplier": "full"}
    one = obsynth.conditions.region(tanks(), REGION, **options)
    assert list(one.constraints) == list(nonlinear_region(tanks(), REGION, **options).constraints)
    with pytest.raises(SpecError, match="multiplier"):
        obsynth.conditions.region(tanks(), REGION, sample_time=2.0, noise=_NOISE, multiplier="half")
