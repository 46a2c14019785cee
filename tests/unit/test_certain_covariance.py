"""Variances are computed in two ways; where rounding leaves no digit, none is named."""

import numpy as np
import pytest

from obsynth.numerics.spectra import certain_noise_covariance


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


def test_a_variance_of_rounding_is_not_named() -> None:
    a = far_from_normal(100.0)
    assert np.max(np.abs(np.linalg.eigvals(a))) < 1.0
    found = certain_noise_covariance(a, np.ones((6, 1)), np.ones((2, 6)), np.zeros((2, 1)), 0.1)
    assert np.all(np.isnan(found))


def test_what_is_not_stable_has_an_infinite_variance() -> None:
    found = certain_noise_covariance(np.eye(2), np.ones((2, 1)), np.ones((1, 2)), np.zeros((1, 1)), 0.1)
    assert np.all(np.isinf(found))
