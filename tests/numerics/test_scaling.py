"""Balancing by powers of two."""

from fractions import Fraction

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from obsynth.numerics import logarithmic_balance
from obsynth.numerics.logarithmic_balance import LogBalance, _whole_parts
from obsynth.numerics.scaling import balance_system, equilibrate_pencil, power_of_two_below
from obsynth.proofs.exact_doubles import stored_matrix
from obsynth.proofs.rational_matrices import nearest_doubles

PAPER_E = np.diag([1.0, 1.0, 1.0, 0.0])
PAPER_A = np.array([[0.9, 0.005, -0.095, 0], [0.005, 0.995, 0.0997, 0], [0.095, -0.0997, 0.99, 0], [1, 0, 1, 1]])
PAPER_C = np.array([[0.0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]])


def is_power_of_two(factors):
    mantissas, _ = np.frexp(factors)
    return bool(np.all(mantissas == 0.5))


def peaks(matrix, axis):
    return np.max(np.abs(matrix), axis=axis, initial=0.0)


def test_power_of_two_below_is_exact_at_the_borders():
    sizes = np.array([0.0, 1.0, np.nextafter(2.0, 0.0), 2.0, np.nextafter(1.0, 0.0), 3e-300, 8.0])
    expected = [1.0, 1.0, 1.0, 2.0, 0.5, 2.0 ** np.floor(np.log2(3e-300)), 8.0]
    np.testing.assert_array_equal(power_of_two_below(sizes), expected)


def test_a_large_matrix_that_is_not_definite_is_factored_by_pivots():
    """Cholesky's factorisation takes the place of one half of it: from the other it is there again."""
    rng = np.random.default_rng(3)
    matrix = rng.normal(size=(logarithmic_balance.MANY_UNKNOWNS, logarithmic_balance.MANY_UNKNOWNS))
    matrix, wanted = matrix + matrix.T, rng.normal(size=len(matrix))
    right = matrix @ wanted
    np.testing.assert_allclose(logarithmic_balance._factored(matrix)(right), wanted, rtol=1e-8, atol=1e-8)


def test_paper_example_is_left_alone():
    scaling = balance_system(PAPER_E, PAPER_A, [np.ones((4, 2))], [PAPER_C])
    np.testing.assert_array_equal(scaling.equations, np.ones(4))
    np.testing.assert_array_equal(scaling.states, np.ones(4))
    np.testing.assert_array_equal(scaling.outputs, np.ones(3))


@pytest.mark.parametrize("seed", range(20))
def test_plants_with_peaks_between_one_and_two_are_left_alone(seed):
    rng = np.random.default_rng(seed)
    E, A = rng.uniform(-1, 1, (5, 5)), rng.uniform(-1, 1, (5, 5))
    C = rng.uniform(-1, 1, (3, 5))
    E[np.arange(5), rng.permutation(5)] = rng.uniform(1, 2, 5)
    C[np.arange(3), :3] = np.diag(rng.uniform(1, 2, 3))
    scaling = balance_system(E, A, [rng.standard_normal((5, 2)) * 1e6], [C])
    assert all(np.all(factors == 1.0) for factors in (scaling.equations, scaling.states, scaling.outputs))


@pytest.mark.parametrize("seed", range(20))
def test_bad_units_are_undone(seed):
    rng = np.random.default_rng(seed)
    rows, columns, measured = (2.0 ** rng.integers(-30, 30, size) for size in (4, 4, 3))
    E = rows[:, None] * PAPER_E * columns
    A = rows[:, None] * PAPER_A * columns
    C = measured[:, None] * PAPER_C * columns
    scaling = balance_system(E, A, [], [C])
    for factors in (scaling.equations, scaling.states, scaling.outputs):
        assert is_power_of_two(factors)
        assert not factors.flags.writeable
    balanced_e, balanced_a = scaling.scale_dynamics(E), scaling.scale_dynamics(A)
    balanced_c = scaling.scale_output(C)
    for size in (peaks(np.hstack([balanced_e, balanced_a]), 1), peaks(balanced_c, 1)):
        assert np.all((size >= 1.0) & (size < 2.0))
    columns_after = peaks(np.vstack([balanced_e, balanced_c]), 0)
    assert np.all((columns_after >= 2.0**-3) & (columns_after < 2.0))


def test_mapping_back_is_exact():
    rng = np.random.default_rng(1)
    E, A = rng.standard_normal((4, 4)) * 1e7, rng.standard_normal((4, 4)) * 1e-5
    B, C, D = rng.standard_normal((4, 2)), rng.standard_normal((3, 4)) * 1e4, rng.standard_normal((3, 2))
    scaling = balance_system(E, A, [B], [C])
    np.testing.assert_array_equal(scaling.scale_dynamics(A) / scaling.equations[:, None] / scaling.states, A)
    np.testing.assert_array_equal(scaling.scale_input(B) / scaling.equations[:, None], B)
    np.testing.assert_array_equal(scaling.scale_output(C) / scaling.outputs[:, None] / scaling.states, C)
    np.testing.assert_array_equal(scaling.scale_feedthrough(D) / scaling.outputs[:, None], D)


