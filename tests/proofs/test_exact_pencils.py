"""Exact decisions on rational pencils, against truths that hold by construction."""

import random
from fractions import Fraction

import numpy as np
import pytest
from flint import fmpq, fmpq_mat, fmpq_poly, fmpz_mat, fmpz_poly

from obsynth.proofs import exact_pencils as exact_arithmetic
from obsynth.proofs.exact_doubles import is_computed, whole_matrices, written_fraction, written_matrix
from obsynth.proofs.exact_pencils import ExactPencil
from obsynth.proofs.polynomial_roots import locate_roots, primitive
from obsynth.proofs.rational_matrices import (
    blocks,
    nearest_doubles,
    null_basis,
    pivot_columns,
    rank_of,
    whole_null_basis,
)


def mixed(E, A, seed):
    """The pencil in other integer coordinates: row and column transformations of determinant one."""
    rng = random.Random(seed)
    rows, columns = np.eye(len(A), dtype=int), np.eye(len(A[0]), dtype=int)
    for matrix in (rows, columns):
        for _ in range(3 * len(matrix)):
            i, j = rng.sample(range(len(matrix)), 2)
            matrix[i] += rng.choice([-1, 1]) * matrix[j]
    exact_rows, exact_columns = (written_matrix(matrix.astype(float)) for matrix in (rows, columns))
    E, A = (written_matrix(np.array(matrix, float)) for matrix in (E, A))
    return ExactPencil(exact_rows * E * exact_columns, exact_rows * A * exact_columns)


def diagonal(values, infinite, tall):
    """Pencil with these finite zeros, so many infinite ones of one block, and so many rows of left null space."""
    n = len(values) + infinite
    E, A = np.zeros((n + tall, n)), np.zeros((n + tall, n))
    E[: len(values), : len(values)] = np.eye(len(values))
    A[: len(values), : len(values)] = np.diag(values)
    A[len(values) : n, len(values) :] = np.eye(infinite)
    E[len(values) : n, len(values) :] = np.eye(infinite, k=1)
    return E, A


@pytest.mark.parametrize("text", ["0.1", "-3.25e-07", "123456.789", "0", "1e+20"])
def test_a_short_decimal_is_what_was_written(text):
    assert written_fraction(float(text)) == Fraction(text)


def test_a_short_multiple_of_a_power_of_two_is_exact():
    value = 3 * 2.0**-44
    assert written_fraction(value) == Fraction(3, 2**44)
    assert not is_computed(value)
    assert is_computed(1.0 / 3.0)


def test_rounding_back_gives_the_doubles():
    matrix = np.array([[0.1, 1 / 3], [2.0**-40, -1e5]])
    assert np.array_equal(nearest_doubles(written_matrix(matrix)), matrix)


@pytest.mark.parametrize("seed", range(6))
def test_zeros_survive_other_coordinates(seed):
    E, A = diagonal([0.9999, 0.9999, 1.5], infinite=2, tall=0)
    pencil = mixed(E, A, seed)
    found = pencil.zeros(discrete=True)
    assert [(root.value, root.multiplicity, root.side) for root in found] == [
        (1.5, 1, "unstable"),
        (0.9999, 2, "stable"),
    ]
    assert pencil.normal_rank == 5
    assert pencil.index == 2


@pytest.mark.parametrize("seed", range(4))
def test_zeros_of_tall_and_of_wide_pencils(seed):
    E, A = diagonal([0.25, 1.0], infinite=1, tall=2)
    E[3:, 0], A[4, 2] = 0, 7
    A[3, 1], E[3, 1] = 1.0, 1.0  # (1 - s) again, in a row more
    for pencil in (mixed(E, A, seed), mixed(E.T, A.T, seed)):
        assert pencil.zero_polynomial == fmpz_poly([1, -5, 4])
        assert [root.side for root in pencil.zeros(discrete=True)] == ["boundary", "stable"]


def test_a_zero_that_one_more_row_removes():
    E, A = diagonal([0.5, 2.0], infinite=0, tall=1)
    A[2, 1] = 1.0
    pencil = mixed(E, A, 1)
    assert pencil.zero_polynomial == fmpz_poly([-1, 2])
    assert pencil.rank_at(Fraction(1, 2)) == 1
    assert pencil.rank_at(Fraction(2)) == 2


@pytest.mark.parametrize("seed", range(4))
def test_normal_rank_that_is_lost_everywhere(seed):
    rng = np.random.default_rng(seed)
    E, A = (rng.integers(-3, 4, (5, 4)).astype(float) for _ in range(2))
    factor = rng.integers(-2, 3, (4, 5)).astype(float)
    pencil = ExactPencil.written(E @ factor, A @ factor)
    assert pencil.normal_rank == 4
    assert pencil.zero_polynomial.degree() == 0


def test_rank_at_an_irrational_point():
    E, A = np.eye(2), np.array([[0.0, 2.0], [1.0, 0.0]])
    pencil = ExactPencil.written(E, A)
    assert pencil.rank_at_root(fmpz_poly([-2, 0, 1])) == 1
    assert pencil.rank_at_root(fmpz_poly([-3, 0, 1])) == 2


