"""Gains that a scheduled design lists are those that run: every one is held against the realisation at the vertices."""

from __future__ import annotations

from collections.abc import Callable
from functools import cache
from typing import Any

import numpy as np
import pytest
from tests.support.corruptions import with_claims

import obsynth
from obsynth import ObserverDesign, PolytopicSystem


def scheduled(**fields: Any) -> PolytopicSystem:
    """Return a plant of two states, one of whose entries is scheduled."""
    plant = {"A": [[0.5, "0.3*v"], [0.1, 0.4]], "B": [[1], [0]], "C": [[1, 0], [0, 1], [1, 0.5]], "dt": 1.0}
    return PolytopicSystem(plant={**plant, **fields}, scheduling={"v": [-1.0, 1.0]})


MAKERS: dict[str, Callable[[], ObserverDesign]] = {
    "filter": lambda: obsynth.fault_estimation_filter(scheduled(Bf=[[1], [0.5]], D=[[0.2], [0], [0]])),
    "filter, fault of changing effect": lambda: obsynth.fault_estimation_filter(
        scheduled(Bf=[["1 + 0.5*v"], ["0.5 + 0.25*v"]])
    ),
    "filter, fault that turns": lambda: obsynth.fault_estimation_filter(scheduled(Bf=[["1 - 0.5*v"], ["0.5*v"]])),
    "unknown-input PI": lambda: obsynth.ui_pi_observer(scheduled(Bf=[[1], [0.5]])),
    "Kalman": lambda: obsynth.descriptor_kalman(scheduled(Bd=[[0], [1]]), Q=0.1, R=0.2),
}


@cache
def made(name: str) -> ObserverDesign:
    return MAKERS[name]()


def failures(design: ObserverDesign) -> set[str]:
    return {row.name for row in obsynth.verify(design.replace(report=None)).failures}


@pytest.mark.one_in(3)
@pytest.mark.parametrize("name", MAKERS)
def test_a_listed_gain_that_does_not_run_is_refused(name: str) -> None:
    design, rng = made(name), np.random.default_rng(46)
    assert failures(design) == set()
    for letter, matrix in design.gains.items():
        if not matrix.size:
            continue
        changed = matrix.copy()
        place = tuple(int(rng.integers(size)) for size in matrix.shape)
        changed[place] = 1.001 * matrix[place] if matrix[place] else 1e-3
        assert any(row.startswith("gains") for row in failures(design.replace(gains={**design.gains, letter: changed})))


@pytest.mark.one_in(5)
@pytest.mark.parametrize("name", MAKERS)
def test_letters_and_shapes_are_those_of_the_method(name: str) -> None:
    design = made(name)
    letters = dict(design.gains)
    last = list(letters)[-1]
    fewer = {letter: matrix for letter, matrix in letters.items() if letter != last}
    assert failures(design.replace(gains=fewer))
    assert failures(design.replace(gains={**letters, "more": np.eye(2)}))
    assert failures(design.replace(gains={**letters, last: np.eye(7)}))
    assert failures(design.replace(gains={})) == set()  # nothing is said about gains


@pytest.mark.parametrize("name", [name for name in MAKERS if name.startswith("filter")])
def test_estimates_of_a_filter_over_a_region_are_not_late(name: str) -> None:
    assert failures(with_claims(made(name), state_lag=1.0))


def test_options_of_a_scheduled_design_can_be_read() -> None:
    design = made("filter")
    assert failures(design.replace(options={**design.options, "weight": "x"})) == {"options"}


@pytest.mark.parametrize(
    ("option", "value"),
    [("state_bounds", {"x1": [0.0, 1.0]}), ("sensors", {"y1": {"every": 2}}), ("early_constraints", True),
     ("outliers", "gate"), ("initial_state", [1.0, 0.0])],
)  # fmt: skip
def test_options_that_a_scheduled_filter_does_not_have_are_not_listed(option: str, value: object) -> None:
    """Bounds of states, or sensors of their own times, that a file states but its filter does not know, are none."""
    design = made("Kalman")
    assert failures(design.replace(options={**design.options, option: value})) == {"options over the region"}
