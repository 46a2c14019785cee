"""Bounds on long products of matrices: never below the truth (in 400 digits), and close to it."""

import flint
import numpy as np
import pytest

from obsynth.proofs.balls import Ball
from obsynth.proofs.contraction import proved_rate
from obsynth.proofs.products import AT_ONCE, logarithm_of_product, product_of_stack, stacked_product


def true_logarithm(factors: np.ndarray) -> float:
    """The logarithm of the norm of the product, formed in 1400 bits."""
    with flint.ctx.workprec(1400):
        whole = flint.arb_mat(len(factors[0]), len(factors[0]), [float(i == j) for i in range(len(factors[0]))
                                                                 for j in range(len(factors[0]))])  # fmt: skip
        for factor in factors:
            whole = flint.arb_mat(*factor.shape, factor.ravel().tolist()) * whole
        largest = max(abs(whole[i, j]) for i in range(whole.nrows()) for j in range(whole.ncols()))
        scaled = np.array([[float((whole[i, j] / largest).mid()) for j in range(whole.ncols())]
                           for i in range(whole.nrows())])  # fmt: skip
        return float(largest.log().mid()) + float(np.log(np.linalg.norm(scaled, 2)))


def blocks(factors: np.ndarray) -> list[Ball]:
    parts = (factors[i : i + AT_ONCE] for i in range(0, len(factors), AT_ONCE))
    return [product_of_stack(part, np.zeros_like(part)) for part in parts]


@pytest.mark.parametrize("seed", range(12))
def test_the_bound_is_above_the_truth_and_close(seed) -> None:
    rng = np.random.default_rng(seed)
    size, steps = int(rng.integers(1, 7)), int(rng.integers(1, 400))
    base = rng.standard_normal((size, size))
    base *= rng.uniform(0.3, 1.1) / max(abs(np.linalg.eigvals(base)))
    units = 10.0 ** rng.uniform(-3, 3, size)
    factors = (base + rng.uniform(0, 0.1) * rng.standard_normal((steps, size, size))) * units / units[:, None]
    truth, bound = true_logarithm(factors), logarithm_of_product(blocks(factors))
    assert truth <= bound + 1e-12 * abs(bound)
    # What is lost does not grow with the steps but by powers: a hundredth per step, and the units once.
    assert bound - truth < 0.01 * steps + 2.0 * np.log(units.max() / units.min()) + 3.0


def test_members_of_balls_are_bounded_too() -> None:
    rng = np.random.default_rng(5)
    base = 0.9 * np.linalg.qr(rng.standard_normal((4, 4)))[0]
    radius = 1e-3
    bound = logarithm_of_product([Ball(base, np.full((4, 4), radius))] * 200)
    for _ in range(20):
        assert true_logarithm(base + radius * rng.choice([-1.0, 1.0], (200, 4, 4))) <= bound
    assert bound < 200 * np.log(0.92)


def test_units_are_those_of_the_product() -> None:
    units = np.array([1.0, 2.0**20])
    factor = np.array([[0.5, 2.0**-20], [0.0, 0.5]]) * 1.0
    moved = factor * units[None, :] / units[:, None]
    assert logarithm_of_product([Ball.exact(factor)] * 3, units) == logarithm_of_product([Ball.exact(moved)] * 3)


def test_nothing_zero_and_what_is_not_finite() -> None:
    assert logarithm_of_product([]) == 0.0
    assert logarithm_of_product([Ball.exact(np.zeros((0, 0)))]) == -np.inf
    assert logarithm_of_product([Ball.exact(np.zeros((2, 2)))]) < -700.0  # what underflow leaves open
    assert logarithm_of_product([Ball.exact(np.full((2, 2), np.inf))]) == np.inf
    nilpotent = np.array([[0.0, 1.0], [0.0, 0.0]])
    assert logarithm_of_product([Ball.exact(nilpotent)] * 40) < -500.0


def test_stacks_multiply_as_balls_do() -> None:
    rng = np.random.default_rng(1)
    a, b, ra, rb = (rng.standard_normal((3, 4, 4)) for _ in range(4))
    middle, radius = stacked_product((a, abs(ra)), (b, abs(rb)))
    for k in range(3):
        one = Ball(a[k], abs(ra[k])) @ Ball(b[k], abs(rb[k]))
        np.testing.assert_array_equal(middle[k], one.midpoint)
        np.testing.assert_allclose(radius[k], one.radius, rtol=1e-12)
    whole = product_of_stack(a, np.zeros_like(a))
    assert np.all(np.abs(a[2] @ a[1] @ a[0] - whole.midpoint) <= whole.radius)


def test_a_rate_is_proved_little_above_the_spectral_radius() -> None:
    matrix = np.array([[0.9, 5.0], [0.0, 0.8]])
    assert 0.9 < proved_rate(matrix) < 0.902
    assert proved_rate(np.array([[1.0]])) is None
    assert proved_rate(np.zeros((0, 0))) == 0.0
