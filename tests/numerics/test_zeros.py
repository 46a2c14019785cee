"""Invariant zeros, their directions, and the boundary of stability."""

from fractions import Fraction

import numpy as np
import pytest
from scipy.linalg import block_diag, eigvals

from obsynth.analysis.existence.wang2015 import fault_filter_conditions, known_fault_zeros
from obsynth.analysis.zeros import fault_zeros, hidden_faults, sampling_zero_warnings
from obsynth.numerics.invariant_zeros import are_outside, is_outside, zeros_of_system
from obsynth.numerics.pencils import finite_zeros
from obsynth.plants.descriptor import DescriptorSystem

PAPER_A = [[0.9, 0.005, -0.095, 0], [0.005, 0.995, 0.0997, 0], [0.095, -0.0997, 0.99, 0], [1, 0, 1, 1]]
PAPER_C = [[0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]


def nonsingular(size, rng):
    left, right = (np.linalg.qr(rng.standard_normal((size, size)))[0] for _ in range(2))
    return left * 5.0 ** rng.uniform(-0.5, 0.5, size) @ right


def real_block(z):
    z = complex(z)
    return np.array([[z.real, z.imag], [-z.imag, z.real]]) if z.imag else np.array([[z.real]])


def planted(zeros, rng, *, degree=2, channels=1, algebraic=0, coupled=False):
    """Return E, A, B, C with the zeros (conjugates implied) as eigenvalues of the zero dynamics.

    ``coupled`` joins equal neighbours into one Jordan block.
    """
    dynamics = block_diag(*map(real_block, zeros)) if zeros else np.zeros((0, 0))
    width = real_block(zeros[0]).shape[0] if zeros else 0
    if coupled:
        dynamics += np.eye(len(dynamics), k=width)
    hidden = len(dynamics)
    size = hidden + degree * channels
    A, B, C = np.zeros((size, size)), np.zeros((size, channels)), np.zeros((channels, size))
    A[:hidden, :hidden] = dynamics
    for channel in range(channels):
        first, last = hidden + channel * degree, hidden + (channel + 1) * degree - 1
        A[:hidden, first] = rng.standard_normal(hidden)
        A[first:last, first + 1 : last + 1] = np.eye(degree - 1)
        A[last] = rng.standard_normal(size)
        B[last, channel] = C[channel, first] = 1.0
    total = size + algebraic
    E, A = block_diag(np.eye(size), np.zeros((algebraic, algebraic))), block_diag(A, np.eye(algebraic))
    A[:size, size:] = rng.standard_normal((size, algebraic))  # these states are zero: nothing changes
    P, Q = nonsingular(total, rng), nonsingular(total, rng)
    B = np.vstack([B, np.zeros((algebraic, channels))]) @ nonsingular(channels, rng)
    C = nonsingular(channels, rng) @ np.hstack([C, rng.standard_normal((channels, algebraic))])
    return P @ E @ Q, P @ A @ Q, P @ B, C @ Q


def with_conjugates(values):
    return [w for z in map(complex, values) for w in ((z, z.conjugate()) if z.imag else (z,))]


def mismatch(expected, found):
    rest = list(found)
    if len(expected) != len(rest):
        return np.inf
    worst = 0.0
    for value in expected:
        nearest = min(range(len(rest)), key=lambda i: abs(rest[i] - value))
        worst = max(worst, abs(rest.pop(nearest) - value))
    return worst


def outside_flags(E, A, B, C, dt):
    ny, nu = C.shape[0], B.shape[1]
    wide_e = np.block([[E, np.zeros_like(B)], [np.zeros_like(C), np.zeros((ny, nu))]])
    wide_a = np.block([[A, B], [C, np.zeros((ny, nu))]])
    return are_outside(wide_e, wide_a, finite_zeros(wide_e, wide_a), dt)


@pytest.mark.parametrize("seed", range(60))
def test_planted_zeros_and_their_directions(seed):
    rng = np.random.default_rng(seed)
    zeros = [*rng.uniform(-2, 2, seed % 3), *(rng.uniform(-1, 1, seed % 2) + 1j * rng.uniform(0.1, 1, seed % 2))]
    E, A, B, C = planted(zeros, rng, degree=1 + seed % 3, channels=1 + seed % 2, algebraic=seed % 4)
    before = [matrix.copy() for matrix in (E, A, B, C)]
    found = zeros_of_system(E, A, B, C, dt=1.0)[1]
    assert mismatch(with_conjugates(zeros), [zero.value for zero in found]) < 1e-10
    for zero in found:
        x, u = zero.state_direction, zero.input_direction
        assert np.linalg.norm(np.concatenate([x, u])) == pytest.approx(1.0)
        assert np.linalg.norm((A - zero.value * E) @ x + B @ u) < 1e-12
        assert np.linalg.norm(C @ x) < 1e-12
        assert not x.flags.writeable
        assert not zero.is_unobservable_mode
    for matrix, copy in zip((E, A, B, C), before, strict=True):
        np.testing.assert_array_equal(matrix, copy)


@pytest.mark.parametrize("seed", range(20))
def test_zeros_agree_with_slycot(seed):
    rng = np.random.default_rng(seed)
    E, A, B, C = planted([], rng, degree=3, channels=2, algebraic=2)
    D = np.outer(rng.standard_normal(2), rng.standard_normal(2)) if seed % 2 else np.zeros((2, 2))
    found = zeros_of_system(E, A, B, C, D, dt=1.0)[1]
    size = len(A)
    reduced_a, reduced_e, *_ = pytest.importorskip("slycot").ag08bd(size, size, 2, 2, A, E, B, C, D, equil="S")
    expected = eigvals(reduced_a, reduced_e) if reduced_a.size else []
    assert mismatch(expected, [zero.value for zero in found]) < 1e-8


@pytest.mark.parametrize("seed", range(20))
def test_zeros_do_not_depend_on_coordinates_and_units(seed):
    rng = np.random.default_rng(seed)
    E, A, B, C = planted([0.5, -1.5, 0.2 + 0.7j], rng, algebraic=2)
    rows, columns = 10.0 ** rng.uniform(-4, 4, len(A)), 10.0 ** rng.uniform(-4, 4, len(A))
    found = zeros_of_system(
        rows[:, None] * E * columns, rows[:, None] * A * columns, 1e5 * rows[:, None] * B, 1e-3 * C * columns, dt=1.0
    )[1]
    assert mismatch([0.5, -1.5, 0.2 + 0.7j, 0.2 - 0.7j], [zero.value for zero in found]) < 1e-9


@pytest.mark.parametrize("kind", ["simple", "double", "triple", "semisimple"])
@pytest.mark.parametrize("seed", range(15))
def test_zeros_on_the_unit_circle_count_as_outside(kind, seed):
    rng = np.random.default_rng(seed)
    point = [1.0, -1.0, np.exp(1j * rng.uniform(0.2, 2.9))][seed % 3]
    count = {"simple": 1, "double": 2, "triple": 3, "semisimple": 2}[kind]
    system = planted([point] * count, rng, channels=2, coupled=kind in ("double", "triple"))
    flags = outside_flags(*system, dt=1.0)
    assert len(flags) == len(with_conjugates([point] * count))
    assert all(flags)


@pytest.mark.parametrize("zeros", [[1 - 1e-6], [-(1 - 1e-7)], [1 - 1e-4] * 2, [0.9988 * np.exp(1j)], [0.0]])
@pytest.mark.parametrize("seed", range(10))
def test_zeros_just_inside_the_unit_circle_do_not(zeros, seed):
    rng = np.random.default_rng(seed)
    assert not any(outside_flags(*planted(zeros, rng, coupled=len(zeros) > 1), dt=1.0))


@pytest.mark.parametrize("seed", range(10))
def test_a_zero_on_the_boundary_says_nothing_about_its_neighbours(seed):
    rng = np.random.default_rng(seed)
    assert sorted(outside_flags(*planted([1.0, 0.995, 0.999], rng), dt=1.0)) == [False, False, True]
    assert sorted(outside_flags(*planted([0.0, -0.005, -0.001], rng), dt=0.0)) == [False, False, True]


@pytest.mark.parametrize("seed", range(10))
def test_double_zeros_on_the_imaginary_axis_count_as_outside(seed):
    rng = np.random.default_rng(seed)
    assert all(outside_flags(*planted([0.0, 0.0], rng, coupled=True), dt=0.0))
    assert all(outside_flags(*planted([2j, 2j], rng, coupled=True), dt=0.0))


def test_is_outside():
    assert is_outside(1.0, 0.1)
    assert is_outside(1 - 1e-9, 0.1)
    assert is_outside(-1.5, 0.1)
    assert not is_outside(1 - 1e-7, 0.1)
    assert is_outside(0.0, 0.0)
    assert is_outside(-1e-9 + 1j, 0.0)
    assert is_outside(-1e-6 + 1000j, 0.0)
    assert not is_outside(-1e-7, 0.0)


def test_unobservable_mode_and_proper_zero_at_the_same_point():
    A = block_diag([[0.5]], [[0.0, 1.0], [0.0, 0.0]])
    B = np.array([[0.0], [1.0], [0.0]])
    A[1:, 1:] = [[0.5, 1.0], [-1.0, 0.3]]  # zero of the second part at 0.3
    A[0, 0] = 0.3
    zeros = zeros_of_system(np.eye(3), A, B, np.array([[0.0, 1.0, 0.0]]), dt=1.0)[1]
    assert [zero.value for zero in zeros] == pytest.approx([0.3, 0.3])
    assert [zero.is_unobservable_mode for zero in zeros] == [True, False]
    np.testing.assert_allclose(zeros[0].state_direction, [1.0, 0.0, 0.0], atol=1e-12)


def test_no_zero_and_no_input():
    assert zeros_of_system(np.eye(1), np.eye(1), np.ones((1, 1)), np.ones((1, 1)), dt=1.0)[1] == ()
    (mode,) = zeros_of_system(np.eye(2), np.diag([0.5, 0.7]), np.zeros((2, 0)), np.array([[1.0, 0.0]]), dt=1.0)[1]
    assert mode.value == pytest.approx(0.7)
    assert mode.is_unobservable_mode


def paper_plant(Bf, **changes):
    return DescriptorSystem(np.diag([1.0, 1, 1, 0]), PAPER_A, C=PAPER_C, Bf=Bf, dt=1.0, **changes)


def missing(plant):
    """Return by how much the rank of ``[A - z E, Bf; C, Df]`` falls short of full column rank at almost every z."""
    found, *_ = zeros_of_system(plant.E, plant.A, plant.Bf, plant.C, plant.Df, dt=plant.dt)
    return plant.nx + plant.nf - found.normal_rank


def test_paper_faults_are_visible():
    plant = paper_plant([[1.0], [0], [0], [0]])
    assert missing(plant) == 0
    for zero in fault_zeros(plant)[0]:
        pencil = np.block([[plant.A - zero.value * plant.E, plant.Bf], [plant.C, plant.Df]])
        assert np.linalg.matrix_rank(pencil, tol=1e-10) < 5


def test_hidden_faults_are_named():
    Bf = np.zeros((4, 4))
    Bf[0, 0] = Bf[1, 1] = 1.0
    Bf[:, 2] = 2.0 * Bf[:, 0]  # third is the first in other units; fourth does nothing
    plant = paper_plant(Bf, fault_names=["valve", "pump", "valve again", "nothing"])
    assert missing(plant) == 2
    assert hidden_faults(plant, missing=2) == ("valve", "valve again", "nothing")


def test_more_faults_than_outputs_are_hidden():
    rng = np.random.default_rng(0)
    plant = DescriptorSystem(None, rng.standard_normal((4, 4)), C=[[1, 0, 0, 0]], Bf=rng.standard_normal((4, 2)))
    assert missing(plant) == 1
    assert hidden_faults(plant, missing=1) == ("f1", "f2")


def test_fault_zeros_outside():
    # y = (z - 1.2) / (z (z - 0.5)) f
    plant = DescriptorSystem(None, [[0.5, 1.0], [0.0, 0.0]], C=[[1.0, 0.0]], Bf=[[1.0], [-1.2]], dt=0.1)
    assert [zero.value for zero in fault_zeros(plant)[1]] == pytest.approx([1.2])
    assert not fault_zeros(plant.replace(Bf=[[1.0], [-0.9]]))[1]


def nearly_seen(entry, *, seen=True):
    """Two faults; the first acts through x3, x2, x1 in a row, and an output of x2 sees x3 a little as well."""
    A = [[0.5, 1, 0, 0], [0, 0.4, 1, 0], [0, 0.2, 0.3, 0], [0.1, 0, 0, 0.6]]
    C = [[0, 0, 0, 1], [0, 0.3, entry, 0.1], *([[1, 0, 0, 0]] if seen else [])]
    Bf = [[0, 0], [0, 0], [1, 0], [0, 1]]
    return DescriptorSystem(None, A, C=C, Bf=Bf, dt=0.1)


def rank_in_fractions(matrix):
    """The rank by Gaussian elimination, without any rounding."""
    rows, rank = [list(row) for row in matrix], 0
    for column in range(len(rows[0])):
        pivot = next((i for i in range(rank, len(rows)) if rows[i][column] != 0), None)
        if pivot is None:
            continue
        rows[rank], rows[pivot] = rows[pivot], rows[rank]
        for i in range(rank + 1, len(rows)):
            factor = rows[i][column] / rows[rank][column]
            rows[i] = [x - factor * y for x, y in zip(rows[i], rows[rank], strict=True)]
        rank += 1
    return rank


def pencil_in_fractions(plant, z):
    top = [
        [Fraction(a) - z * Fraction(e) for a, e in zip(row_a, row_e, strict=True)] + [Fraction(f) for f in row_f]
        for row_a, row_e, row_f in zip(plant.A.tolist(), plant.E.tolist(), plant.Bf.tolist(), strict=True)
    ]
    return top + [[Fraction(c) for c in row] + [Fraction(0)] * plant.nf for row in plant.C.tolist()]


@pytest.mark.parametrize("entry", [1e-3, 1e-4, 1e-5, 1e-6])
def test_a_small_entry_makes_no_zero_where_another_output_still_sees(entry):
    """Without the output of x1 there is one, at about -0.3 / entry; with it there is none, in exact arithmetic."""
    plant = nearly_seen(entry)
    point = Fraction(0.4) - Fraction(0.3) / Fraction(entry)
    assert rank_in_fractions(pencil_in_fractions(nearly_seen(entry, seen=False), point)) == 6 - 1
    assert rank_in_fractions(pencil_in_fractions(plant, point)) == 6
    assert fault_zeros(plant)[0] == ()


@pytest.mark.parametrize("entry", [1e-2, 1e-4, 1e-6, -1e-6])
def test_a_true_zero_far_out_is_found_and_its_fault_named(entry):
    """Where the small entry does make a zero: it is real data, and the fault behind it is the first."""
    plant = nearly_seen(entry, seen=False)
    (zero,) = fault_zeros(plant)[1]
    assert zero.value == pytest.approx(0.4 - 0.3 / entry, rel=1e-9)
    assert abs(zero.input_direction[0]) > 0.99
    # The second fault only holds x4 at zero against 0.1 x1.
    assert zero.input_direction[1] == pytest.approx(-0.1 * zero.state_direction[0], rel=1e-6, abs=1e-15)
    assert not zero.is_unobservable_mode
    condition = fault_filter_conditions(plant)[-1]
    assert (condition.name, condition.holds, condition.signals) == ("fault zeros", False, ("f1",))


@pytest.mark.parametrize("modulus", [1e2, 1e4, 1e6])
@pytest.mark.parametrize("seed", range(5))
def test_planted_zeros_far_out_of_a_tall_pencil_are_kept(modulus, seed):
    rng = np.random.default_rng(seed)
    A, B, C = (np.zeros(shape) for shape in ((4, 4), (4, 1), (2, 4)))
    A[0] = [-modulus, 1.0, 0.0, 0.0]  # a mode that no output shows
    A[1:, 1:], B[1:, 0], C[:, 1:] = rng.standard_normal((3, 3)), rng.standard_normal(3), rng.standard_normal((2, 3))
    left, right = nonsingular(4, rng), nonsingular(4, rng)
    zeros = zeros_of_system(left @ right, left @ A @ right, left @ B, C @ right, dt=1.0)[1]
    assert [zero.value for zero in zeros] == [pytest.approx(-modulus, rel=1e-6)]
    assert zeros[0].is_unobservable_mode


@pytest.mark.parametrize("seed", range(5))
def test_both_zeros_of_a_pair_are_on_the_same_side(seed):
    rng = np.random.default_rng([21, seed])
    for modulus in (1.0, 1.0 - 1e-6, 1.0 - 1e-4, 0.5):
        zero = modulus * np.exp(0.7j)
        E, A, B, C = planted([zero, 0.3], rng)
        system_e = np.zeros((len(A) + len(C), len(A) + B.shape[1]))
        system_e[: len(E), : len(E)] = E
        system_a = np.block([[A, B], [C, np.zeros((len(C), B.shape[1]))]])
        found = finite_zeros(system_e, system_a)
        sides = dict(zip(found.values, are_outside(system_e, system_a, found, 0.1), strict=True))
        assert len(sides) == 3
        assert all(outside == sides[value.conjugate()] for value, outside in sides.items())
        assert sum(sides.values()) == (2 if modulus == 1.0 else 0)


@pytest.mark.parametrize("seed", range(4))
def test_warnings_of_zeros_are_those_of_the_zeros_that_existence_knows(seed) -> None:
    rng = np.random.default_rng([52, seed])
    E, A, B, C = planted([0.99, 0.985 + 0.02j, 0.3], rng, degree=1)
    plant = DescriptorSystem(E=E, A=A, C=C, Bf=B, dt=0.1)
    assert known_fault_zeros(plant) is None
    assert fault_filter_conditions(plant)[-1].holds
    zeros = known_fault_zeros(plant)
    texts = sampling_zero_warnings(plant, zeros)
    assert len(texts) == 2
    assert texts == sampling_zero_warnings(plant)
