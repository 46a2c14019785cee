"""Balancing by powers of two."""

from fractions import Fraction

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from obsynth.numerics import scaling
from obsynth.numerics.scaling import (
    balance_by_least_squares,
    balance_system,
    doubled_sums,
    equilibrate_pencil,
    power_of_two_below,
)

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
    matrix = rng.normal(size=(scaling.MANY_UNKNOWNS, scaling.MANY_UNKNOWNS))
    matrix, wanted = matrix + matrix.T, rng.normal(size=len(matrix))
    right = matrix @ wanted
    np.testing.assert_allclose(scaling._factored(matrix)(right), wanted, rtol=1e-8, atol=1e-8)


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


def test_sums_of_rows_have_twice_the_digits() -> None:
    rng = np.random.default_rng(5)
    parts = rng.normal(size=(37, 9)) * 10.0 ** rng.integers(-12, 12, size=(37, 9))
    parts = np.vstack([parts, -parts[:36] * (1.0 + 1e-13)])
    heads, tails = doubled_sums(parts)
    for column, head, tail in zip(parts.T.tolist(), heads.tolist(), tails.tolist(), strict=True):
        exact = sum(map(Fraction, column), Fraction(0))
        # 73 terms in pairs: the error of the tails' own sums, each below eps^2 of all sizes.
        allowed = 73 * Fraction(float(np.finfo(np.float64).eps)) ** 2 * sum(map(abs, map(Fraction, column)))
        assert abs(Fraction(head) + Fraction(tail) - exact) <= allowed
    assert [part.tolist() for part in doubled_sums(np.zeros((0, 2)))] == [[0.0, 0.0], [0.0, 0.0]]


def test_many_unknowns_are_balanced_as_few_are(monkeypatch: pytest.MonkeyPatch) -> None:
    rng = np.random.default_rng(8)
    e, a = (rng.normal(size=(9, 9)) * 10.0 ** rng.integers(-6, 6, size=(9, 1)) for _ in range(2))
    b, c = rng.normal(size=(9, 2)), 1e5 * rng.normal(size=(3, 9))
    few = balance_by_least_squares(e, a, inputs=[b], outputs=[c])
    monkeypatch.setattr(scaling, "FEW_UNKNOWNS", 0)
    many = balance_by_least_squares(e, a, inputs=[b], outputs=[c])
    for name in ("equations", "states", "outputs"):
        assert np.array_equal(getattr(few, name), getattr(many, name))
