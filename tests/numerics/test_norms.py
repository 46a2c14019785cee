"""System norms against closed forms, SLICOT, impulse responses and direct summation."""

import control
import numpy as np
import pytest

from obsynth.numerics import modal_response, norms
from obsynth.numerics.norms import (
    STATES_OF_PENCIL,
    frequency_response,
    highest_gain_found,
    hinf_norm,
    norm_is_at_most,
    output_covariance,
    spectral_radius,
)


def system(a, b, c, d):
    return tuple(np.atleast_2d(np.asarray(matrix, dtype=float)) for matrix in (a, b, c, d))


def rotation(angle, radius):
    return radius * np.array([[np.cos(angle), np.sin(angle)], [-np.sin(angle), np.cos(angle)]])


def check_encloses(found, true, *, width=2.1e-9, slack=1e-12):
    """Value <= true <= upper, up to the rounding of the true value; the bracket is narrow."""
    assert found.value <= true * (1.0 + slack)
    assert found.upper >= true * (1.0 - slack)
    assert found.upper <= found.value * (1.0 + width)


def random_system(rng, *, damping, scaled=False):
    n, m, p = (int(k) for k in rng.integers(1, (9, 4, 4)))
    a, b, c = rng.standard_normal((n, n)), rng.standard_normal((n, m)), rng.standard_normal((p, n))
    a *= (1.0 - damping) / np.max(np.abs(np.linalg.eigvals(a)))
    d = rng.standard_normal((p, m)) * rng.integers(0, 2)
    if scaled:
        scale = 10.0 ** rng.uniform(-3, 3, n)
        a, b, c = a * scale / scale[:, None], b / scale[:, None], c * scale
    return a, b, c, d


def by_slicot(a, b, c, d):
    n, m, p = a.shape[0], b.shape[1], c.shape[0]
    return pytest.importorskip("slycot").ab13dd("D", "I", "N", "D", n, m, p, a, np.eye(n), b, c, d, 1e-12)[0]


class TestManyStates:
    """Above eighty states a modal response and a Riccati equation take the place of the pencil."""

    SIZE = STATES_OF_PENCIL + 10

    def realisation(self, rng, inputs, outputs, damping):
        """Return a stable system with its largest pole at a distance ``damping`` from the circle."""
        a = rng.standard_normal((self.SIZE, self.SIZE))
        b, c = rng.standard_normal((self.SIZE, inputs)), rng.standard_normal((outputs, self.SIZE))
        a *= (1.0 - damping) / np.max(np.abs(np.linalg.eigvals(a)))
        return a, b, c, rng.standard_normal((outputs, inputs))

    @pytest.mark.one_in(3)
    @pytest.mark.parametrize("damping", [0.3, 1e-2, 1e-4])
    def test_against_slicot(self, damping):
        rng = np.random.default_rng(11)
        for _ in range(4):
            realisation = self.realisation(rng, 3, 2, damping)
            true = by_slicot(*realisation)
            check_encloses(hinf_norm(*realisation), true, width=1.1e-3, slack=1e-8)
            assert highest_gain_found(*realisation) == pytest.approx(true, rel=1e-4)
            assert norm_is_at_most(*realisation, 1.002 * true)
            assert not norm_is_at_most(*realisation, 0.999 * true)

    @pytest.mark.parametrize("damping", [0.3, 1e-3])
    def test_against_slicot_with_several_signals(self, damping):
        """The largest singular value of more than two is estimated by power iteration."""
        rng = np.random.default_rng(12)
        for _ in range(3):
            realisation = self.realisation(rng, 4, 5, damping)
            true = by_slicot(*realisation)
            check_encloses(hinf_norm(*realisation), true, width=1.1e-3, slack=1e-8)
            assert highest_gain_found(*realisation) == pytest.approx(true, rel=1e-4)

    def test_defective_dynamics(self):
        """A chain of delays has one eigenvector: modal coordinates say nothing, and the norm is that of the taps."""
        taps = np.linspace(1.0, 2.0, self.SIZE + 1)
        found = hinf_norm(np.eye(self.SIZE, k=-1), np.eye(self.SIZE)[:, :1], taps[None, 1:], taps[:1, None])
        check_encloses(found, float(np.sum(taps)), width=1.1e-3, slack=1e-9)


