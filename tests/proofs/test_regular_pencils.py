"""Gains that are proved without a certificate: nothing below one that is reached, and flat ones too."""

from __future__ import annotations

import numpy as np
import pytest

from obsynth.numerics.norms import hinf_norm
from obsynth.numerics.standard_form import cayley, uncayley
from obsynth.verification.gain_by_pencil import prove_norm_by_eigenvalues

Model = tuple[np.ndarray, ...]


def proved(system: Model, gain: float, dt: float) -> bool:
    return prove_norm_by_eigenvalues(
        lambda kind: tuple(kind.exact(part) for part in system), len(system[0]), gain, dt=dt
    ).proved


def random_system(rng: np.random.Generator, n: int, dt: float) -> Model:
    a = rng.normal(size=(n, n))
    a *= 0.95 / np.max(np.abs(np.linalg.eigvals(a)))
    units = 10.0 ** rng.uniform(-3.0, 3.0, n)
    b, c, d = units[:, None] * rng.normal(size=(n, 2)), rng.normal(size=(3, n)) / units, rng.normal(size=(3, 2))
    system = units[:, None] * a / units, b, c, d
    return system if dt else uncayley(*system, 10.0 ** rng.uniform(-3.0, 3.0))


def all_pass(poles: np.ndarray) -> Model:
    """Return a product of first-order all-pass systems, of gain one at every frequency."""
    a, b, c, d = np.zeros((0, 0)), np.zeros((0, 1)), np.zeros((1, 0)), np.eye(1)
    for pole in poles:
        root = 1.0 - pole**2
        a = np.block([[a, np.zeros((len(a), 1))], [c, np.array([[pole]])]])
        b, c, d = np.vstack([b, d]), np.hstack([-pole * c, [[root]]]), -pole * d
    return a, b, c, d


@pytest.mark.parametrize("dt", [0.0, 1.0])
def test_levels_above_a_gain_are_proved_and_none_below(dt: float) -> None:
    rng = np.random.default_rng([47, int(dt)])
    for n in (1, 4, 9):
        system = random_system(rng, n, dt)
        gain = hinf_norm(*(system if dt else cayley(*system, 1.0))).upper
        assert proved(system, gain * (1.0 + 1e-8), dt)
        for share in (1e-6, 0.1, 0.9):
            assert not proved(system, gain * (1.0 - share), dt)


@pytest.mark.parametrize("poles", [np.linspace(-0.8, 0.8, 8), np.full(3, 0.5)], ids=["apart", "repeated"])
@pytest.mark.parametrize("dt", [0.0, 1.0])
def test_a_flat_gain_is_proved_closely(poles: np.ndarray, dt: float) -> None:
    """Optimal errors have one: of the Hamiltonian matrix the inverse of ``g^2 - D'D`` left no digits at 33 states."""
    system = all_pass(poles)
    system = system if dt else uncayley(*system, 2.0)
    assert proved(system, 1.0 + 1e-7, dt)
    assert not proved(system, 1.0, dt)
    assert not proved(system, 1.0 - 1e-7, dt)


def test_a_gain_that_is_larger_at_every_frequency_is_no_proof() -> None:
    """``2 / z``: nothing passes at once, and the level is reached at no frequency."""
    delay = np.zeros((1, 1)), np.eye(1), 2.0 * np.eye(1), np.zeros((1, 1))
    assert not proved(delay, 1.0, 1.0)
    assert proved(delay, 2.0 + 1e-9, 1.0)