@pytest.mark.parametrize(
    ("polynomial", "discrete", "sides"),
    [
        (fmpz_poly([1, 0, 1]) ** 3 * fmpz_poly([1, 2]), False, ["boundary", "boundary", "stable"]),
        (fmpz_poly([-(10**40) + 1, 10**40]) ** 2, True, ["stable"]),
        (fmpz_poly([-(10**40) - 1, 10**40]), True, ["unstable"]),
        (fmpz_poly([-2, 1]) * fmpz_poly([-1, 2]) * fmpz_poly([0, 1]), True, ["unstable", "stable", "stable"]),
        (fmpz_poly([-2, 1]) * fmpz_poly([2, 1]), False, ["unstable", "stable"]),
        (fmpz_poly([5, -6, 5]), True, ["boundary", "boundary"]),
        (fmpz_poly([7]), True, []),
    ],
)
def test_sides_of_roots(polynomial, discrete, sides):
    found = locate_roots(polynomial, discrete=discrete)
    assert [root.side for root in found] == sides


def test_index_of_pencils_that_are_not_regular():
    assert ExactPencil.written(np.zeros((2, 3)), np.zeros((2, 3))).index is None
    assert ExactPencil.written(np.diag([1.0, 0.0]), np.diag([1.0, 0.0])).index is None
    assert ExactPencil.written(np.eye(2), np.zeros((2, 2))).index == 0
    assert ExactPencil.written(np.diag([1.0, 0.0]), np.eye(2)).index == 1


def test_pivots_and_null_space():
    matrix = fmpq_mat(2, 4, [0, 1, 2, 0, 0, 2, 4, 1])
    assert pivot_columns(matrix) == [1, 3]
    basis = null_basis(matrix)
    assert (basis.nrows(), basis.ncols()) == (4, 2)
    assert matrix * basis == fmpq_mat(2, 2)
    assert blocks([[matrix], [matrix]])[3, 3] == fmpq(1)


def test_a_whole_multiple_of_a_null_basis_is_that_basis():
    matrix = fmpq_mat(2, 5, [0, fmpq(1, 3), 2, fmpq(5, 7), 0, 0, 2, fmpq(1, 11), 4, 1])
    whole, size, free = whole_null_basis(matrix)
    assert free == [0, 3, 4]
    assert matrix * fmpq_mat(whole) == fmpq_mat(2, 3)
    assert [int(whole[j, k]) for k, j in enumerate(free)] == [int(size)] * 3


def test_matrices_as_stored_are_whole_in_one_unit():
    matrices = [np.array([[0.1, -3.0, 0.0]]), np.array([[2.0**-60], [1e300]]), np.zeros((0, 2))]
    whole, unit = whole_matrices(matrices)
    for found, matrix in zip(whole, matrices, strict=True):
        assert [Fraction(int(value), int(unit)) for value in found.entries()] == [*map(Fraction, matrix.ravel())]


def test_powers_of_two_as_units_change_nothing():
    E, A = diagonal([0.5, 1.0], infinite=1, tall=1)
    A[3] = [1, 2, 3]
    rows, columns = np.exp2([-13, 7, 12, -9]), np.exp2([11, -13, 3])
    scaled = ExactPencil.written(rows[:, None] * E * columns, rows[:, None] * A * columns)
    assert scaled.zero_polynomial == ExactPencil.written(E, A).zero_polynomial


def unimodular(order, seed):
    """Return an integer matrix of determinant one with entries of many digits."""
    rng = random.Random(seed)
    found = fmpz_mat(order, order, [int(i == j) for i in range(order) for j in range(order)])
    for _ in range(3):
        for lower in (True, False):
            found *= fmpz_mat(order, order, [1 if i == j else rng.randrange(-999, 999) if (i > j) == lower else 0
                                             for i in range(order) for j in range(order)])  # fmt: skip
    return found


@pytest.mark.parametrize(
    "pairs",
    [
        [(0, 1), (1, 1), (-1, 1), (2, 1), (-2, 1), (3, 0)],  # zero at every integer that is tried first
        [(0, 5), (0, 7), (10**40, 3), (-1, 10**30), (2, 0)],
        [(2**61 - 1, 1), (1, 2**61 - 1), (2**61 - 1, 2**61 - 31), (4, 1)],  # primes that must be left out
        [(7, 0), (5, 0), (1, 3)],
    ],
)
def test_determinants_of_pencils_that_are_known(pairs):
    order, degree = len(pairs), sum(slope != 0 for _, slope in pairs)
    left, right = unimodular(order, 1), unimodular(order, 2)
    constant, slope = (fmpz_mat(order, order, [pair[part] if i == j else 0 for i, pair in enumerate(pairs)
                                               for j in range(order)]) for part in (0, 1))  # fmt: skip
    expected = fmpz_poly([1])
    for a, e in pairs:
        expected *= fmpz_poly([a, -e])
    found = exact_arithmetic._determinant(left * slope * right, left * constant * right, degree)
    assert found == primitive(fmpq_poly(expected))


def test_a_determinant_that_vanishes_everywhere_is_zero():
    e, a = fmpz_mat([[1, 2], [2, 4]]), fmpz_mat([[3, 5], [6, 10]])
    assert exact_arithmetic._determinant(e, a, 1) == fmpz_poly([0])


def test_a_rank_is_that_of_the_rationals_also_where_it_is_less_modulo_the_prime():
    prime = exact_arithmetic._PRIMES[0]
    assert rank_of(fmpq_mat(2, 2, [fmpq(1, 3), fmpq(2, 3), fmpq(2, 7), fmpq(4, 7)])) == 1
    assert rank_of(fmpq_mat(2, 3, [fmpq(1, 3), fmpq(2, 3), fmpq(1), fmpq(2, 7), fmpq(4, 7), fmpq(0)])) == 2
    assert rank_of(fmpq_mat(2, 2, [fmpq(1), fmpq(0), fmpq(0), fmpq(prime)])) == 2
    assert rank_of(fmpq_mat(0, 3)) == 0
