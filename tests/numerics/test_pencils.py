"""Kronecker structure and finite zeros of pencils, against planted structure and slycot."""

import numpy as np
import pytest
from scipy.linalg import block_diag, eigvals

from obsynth import DescriptorSystem
from obsynth.numerics import pencil_points as pencils
from obsynth.numerics.pencils import finite_zeros, reduced, structure_of_reduced
from obsynth.numerics.ranks import RANK_TOLERANCE
from obsynth.plants.pencil import regularity_of, structure_of


def pencil_structure(E, A):
    return structure_of_reduced(E.shape, reduced(E, A))


def nonsingular(size, rng, spread=10.0):
    left, right = (np.linalg.qr(rng.standard_normal((size, size)))[0] if size else np.eye(0) for _ in range(2))
    return left * spread ** rng.uniform(-0.5, 0.5, size) @ right


def stacked(blocks):
    """Block diagonal, where blocks may have zero rows or columns."""
    result = np.zeros((sum(b.shape[0] for b in blocks), sum(b.shape[1] for b in blocks)))
    row = column = 0
    for block in blocks:
        result[row : row + block.shape[0], column : column + block.shape[1]] = block
        row, column = row + block.shape[0], column + block.shape[1]
    return result


def canonical(eigenvalues=(), infinite=(), right=(), left=()):
    """Return the Kronecker form (E, A): real or complex-pair eigenvalues, and sizes of the other blocks."""
    pairs = []
    for z in map(complex, eigenvalues):
        pairs.append((np.eye(2), [[z.real, z.imag], [-z.imag, z.real]]) if z.imag else (np.eye(1), [[z.real]]))
    pairs += [(np.eye(size, k=1), np.eye(size)) for size in infinite]
    pairs += [(np.eye(size, size + 1), np.eye(size, size + 1, k=1)) for size in right]
    pairs += [(np.eye(size + 1, size), np.eye(size + 1, size, k=-1)) for size in left]
    return stacked([np.asarray(e, float) for e, _ in pairs]), stacked([np.asarray(a, float) for _, a in pairs])


def disguised(E, A, rng, spread=10.0):
    P, Q = nonsingular(E.shape[0], rng, spread), nonsingular(E.shape[1], rng, spread)
    return P @ E @ Q, P @ A @ Q


def with_conjugates(values):
    return [w for z in map(complex, values) for w in ((z, z.conjugate()) if z.imag else (z,))]


def mismatch(expected, found):
    """Return the largest distance in a greedy pairing; infinite when the counts differ."""
    rest = list(found)
    if len(expected) != len(rest):
        return np.inf
    worst = 0.0
    for value in expected:
        nearest = min(range(len(rest)), key=lambda i: abs(rest[i] - value))
        worst = max(worst, abs(rest.pop(nearest) - value) / max(1.0, abs(value)))
    return worst


@pytest.mark.parametrize(
    ("infinite", "index"),
    [((), 0), ((1,), 1), ((1, 1, 1), 1), ((2, 1), 2), ((2, 2), 2), ((3, 1, 1), 3), ((4, 2, 1), 4)],
)
@pytest.mark.parametrize("seed", range(5))
def test_index_and_blocks_of_regular_pencils(infinite, index, seed):
    rng = np.random.default_rng(seed)
    eigenvalues = (0.5, -1.25, 0.3 + 0.8j)
    E, A = disguised(*canonical(eigenvalues, infinite), rng)
    structure = pencil_structure(E, A)
    assert structure.regular
    assert structure.index == index
    assert structure.infinite_block_sizes == infinite
    assert structure.normal_rank == E.shape[0]
    assert mismatch(with_conjugates(eigenvalues), structure.finite_eigenvalues) < 1e-11
    assert all(decision.clear for decision in structure.decisions)


