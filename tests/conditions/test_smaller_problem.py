"""(45) without Y has the optimum of (45), its solution is one of (45), and what a user changes is solved as it is."""

import cvxpy
import numpy as np
import pytest

import obsynth


def random_plant(nx: int, *, nd: int, seed: int, feedthrough: bool = False) -> obsynth.DescriptorSystem:
    rng = np.random.default_rng([20261129, seed])
    ny = 4
    a = rng.normal(size=(nx, nx))
    a *= 1.05 / np.max(np.abs(np.linalg.eigvals(a)))
    hidden = rng.normal(size=(nx, 1))
    e = np.eye(nx) - hidden @ np.linalg.pinv(hidden)
    c, bf, bd = rng.normal(size=(ny, nx)), rng.normal(size=(nx, 2)), 0.3 * rng.normal(size=(nx, nd))
    return obsynth.DescriptorSystem(
        e, a, None, c, Bf=bf, Bd=bd, Dd=0.1 * rng.normal(size=(ny, nd)) if feedthrough else None, dt=0.1
    )


@pytest.mark.one_in(2)
@pytest.mark.parametrize("coordinates", ["plant", "balanced"])
@pytest.mark.parametrize("weight", [None, "free"])
@pytest.mark.parametrize("feedthrough", [False, True])
def test_the_solution_is_one_of_the_inequality_and_as_good(coordinates, weight, feedthrough):
    plant = random_plant(6, nd=3, seed=1, feedthrough=feedthrough)
    paper = obsynth.conditions.wang2015(plant, coordinates=coordinates, W=weight)
    value = paper.problem.solve()
    assert paper.problem.status == "optimal"
    # It was the smaller problem that was solved.
    assert paper.problem._solution is None
    assert paper.problem.solver_stats.solver_name == "CLARABEL"
    size = max(float(np.max(np.abs(variable.value))) for variable in paper.problem.variables())
    assert max(float(np.max(part.violation())) for part in paper.problem.constraints) <= 1e-7 * max(size, 1.0)
    design = paper.design()
    whole = obsynth.conditions.wang2015(plant, coordinates=coordinates, W=weight)
    assert value == pytest.approx(whole.problem.solve(solver="CLARABEL"), rel=2e-4)
    # The proof of the gains is of the norm, not of what a solver says.
    assert design.report.passed
    assert design.certificate.claims["gamma"] <= np.sqrt(value) * (1.0 + 1e-4)


def test_a_constraint_of_the_users_is_kept():
    plant = random_plant(6, nd=3, seed=2)
    paper = obsynth.conditions.wang2015(plant, coordinates="balanced")
    free = paper.problem.solve()
    bound = 0.5 * float(np.trace(paper.variables["P"].value))
    bounded = paper.changed(constraints={"bound": cvxpy.trace(paper.variables["P"]) <= bound})
    assert bounded.problem.solve() >= free * (1.0 - 1e-6)
    assert np.trace(paper.variables["P"].value) <= bound * (1.0 + 1e-6)


@pytest.mark.long
def test_a_given_level_is_judged_as_before():
    plant = random_plant(6, nd=3, seed=3)
    least = np.sqrt(obsynth.conditions.wang2015(plant).problem.solve())
    paper = obsynth.conditions.wang2015(plant, gamma=1.05 * least)
    paper.problem.solve()
    assert paper.problem.status == "optimal"
    assert paper.design().report.passed
    paper.parameters["gamma_squared"].value = (0.95 * least) ** 2
    paper.problem.solve()
    assert paper.problem.status not in ("optimal", "optimal_inaccurate")


def test_a_smaller_solution_that_misses_the_constraints_is_not_taken(monkeypatch):
    paper = obsynth.conditions.wang2015(random_plant(6, nd=3, seed=4), coordinates="balanced")
    smaller = paper.problem._smaller
    right = smaller.set_values

    def wrong() -> None:
        right()
        paper.variables["gamma_squared"].save_value(0.5 * paper.variables["gamma_squared"].value)

    object.__setattr__(smaller, "set_values", wrong)
    value = paper.problem.solve()
    assert paper.problem._solution is not None  # of the whole problem
    assert value == pytest.approx(
        obsynth.conditions.wang2015(random_plant(6, nd=3, seed=4), coordinates="balanced").problem.solve(), rel=2e-4
    )


@pytest.mark.long
@pytest.mark.parametrize("seed", [2, 3])
def test_24_states_are_optimal(seed):
    plant = random_plant(24, nd=14, seed=seed)
    paper = obsynth.conditions.wang2015(plant)
    level = np.sqrt(paper.problem.solve())
    assert paper.problem.status == "optimal"
    assert paper.problem._solution is None
    least = obsynth.fault_estimation_filter(plant, weight="paper").certificate.claims["gamma"]
    assert level <= 1.001 * least
    assert paper.design().report.passed


@pytest.mark.parametrize("seed", [11, 19])
def test_dependent_measurements_leave_no_rounding_in_the_gain(seed):
    # In the plant's coordinates rows of I - Upsilon W are dependent: 2e-15 in its rank made a gain that misses (45).
    paper = obsynth.conditions.wang2015(random_plant(6, nd=3, seed=seed))
    paper.problem.solve()
    assert paper.problem.status == "optimal"
    assert paper.problem._solution is None  # the smaller problem was enough
