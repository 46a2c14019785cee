"""What a region, a decay and a level that are asked for mean, whatever a solver returns."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

import obsynth
from obsynth.conditions.problem import Conditions
from obsynth.methods.engines import own_terms
from obsynth.numerics.regions import disk, half_plane, sector

DESIGNS = Path(__file__).parents[2] / "designs"


def plant_of(name: str) -> obsynth.DescriptorSystem:
    return obsynth.load_spec(DESIGNS / name / "spec.yaml").plant


def a_filter(**options: Any) -> obsynth.ObserverDesign:
    return obsynth.fault_estimation_filter(plant_of("wang2015"), **options)


def a_pd(**options: Any) -> obsynth.ObserverDesign:
    return obsynth.pd_observer(plant_of("filasova"), **options)


def a_ui_pi(**options: Any) -> obsynth.ObserverDesign:
    return obsynth.ui_pi_observer(plant_of("sharepasand"), fault_model="ramp", **options)


REGIONS = {
    "filter": (a_filter, disk(0.0, 0.6), "L"),
    "pd": (a_pd, half_plane(0.3), "JM"),
    "ui-pi": (a_ui_pi, half_plane(0.5), ("Ahat",)),
}


@pytest.mark.parametrize("name", REGIONS)
def test_gains_outside_of_the_region_are_inconclusive(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """Had the solver returned other gains than those of its inequality, the design would be refused."""
    make, where, letters = REGIONS[name]
    assert make(region=where).report.passed
    gains = Conditions.gains

    def spoilt(found: Conditions) -> dict[str, np.ndarray]:
        kept = {letter: np.asarray(gain) for letter, gain in gains(found).items()}
        return kept | {letter: -30.0 * gain for letter, gain in kept.items() if letter in letters}

    monkeypatch.setattr(Conditions, "gains", spoilt)
    with pytest.raises(obsynth.SolverError, match="outside"):
        make(region=where)


@pytest.mark.parametrize(("value", "inside"), [(0.59, True), (0.6 + 5e-7, True), (0.6 + 1e-5, False), (-0.7, False)])
def test_one_eigenvalue_outside_is_enough(value: float, inside: bool) -> None:
    closed = np.diag([0.1, value, 0.2])
    own_terms._require_inside(closed, None)
    if inside:
        own_terms._require_inside(closed, disk(0.0, 0.6))
        return
    with pytest.raises(obsynth.SolverError, match="outside"):
        own_terms._require_inside(closed, disk(0.0, 0.6))


def test_a_filter_needs_zero_in_its_region() -> None:
    """Those eigenvalues that decouple the faults are at zero, whatever the gains are."""
    with pytest.raises(obsynth.PreconditionError, match="region with 0 in it") as told:
        a_filter(region=disk(0.5, 0.3))
    assert told.value.condition == "region"
    assert np.min(np.abs(np.linalg.eigvals(a_filter(region=disk(0.0, 0.6)).observer.Az))) < 1e-6


@pytest.mark.parametrize("decay", [2.0, 6.0])
def test_a_decay_is_that_of_the_slowest_eigenvalue(decay: float, monkeypatch: pytest.MonkeyPatch) -> None:
    """The disk that is asked for is that of the whole rate: no larger, and no smaller."""
    asked: list[Any] = []
    inside = own_terms._require_inside

    def seen(closed: np.ndarray, where: Any) -> None:
        asked.append(where)
        inside(closed, where)

    monkeypatch.setattr(own_terms, "_require_inside", seen)
    design = a_filter(decay=decay, objective=lambda letters: letters["gamma_squared"] * 0.0 + 1.0)
    dt = design.plant.dt
    assert np.max(np.abs(np.linalg.eigvals(design.observer.Az))) <= np.exp(-decay * dt) * (1.0 + 1e-6)
    edge = np.exp(-decay * dt)
    assert asked[0].contains([0.999 * edge])
    assert not asked[0].contains([1.001 * edge])


def test_named_parts_of_a_region_are_all_meant() -> None:
    method = own_terms.UiPiObserver.of({"region": {"decay": 1.5, "radius": 4.0, "damping": 0.6}, "fault_model": "ramp"})
    where = own_terms._region_of_poles(method, 0.0)
    assert where is not None
    assert where.contains([-1.501])
    assert not where.contains([-1.499])
    assert where.contains([-3.999])
    assert not where.contains([-4.001])
    # The cosine of the angle of -2 + 2.6 j is .61, that of -2 + 2.8 j is .58.
    assert where.contains([-2.0 + 2.6j, -2.0 - 2.6j])
    assert not where.contains([-2.0 + 2.8j, -2.0 - 2.8j])
    assert sector(0.6).contains([-2.0 + 2.6j, -2.0 - 2.6j])


@pytest.mark.parametrize("dt", [0.1, 0.2])
def test_the_decay_of_sampled_poles_is_that_of_a_disk(dt: float) -> None:
    method = own_terms.UiPiObserver.of({"region": {"decay": 1.5}, "fault_model": "ramp"})
    where = own_terms._region_of_poles(method, dt)
    assert where is not None
    assert where.contains([0.999 * np.exp(-1.5 * dt)])
    assert not where.contains([1.001 * np.exp(-1.5 * dt)])


@pytest.mark.parametrize("rate", [0.01, 0.5, 3.0])
def test_delta_is_chosen_well_inside_of_the_region(rate: float) -> None:
    where = half_plane(2.0)
    delta = own_terms._fitting_delta(1.0 / rate, where)
    assert where.contains([-1.0 / delta])
    assert own_terms._fitting_delta(1.0 / rate, None) == 1.0 / rate
    assert own_terms._fitting_delta(1.0 / 7.0, where) == 1.0 / 7.0
    # Of all rates that are well inside the nearest one is taken.
    assert 1.0 / delta <= 30.0 * max(rate, 2.0)


def test_a_solver_that_ends_without_an_answer_is_no_proof_that_there_is_none(monkeypatch: pytest.MonkeyPatch) -> None:
    found = SimpleNamespace(
        source="the inequality", constraints={"own": None}, problem=SimpleNamespace(status="infeasible"),
        solve=lambda **_: None,
    )  # fmt: skip
    asked = SimpleNamespace(solver="CLARABEL", solver_options=None)
    with pytest.raises(obsynth.SolverError, match="'own'") as told:
        own_terms._solved(found, asked)  # type: ignore[arg-type]
    assert told.value.record["status"] == "infeasible"
