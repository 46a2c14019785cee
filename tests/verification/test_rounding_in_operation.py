"""Rounding as an observer runs: the bound holds for every rounding, and the worst one comes near it."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

import obsynth
from obsynth import DescriptorSystem, LinearObserver
from obsynth.verification.rounding_in_operation import as_it_runs, rounding_in_operation

#: One rounding of a double.
ROUNDING = 2.0**-53
STEPS = 400


def observer_of(seed: int, order: int = 4) -> tuple[LinearObserver, np.ndarray]:
    """Return an observer of two faults with some states that decay slowly, and outputs in several units."""
    rng = np.random.default_rng([46, 53, seed])
    az = rng.standard_normal((order, order))
    az *= 0.93 / np.max(np.abs(np.linalg.eigvals(az)))
    plant = DescriptorSystem(A=0.5 * np.eye(3), B=np.eye(3)[:, :1], C=np.eye(3), Bf=np.eye(3)[:, :2], dt=1.0)
    sizes = 10.0 ** rng.uniform(-3.0, 3.0, 3)
    given = obsynth.fault_estimation_filter(plant).observer
    # Only Az, By, Cz and Dy matter: these are any.
    count = given.fault_rows.stop - given.fault_rows.start
    rows = np.zeros((len(given.Cz), order))
    rows[given.fault_rows] = rng.standard_normal((count, order))
    observer = dataclasses.replace(
        given, Az=az, By=rng.standard_normal((order, 3)) / sizes, Bu=np.zeros((order, 1)), Cz=rows
    )
    return observer, (sizes * rng.standard_normal(3))[:, None]


def settled(observer: LinearObserver, y: np.ndarray) -> np.ndarray:
    return np.linalg.solve(np.eye(observer.order) - observer.Az, observer.By @ y)


def worst_run(observer: LinearObserver, y: np.ndarray, row: int, roundings: int) -> float:
    """Return how far an estimate is off at the end if each sum is off by as much as it may, in the worst direction."""
    z, az, by = settled(observer, y)[:, 0], observer.Az, observer.By
    cz, dy = observer.Cz[observer.fault_rows][row], observer.Dy[observer.fault_rows][row]
    directions = [cz]
    for _ in range(STEPS):
        directions.append(directions[-1] @ az)
    error = np.zeros_like(z)
    for k in range(STEPS):
        off = roundings * ROUNDING * (np.abs(az) @ np.abs(z + error) + np.abs(by) @ np.abs(y[:, 0]))
        error = az @ error + np.sign(directions[STEPS - 1 - k]) * off
    last = roundings * ROUNDING * (np.abs(cz) @ np.abs(z + error) + np.abs(dy) @ np.abs(y[:, 0]))
    return float(abs(cz @ error) + last)


@pytest.mark.one_in(6)
@pytest.mark.parametrize("seed", range(8))
def test_the_worst_of_all_roundings_comes_near_the_bound(seed: int) -> None:
    observer, y = observer_of(seed)
    bound = rounding_in_operation(observer, np.arange(observer.order), np.abs(y), np.abs(settled(observer, y)))
    # Four states, three outputs, one input: eight products are added, and each output was rounded before.
    for row in range(2):
        worst = worst_run(observer, y, row, 9)
        assert worst <= bound[row, 0] <= 1.7 * worst
        assert worst_run(observer, y, row, 13) >= 0.9 * bound[row, 0]


@pytest.mark.parametrize("seed", range(4))
def test_the_sum_of_the_sizes_of_powers_is_enough_where_no_norm_is_proved_to_contract(
    seed: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("obsynth.verification.rounding_in_operation.contraction_of", lambda observer: None)
    observer, y = observer_of(seed)
    sizes = np.abs(observer.Az)
    observer = dataclasses.replace(observer, Az=0.9 / np.max(np.abs(np.linalg.eigvals(sizes))) * sizes)
    bound = rounding_in_operation(observer, np.arange(observer.order), np.abs(y), np.abs(settled(observer, y)))
    for row in range(2):
        # No sign is used: the sum of sizes may be some times the one in the worst direction.
        worst = worst_run(observer, y, row, 9)
        assert worst <= bound[row, 0] <= 20.0 * worst


def test_an_observer_without_state_rounds_its_outputs_alone() -> None:
    observer, y = observer_of(0)
    still = dataclasses.replace(observer, Cz=np.zeros_like(observer.Cz))
    bound = rounding_in_operation(still, np.arange(0), np.abs(y), np.zeros((0, 1)))
    sizes = np.abs(still.Dy[still.fault_rows]) @ np.abs(y)
    assert np.all(bound >= 5.0 * ROUNDING * sizes)
    assert np.all(bound <= 12.0 * ROUNDING * sizes + 1e-300)


def test_states_that_reach_no_estimate_do_not_count() -> None:
    observer, y = observer_of(1)
    sizes = np.abs(settled(observer, y))
    alone = rounding_in_operation(observer, np.arange(4), np.abs(y), sizes)
    az, by, cz = np.eye(5) * 2.0, np.ones((5, 3)) * 1e9, np.zeros((len(observer.Cz), 5))
    az[:4, :4], by[:4], cz[:, :4] = observer.Az, observer.By, observer.Cz
    larger = dataclasses.replace(observer, Az=az, By=by, Cz=cz, Bu=np.zeros((5, 1)))
    assert np.array_equal(rounding_in_operation(larger, np.arange(4), np.abs(y), sizes), alone)


@pytest.mark.parametrize("slowest", [1.0 + 1e-3, 1.0])
def test_an_observer_that_does_not_decay_has_no_bound(slowest: float) -> None:
    observer, y = observer_of(2)
    for az in (slowest * np.eye(4), np.diag([slowest, 0.1, 0.2, 0.3])):
        kept = dataclasses.replace(observer, Az=az)
        assert np.all(np.isinf(rounding_in_operation(kept, np.arange(4), np.abs(y), np.ones((4, 1)))))


def test_a_continuous_observer_runs_as_it_is_sampled() -> None:
    plant = DescriptorSystem(A=[[-1.0, 0.5], [0.0, -2.0]], C=np.eye(2), Bf=[[1.0], [0.0]], dt=0.0)
    design = obsynth.ui_pi_observer(plant)
    running = as_it_runs(design.observer)
    assert running.dt == pytest.approx(1.0 / np.max(np.abs(np.linalg.eigvals(design.observer.Az))))
    assert f"sampled every {running.dt:.3g} s" in design.report["constant fault"].detail
    y = np.linalg.solve(-plant.A, plant.Bf)
    z = np.linalg.solve(np.eye(running.order) - running.Az, running.By @ y)[:, 0]
    shown = running.run(np.tile(y[:, 0], (500, 1)), initial_state=z).faults
    assert np.max(np.abs(shown - 1.0)) <= design.report["constant fault"].value < 1e-10
    assert as_it_runs(running) is running


def test_a_long_window_is_not_refused_for_rounding_of_its_delays() -> None:
    """A chain of delays moves numbers without rounding them: no norm contracts it, the sum of its powers is exact."""
    plant = obsynth.DescriptorSystem(A=[[0.9]], C=[[1.0]], Bf=[[1.0]], dt=1.0)
    design = obsynth.guaranteed_test(plant, course="constant", samples=120, noise_bound={"y1": 1.0})
    row = next(row for row in design.report.checks if row.name == "constant fault")
    assert row.passed
    assert row.value < 1e-9


@pytest.mark.parametrize("decades", [10.0, 25.0])
def test_units_of_the_states_change_no_bound(decades: float) -> None:
    """States of long chains are decades apart: what rounding adds is a share of each, in whatever unit."""
    observer, y = observer_of(3, order=12)
    unit = np.ldexp(1.0, np.round(np.linspace(-decades, decades, 12) * np.log2(10.0)).astype(int))
    scaled = dataclasses.replace(
        observer, Az=unit[:, None] * observer.Az / unit, By=unit[:, None] * observer.By, Cz=observer.Cz / unit
    )
    plain, other = (
        rounding_in_operation(one, np.arange(12), np.abs(y), np.abs(settled(one, y))) for one in (observer, scaled)
    )
    assert np.all(other <= 1.5 * plain)
