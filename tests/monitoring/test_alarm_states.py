"""Bounds of the state in the window of a proof: plants of the box stay between them, and come close to them."""

from __future__ import annotations

import itertools
from typing import Any

import numpy as np
import pytest
from uncertain_plants import DRIVE, drive, two_masses

import obsynth
from obsynth.monitoring.alarms.proof_file import assumptions_of
from obsynth.monitoring.alarms.proof_window import window_data
from obsynth.verification.over_tolerances.plants_of_the_box import plant_at

STEPS, WINDOW = 40, 12
UNCERTAIN = ("J1", "k")


def replayed(design: Any, points: np.ndarray) -> tuple[np.ndarray, Any]:
    """Return states of an exact plant, its constants at ``points (steps, p)``, and what a replay knows of them."""
    plant = design.plant
    known: dict[tuple[float, ...], Any] = {}
    for q in points:
        if tuple(q) not in known:
            known[tuple(q)] = obsynth.eliminate_algebraic_states(plant_at(plant, plant.uncertainty.box.values(q))).plant
    x, u = np.zeros(plant.nx), np.random.default_rng(4).uniform(0.5, 1.0, (len(points), plant.nu))
    states, y = np.empty((len(points), plant.nx)), np.empty((len(points), plant.ny))
    for k, q in enumerate(points):
        true = known[tuple(q)]
        states[k], y[k] = x, true.C @ x + true.D @ u[k]
        x = true.A @ x + true.B @ u[k]
    start = dict.fromkeys(plant.state_names, 0.0)
    assumed = assumptions_of(design, dict.fromkeys(plant.disturbance_names, 0.0), 0.0, start, None, WINDOW)
    return states, window_data(design, assumed, WINDOW, u, y)


@pytest.mark.parametrize(("variation", "share", "near"), [("constant", 0.02, 0.9), ("varying", 0.2, 0.3)])
def test_states_of_every_plant_stay_between_the_bounds_of_a_replay(variation: str, share: float, near: float) -> None:
    """The box is on one side of the nominal values: its middle is no plant that the observer knows."""
    ranges = {
        name: {"nominal": value, "range": [value, (1.0 + share) * value]}
        for name, value in DRIVE.items()
        if name in UNCERTAIN
    }
    design = obsynth.fault_estimation_filter(obsynth.uncertain_system(drive("0 %"), ranges, variation=variation))
    # Constants that vary all change once, in the middle: what came before leads away from what they do now.
    signs = np.where(np.arange(STEPS) < STEPS // 2, -1.0, 1.0) if variation == "varying" else np.ones(STEPS)
    closest = 0.0
    for corner in itertools.product((-1.0, 1.0), repeat=len(UNCERTAIN)):
        states, (affine, data, origin) = replayed(design, np.outer(signs, corner))
        assert (origin, data.y.shape, data.u.shape) == ("replay from the start", (WINDOW, 2), (WINDOW, 1))
        seen = np.linalg.solve(affine.coordinates, states[-WINDOW:].T).T
        assert np.all((data.low <= seen) & (seen <= data.high))
        middle, width = (data.low + data.high) / 2.0, (data.high - data.low) / 2.0
        closest = max(closest, float(np.max(np.abs(seen - middle) / width)))
    assert closest > near


def test_stated_bounds_are_those_of_states_in_coordinates_that_no_constant_touches() -> None:
    """Two masses in absolute positions: one of the coordinates is the position of both."""
    design = obsynth.fault_estimation_filter(two_masses())
    sizes = dict(zip(design.plant.state_names, (1.0, 3.0, 0.5, 2.0), strict=True))
    assumed = assumptions_of(design, {}, 0.0, None, sizes, WINDOW)
    affine, data, origin = window_data(design, assumed, WINDOW, np.zeros((STEPS, 0)), np.zeros((STEPS, 2)))
    assert (origin, data.high.shape) == ("stated", (WINDOW, 4))
    corners = np.array(list(itertools.product((-1.0, 1.0), repeat=4))) * list(sizes.values())
    reached = np.linalg.solve(affine.coordinates, corners.T).T
    assert not np.array_equal(affine.coordinates, np.eye(4))
    assert data.high[0] == pytest.approx(reached.max(axis=0), rel=1e-12)
    assert data.low[0] == pytest.approx(reached.min(axis=0), rel=1e-12)
