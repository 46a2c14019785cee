"""Norms of continuous-time systems: closed forms, and another library."""

from __future__ import annotations

import numpy as np
import pytest

from obsynth.methods.pd_observer.realisation import PdErrorSystem
from obsynth.numerics import continuous
from obsynth.numerics.continuous import ContinuousNorms
from obsynth.numerics.norms import HinfNorm, hinf_norm
from obsynth.numerics.spectra import abscissa


def continuous_hinf_norm(a: np.ndarray, b: np.ndarray, c: np.ndarray, d: np.ndarray) -> HinfNorm:
    return ContinuousNorms(a).between(b, c, d)


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
        a -= (abscissa(a, 0.0) + 10.0 ** rng.uniform(-2, 0) * np.linalg.norm(a)) * np.eye(n)
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
    assert abscissa(np.array([[0.0, 1.0], [-5.0, -2.0]]), 0.0) == pytest.approx(-1.0)
    assert abscissa(np.zeros((0, 0)), 0.0) == -np.inf
    assert abscissa(np.array([[np.nan]]), 0.0) == np.inf


def test_one_norm_of_systems_that_differ_in_what_drives_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    rng = np.random.default_rng(1)
    a, b, c = rng.normal(size=(4, 4)) - 6.0 * np.eye(4), rng.normal(size=(4, 2)), rng.normal(size=(1, 4))
    asked: list[int] = []

    def counted(*parts: np.ndarray, **named: object) -> object:
        asked.append(1)
        return hinf_norm(*parts, **named)

    monkeypatch.setattr(continuous, "hinf_norm", counted)
    norms, nothing = ContinuousNorms(a), np.zeros((4, 3))
    first = norms.between(b, c, np.zeros((1, 2)))
    assert norms.between(np.hstack([nothing, b]), c, np.zeros((1, 5))) == first
    assert len(asked) == 1
    # A feedthrough alone drives the output too, and another input matrix is another system.
    assert norms.between(np.hstack([nothing, b]), c, np.eye(1, 5)).value >= 1.0
    assert norms.between(2.0 * b, c, np.zeros((1, 2))).value == pytest.approx(2.0 * first.value, rel=1e-9)
    assert len(asked) == 3


def test_the_noise_and_its_derivative_reach_the_fault_error_as_the_frequency_response_says() -> None:
    rng = np.random.default_rng(2)
    nx, nf, ny, nw = 4, 2, 3, 2
    n = nx + nf
    az, s = rng.normal(size=(n, n)) - 5.0 * np.eye(n), rng.normal(size=(n, n))
    j, el, process, sensor = (rng.normal(size=shape) for shape in ((n, ny), (n, ny), (nx, nw), (ny, nw)))
    none = (np.zeros((n, 0)), np.zeros((n, 0)))
    errors = PdErrorSystem(az, s, none, none, none, j, el, nx)
    driven = np.hstack([np.vstack([process, np.zeros((nf, nw))]) - j @ sensor, -el @ sensor])
    points = 1j * np.concatenate([[0.0], np.geomspace(1e-2, 1e3, 4000)])
    gains = [np.linalg.norm(s[nx:] @ np.linalg.solve(p * np.eye(n) - az, driven), 2) for p in points]
    assert errors.separate_noise_norm(process, sensor).upper == pytest.approx(max(gains), rel=1e-4)