class TestHinfNorm:
    @pytest.mark.parametrize("a", [-0.999999, -0.9, -0.2, 0.0, 0.3, 0.95, 0.9999])
    def test_first_order(self, a):
        """|b c / (z - a)| is largest at z = 1 for a > 0 and at z = -1 for a < 0."""
        found = hinf_norm(*system(a, 2.0, 3.0, 0.0))
        check_encloses(found, 6.0 / (1.0 - abs(a)), slack=1e-10)
        assert a == 0.0 or found.frequency == pytest.approx(0.0 if a > 0 else np.pi, abs=1e-9)

    @pytest.mark.parametrize("a", [-0.99, -0.5, 0.7, 0.99999])
    def test_all_pass(self, a):
        """(1 - a z) / (z - a) has modulus one everywhere."""
        check_encloses(hinf_norm(*system(a, 1.0 - a * a, 1.0, -a)), 1.0, slack=1e-9)

    def test_all_pass_of_two_channels(self):
        a = np.diag([0.7, -0.3])
        check_encloses(hinf_norm(a, np.eye(2) - a @ a, np.eye(2), -a), 1.0)

    @pytest.mark.parametrize("delay", [1, 2, 5])
    def test_pure_delay_is_flat(self, delay):
        shift = np.eye(delay, k=-1)
        found = hinf_norm(shift, np.eye(delay)[:, :1], 4.0 * np.eye(delay)[-1:], np.zeros((1, 1)))
        check_encloses(found, 4.0)

    def test_finite_impulse_response(self):
        taps = np.array([1.0, 0.5, -1.0, 0.25, 2.0, 0.1])
        n = len(taps) - 1
        found = hinf_norm(np.eye(n, k=-1), np.eye(n)[:, :1], taps[None, 1:], np.array([[taps[0]]]))
        angles = np.linspace(found.frequency - 1e-3, found.frequency + 1e-3, 200001)
        near = np.abs(np.polyval(taps[::-1], np.exp(-1j * angles))).max()
        everywhere = np.abs(np.fft.fft(taps, 2**18)).max()
        check_encloses(found, max(near, everywhere))

    def test_moving_average_peaks_at_zero_and_differences_at_pi(self):
        shift, first = np.eye(3, k=-1), np.eye(3)[:, :1]
        low = hinf_norm(shift, first, np.full((1, 3), 0.25), np.full((1, 1), 0.25))
        check_encloses(low, 1.0)
        assert low.frequency == pytest.approx(0.0, abs=1e-6)
        high = hinf_norm(shift, first, np.array([[-1.0, 1.0, -1.0]]), np.ones((1, 1)))
        check_encloses(high, 4.0)
        assert high.frequency == pytest.approx(np.pi, abs=1e-6)

    @pytest.mark.parametrize("angle", [0.01, 1.234567, 3.0])
    @pytest.mark.parametrize("damping", [1e-1, 1e-3, 1e-6])
    def test_resonance_between_zero_and_pi(self, angle, damping):
        """With x' rotated and B, C complex-diagonal the response is 1 / (z - r e^{jw}) and its conjugate."""
        found = hinf_norm(rotation(angle, 1.0 - damping), np.eye(2), np.eye(2), np.zeros((2, 2)))
        check_encloses(found, 1.0 / damping, slack=1e-9)
        assert found.frequency == pytest.approx(angle, abs=1e-6)

    def test_the_higher_of_two_narrow_peaks(self):
        """Peaks of width 1e-5, far narrower than the starting grid, and one per mille apart in height."""
        for heights in ((1.0, 1.001), (1.001, 1.0)):
            damping = 1e-5
            a = np.zeros((4, 4))
            a[:2, :2], a[2:, 2:] = rotation(0.777, 1.0 - damping), rotation(2.222, 1.0 - damping)
            c = np.kron(np.diag(heights), np.eye(2))
            found = hinf_norm(a, np.eye(4), c, np.zeros((4, 4)))
            check_encloses(found, 1.001 / damping, slack=1e-9)
            assert found.frequency == pytest.approx((0.777, 2.222)[int(np.argmax(heights))], abs=1e-6)

    @pytest.mark.long
    def test_a_peak_that_is_not_at_a_pole(self):
        """Random sums and poles far inside: the peak lies where SLICOT's iteration finds it."""
        rng = np.random.default_rng(1)
        for _ in range(300):
            realisation = random_system(rng, damping=rng.uniform(0.2, 0.9))
            check_encloses(hinf_norm(*realisation), by_slicot(*realisation), slack=2e-10)

    @pytest.mark.one_in(2)
    @pytest.mark.parametrize("damping", [1e-2, 1e-4])
    def test_against_slicot_with_poles_near_the_circle(self, damping):
        rng = np.random.default_rng(2)
        for _ in range(200):
            realisation = random_system(rng, damping=damping)
            check_encloses(hinf_norm(*realisation), by_slicot(*realisation), slack=1e-8)

    def test_against_python_control(self):
        pytest.importorskip("slycot", reason="what control computes the norm with")
        rng = np.random.default_rng(3)
        for _ in range(50):
            realisation = random_system(rng, damping=0.1)
            true, _ = control.linfnorm(control.ss(*realisation, 1.0), tol=1e-12)
            check_encloses(hinf_norm(*realisation), true, slack=1e-9)

    @pytest.mark.long
    def test_units_of_the_states_do_not_matter(self):
        """Without balancing, crossings were missed and the bound was 6e-6 too low."""
        rng = np.random.default_rng(4)
        for _ in range(500):
            a, b, c, d = random_system(rng, damping=10.0 ** rng.uniform(-3, -0.1))
            powers = np.exp2(rng.integers(-15, 16, a.shape[0]))
            plain, scaled = (
                hinf_norm(a, b, c, d),
                hinf_norm(a * powers / powers[:, None], b / powers[:, None], c * powers, d),
            )
            check_encloses(scaled, plain.value, slack=2e-9)
            check_encloses(plain, scaled.value, slack=2e-9)

    @pytest.mark.long
    def test_nothing_in_a_fine_grid_exceeds_the_upper_bound(self):
        rng = np.random.default_rng(5)
        for _ in range(100):
            realisation = random_system(rng, damping=10.0 ** rng.uniform(-3, -0.1), scaled=True)
            found = hinf_norm(*realisation)
            near = found.frequency + np.linspace(-1e-3, 1e-3, 501)
            response = frequency_response(*realisation, np.concatenate([np.linspace(0.0, np.pi, 2001), near]))
            assert np.linalg.norm(response, 2, axis=(1, 2)).max() <= found.upper * (1.0 + 1e-11)

    def test_several_inputs_and_outputs(self):
        """Two channels turned by orthogonal matrices: singular values are those of the channels."""
        rng = np.random.default_rng(6)
        left, right = (np.linalg.qr(rng.standard_normal((3, 3)))[0] for _ in range(2))
        poles, gains = np.array([0.5, -0.8, 0.3]), np.array([1.0, 2.0, 7.0])
        found = hinf_norm(np.diag(poles), right, left * gains, np.zeros((3, 3)))
        check_encloses(found, np.max(gains / (1.0 - np.abs(poles))))

    @pytest.mark.parametrize(("rows", "columns"), [(1, 3), (3, 1), (2, 2)])
    def test_feedthrough_alone(self, rows, columns):
        d = np.random.default_rng(7).standard_normal((rows, columns))
        found = hinf_norm(np.zeros((0, 0)), np.zeros((0, columns)), np.zeros((rows, 0)), d)
        assert found.value == found.upper == pytest.approx(np.linalg.norm(d, 2), rel=1e-14)

    def test_states_that_do_nothing(self):
        for b, c in ((0.0, 1.0), (1.0, 0.0), (0.0, 0.0)):
            check_encloses(hinf_norm(*system(0.5, b, c, 2.0)), 2.0)
            assert hinf_norm(*system(0.5, b, c, 0.0)).upper == 0.0

    def test_no_inputs_or_outputs(self):
        for a in (0.5, 2.0):
            assert hinf_norm(np.full((1, 1), a), np.zeros((1, 0)), np.eye(1), np.zeros((1, 0))).upper == 0.0
            assert hinf_norm(np.full((1, 1), a), np.eye(1), np.zeros((0, 1)), np.zeros((0, 1))).upper == 0.0

    @pytest.mark.parametrize("a", [1.0, -1.0, 1.0 + 1e-12, 2.0, -3.0])
    def test_not_stable(self, a):
        found = hinf_norm(*system(a, 1.0, 1.0, 0.0))
        assert found.value == found.upper == np.inf

    def test_not_stable_by_a_pair_on_the_circle(self):
        quarter = np.array([[0.0, 1.0], [-1.0, 0.0]])
        assert hinf_norm(quarter, np.eye(2), np.eye(2), np.zeros((2, 2))).upper == np.inf

    @pytest.mark.parametrize("size", [1e-150, 1e-9, 1e9, 1e140])
    def test_size_of_the_signals_does_not_matter(self, size):
        check_encloses(hinf_norm(*system(0.5, size, 1.0, size)), 3.0 * size)

    @pytest.mark.parametrize("value", [np.nan, np.inf, 1e300])
    def test_what_is_not_finite_or_overflows_has_no_bound(self, value):
        for place in range(4):
            realisation = list(system(0.5, 1e10, 1.0, 1.0))
            realisation[place] = realisation[place] * 0.0 + value
            found = hinf_norm(*realisation)
            assert found.upper == np.inf or (value == 1e300 and place > 0 and found.upper > 1e299)
        assert hinf_norm(*system(0.5, 1e200, 1e200, 0.0)).upper == np.inf

    def test_nothing_is_written_to(self):
        realisation = system(0.5, 1.0, 1.0, 0.5)
        copies = [matrix.copy() for matrix in realisation]
        for matrix in realisation:
            matrix.setflags(write=False)
        hinf_norm(*realisation)
        output_covariance(*realisation)
        assert all(np.array_equal(matrix, copy) for matrix, copy in zip(realisation, copies, strict=True))