def test_equation_without_states_is_scaled_by_its_inputs():
    E = np.diag([1.0, 0.0])
    A = np.array([[0.5, 0.0], [0.0, 0.0]])
    scaling = balance_system(E, A, [np.array([[1.0], [1024.0]])], [])
    np.testing.assert_array_equal(scaling.equations, [1.0, 2.0**-10])
    assert scaling.outputs.shape == (0,)


def test_a_fast_state_does_not_drift():
    scaling = balance_system(np.eye(1), np.array([[-1e6]]), [], [])
    assert scaling.states[0] == 1.0
    assert abs(scaling.scale_dynamics(np.array([[-1e6]]))[0, 0]) < 2.0


def test_coupled_units_are_balanced():
    A = np.array([[-1.0, 2.0**20], [2.0**-20, -1.0]])
    scaling = balance_system(np.eye(2), A, [], [])
    np.testing.assert_array_equal(np.abs(scaling.scale_dynamics(A)), np.ones((2, 2)))


matrices = st.integers(0, 2**32 - 1).map(np.random.default_rng)


@settings(max_examples=60, deadline=None)
@given(rng=matrices, rows=st.integers(0, 6), columns=st.integers(0, 6))
def test_equilibrated_pencils_have_peaks_between_one_and_two(rng, rows, columns):
    E, A = (rng.standard_normal((rows, columns)) * 10.0 ** rng.uniform(-12, 12, (rows, columns)) for _ in range(2))
    E[rng.random(E.shape) < 0.3] = 0.0
    A[rng.random(A.shape) < 0.3] = 0.0
    before = E.copy(), A.copy()
    pencil = equilibrate_pencil(E, A)
    np.testing.assert_array_equal(pencil.E, pencil.rows[:, None] * E * pencil.columns)
    np.testing.assert_array_equal(pencil.A, pencil.rows[:, None] * A * pencil.columns)
    size = np.maximum(np.abs(pencil.E), np.abs(pencil.A))
    for axis in (0, 1):
        largest = peaks(size, axis)
        assert np.all((largest == 0.0) | ((largest >= 1.0) & (largest < 2.0)))
    np.testing.assert_array_equal(E, before[0])
    np.testing.assert_array_equal(A, before[1])


def test_parts_of_a_sum_add_up_exactly() -> None:
    rng = np.random.default_rng(5)
    numbers = rng.normal(size=500) * 2.0 ** rng.integers(-20, 9, size=500)
    parts = _whole_parts(numbers)
    for row in zip(numbers.tolist(), *(part.tolist() for part in parts), strict=True):
        assert abs(sum(map(Fraction, row[1:])) - Fraction(row[0])) <= Fraction(1, 2**77)
    for part in parts:
        forth, back = float(np.add.accumulate(part)[-1]), float(np.add.accumulate(part[::-1])[-1])
        assert forth == back == float(sum(map(Fraction, part.tolist())))


def test_least_squares_are_those_of_the_matrix_of_all_entries() -> None:
    """Of rows, columns and a common unknown, with their signs, weights and wishes."""
    rng = np.random.default_rng(8)
    first, second = (np.where(rng.random((4, 4)) < 0.7, 10.0 ** rng.uniform(-5, 5, (4, 4)), 0.0) for _ in range(2))
    problem = LogBalance(9)
    problem.add(first, range(1, 5), range(5, 9), signs=(1, -1), weight=3.0)
    problem.add(second, range(1, 5), range(5, 9), signs=(-1, 1), common=0)
    problem.add(np.zeros((4, 0)), range(1, 5), range(9, 9))
    problem.wish(3, 2.0)
    rows, right, weights = [], [], []
    for matrix, weight, signs, common in ((first, 3.0, (1.0, -1.0), 0.0), (second, 1.0, (-1.0, 1.0), 1.0)):
        for i, j in zip(*np.nonzero(matrix), strict=True):
            row = np.zeros(9)
            row[0], row[1 + i], row[5 + j] = common, *signs
            rows.append(row), right.append(-np.log2(matrix[i, j])), weights.append(weight)
    ridge = logarithmic_balance.RIDGE
    rows += [*np.eye(9), np.eye(9)[3]]
    right += [*np.zeros(9), 2.0]
    weights += [*np.full(9, ridge), logarithmic_balance.WISH_WEIGHT * ridge]
    known, wanted, size = map(stored_matrix, (np.array(rows), np.array(right)[:, None], np.diag(weights)))
    turned = known.transpose() * size
    expected = nearest_doubles((turned * known).solve(turned * wanted)).ravel()
    np.testing.assert_allclose(problem.solve(passes=0), expected, rtol=0, atol=1e-13)
