"""No false proof of definiteness, against exact integer arithmetic; and proofs where there is a margin."""

from fractions import Fraction

import numpy as np
import pytest

from obsynth.proofs import definiteness as balls
from obsynth.proofs.balls import PANEL_ROWS, Ball
from obsynth.proofs.definiteness import prove_positive_definite


def whole(matrix):
    """Return the entries as exact whole numbers, up to a common positive factor."""
    ratios = [[float(value).as_integer_ratio() for value in row] for row in matrix]
    common = max(denominator for row in ratios for _, denominator in row)
    return [[numerator * (common // denominator) for numerator, denominator in row] for row in ratios]


def is_positive_definite(entries):
    """Decide exactly, by Sylvester's criterion: leading minors by fraction-free elimination (Bareiss)."""
    rows, previous = [list(row) for row in entries], 1
    for k in range(len(rows)):
        if rows[k][k] <= 0:
            return False
        for i in range(k + 1, len(rows)):
            for j in range(k + 1, len(rows)):
                rows[i][j] = (rows[i][j] * rows[k][k] - rows[i][k] * rows[k][j]) // previous
        previous = rows[k][k]
    return True


def symmetric(matrix):
    return np.tril(matrix) + np.tril(matrix, -1).T


def units(rng, size):
    """Return powers of two, as a change of units."""
    return np.ldexp(np.ones(size), rng.integers(-40, 40, size))


def singular_gram(rng, size):
    """Exactly singular: whole numbers, rank one short, in random units."""
    factor = rng.integers(-50, 51, (size, size - 1)).astype(float)
    scale = units(rng, size)
    return scale[:, None] * (factor @ factor.T) * scale


def gram_off_by_one_ulp(rng, size):
    """Exactly singular, but for one diagonal entry that is one unit in the last place away, up or down."""
    matrix, i = singular_gram(rng, size), rng.integers(size)
    matrix[i, i] = np.nextafter(matrix[i, i], rng.choice([-np.inf, np.inf]))
    return matrix


def known_inertia(rng, size):
    """L D L' in whole numbers: the signs of D are the signs of the eigenvalues; at most one is not positive."""
    lower = np.tril(rng.integers(-9, 10, (size, size)), -1) + np.eye(size, dtype=np.int64)
    diagonal = rng.integers(1, 1000, size)
    diagonal[rng.integers(size)] = rng.integers(-1, 2)
    return (lower @ np.diag(diagonal) @ lower.T).astype(float)


def shifted_to_the_edge(rng, size):
    """Random, less its computed smallest eigenvalue: singular up to rounding errors."""
    factor = rng.standard_normal((size, size))
    matrix = symmetric(factor + factor.T)
    matrix -= (np.linalg.eigvalsh(matrix)[0] + rng.integers(-3, 4) * 1e-16) * np.eye(size)
    return matrix


def off_by_one_ulp_of_indefinite(rng, size):
    """A Schur complement of exactly zero at the last row; one unit in the last place decides the sign."""
    matrix = np.diag(rng.integers(1, 9, size).astype(float))
    row = rng.integers(-8, 9, size - 1).astype(float) * np.diag(matrix)[:-1]
    matrix[-1, :-1] = matrix[:-1, -1] = row
    matrix[-1, -1] = np.sum(row**2 / np.diag(matrix)[:-1])
    if matrix[-1, -1] > 0.0:
        matrix[-1, -1] = np.nextafter(matrix[-1, -1], rng.choice([-np.inf, 0.0, np.inf]))
    return matrix


FAMILIES = (singular_gram, gram_off_by_one_ulp, known_inertia, shifted_to_the_edge, off_by_one_ulp_of_indefinite)


@pytest.fixture
def without_more_digits(monkeypatch):
    monkeypatch.setattr(balls, "LARGEST_ORDER", 0)


@pytest.mark.one_in(4)
@pytest.mark.parametrize("family", FAMILIES, ids=lambda family: family.__name__)
def test_no_false_proof_in_2000_matrices(family, share):
    """Five families: 10,000 matrices with --whole.  With ball arithmetic none that is definite is missed, either."""
    rng, cases = np.random.default_rng(11), share(range(2000))
    definite, by_balls = 0, 0
    for _ in cases:
        matrix = family(rng, int(rng.integers(2, 8)))
        assert np.array_equal(matrix, matrix.T)
        truth = is_positive_definite(whole(matrix))
        definite += truth
        proof = prove_positive_definite(matrix)
        assert proof.proved is truth, matrix.tolist()
        by_balls += proof.means == "ball arithmetic"
        assert (proof.lower_bound > 0.0) is truth
    assert definite <= 0.75 * len(cases)  # at least a quarter of each family could have been proved falsely
    if family in (gram_off_by_one_ulp, shifted_to_the_edge, off_by_one_ulp_of_indefinite):
        assert by_balls >= 0.025 * len(cases)


@pytest.mark.parametrize("family", FAMILIES, ids=lambda family: family.__name__)
def test_no_false_proof_without_ball_arithmetic(family, without_more_digits, share):
    rng = np.random.default_rng(18)
    for _ in share(range(500)):
        matrix = family(rng, int(rng.integers(2, 8)))
        proof = prove_positive_definite(matrix)
        assert not proof.proved or is_positive_definite(whole(matrix)), matrix.tolist()
        assert proof.means != "ball arithmetic"


@pytest.mark.long
@pytest.mark.parametrize(("size", "count"), [(50, 5), (120, 2)])
def test_no_false_proof_of_larger_singular_matrices(size, count, monkeypatch):
    """Sizes at which LAPACK's blocked kernels run; whole numbers make the rank certain."""
    rng = np.random.default_rng(size)
    for i in range(10 + count):
        if i == count:
            monkeypatch.setattr(balls, "LARGEST_ORDER", 0)
        factor = rng.integers(-9, 10, (size, size - 1)).astype(float)
        assert not prove_positive_definite(factor @ factor.T).proved


@pytest.mark.long
def test_a_ball_with_a_member_that_is_not_definite_is_not_proved(share):
    """Margin and radius of the same size: the exact sign of the worst member decides."""
    rng, cases = np.random.default_rng(12), share(range(2000))
    proofs = failures = 0
    for _ in cases:
        size = int(rng.integers(2, 6))
        factor = rng.integers(-9, 10, (size, size - 1)).astype(float)
        margin = 2.0 ** -float(rng.integers(5, 40))
        matrix = factor @ factor.T + margin * np.eye(size)
        radius = symmetric(rng.uniform(0.0, 2.0, (size, size))) * margin / size
        # The worst member along the vector that the Gram matrix does not see.
        direction = np.sign(np.linalg.eigh(matrix)[1][:, 0])
        corner = [
            [Fraction(m) - Fraction(r) * int(s) for m, r, s in zip(*rows, strict=True)]
            for rows in zip(matrix, radius, np.outer(direction, direction), strict=True)
        ]
        truth = is_positive_definite_fraction(corner)
        proved = prove_positive_definite(Ball(matrix, radius)).proved
        assert truth or not proved
        proofs, failures = proofs + proved, failures + (not truth)
    assert proofs >= 0.1 * len(cases)
    assert failures >= 0.1 * len(cases)


def is_positive_definite_fraction(entries):
    common = 1
    for row in entries:
        for value in row:
            common = max(common, value.denominator)
    return is_positive_definite([[int(value * common) for value in row] for row in entries])


def test_the_midpoint_may_be_unsymmetric_within_the_radius():
    """The symmetric members are what counts: here those with off-diagonal entries from 0.9 to 1."""
    for diagonal, definite in ((1.0, False), (1.2, True)):
        midpoint = np.array([[diagonal, 0.9], [1.0, diagonal]])
        ball = Ball(midpoint, np.array([[0.0, 0.1], [0.1, 0.0]]))
        assert prove_positive_definite(ball).proved is definite


def conditioned(rng, size, condition):
    """Return a random symmetric matrix with this condition number (eigenvalues spread evenly in the exponent)."""
    basis = np.linalg.qr(rng.standard_normal((size, size)))[0]
    return symmetric((basis * condition ** -np.linspace(0.0, 1.0, size)) @ basis.T)


@pytest.mark.one_in(4)
@pytest.mark.parametrize("condition", [1.0, 1e3, 1e6, 1e8, 1e10])
def test_every_matrix_with_a_margin_is_proved(condition):
    rng = np.random.default_rng(13)
    proofs = [prove_positive_definite(conditioned(rng, int(rng.integers(2, 41)), condition)) for _ in range(300)]
    assert sum(proof.proved for proof in proofs) == 300
    assert all(proof.lower_bound > 0.0 for proof in proofs)


def test_larger_matrices_are_proved():
    rng = np.random.default_rng(14)
    for size, condition in ((100, 1e3), (100, 1e9), (200, 1e8)):
        assert prove_positive_definite(conditioned(rng, size, condition)).proved


def test_units_do_not_matter():
    rng = np.random.default_rng(15)
    for _ in range(200):
        size = int(rng.integers(2, 9))
        matrix = conditioned(rng, size, 1e4)
        scale = np.ldexp(np.ones(size), rng.integers(-500, 500, size))
        assert prove_positive_definite(scale[:, None] * matrix * scale).proved
        matrix[0, 0] = -matrix[0, 0]
        assert not prove_positive_definite(scale[:, None] * matrix * scale).proved


def test_the_lower_bound_is_one():
    """On a unit diagonal the bound is one on the smallest eigenvalue itself: A - bound I is definite, exactly."""
    rng = np.random.default_rng(16)
    proofs = 0
    for _ in range(500):
        size = int(rng.integers(2, 7))
        matrix = symmetric(rng.integers(-(2**20), 2**20, (size, size)) / 2.0**20 / rng.integers(1, size + 1))
        np.fill_diagonal(matrix, 1.0)
        proof = prove_positive_definite(matrix)
        if proof.proved and proof.lower_bound < np.linalg.eigvalsh(matrix)[0] * 0.9:
            proofs += 1
            shifted = [
                [Fraction(value) - (Fraction(proof.lower_bound) if i == j else 0) for j, value in enumerate(row)]
                for i, row in enumerate(matrix.tolist())
            ]
            assert is_positive_definite_fraction(shifted)
    assert proofs >= 100


def test_indefinite_matrices_are_not_proved():
    rng = np.random.default_rng(17)
    for _ in range(500):
        size = int(rng.integers(1, 20))
        basis = np.linalg.qr(rng.standard_normal((size, size)))[0]
        values = 10.0 ** rng.uniform(-6, 6, size)
        values[0] *= -1.0
        proof = prove_positive_definite(symmetric((basis * values) @ basis.T))
        assert not proof.proved
        assert proof.lower_bound <= 0.0


def test_empty_and_scalar():
    assert prove_positive_definite(np.zeros((0, 0))).proved
    for value, definite in ((1.0, True), (5e-324, True), (1.7e308, True), (0.0, False), (-0.0, False), (-1.0, False)):
        assert prove_positive_definite(np.array([[value]])).proved is definite
    assert prove_positive_definite(Ball(np.array([[1.0]]), np.array([[0.999]]))).proved
    assert not prove_positive_definite(Ball(np.array([[1.0]]), np.array([[1.0]]))).proved


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
@pytest.mark.parametrize("place", [(0, 0), (1, 0)])
def test_what_is_not_finite_is_not_proved(value, place):
    matrix = np.eye(3)
    matrix[place] = matrix[place[::-1]] = value
    assert not prove_positive_definite(matrix).proved
    assert not prove_positive_definite(Ball(np.eye(3), np.abs(matrix - np.eye(3)))).proved


def test_extreme_sizes_neither_warn_nor_raise(monkeypatch):
    """Entries that overflow when scaled, and a Cholesky factor whose LU pivots underflow."""
    assert not prove_positive_definite(np.array([[1.0, 1e308], [1e308, 1.0]])).proved
    assert not prove_positive_definite(np.array([[1e-300, 1e300], [1e300, 1e-300]])).proved
    assert prove_positive_definite(np.diag([1e-320, 1e308])).proved
    factor = np.eye(60, k=-1) + 2.0**-25 * np.eye(60)
    factor[0, 0] = 1.0
    # Definite (the product is exact), with a smallest eigenvalue far below every double.
    assert prove_positive_definite(factor @ factor.T).means == "ball arithmetic"
    monkeypatch.setattr(balls, "LARGEST_ORDER", 0)
    assert not prove_positive_definite(factor @ factor.T).proved


def test_a_ball_of_several_blocks_is_made_symmetric_entry_by_entry():
    rng = np.random.default_rng(9)
    n = 2 * PANEL_ROWS + 5
    ball = Ball(rng.standard_normal((n, n)), rng.random((n, n)))
    found = balls._symmetric(ball)
    for part in (found.midpoint, found.radius):
        assert np.array_equal(part, part.T)
    # Every symmetric member of the ball is within: those are members of its transpose, too.
    lower = np.maximum(ball.midpoint - ball.radius, ball.midpoint.T - ball.radius.T)
    upper = np.minimum(ball.midpoint + ball.radius, ball.midpoint.T + ball.radius.T)
    some = lower <= upper
    assert np.all((found.midpoint - found.radius <= lower)[some])
    assert np.all((found.midpoint + found.radius >= upper)[some])
    assert np.array_equal(found.midpoint, 0.5 * (ball.midpoint + ball.midpoint.T))


def test_a_shift_is_taken_from_the_diagonal_alone():
    rng = np.random.default_rng(10)
    matrix = rng.standard_normal((6, 6))
    matrix = matrix @ matrix.T + 2.0 * np.eye(6)
    kept = matrix.copy()
    factor = balls._shifted_factor(matrix, 1.5)
    assert np.array_equal(matrix, kept)
    assert np.array_equal(factor, np.tril(factor))
    assert np.allclose(factor @ factor.T, matrix - 1.5 * np.eye(6), rtol=0.0, atol=1e-14 * np.max(matrix))
    assert balls._shifted_factor(matrix, 1e3) is None
    assert balls._shifted_factor(np.full((2, 2), np.nan), 0.0) is None