class TestFrequencyResponse:
    def test_against_python_control(self):
        rng = np.random.default_rng(8)
        angles = np.array([0.0, 0.1, 1.0, 3.0, np.pi])
        for _ in range(50):
            realisation = random_system(rng, damping=0.05)
            expected = control.ss(*realisation, 1.0)(np.exp(1j * angles), squeeze=False)
            found = frequency_response(*realisation, angles)
            assert found.shape == (5, *realisation[3].shape)
            assert np.allclose(found, np.moveaxis(expected, 2, 0), rtol=1e-10, atol=1e-10)

    def test_is_the_transform_of_the_impulse_response(self):
        a, b, c, d = random_system(np.random.default_rng(9), damping=0.5)
        total, power = d.astype(complex), b.copy()
        for k in range(1, 200):
            total = total + c @ power * np.exp(-1j * k * 0.7)
            power = a @ power
        assert np.allclose(frequency_response(a, b, c, d, np.array([0.7]))[0], total, rtol=1e-12, atol=1e-12)

    def test_without_states_inputs_or_outputs(self):
        d = np.array([[1.0, 2.0]])
        flat = frequency_response(np.zeros((0, 0)), np.zeros((0, 2)), np.zeros((1, 0)), d, np.array([0.0, 1.0, 2.0]))
        assert np.array_equal(flat, np.broadcast_to(d, (3, 1, 2)))
        flat[0, 0, 0] = 5.0  # a copy of its own: writable
        assert d[0, 0] == 1.0
        a = np.eye(2) * 0.5
        no_inputs = frequency_response(a, np.zeros((2, 0)), np.eye(2), np.zeros((2, 0)), np.array([0.3]))
        assert no_inputs.shape == (1, 2, 0)
        no_outputs = frequency_response(a, np.eye(2), np.zeros((0, 2)), np.zeros((0, 2)), np.array([0.3]))
        assert no_outputs.shape == (1, 0, 2)


