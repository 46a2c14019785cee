"""The least gain by the eliminated inequality: our own solver, a general one, and the paper's inequality as written.

Whatever the data (feedthrough of the disturbance, more disturbances than measurements, a free weight or a limited one),
the own solver agrees with Clarabel on the same problem, and the eliminated form with the whole one.
"""

from __future__ import annotations

import itertools
import warnings

import cvxpy
import numpy as np
import pytest

from obsynth.methods.fault_estimation_filter import inequality_solutions
from obsynth.methods.fault_estimation_filter.injection_problem import GainProblem, WeightLimit, normalise

#: What solvers leave open of the squared level, relative; the whole inequality is solved worse.
ACCURACY = 1e-5
ACCURACY_OF_WHOLE = 1e-3


def random_problem(seed: int, *, weight: str, feedthrough: bool, nd: int, order: int = 5) -> GainProblem:
    """Return a problem in normalised coordinates."""
    rng = np.random.default_rng([46, seed])
    m, q = 2, 2
    a = rng.standard_normal((order, order))
    a *= 1.05 / np.max(np.abs(np.linalg.eigvals(a)))
    c, z = rng.standard_normal((m, order)), rng.standard_normal((q, order))
    fixed, free = rng.standard_normal((q, 4)), np.linalg.qr(rng.standard_normal((4, m)))[0].T
    fixed -= fixed @ free.T @ free
    limit = WeightLimit(fixed, free, 1.2 * float(np.linalg.norm(fixed, 2)))
    problem = GainProblem(
        A=a,
        C=c,
        Z=z,
        B=rng.standard_normal((order, nd)),
        D=0.3 * rng.standard_normal((m, nd)) if feedthrough else np.zeros((m, nd)),
        Zd=0.3 * rng.standard_normal((q, nd)) if feedthrough else np.zeros((q, nd)),
        Bn=np.zeros((order, m)),
        Dn=-np.eye(m),
        Zn=np.zeros((q, m)),
        free_weight=weight != "fixed",
        weight_limit=limit if weight == "limited" else None,
    )
    return normalise(problem).problem


def whole_inequality(problem: GainProblem) -> float:
    """Return the least level of the paper's inequality in P, Y, V and the level, written anew."""
    n, m, q, nd = problem.order, problem.measured, len(problem.Z), problem.disturbances
    p, y, squared = cvxpy.Variable((n, n), symmetric=True), cvxpy.Variable((n, m)), cvxpy.Variable()
    v = cvxpy.Variable((q, m)) if problem.free_weight else np.zeros((q, m))
    left = cvxpy.bmat([[p, np.zeros((n, nd))], [np.zeros((nd, n)), squared * np.eye(nd)]])
    right = cvxpy.bmat([[p, np.zeros((n, q))], [np.zeros((q, n)), np.eye(q)]])
    loop = cvxpy.bmat(
        [
            [p @ problem.A - y @ problem.C, p @ problem.B - y @ problem.D],
            [problem.Z + v @ problem.C, problem.Zd + v @ problem.D],
        ]
    )
    whole = cvxpy.bmat([[left, loop.T], [loop, right]])
    constraints = [whole + whole.T >> 0, cvxpy.trace(p) <= inequality_solutions.P_CEILING * n]
    limit = problem.weight_limit
    if limit is not None:
        constraints.append(cvxpy.sigma_max(limit.fixed + v @ limit.free) <= limit.bound)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # "may be inaccurate": so is the comparison
        cvxpy.Problem(cvxpy.Minimize(squared), constraints).solve(solver="CLARABEL")
    return float(np.sqrt(squared.value))


CASES = list(itertools.product(("fixed", "free", "limited"), (False, True), (3, 5)))


@pytest.mark.parametrize(("weight", "feedthrough", "nd"), CASES)
def test_our_solver_agrees_with_a_general_one(weight: str, feedthrough: bool, nd: int) -> None:
    for seed in range(4):
        problem = random_problem(seed, weight=weight, feedthrough=feedthrough, nd=nd)
        ours = inequality_solutions.least_gain(problem, solver="SCHUR")
        general = inequality_solutions.least_gain(problem, solver="CLARABEL")
        assert ours.gain == pytest.approx(general.gain, rel=ACCURACY, abs=1e-4), seed
        reached = problem.achieved_gain(ours.injection)
        assert reached <= ours.gain * (1.0 + ACCURACY) + 1e-4, seed


@pytest.mark.parametrize(("weight", "feedthrough", "nd"), CASES)
def test_elimination_loses_nothing(weight: str, feedthrough: bool, nd: int) -> None:
    problem = random_problem(9, weight=weight, feedthrough=feedthrough, nd=nd)
    found = inequality_solutions.least_gain(problem, solver="SCHUR")
    assert found.gain == pytest.approx(whole_inequality(problem), rel=ACCURACY_OF_WHOLE, abs=1e-3)


@pytest.mark.parametrize("feedthrough", [False, True])
def test_a_limit_on_the_weight_holds_and_binds(feedthrough: bool) -> None:
    for seed in range(4):
        gains = []
        for weight in ("fixed", "limited", "free"):
            problem = random_problem(seed, weight=weight, feedthrough=feedthrough, nd=3)
            found = inequality_solutions.least_gain(problem, solver="SCHUR")
            gains.append(found.gain)
            limit = problem.weight_limit
            if limit is not None:
                assert np.linalg.norm(limit.fixed + found.injection.V @ limit.free, 2) <= limit.bound
        assert gains[0] * (1.0 + ACCURACY) >= gains[1] >= gains[2] * (1.0 - ACCURACY) - 1e-4
        assert gains[0] > 1.001 * gains[2], seed