@pytest.mark.parametrize("seed", range(5))
@pytest.mark.parametrize(
    ("right", "left"), [((0,), (0,)), ((1,), (1,)), ((2,), ()), ((), (2,)), ((0, 3), (1,)), ((1, 1), (0, 2))]
)
def test_singular_and_rectangular_pencils(right, left, seed):
    rng = np.random.default_rng(seed)
    eigenvalues, infinite = (0.7, -0.2 + 1.1j), (2, 1)
    E, A = disguised(*canonical(eigenvalues, infinite, right, left), rng)
    structure = pencil_structure(E, A)
    assert not structure.regular
    assert structure.index is None
    assert structure.infinite_block_sizes == infinite
    assert structure.normal_rank == 6 + sum(right) + sum(left)
    zeros = finite_zeros(E, A)
    assert zeros.normal_rank == structure.normal_rank
    assert mismatch(with_conjugates(eigenvalues), structure.finite_eigenvalues) < 1e-10
    assert mismatch(with_conjugates(eigenvalues), zeros.values) < 1e-10


@pytest.mark.long
def test_500_random_planted_pencils():
    rng = np.random.default_rng(2024)
    for trial in range(500):
        real, pairs = rng.uniform(-2, 2, rng.integers(0, 3)), rng.integers(0, 3)
        eigenvalues = [*real, *(rng.uniform(-2, 2, pairs) + 1j * rng.uniform(0.1, 2, pairs))]
        infinite, right, left = (tuple(rng.integers(low, 5 - (low == 0), rng.integers(0, 3))) for low in (1, 0, 0))
        if trial % 2:
            right = left = ()
        E, A = disguised(*canonical(eigenvalues, infinite, right, left), rng, spread=30.0)
        # units: rows and columns scaled over six decades
        rows, columns = 10.0 ** rng.uniform(-3, 3, E.shape[0]), 10.0 ** rng.uniform(-3, 3, E.shape[1])
        E, A = rows[:, None] * E * columns, rows[:, None] * A * columns
        structure, zeros = pencil_structure(E, A), finite_zeros(E, A)
        expected = with_conjugates(eigenvalues)
        assert structure.infinite_block_sizes == tuple(sorted(infinite, reverse=True)), trial
        assert structure.normal_rank == len(expected) + sum(infinite) + sum(right) + sum(left), trial
        assert structure.regular == (not right and not left), trial
        assert mismatch(expected, structure.finite_eigenvalues) < 1e-9, trial
        assert mismatch(expected, zeros.values) < 1e-9, trial


@pytest.mark.parametrize("seed", range(30))
def test_finite_zeros_agree_with_slycot(seed):
    rng = np.random.default_rng(seed)
    nx, nu = int(rng.integers(3, 8)), int(rng.integers(1, 3))
    ny = nu + seed % 2
    E, A = disguised(*canonical(rng.uniform(-1, 1, nx - 2), (1, 1)), rng)
    B, C = rng.standard_normal((nx, nu)), rng.standard_normal((ny, nx))
    D = np.zeros((ny, nu))
    pencil_e = stacked([E, np.zeros((ny, nu))])
    found = finite_zeros(pencil_e, np.block([[A, B], [C, D]]))
    reduced_a, reduced_e, normal_rank, *_ = pytest.importorskip("slycot").ag08bd(
        nx, nx, nu, ny, A, E, B, C, D, equil="S"
    )
    assert found.normal_rank == normal_rank
    expected = eigvals(reduced_a, reduced_e) if reduced_a.size else []
    assert mismatch(expected, found.values) < 1e-8


def test_weak_chain_does_not_hide_an_unobservable_mode():
    """Sixty states seen through one output: every step is harmless, their product is not."""
    rng = np.random.default_rng(3)
    size = 60
    A = np.diag(np.linspace(-1, 1, size)) + np.diag(np.full(size - 1, 0.02), 1) + np.diag(np.full(size - 1, 0.02), -1)
    C = np.zeros((1, size))
    C[0, 0] = 1.0
    orthogonal = np.linalg.qr(rng.standard_normal((size + 1, size + 1)))[0]
    A = orthogonal.T @ block_diag(A, [[1.5]]) @ orthogonal
    C = np.hstack([C, [[0.0]]]) @ orthogonal
    E = np.vstack([np.eye(size + 1), np.zeros((1, size + 1))])
    found = finite_zeros(E, np.vstack([A, C]))
    assert min(abs(found.values - 1.5)) < 1e-9


@pytest.mark.parametrize("shape", [(0, 0), (0, 3), (3, 0), (2, 3), (3, 3)])
def test_zero_and_empty_pencils(shape):
    structure = pencil_structure(np.zeros(shape), np.zeros(shape))
    assert structure.normal_rank == 0
    assert structure.finite_eigenvalues.shape == (0,)
    assert structure.regular == (shape == (0, 0))
    assert finite_zeros(np.zeros(shape), np.zeros(shape)).values.shape == (0,)


