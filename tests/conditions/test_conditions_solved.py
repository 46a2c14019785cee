"""`Conditions.solve`: the least value, and what is wrong with a solver's name."""

import numpy as np
import pytest

import obsynth
from obsynth.conditions import wang2015


@pytest.fixture
def plant() -> obsynth.DescriptorSystem:
    return obsynth.DescriptorSystem(
        A=[[0.9, 0.1], [0.0, 0.8]], C=[[1, 0], [0, 1]], Bf=[[1], [0]], Bd=[[0.1], [1]], dt=1.0
    )


def test_the_least_value_is_returned_and_is_that_of_the_problem(plant: obsynth.DescriptorSystem) -> None:
    paper, another = wang2015(plant), wang2015(plant)
    least = paper.solve()
    assert least == pytest.approx(another.problem.solve(), rel=1e-6)
    assert paper.solve(solver="SCS", settings={"eps": 1e-6}) == pytest.approx(least, rel=1e-2)


def test_no_solution_is_an_infinite_value(plant: obsynth.DescriptorSystem) -> None:
    paper = wang2015(plant, gamma=1e-3)
    assert paper.solve() == np.inf
    assert paper.problem.status.startswith("infeasible")


def test_a_solver_that_is_not_there_is_named_with_those_that_are(plant: obsynth.DescriptorSystem) -> None:
    paper = wang2015(plant, gamma=10.0)
    with pytest.raises(obsynth.SpecError, match=r"no solver 'CLARABELL'.*CLARABEL"):
        paper.solve(solver="CLARABELL")
    with pytest.raises(obsynth.SpecError, match="no solver 'CLARABELL'"):
        paper.bisect("gamma_squared", 100.0, 0.0, solver="CLARABELL")


def test_what_a_solver_does_not_take_is_a_solver_error(plant: obsynth.DescriptorSystem) -> None:
    with pytest.raises(obsynth.SolverError, match="CLARABEL failed"):
        wang2015(plant).solve(solver="CLARABEL", settings={"no_such_setting": 1})
