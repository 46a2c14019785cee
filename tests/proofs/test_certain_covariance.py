"""Variances are computed in two ways; where rounding leaves no digit, none is named."""

from itertools import product

import numpy as np
import pytest
from flint import fmpq, fmpq_mat

from obsynth.numerics.spectra import noise_covariance
from obsynth.proofs import covariances as products
from obsynth.proofs.covariances import certain_noise_covariance, enclosed_noise_covariance


def far_from_normal(steep: float) -> np.ndarray:
    """Return a stable matrix ``(6, 6)`` with a strictly triangular part of this size, turned by a rotation."""
    rng = np.random.default_rng(8)
    turn = np.linalg.qr(rng.normal(size=(6, 6)))[0]
    return turn @ (np.diag(np.linspace(0.3, 0.7, 6)) + steep * np.triu(rng.normal(size=(6, 6)), 1)) @ turn.T


@pytest.mark.parametrize("dt", [0.0, 0.1])
def test_a_variance_that_both_ways_agree_on_is_right(dt: float) -> None:
    a = far_from_normal(1.0)
    a = a if dt else a - 4.0 * np.eye(6)
    b, c, d = np.ones((6, 1)), np.ones((2, 6)), np.zeros((2, 1))
    found = certain_noise_covariance(a, b, c, d, dt)
    summed = np.zeros((6, 6))
    if dt:
        state = b
        for _ in range(3000):
            summed, state = summed + state @ state.T, a @ state
    else:
        unknown = np.kron(a, np.eye(6)) + np.kron(np.eye(6), a)
        summed = np.linalg.solve(unknown, -(b @ b.T).ravel()).reshape(6, 6)
    assert found == pytest.approx(c @ summed @ c.T, rel=1e-8)


def exact_covariance(a: np.ndarray, b: np.ndarray, c: np.ndarray, dt: float) -> np.ndarray:
    """Solve the Lyapunov equation of the stored numbers in fractions."""
    n = len(a)
    left, entering = (fmpq_mat(*m.shape, [fmpq(*v.as_integer_ratio()) for v in m.ravel().tolist()]) for m in (a, b))
    one, noise = fmpq_mat(n, n, [fmpq(i == j) for i in range(n) for j in range(n)]), entering * entering.transpose()
    unknown = fmpq_mat(n * n, n * n)
    for i, j, k, m in product(range(n), repeat=4):
        first, last = (one[i, k], left[i, k]), (one[j, m], left[j, m])
        still = first[0] * last[0] - first[1] * last[1] if dt else -first[1] * last[0] - first[0] * last[1]
        unknown[n * i + j, n * k + m] = still
    states = unknown.solve(fmpq_mat(n * n, 1, noise.entries()))
    return c @ np.array([int(v.p) / int(v.q) for v in states.entries()]).reshape(n, n) @ c.T


@pytest.mark.parametrize("dt", [0.0, 0.1])
def test_a_variance_of_which_double_precision_knows_no_digit_is_that_of_the_stored_numbers(dt: float) -> None:
    a = far_from_normal(100.0) if dt else far_from_normal(1e3) - np.eye(6)
    b, c, d = np.ones((6, 1)), np.eye(2, 6), np.zeros((2, 1))
    found, exact = certain_noise_covariance(a, b, c, d, dt), exact_covariance(a, b, c, dt)
    # Nine digits are proved, relative to the deviations.
    sizes = np.sqrt(np.diag(exact))
    assert np.all(np.abs(found - exact) <= 1e-8 * np.outer(sizes, sizes))
    assert noise_covariance(a, b, c, d, dt) != pytest.approx(exact, rel=1e-4)


def test_a_variance_of_rounding_is_not_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(products, "MOST_ENCLOSED_STATES", 5)
    a = far_from_normal(100.0)
    found = certain_noise_covariance(a, np.ones((6, 1)), np.ones((2, 6)), np.zeros((2, 1)), 0.1)
    assert np.all(np.isnan(found))


def test_what_is_not_stable_has_an_infinite_variance() -> None:
    found = certain_noise_covariance(np.eye(2), np.ones((2, 1)), np.ones((1, 2)), np.zeros((1, 1)), 0.1)
    assert np.all(np.isinf(found))


@pytest.mark.parametrize("dt", [0.0, 0.1])
def test_noise_that_passes_at_once_counts_in_samples_alone(dt: float) -> None:
    a = far_from_normal(0.1)
    a = a if dt else a - 4.0 * np.eye(6)
    rng = np.random.default_rng(3)
    b, c, d = rng.normal(size=(6, 2)), rng.normal(size=(2, 6)), 5.0 * rng.normal(size=(2, 2))
    enclosed = enclosed_noise_covariance(a, b, c, d, dt)
    assert enclosed is not None
    np.testing.assert_allclose(enclosed, noise_covariance(a, b, c, d, dt), rtol=1e-9)
    without = enclosed_noise_covariance(a, b, c, 0.0 * d, dt)
    np.testing.assert_allclose(enclosed - without, d @ d.T if dt else 0.0 * d, atol=1e-9)