class TestOutputCovariance:
    @pytest.mark.parametrize("seed", range(20))
    def test_against_the_sum_over_the_impulse_response(self, seed):
        a, b, c, d = random_system(np.random.default_rng(seed), damping=0.1)
        total, power = d @ d.T, b.copy()
        for _ in range(2000):
            total = total + c @ power @ power.T @ c.T
            power = a @ power
        found = output_covariance(a, b, c, d)
        assert found.shape == (c.shape[0], c.shape[0])
        assert np.allclose(found, total, rtol=1e-9, atol=1e-9 * np.max(np.abs(total)))

    def test_first_order(self):
        assert output_covariance(*system(0.5, 2.0, 3.0, 1.0))[0, 0] == pytest.approx(36.0 / 0.75 + 1.0, rel=1e-14)

    def test_large_systems_and_poles_near_the_circle(self):
        poles = np.linspace(0.2, 1.0 - 1e-6, 40)
        found = output_covariance(np.diag(poles), np.eye(40), np.eye(40), np.zeros((40, 40)))
        assert np.allclose(np.diag(found), 1.0 / (1.0 - poles**2), rtol=1e-8)

    def test_without_states_or_inputs(self):
        found = output_covariance(np.zeros((0, 0)), np.zeros((0, 2)), np.zeros((1, 0)), np.array([[3.0, 4.0]]))
        assert np.array_equal(found, [[25.0]])
        silent = output_covariance(np.eye(1) * 0.5, np.zeros((1, 0)), np.eye(1), np.zeros((1, 0)))
        assert np.array_equal(silent, [[0.0]])

    def test_units_of_the_states_do_not_matter(self):
        """Without balancing, scipy's solver warned of an ill-conditioned matrix."""
        rng = np.random.default_rng(10)
        for _ in range(50):
            a, b, c, d = random_system(rng, damping=0.1)
            powers = np.exp2(rng.integers(-40, 41, a.shape[0]))
            scaled = output_covariance(a * powers / powers[:, None], b / powers[:, None], c * powers, d)
            assert np.allclose(scaled, output_covariance(a, b, c, d), rtol=1e-10, atol=0.0)

    def test_overflow_is_infinite(self):
        for b, c, d in ((1e200, 1.0, 0.0), (1.0, 1e200, 0.0), (1.0, 1.0, 1e200)):
            assert output_covariance(*system(0.5, b, c, d))[0, 0] == np.inf

    @pytest.mark.parametrize("a", [1.0, -1.0, 1.5])
    def test_not_stable(self, a):
        assert np.all(np.isinf(output_covariance(*system(a, 1.0, 1.0, 0.0))))


def test_spectral_radius():
    assert spectral_radius(np.zeros((0, 0))) == 0.0
    assert spectral_radius(np.diag([0.5, -0.75])) == 0.75
    assert spectral_radius(rotation(1.0, 0.9)) == pytest.approx(0.9, rel=1e-14)
    assert spectral_radius(np.eye(3, k=1)) == 0.0


def test_responses_in_parts_are_those_at_each_point(monkeypatch):
    rng = np.random.default_rng(3)
    a, b, c, d = rng.normal(size=(5, 5)) / 3, rng.normal(size=(5, 2)), rng.normal(size=(3, 5)), rng.normal(size=(3, 2))
    monkeypatch.setattr(modal_response, "MOST_ENTRIES_AT_ONCE", 60)
    angles = np.linspace(0.0, 3.0, 7)
    found = norms.frequency_response(a, b, c, d, angles)
    for angle, value in zip(angles, found, strict=True):
        np.testing.assert_allclose(value, c @ np.linalg.inv(np.exp(1j * angle) * np.eye(5) - a) @ b + d, atol=1e-12)
    assert norms.frequency_response(a, b, c, d, angles[:0]).shape == (0, 3, 2)
