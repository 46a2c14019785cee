"""An unknown input that is a multiple of another one but for rounding takes no design away."""

from __future__ import annotations

import cvxpy
import numpy as np
import pytest

import obsynth
from obsynth.plants.transformations.repeated_disturbances import without_repeated_disturbances

A = np.array([[-1.1, 0.25], [0.3, -0.9]])


def plant_with(factors: list[float], dt: float, *, direction: tuple[float, float] = (0.7083207575539909, -0.77351)):
    """Return a plant whose unknown inputs all act in one direction."""
    return obsynth.DescriptorSystem(
        A=A + (1.0 if dt else 0.0) * np.eye(2), C=[[1.0, 0.2], [0.1, 1.3]], Bf=[[0.4], [1.1]],
        Bd=np.outer(direction, factors), dt=dt,
    )  # fmt: skip


@pytest.mark.one_in(2)
@pytest.mark.parametrize("dt", [0.0, 1.0])
@pytest.mark.parametrize("factor", [3.0, 0.1, 1.0 / 3.0, 7e5])
@pytest.mark.parametrize("method", ["ui-pi-observer", "functional-filter"])
def test_a_multiple_takes_no_design_away_and_is_decoupled(method: str, factor: float, dt: float) -> None:
    plant = plant_with([1.0, factor], dt)
    design = obsynth.design(plant, method)
    assert design.report.passed
    assert obsynth.check(plant)[method].passed
    observer = design.linear[1]
    point = np.exp(0.3j) if dt else 0.3j
    states = np.linalg.solve(point * np.eye(2) - plant.A, plant.Bd)
    through = observer.Cz @ np.linalg.solve(point * np.eye(observer.order) - observer.Az, observer.By) + observer.Dy
    estimates = (through @ plant.C @ states)[observer.fault_rows]
    assert np.max(np.abs(estimates / [1.0, factor])) < 1e-9


@pytest.mark.one_in(6)
@pytest.mark.parametrize("options", [{}, {"decay": 0.5}, {"joint": True}])
@pytest.mark.parametrize("factor", [3.0, 1.0 / 3.0, 7e4])
def test_a_multiple_that_outputs_show_takes_no_design_away(factor: float, options: dict[str, float]) -> None:
    direct = np.outer([0.4531, -1.207], [1.0, factor])
    plant = plant_with([1.0, factor], 0.0).replace(Dd=direct, Dw=0.1 * np.eye(2), Bw=None, noise_names=None)
    assert obsynth.ui_pi_observer(plant, **options).report.passed


@pytest.mark.parametrize("factor", [3.0, 1.0 / 3.0])
def test_the_inequality_as_it_is_solved_is_that_of_the_independent_ones(factor: float) -> None:
    direct = np.outer([0.4531, -1.207], [1.0, factor])
    plant = plant_with([1.0, factor], 0.0).replace(Dd=direct)
    problem = obsynth.conditions.sharepasand(plant, region=obsynth.conditions.half_plane(0.3))
    problem.problem.solve()
    assert problem.design().report.passed
    own = obsynth.ui_pi_observer(plant, decay=0.3, objective=lambda letters: cvxpy.Minimize(cvxpy.trace(letters["P"])))
    assert own.report.passed


def test_unknown_inputs_that_differ_are_all_there() -> None:
    assert without_repeated_disturbances(plant_with([1.0], 0.0)) is None
    two = plant_with([1.0, 3.0], 0.0)
    fewer = without_repeated_disturbances(two)
    assert fewer is not None
    assert fewer.disturbance_names == ("d1",)
    changed = two.Bd.copy()
    changed[0, 1] *= 1.0 + 1e-9
    assert without_repeated_disturbances(two.replace(Bd=changed)) is None
