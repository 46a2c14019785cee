"""Peaks of a frequency response in modal coordinates, against the response itself."""

import numpy as np
import pytest

from obsynth.numerics.modal_response import ModalResponse, Modes, level_crossings
from obsynth.numerics.norms import frequency_response, highest_gain_found, hinf_norm


def random_system(rng, n, m, p, *, damping):
    a = rng.standard_normal((n, n))
    a *= (1.0 - damping) / np.max(np.abs(np.linalg.eigvals(a)))
    return a, rng.standard_normal((n, m)), rng.standard_normal((p, n)), rng.standard_normal((p, m))


@pytest.mark.parametrize(("m", "p"), [(1, 1), (1, 4), (2, 2), (5, 2), (2, 7), (3, 3), (6, 4)])
def test_gains_are_the_largest_singular_values(m, p):
    rng = np.random.default_rng([1, m, p])
    angles = np.linspace(0.0, np.pi, 40)
    for n in (1, 5, 12):
        a, b, c, d = random_system(rng, n, m, p, damping=0.1)
        true = np.linalg.svd(frequency_response(a, b, c, d, angles), compute_uv=False)[:, 0]
        found = ModalResponse.of(Modes.of(a), b, c, d).gains(angles)
        assert np.allclose(found, true, rtol=1e-9)


def test_an_estimate_for_many_states_and_signals_is_below_and_close():
    rng = np.random.default_rng(2)
    a, b, c, d = random_system(rng, 70, 4, 5, damping=1e-2)
    response = ModalResponse.of(Modes.of(a), b, c, d)
    angle = response.refined(*response.rough_peaks(257)[:2])[:1]
    true = np.linalg.svd(frequency_response(a, b, c, d, angle), compute_uv=False)[:, 0]
    assert 0.9 * true[0] <= response.gains(angle)[0] <= true[0] * (1.0 + 1e-9)


@pytest.mark.parametrize(
    "units", [(1.0, 1.0, 1.0), (1e25, 1e20, 1e45), (1e-30, 1e-25, 1e-55), (1.0, 0.0, 1e-90), (1.0, 1e-60, 3.0)]
)
def test_where_a_peak_may_be_is_told_in_any_units(units):
    rng = np.random.default_rng(3)
    a, b, c, d = random_system(rng, 70, 4, 5, damping=1e-2)
    b, c, d = (part * unit for part, unit in zip((b, c, d), units, strict=True))
    response, angles = ModalResponse.of(Modes.of(a), b, c, d), np.linspace(0.0, np.pi, 40)
    rough = response.gains(angles, roughly=True)
    true = np.linalg.svd(frequency_response(a, b, c, d, angles), compute_uv=False)[:, 0]
    assert np.all(rough <= true * (1.0 + 1e-4))
    assert np.all(rough >= 0.5 * true)


@pytest.mark.parametrize("damping", [0.5, 1e-1, 1e-2, 1e-4, 1e-6])
def test_the_highest_peak_is_found_where_a_fine_grid_has_it(damping, share):
    for seed in share(range(5)):
        rng = np.random.default_rng([3, seed])
        a, b, c, d = random_system(rng, 8, 2, 2, damping=damping)
        modes = Modes.of(a)
        response = ModalResponse.of(modes, b, c, d)
        angles = response.refined(*response.rough_peaks(33)[:2])
        found = np.linalg.svd(frequency_response(a, b, c, d, angles), compute_uv=False)[:, 0].max()
        poles = np.abs(np.angle(modes.values))[:, None] + damping * np.linspace(-3.0, 3.0, 601)
        fine = np.concatenate([np.linspace(0.0, np.pi, 4001), poles.ravel()])
        grid = np.linalg.svd(frequency_response(a, b, c, d, fine), compute_uv=False)[:, 0]
        assert found >= grid.max() * (1.0 - 1e-6)


def test_eigenvectors_that_are_no_basis_give_no_response():
    shift = np.eye(3, k=1)
    assert ModalResponse.of(Modes.of(shift), np.ones((3, 1)), np.ones((1, 3)), np.zeros((1, 1))) is None


def test_known_modes_change_nothing():
    rng = np.random.default_rng(4)
    for n in (6, 70):
        a, b, c, d = random_system(rng, n, 2, 2, damping=0.05)
        assert hinf_norm(a, b, c, d, modes=Modes.of(a)) == hinf_norm(a, b, c, d)
        assert highest_gain_found(a, b, c, d, modes=Modes.of(a)) == highest_gain_found(a, b, c, d)
    assert Modes.of(np.diag([0.5, -0.75])).radius == 0.75
    assert Modes.of(np.zeros((0, 0))).radius == 0.0


@pytest.mark.parametrize("side", [1.0, -1.0])
def test_crossings_next_to_zero_and_to_the_highest_frequency(side):
    """|1 / (z - a)| = level at one angle; close to pi the pencil cannot be made an ordinary problem."""
    a = 0.5 * side
    for angle in (1e-3, 0.5, 2.0, np.pi - 1e-3):
        level = 1.0 / abs(np.exp(1j * angle) - a)
        matrices = (np.full((1, 1), value) for value in (a, 1.0, 1.0, 0.0))
        crossings = level_crossings(*matrices, level)
        assert np.min(np.abs(crossings - angle)) < 1e-6
    # At the peak itself the pencil is singular at z = 1 or -1.
    crossings = level_crossings(*(np.full((1, 1), v) for v in (a, 1.0, 1.0, 0.0)), 2.0)
    assert crossings.size
    assert np.all(np.minimum(crossings, np.pi - crossings) < 1e-3)
