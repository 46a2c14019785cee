"""Balls contain the exact result: rounding, cancellation and underflow against integer arithmetic."""

from fractions import Fraction

import numpy as np
import pytest

from obsynth.proofs import products
from obsynth.proofs.balls import UNDERFLOW, UNIT_ROUNDOFF, Ball, gamma, rounded_up
from obsynth.proofs.extended_balls import block

#: Every double is a whole multiple of 1 / UNITS.
UNITS = 2**1074
#: Exponents of two of the entries: moderate, wide, around underflow, and products that lose digits to underflow.
RANGES = {
    "moderate": ((-20, 20), (-20, 20)),
    "wide": ((-500, 480), (-500, 480)),
    "subnormal": ((-1080, -1000), (-1080, -1000)),
    "underflowing products": ((-560, -500), (-560, -500)),
    "huge times subnormal": ((900, 990), (-1080, -1000)),
}


def whole(matrix):
    """Return the entries as exact whole numbers of 1 / UNITS."""

    def number(value):
        numerator, denominator = float(value).as_integer_ratio()
        return numerator * (UNITS // denominator)

    return np.array([[number(value) for value in row] for row in matrix], dtype=object).reshape(np.shape(matrix))


def contains(ball, exact, factors=1):
    """Whether every entry of ``exact``, in units of ``UNITS**-factors``, lies in the ball."""
    scale = UNITS ** (factors - 1)
    return bool(np.all(abs(whole(ball.midpoint) * scale - exact) <= whole(ball.radius) * scale))


def random_matrix(rng, shape, exponents):
    values = np.ldexp(rng.uniform(0.5, 1.0, shape) * rng.choice([-1.0, 1.0], shape), rng.integers(*exponents, shape))
    return np.where(rng.random(shape) < 0.1, 0.0, values)


def random_ball(rng, shape, exponents):
    """Return a ball whose radii are anything from zero to the size of the entries."""
    midpoint = random_matrix(rng, shape, exponents)
    shrink = -rng.integers(0, 80, shape)
    return Ball(midpoint, np.where(rng.random(shape) < 0.3, 0.0, np.abs(np.ldexp(midpoint, shrink))))


def some_member(rng, ball):
    """Return a member, exactly: each entry at one end of its interval or in the middle."""
    ends = np.array(rng.integers(-1, 2, ball.shape).tolist(), dtype=object).reshape(ball.shape)
    return whole(ball.midpoint) + ends * whole(ball.radius)


@pytest.mark.parametrize("terms", [1, 2, 3, 10, 1000, 10**6, 10**9])
def test_gamma_is_an_upper_bound_and_tight(terms):
    u = Fraction(1, 2**53)
    exact = terms * u / (1 - terms * u)
    assert exact <= Fraction(gamma(terms)) <= exact * (1 + 8 * (terms + 4) * u)


def test_constants():
    assert np.finfo(np.float64).eps / 2.0 == UNIT_ROUNDOFF
    assert 2.0 * np.nextafter(0.0, 1.0) == UNDERFLOW


@pytest.mark.parametrize("operations", [1, 5, 100])
def test_rounded_up_covers_its_roundings(operations):
    rng = np.random.default_rng(operations)
    for value in np.ldexp(rng.uniform(0.5, 1.0, 500), rng.integers(-1080, 1000, 500)):
        largest = Fraction(value) / (1 - Fraction(1, 2**53)) ** operations + operations * Fraction(1, 2**1075)
        assert Fraction(float(rounded_up(value, operations))) >= largest


@pytest.mark.one_in(4)
@pytest.mark.parametrize("kind", RANGES)
def test_products_contain_every_product_of_members(kind, share):
    rng = np.random.default_rng(1)
    for _ in share(range(1000)):
        rows, length, columns = rng.integers(1, 6, 3)
        left = random_ball(rng, (rows, length), RANGES[kind][0])
        right = random_ball(rng, (length, columns), RANGES[kind][1])
        product = left @ right
        assert contains(product, whole(left.midpoint) @ whole(right.midpoint), factors=2)
        assert contains(product, some_member(rng, left) @ some_member(rng, right), factors=2)


@pytest.mark.one_in(4)
@pytest.mark.parametrize("kind", RANGES)
def test_sums_contain_every_sum_of_members(kind, share):
    rng = np.random.default_rng(2)
    for _ in share(range(1000)):
        shape = tuple(rng.integers(1, 6, 2))
        left, right = (random_ball(rng, shape, exponents) for exponents in RANGES[kind])
        first, second = some_member(rng, left), some_member(rng, right)
        assert contains(left + right, first + second)
        assert contains(left - right, first - second)
        assert contains(-left, -first)


def test_products_that_cancel():
    """Rows whose exact product is zero, or far below the terms."""
    rng = np.random.default_rng(3)
    for _ in range(1000):
        half = random_matrix(rng, (1, 4), (-30, 30))
        other = random_matrix(rng, (4, 1), (-30, 30))
        nudged = other * (1.0 + rng.integers(-1, 2) * np.finfo(np.float64).eps)
        left, right = Ball.exact(np.hstack([half, -half])), Ball.exact(np.vstack([other, nudged]))
        assert contains(left @ right, whole(left.midpoint) @ whole(right.midpoint), factors=2)


def test_what_one_factor_loses_by_underflow_the_other_does_not_magnify():
    left, right = np.array([[1.3e300]]), np.array([[1.1e-310]])
    assert contains(Ball.exact(left) @ Ball.exact(right), whole(left) @ whole(right), factors=2)


@pytest.mark.parametrize("size", [17, 64, 130])
def test_products_by_blocked_kernels(size):
    rng = np.random.default_rng(size)
    left, right = random_matrix(rng, (size, size), (-40, 40)), random_matrix(rng, (size, 5), (-40, 40))
    assert contains(Ball.exact(left) @ Ball.exact(right), whole(left) @ whole(right), factors=2)
    assert contains(Ball.exact(right).T @ Ball.exact(right), whole(right).T @ whole(right), factors=2)


@pytest.mark.long
def test_chains_of_operations():
    rng = np.random.default_rng(4)
    for _ in range(500):
        a, b, c, d = (random_ball(rng, (3, 3), (-30, 30)) for _ in range(4))
        x, y, z, w = (some_member(rng, ball) for ball in (a, b, c, d))
        exact = ((x @ y + z * UNITS) @ w) - x * UNITS**2
        assert contains((a @ b + c) @ d - a, exact, factors=3)
        assert contains((b.T @ a) @ b, (y.T @ x) @ y, factors=3)


def test_radii_are_not_wasteful():
    rng = np.random.default_rng(5)
    left, right = rng.standard_normal((2, 30, 30))
    product = Ball.exact(left) @ Ball.exact(right)
    assert np.all(product.radius <= 2.0 * gamma(31) * (np.abs(left) @ np.abs(right)))
    assert np.all((product + product).radius <= 2.0 * product.radius + 4.0 * UNIT_ROUNDOFF * np.abs(product.midpoint))


def test_scaling_by_powers_of_two():
    rng = np.random.default_rng(6)
    for _ in range(500):
        ball, exponents = random_ball(rng, (4, 4), (-400, 400)), rng.integers(-500, 500, 4)
        total = exponents[:, None] + exponents
        member, scaled = some_member(rng, ball), ball.congruent(exponents)
        up = np.array([[2 ** int(k + 1000) for k in row] for row in total], dtype=object)
        finite = np.isfinite(scaled.midpoint) & np.isfinite(scaled.radius)
        midpoint, radius = (np.where(finite, part, 0.0) for part in (scaled.midpoint, scaled.radius))
        miss = abs(whole(midpoint) * 2**1000 - member * up) - whole(radius) * 2**1000
        assert np.all(miss[finite] <= 0)


def test_scaling_by_powers_whose_products_are_no_doubles_is_the_same():
    rng = np.random.default_rng(8)
    ball, exponents = random_ball(rng, (4, 4), (-40, 40)), np.array([500, -500, 3, 0])
    larger = np.array([501, -501, 3, 0])
    for given in (exponents, larger):
        total = given[:, None] + given
        scaled = ball.congruent(given)
        with np.errstate(over="ignore"):
            middle, radius = np.ldexp(ball.midpoint, total), np.ldexp(ball.radius, total) + UNDERFLOW
        assert np.array_equal(scaled.midpoint, middle)
        assert np.array_equal(scaled.radius, radius)


def test_blocks_and_transposes():
    rng = np.random.default_rng(7)
    a, b, c, d = (random_ball(rng, shape, (-5, 5)) for shape in ((2, 2), (2, 3), (1, 2), (1, 3)))
    joined = block([[a, b], [c, d]])
    assert joined.shape == (3, 5)
    for part in ("midpoint", "radius"):
        values = [getattr(ball, part) for ball in (a, b, c, d)]
        assert np.array_equal(getattr(joined, part), np.block([values[:2], values[2:]]))
        assert np.array_equal(getattr(joined.T, part), getattr(joined, part).T)


def test_empty_products():
    product = Ball.exact(np.zeros((2, 0))) @ Ball.exact(np.zeros((0, 3)))
    assert product.shape == (2, 3)
    assert np.array_equal(product.midpoint, np.zeros((2, 3)))
    assert np.all(product.radius < 1e-300)


def test_overflow_claims_nothing():
    huge = Ball.exact(np.full((2, 2), 1e300))
    for result in (huge @ huge, (huge @ huge) @ Ball.exact(np.zeros((2, 2))), Ball.exact(np.full((1, 1), 1.7e308))):
        doubled = result + result
        assert not np.any(np.isfinite(doubled.midpoint) & np.isfinite(doubled.radius))


class TestExponentialsOfManyStates:
    """By squaring in double precision, in units that balance the matrix."""

    @pytest.mark.parametrize("time", [0.05, 3.0])
    def test_balls_hold_what_more_digits_and_identities_say(self, time, monkeypatch):
        n, rng = products.EXACT_PRODUCTS_UP_TO + 1, np.random.default_rng(7)
        units = 10.0 ** rng.uniform(-3, 3, n)
        a = units[:, None] * (rng.normal(size=(n, n)) / np.sqrt(n) - 1.5 * np.eye(n)) / units
        b = Ball.exact(units[:, None] * rng.normal(size=(n, 2)))
        found, energy = products.exponential(a, time), products.energy(a, b.midpoint, time)
        # A W + W A' = e^{A t} B B' e^{A' t} - B B'.
        inner, moved = Ball.exact(a) @ energy, found @ b
        left = inner + inner.T - moved @ moved.T + b @ b.T
        assert np.all(np.abs(left.midpoint) <= left.radius)
        monkeypatch.setattr(products, "FEW_STATES_FOR_BALLS", n)
        sharp = products.exponential(a, time)
        assert np.all(np.abs(found.midpoint - sharp.midpoint) <= found.radius + sharp.radius)
        assert np.max(sharp.radius) < np.max(found.radius) <= 1e-7 * np.max(np.abs(found.midpoint))

    def test_what_double_precision_does_not_tell_is_left_to_more_digits(self, monkeypatch):
        a = np.random.default_rng(8).normal(size=(products.EXACT_PRODUCTS_UP_TO + 1,) * 2) / 8.0
        fast = products.exponential(a, 1.0)
        monkeypatch.setattr(products, "LARGEST_RADIUS_SHARE", 1e-15)
        assert np.max(products.exponential(a, 1.0).radius) < 0.01 * np.max(fast.radius)
