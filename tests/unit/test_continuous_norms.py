"""Norms of continuous-time systems: closed forms, and another library."""

from __future__ import annotations

import numpy as np
import pytest

from obsynth.numerics.continuous import continuous_hinf_norm, spectral_abscissa


def as_arrays(*matrices: object) -> tuple[np.ndarray, ...]:
    return tuple(np.array(matrix, dtype=float) for matrix in matrices)


@pytest.mark.parametrize("rate", [1e-6, 0.3, 1.0, 1e6])
def test_a_low_pass_filter_has_its_peak_at_zero(rate: float) -> None:
    norm = continuous_hinf_norm(*as_arrays([[-rate]], [[rate]], [[2.0]], [[0.0]]))
    assert norm.value == pytest.approx(2.0, rel=1e-12)
    assert 2.0 <= norm.upper <= 2.0 * (1.0 + 2e-9)
    assert norm.frequency == 0.0


def test_a_high_pass_filter_has_its_peak_at_infinity() -> None:
    norm = continuous_hinf_norm(*as_arrays([[-3.0]], [[1.0]], [[-9.0]], [[3.0]]))
    assert norm.value == pytest.approx(3.0, rel=1e-12)
    assert norm.frequency == np.inf


@pytest.mark.parametrize("damping", [0.5, 1e-2, 1e-5])
@pytest.mark.parametrize("w", [1e-3, 2.0, 1e4])
def test_a_resonance(damping: float, w: float) -> None:
    """w^2 / (s^2 + 2 z w s + w^2): the peak is 1 / (2 z sqrt(1 - z^2)) at w sqrt(1 - 2 z^2)."""
    norm = continuous_hinf_norm(*as_arrays([[0, w], [-w, -2 * damping * w]], [[0], [w]], [[1, 0]], [[0]]))
    assert norm.value == pytest.approx(1.0 / (2.0 * damping * np.sqrt(1.0 - damping**2)), rel=1e-8)
    assert norm.frequency == pytest.approx(w * np.sqrt(1.0 - 2.0 * damping**2), rel=1e-3)


def test_against_another_library() -> None:
    import control

    pytest.importorskip("slycot", reason="what control computes the norm with")

    rng = np.random.default_rng(0)
    for _ in range(60):
        n, m, p = rng.integers(1, 8), *rng.integers(1, 4, 2)
        a = rng.normal(size=(n, n)) * 10.0 ** rng.uniform(-2, 3)
        a -= (spectral_abscissa(a) + 10.0 ** rng.uniform(-2, 0) * np.linalg.norm(a)) * np.eye(n)
        b, c = rng.normal(size=(n, m)), rng.normal(size=(p, n))
        d = rng.normal(size=(p, m)) * rng.integers(0, 2)
        expected = control.linfnorm(control.ss(a, b, c, d), tol=1e-10)[0]
        found = continuous_hinf_norm(a, b, c, d)
        assert found.value == pytest.approx(expected, rel=1e-8)
        assert found.value <= found.upper <= found.value * (1.0 + 2e-9)


def test_what_is_not_stable_or_not_finite_has_no_norm() -> None:
    for a in ([[0.0]], [[1.0]], [[np.nan]], [[np.inf]]):
        assert continuous_hinf_norm(*as_arrays(a, [[1.0]], [[1.0]], [[0.0]])).upper == np.inf
    assert continuous_hinf_norm(*as_arrays([[-1.0]], [[np.nan]], [[1.0]], [[0.0]])).upper == np.inf


def test_nothing_to_norm() -> None:
    a = np.array([[-1.0]])
    assert continuous_hinf_norm(a, np.zeros((1, 0)), np.ones((1, 1)), np.zeros((1, 0))).upper == 0.0
    assert continuous_hinf_norm(a, np.ones((1, 1)), np.zeros((0, 1)), np.zeros((0, 1))).upper == 0.0
    none = continuous_hinf_norm(np.zeros((0, 0)), np.zeros((0, 2)), np.zeros((1, 0)), np.array([[3.0, 4.0]]))
    assert none.upper == pytest.approx(5.0)


def test_spectral_abscissa() -> None:
    assert spectral_abscissa(np.array([[0.0, 1.0], [-5.0, -2.0]])) == pytest.approx(-1.0)
    assert spectral_abscissa(np.zeros((0, 0))) == -np.inf
    assert np.isnan(spectral_abscissa(np.array([[np.nan]])))