def test_constant_pencil_has_index_one_and_no_eigenvalue():
    structure = pencil_structure(np.zeros((3, 3)), np.eye(3))
    assert (structure.index, structure.infinite_block_sizes) == (1, (1, 1, 1))
    assert structure.finite_eigenvalues.size == 0


def test_huge_eigenvalue_is_finite_and_infinite_one_is_not():
    E, A = np.diag([1e-8, 1.0, 0.0]), np.diag([1.0, 0.5, 1.0])
    structure = pencil_structure(E, A)
    assert structure.infinite_block_sizes == (1,)
    assert mismatch([1e8, 0.5], structure.finite_eigenvalues) < 1e-12


def test_defective_eigenvalue_keeps_its_multiplicity():
    E, A = disguised(np.eye(3), np.eye(3) * 0.5 + np.eye(3, k=1), np.random.default_rng(0))
    values = pencil_structure(E, A).finite_eigenvalues
    assert len(values) == 3
    assert np.max(np.abs(values - 0.5)) < 1e-4
    assert abs(np.mean(values) - 0.5) < 1e-12


@pytest.mark.parametrize("seed", range(10))
def test_conjugate_pairs_are_exact_and_adjacent(seed):
    rng = np.random.default_rng(seed)
    values = list(pencil_structure(rng.standard_normal((9, 9)), rng.standard_normal((9, 9))).finite_eigenvalues)
    while values:
        value = values.pop(0)
        assert value.imag >= 0.0
        if value.imag:
            assert values.pop(0) == value.conjugate()


def test_arguments_are_not_modified_and_results_are_read_only():
    rng = np.random.default_rng(0)
    E, A = rng.standard_normal((4, 5)), rng.standard_normal((4, 5))
    before = E.copy(), A.copy()
    structure, zeros = pencil_structure(E, A), finite_zeros(E, A)
    np.testing.assert_array_equal(E, before[0])
    np.testing.assert_array_equal(A, before[1])
    assert not structure.finite_eigenvalues.flags.writeable
    assert not zeros.values.flags.writeable


@pytest.mark.parametrize("seed", range(100))
def test_singular_values_around_the_tolerance_give_a_consistent_answer(seed):
    """Whatever is decided about doubtful ranks, the blocks must fill the pencil."""
    rng = np.random.default_rng(seed)
    left, right = (np.linalg.qr(rng.standard_normal((6, 6)))[0] for _ in range(2))
    E = left * 10.0 ** rng.uniform(-12, 0, 6) @ right
    A = left @ np.diag(10.0 ** rng.uniform(-12, 0, 6)) @ np.linalg.qr(rng.standard_normal((6, 6)))[0]
    structure = pencil_structure(E, A)
    if structure.regular:
        assert len(structure.finite_eigenvalues) + sum(structure.infinite_block_sizes) == 6
        assert structure.index == max(structure.infinite_block_sizes, default=0)
    assert len(structure.finite_eigenvalues) <= structure.normal_rank <= 6
    assert np.all(np.isfinite(structure.finite_eigenvalues))
    assert np.all(np.isfinite(finite_zeros(E, A).values))


def test_a_pencil_on_which_lapack_does_not_converge():
    """The QZ iteration ends in an error for this one; its eigenvalues are -1 plus the cube roots of one."""
    a = np.array([[-1.0, 0.0, 1.0], [-1.0, -1.0, 0.0], [0.0, -1.0, -1.0]])
    found = pencil_structure(np.eye(3), a).finite_eigenvalues
    expected = -1.0 + np.exp(2j * np.pi * np.arange(3) / 3)
    assert len(found) == 3
    assert max(np.min(np.abs(found - value)) for value in expected) < 1e-12


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("spread", [10.0, 1e6])
def test_planted_eigenvalues_of_many_states(seed, spread):
    """From a hundred states on, a well-conditioned E is inverted and an ill-conditioned one is not."""
    rng = np.random.default_rng([11, seed])
    planted = rng.uniform(-2.0, 2.0, 116)
    E, A = canonical(planted, infinite=(2, 1, 1))
    Q = nonsingular(120, rng, 10.0)
    P = Q.T @ np.diag(spread ** rng.uniform(-0.5, 0.5, 120))
    structure = pencil_structure(P @ E @ Q, P @ A @ Q)
    assert structure.regular
    assert structure.infinite_block_sizes == (2, 1, 1)
    assert mismatch(planted, structure.finite_eigenvalues) < 1e-6


