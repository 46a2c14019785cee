"""Sylvester's equation with a pencil: known solutions, singular E, and eigenvalues that meet."""

import numpy as np
import pytest

from obsynth.numerics.sylvester import pencil_sylvester


@pytest.mark.parametrize(("m", "n", "lost"), [(1, 1, 0), (3, 4, 1), (7, 5, 2), (62, 60, 3)])
def test_a_known_solution_is_found(m, n, lost):
    rng = np.random.default_rng([5, m, n])
    a, A, E, T = (rng.normal(size=size) for size in ((m, m), (n, n), (n, n), (m, n)))
    E[n - lost :] = 0.0
    found = pencil_sylvester(a, A, E, a @ T @ E - T @ A)
    assert np.max(np.abs(found - T)) <= 1e-9 * np.max(np.abs(T))


def test_the_solution_of_two_numbers_is_that_by_hand():
    # (2 t) 3 - t 5 = 7.
    assert pencil_sylvester(*(np.array([[value]]) for value in (2.0, 5.0, 3.0, 7.0)))[0, 0] == pytest.approx(7.0)


def test_a_common_eigenvalue_leaves_no_single_solution():
    a, A = np.diag([0.5, 0.2]), np.diag([0.5, 0.7, 0.1])
    assert pencil_sylvester(a, A, np.eye(3), np.ones((2, 3))) is None


def test_without_states_there_is_nothing_to_solve():
    assert pencil_sylvester(np.zeros((0, 0)), np.eye(2), np.eye(2), np.zeros((0, 2))).shape == (0, 2)
