"""Riccati equations of estimation with many states: the solution satisfies its equation."""

import numpy as np
import pytest

import obsynth.numerics.least_estimation as least_estimation
from obsynth.methods.optimal_filter.fault_maps import first_problem
from obsynth.methods.optimal_filter.method import OptimalFilterMethod
from obsynth.plants.descriptor import DescriptorSystem


def problem_of_thirty_states(delay: int):
    """Return the problem of an exact fault map: beside the plant it has states of a window, with eigenvalues zero."""
    n, rng = 30, np.random.default_rng([98, 30, 0])
    a = rng.normal(size=(n, n))
    a = 0.95 / np.max(np.abs(np.linalg.eigvals(a))) * a
    b, c, faults = rng.normal(size=(n, 1)), rng.normal(size=(3, n)), rng.normal(size=(n, 2))
    plant = DescriptorSystem(
        A=a,
        B=b,
        C=c,
        Bf=faults,
        Bw=np.hstack([0.05 * rng.normal(size=(n, n)), np.zeros((n, 3))]),
        Dw=np.hstack([np.zeros((3, n)), 0.05 * np.eye(3)]),
        dt=1.0,
    )
    return first_problem(plant, OptimalFilterMethod(delay=delay))[1]


@pytest.mark.parametrize("delay", [1, 2])
def test_the_covariance_of_a_filter_solves_its_equation(delay):
    problem = problem_of_thirty_states(delay)
    P, K, R = least_estimation._kalman(problem)
    missed = problem.A @ P @ problem.A.T + problem.B @ problem.B.T - K @ R @ K.T - P
    # SciPy's solution misses by 3e-6 of the terms with delay 1, and by .7 of them with delay 2.
    assert np.linalg.norm(missed) <= 1e-10 * np.linalg.norm(P)