@pytest.mark.parametrize("seed", range(10))
def test_where_there_are_no_zeros_the_staircase_may_end_early(seed):
    """What it says must not depend on that: with a planted zero, and with none."""
    rng = np.random.default_rng([12, seed])
    for eigenvalues in ((), (0.7,), (0.3, -0.5 + 0.2j)):
        E, A = disguised(*canonical(eigenvalues, infinite=(1, 2), left=(3, 2, 2)), rng)
        for e, a in ((E, A), (E.T, A.T)):
            whole, early = finite_zeros(e, a), finite_zeros(e, a, to_the_end=False)
            assert mismatch(with_conjugates(eigenvalues), early.values) < 1e-7
            assert whole.normal_rank == early.normal_rank == min(E.shape)
            if eigenvalues:
                assert len(whole.decisions) == len(early.decisions)


@pytest.mark.parametrize("extra", [0, 3])
def test_planted_zeros_of_many_states_are_neither_lost_nor_joined_by_others(extra):
    channels, rng = 50, np.random.default_rng(11)
    zeros = np.sort(np.linspace(-3.0, 3.0, channels) + rng.uniform(-0.02, 0.02, channels))
    a, b, c = np.zeros((3 * channels,) * 2), np.zeros((3 * channels, channels)), np.zeros((channels, 3 * channels))
    for k, zero in enumerate(zeros):
        # (s - zero) over a polynomial whose roots are all over the place
        own = slice(3 * k, 3 * k + 3)
        a[own, own] = np.array([[0.0, 1.0, 0.0], [0.0, 0.0, 1.0], rng.uniform(-3.0, 3.0, 3)])
        b[3 * k + 2, k], c[k, own] = 1.0, (-zero, 1.0, 0.0)
    turn = np.linalg.qr(rng.normal(size=a.shape))[0]
    mixed = np.linalg.qr(rng.normal(size=(channels + extra, channels)))[0]
    a, b, c = turn @ a @ turn.T, turn @ b, mixed @ c @ turn.T
    E = np.zeros((len(a) + len(c), len(a) + channels))
    E[: len(a), : len(a)] = np.eye(len(a))
    A = np.block([[a, b], [c, np.zeros((len(c), channels))]])
    found = finite_zeros(E, A)
    np.testing.assert_allclose(np.sort(found.values.real), zeros, atol=1e-8)
    assert np.max(np.abs(found.values.imag)) < 1e-8
    # Outputs of their own, random ones, see every one of them.
    seen = np.vstack([A, np.hstack([rng.normal(size=(2, len(a))), np.zeros((2, channels))])])
    assert finite_zeros(np.vstack([E, np.zeros((2, E.shape[1]))]), seen).values.size == 0


@pytest.mark.parametrize("seed", range(6))
def test_zeros_beside_a_badly_conditioned_derivative_are_found_among_clear_candidates(seed, monkeypatch):
    # Two modes that the outputs do not see, a pair and a real one; all others show, which eigenvectors tell.

    rng = np.random.default_rng(seed)
    n = 30
    modes = -np.arange(1.0, n + 1.0)
    a = np.diag(modes)
    a[0, 0], a[0, 1], a[1, 0], a[1, 1] = -1.5, 2.0, -2.0, -1.5
    c = rng.uniform(0.5, 1.5, (4, n))
    c[:, :2] = 0.0
    c[:, 7] = 0.0
    turn = np.linalg.qr(rng.normal(size=(n, n)))[0]
    e = turn @ np.diag(np.geomspace(1.0, 1e-6, n)) @ np.linalg.qr(rng.normal(size=(n, n)))[0]
    counted = []
    judged = pencils.PencilPoints.nullity
    monkeypatch.setattr(pencils.PencilPoints, "nullity", lambda self, z: counted.append(z) or judged(self, z))
    found = finite_zeros(np.vstack([e, np.zeros((4, n))]), np.vstack([e @ a, c])).values
    assert np.allclose(sorted(found, key=lambda z: (z.real, z.imag)), [-8.0, -1.5 - 2.0j, -1.5 + 2.0j], atol=1e-5)
    # Found by the staircase or not, few points are looked at: of a pair one.
    assert len(counted) <= 10


def test_the_structure_of_a_plant_is_that_of_its_pencil_and_found_once(monkeypatch):
    rng = np.random.default_rng(12)
    e = np.diag([1.0, 1.0, 0.0, 0.0])
    plant = DescriptorSystem(e, rng.standard_normal((4, 4)), None, np.eye(4), dt=0.1)
    found, direct = structure_of(plant), pencil_structure(plant.E, plant.A)
    for name in ("regular", "normal_rank", "index", "infinite_block_sizes"):
        assert getattr(found, name) == getattr(direct, name)
    assert np.array_equal(found.finite_eigenvalues, direct.finite_eigenvalues)
    monkeypatch.setattr("obsynth.plants.pencil.reduced", lambda *_: pytest.fail("again"))
    assert structure_of(plant) is found
    assert regularity_of(plant) == (True, 4)


def test_zero_behind_a_long_chain_is_as_clear_as_the_pencil_is_there():
    """What the staircase leaves of such a zero is rounding over the product of couplings, other on each processor."""
    for seed in range(40):
        rng = np.random.default_rng(seed)
        n = 4 + seed % 3
        A = np.zeros((n + 1, n + 1))
        A[:n, :n] = np.diag(rng.uniform(-0.9, 0.9, n)) + np.diag(np.full(n - 1, 10 ** rng.uniform(-1.5, -0.5)), 1)
        A[n, :n], A[n, n] = rng.normal(size=n), 0.4
        turn = np.linalg.qr(rng.normal(size=(n + 1, n + 1)))[0]
        C = np.eye(1, n + 1) @ turn
        found = finite_zeros(np.vstack([np.eye(n + 1), 0.0 * C]), np.vstack([turn.T @ A @ turn, C]))
        assert found.values == pytest.approx([0.4])
        assert all(decision.clear for decision in found.decisions)


@pytest.mark.parametrize("outputs", [3, 90])
def test_points_of_a_large_pencil_with_a_badly_conditioned_derivative_are_judged_as_by_all_singular_values(outputs):
    # Pairs and real modes; hidden are a pair, and a real one six times, which is more directions than are looked for at
    # first.  E spans seven decades, so that its inverse serves no Schur form.
    rng = np.random.default_rng(outputs)
    n = 100
    a = np.diag(-np.arange(1.0, n + 1.0))
    for i in range(0, 40, 2):
        a[i, i + 1], a[i + 1, i], a[i + 1, i + 1] = 3.0, -3.0, a[i, i]
    c = rng.uniform(0.5, 1.5, (outputs, n))
    c[:, :2] = 0.0
    a[70:76, 70:76], c[:, 70:76] = -71.0 * np.eye(6), 0.0
    left, right = (np.linalg.qr(rng.normal(size=(n, n)))[0] for _ in range(2))
    e = left @ np.diag(np.geomspace(1.0, 1e-7, n)) @ right
    E, A = np.vstack([e, np.zeros((outputs, n))]), np.vstack([e @ right.T @ a @ right, c @ right])
    scales = float(np.linalg.norm(E, 2)), float(np.linalg.norm(A, 2))
    points = pencils.PencilPoints(E, A, scales)
    hidden = {-1.0 + 3.0j: 1, -71.0 + 0.0j: 6}
    for place in (*hidden, -3.0 + 3.0j, -50.0 + 0.0j, -99.0 + 0.0j, 0.7 + 0.0j):
        values = np.linalg.svd(A - place * E, compute_uv=False)
        lost = int(np.sum(values <= RANK_TOLERANCE * (scales[1] + abs(place) * scales[0])))
        assert points.nullity(place) == points.rank(place).expected - points.rank(place).rank == lost
        assert lost == hidden.get(place, 0)
        assert np.isclose(points.rank(place).singular_values[-1], values[-1], rtol=0.1, atol=1e-14 * scales[1])
